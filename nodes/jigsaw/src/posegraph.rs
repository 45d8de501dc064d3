//! Pose graph: all poses of an assembly adjusted together.
//!
//! Each contact of two pieces says how one should move relative to the other, as a quadratic form in the small motion
//! (x, y, turn) at the contact (Lu and Milios 1997, *Globally consistent range scan alignment*). The sum over all
//! contacts is minimised by one sparse Cholesky factorisation in 3 x 3 blocks, nodes eliminated in the order of minimum degree
//! (Tinney and Walker 1967; about O(n log n) of fill on the planar graph of a puzzle). The first node of each connected part
//! stays where it is.

use isthmus::wide::widely;
use nalgebra::{Matrix3, Point2, UnitComplex, Vector2, Vector3};

/// A contact: the motion `d` of node `a` relative to node `b` at `centre` costs `½ dᵀ hessian d + gradientᵀ d`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Factor {
    pub(crate) a: usize,
    pub(crate) b: usize,
    pub(crate) centre: Point2<f64>,
    pub(crate) hessian: Matrix3<f64>,
    pub(crate) gradient: Vector3<f64>,
}

/// Motion (x, y, turn) at a point `to` per motion of the same body at a point `from`.
pub(crate) fn lever(from: Point2<f64>, to: Point2<f64>) -> Matrix3<f64> {
    let d = to - from;
    Matrix3::new(1.0, 0.0, -d.y, 0.0, 1.0, d.x, 0.0, 0.0, 1.0)
}

/// A matrix times [`lever`] of an arm, most of which is zeros and ones.
fn levered(mut matrix: Matrix3<f64>, arm: Vector2<f64>) -> Matrix3<f64> {
    let turn = matrix.column(0) * -arm.y + matrix.column(1) * arm.x + matrix.column(2);
    matrix.set_column(2, &turn);
    matrix
}

/// A turn of the axes in which a small motion (x, y, turn) is given.
pub(crate) fn turned(rotation: UnitComplex<f64>) -> Matrix3<f64> {
    rotation.to_rotation_matrix().to_homogeneous()
}

/// Motion (x, y, turn about the reference point) of one node, the `a` of all factors, that minimises their sum while all
/// others are held; `None` if they leave it open.
pub(crate) fn settle(reference: Point2<f64>, factors: &[Factor]) -> Option<Vector3<f64>> {
    let (mut hessian, mut right) = (Matrix3::zeros(), Vector3::zeros());
    for f in factors {
        let j = lever(reference, f.centre);
        hessian += j.transpose() * f.hessian * j;
        right -= j.transpose() * f.gradient;
    }
    hessian.cholesky().map(|h| h.solve(&right))
}

/// In which order nodes are eliminated, and between which of them blocks then stand: a matter of which nodes factors
/// connect, not of what they say, so that it serves as long as no others are connected.
#[derive(Debug, Clone)]
pub(crate) struct Plan {
    order: Vec<usize>,
    /// Place of each node in the order.
    place: Vec<usize>,
    /// For each place where its row of blocks begins, and for each block the later place, in order.
    starts: Vec<usize>,
    columns: Vec<usize>,
}

impl Plan {
    /// So many nodes; of those left the one with the fewest neighbours is eliminated first.
    pub(crate) fn new(n: usize, factors: &[Factor]) -> Self {
        /// Neighbours of a piece in a grid, and as many again that elimination brings.
        const NEIGHBOURS: usize = 16;
        let mut around: Vec<Vec<usize>> = (0..n).map(|_| Vec::with_capacity(NEIGHBOURS)).collect();
        for f in factors.iter().filter(|f| f.a != f.b) {
            around[f.a].push(f.b);
            around[f.b].push(f.a);
        }
        let mut of_degree: Vec<Vec<usize>> = vec![Vec::new(); n];
        for (node, others) in around.iter().enumerate() {
            of_degree[others.len()].push(node);
        }
        let (mut order, mut rows) = (Vec::with_capacity(n), Vec::with_capacity(n));
        let mut gone = vec![false; n];
        // Of each node the last one that was seen beside it: whom it is beside, it stays beside.
        let mut beside = vec![n; n];
        let mut least = 0;
        while order.len() < n {
            let Some(node) = of_degree[least].pop() else {
                least += 1;
                continue;
            };
            if gone[node] || around[node].len() != least {
                continue;
            }
            gone[node] = true;
            // What is connected through the node is connected without it.
            let row = std::mem::take(&mut around[node]);
            for &other in &row {
                let others = &mut around[other];
                others.retain(|k| *k != node);
                others.iter().for_each(|k| beside[*k] = other);
                beside[other] = other;
                others.extend(row.iter().filter(|k| beside[**k] != other));
                of_degree[others.len()].push(other);
                least = least.min(others.len());
            }
            order.push(node);
            rows.push(row);
        }
        let mut place = vec![0; n];
        for (k, node) in order.iter().enumerate() {
            place[*node] = k;
        }
        let (mut starts, mut columns) = (vec![0], Vec::new());
        for row in &mut rows {
            row.iter_mut().for_each(|node| *node = place[*node]);
            row.sort_unstable();
            columns.extend_from_slice(row);
            starts.push(columns.len());
        }
        Self { order, place, starts, columns }
    }

    /// Whether the plan was made for as many nodes, and has a block for each of the factors.
    pub(crate) fn suits(&self, n: usize, factors: &[Factor]) -> bool {
        self.order.len() == n && factors.iter().all(|f| f.a == f.b || self.block(f).is_some())
    }

    /// Where the block between the nodes of a factor stands.
    fn block(&self, factor: &Factor) -> Option<usize> {
        let (a, b) = (self.place[factor.a], self.place[factor.b]);
        let (first, second) = (a.min(b), a.max(b));
        let row = &self.columns[self.starts[first]..self.starts[first + 1]];
        row.binary_search(&second).ok().map(|k| self.starts[first] + k)
    }

    /// Motions (x, y, turn about the reference points) of all nodes that minimise the sum of factors, which the plan suits.
    pub(crate) fn minimise(&self, references: &[Point2<f64>], factors: &[Factor]) -> Vec<Vector3<f64>> {
        let n = self.order.len();
        // From here on nodes go by their place in the order.
        let mut pivots = vec![Matrix3::zeros(); n];
        let mut right = vec![Vector3::zeros(); n];
        let mut blocks = vec![Matrix3::zeros(); self.columns.len()];
        let row = |k: usize| self.starts[k]..self.starts[k + 1];
        let mut weight = 0.0f64;
        for f in factors {
            let [arm_a, arm_b] = [f.a, f.b].map(|k| f.centre - references[k]);
            let [ha, hb] = [arm_a, arm_b].map(|arm| levered(f.hessian.transpose(), arm).transpose());
            let (a, b) = (self.place[f.a], self.place[f.b]);
            pivots[a] += levered(ha, arm_a);
            pivots[b] += levered(hb, arm_b);
            if let Some(k) = self.block(f) {
                blocks[k] -= if a < b { levered(ha, arm_b) } else { levered(hb, arm_a) };
            }
            right[a] -= lever(references[f.a], f.centre).tr_mul(&f.gradient);
            right[b] += lever(references[f.b], f.centre).tr_mul(&f.gradient);
            weight = weight.max(f.hessian.diagonal().max());
        }
        // Gauge: the first node of each connected part is held; a trace of damping on the rest for slack contacts.
        for root in roots(n, factors) {
            pivots[self.place[root]] += Matrix3::identity() * (1e6 * weight.max(1.0));
        }
        let damping = Matrix3::identity() * (1e-9 * weight.max(1e-9));
        widely!(self.eliminate(damping, &mut pivots, &mut right, &mut blocks));
        let mut motion = vec![Vector3::zeros(); n];
        for k in (0..n).rev() {
            let known = row(k).map(|at| blocks[at] * motion[self.order[self.columns[at]]]);
            motion[self.order[k]] = pivots[k] * known.fold(right[k], |sum, known| sum - known);
        }
        motion
    }

    #[inline(always)]
    fn eliminate(
        &self,
        damping: Matrix3<f64>,
        pivots: &mut [Matrix3<f64>],
        right: &mut [Vector3<f64>],
        blocks: &mut [Matrix3<f64>],
    ) {
        let row = |k: usize| self.starts[k]..self.starts[k + 1];
        for k in 0..self.order.len() {
            let inverse = (pivots[k] + damping).try_inverse().unwrap_or_default();
            pivots[k] = inverse;
            let pivot_right = right[k];
            for at in row(k) {
                let (i, block) = (self.columns[at], blocks[at]);
                let scaled = block.transpose() * inverse;
                pivots[i] -= scaled * block;
                right[i] -= scaled * pivot_right;
                // The rest of this row is among the blocks of that one; both are in order.
                let mut others = row(i);
                for rest in at + 1..self.starts[k + 1] {
                    if let Some(other) = others.find(|other| self.columns[*other] == self.columns[rest]) {
                        let fill = scaled * blocks[rest];
                        blocks[other] -= fill;
                    }
                }
            }
        }
    }
}

/// The least node of each part that factors connect.
fn roots(n: usize, factors: &[Factor]) -> Vec<usize> {
    let mut parts: Vec<usize> = (0..n).collect();
    let root = |parts: &mut Vec<usize>, mut k: usize| {
        while parts[k] != k {
            parts[k] = parts[parts[k]];
            k = parts[k];
        }
        k
    };
    for f in factors {
        let (a, b) = (root(&mut parts, f.a), root(&mut parts, f.b));
        parts[a.max(b)] = a.min(b);
    }
    (0..n).filter(|k| parts[*k] == *k).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The minimum is where the gradient vanishes: checked on a ring with contradicting contacts.
    #[test]
    fn the_gradient_vanishes_at_the_minimum() {
        let references: Vec<_> = (0..6).map(|k| Point2::new(f64::from(k) * 3.0, f64::from(k * k % 5))).collect();
        let factors: Vec<_> = (0..6)
            .map(|k| {
                let t = k as f64;
                let j = Matrix3::new(1.0, 0.2 * t, 0.1, 0.0, 2.0, 0.3, 0.0, 0.1, 1.5);
                Factor {
                    a: k,
                    b: (k + 1) % 6,
                    centre: Point2::new(t, -t),
                    hessian: j.transpose() * j,
                    gradient: Vector3::new(0.1 * t, -0.3, 0.05 * t),
                }
            })
            .collect();
        let motion = Plan::new(references.len(), &factors).minimise(&references, &factors);
        let mut gradient = vec![Vector3::<f64>::zeros(); 6];
        for f in &factors {
            let (ja, jb) = (lever(references[f.a], f.centre), lever(references[f.b], f.centre));
            let force = f.hessian * (ja * motion[f.a] - jb * motion[f.b]) + f.gradient;
            gradient[f.a] += ja.transpose() * force;
            gradient[f.b] -= jb.transpose() * force;
        }
        assert!(gradient.iter().all(|g| g.norm() < 1e-6), "{gradient:?}");
        assert!(motion[0].norm() < 1e-5, "the first node is held");
    }
}
