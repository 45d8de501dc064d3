//! Pose graph: all poses of an assembly adjusted together.
//!
//! Each contact of two pieces says how one should move relative to the other, as a quadratic form in the small motion
//! (x, y, turn) at the contact (Lu and Milios 1997, *Globally consistent range scan alignment*). The sum over all
//! contacts is minimised by one sparse Cholesky factorisation in 3 x 3 blocks, nodes eliminated by least degree (fill
//! O(n log n) on the planar graph of a puzzle). The first node of each connected part stays where it is.

use nalgebra::{Matrix3, Point2, Vector3};
use std::collections::{BTreeMap, BTreeSet};

/// A contact: the motion `d` of node `a` relative to node `b` at `centre` costs `½ dᵀ hessian d + gradientᵀ d`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Factor {
    pub(crate) a: usize,
    pub(crate) b: usize,
    pub(crate) centre: Point2<f64>,
    pub(crate) hessian: Matrix3<f64>,
    pub(crate) gradient: Vector3<f64>,
}

/// An eliminated column: inverse of its pivot, and the off-diagonal blocks with their nodes.
type Column = (Matrix3<f64>, Vec<(usize, Matrix3<f64>)>);

/// Motion (x, y, turn) at a point `to` per motion of the same body at a point `from`.
pub(crate) fn lever(from: Point2<f64>, to: Point2<f64>) -> Matrix3<f64> {
    let d = to - from;
    Matrix3::new(1.0, 0.0, -d.y, 0.0, 1.0, d.x, 0.0, 0.0, 1.0)
}

/// Motions (x, y, turn about the reference point) of all nodes that minimise the sum of the factors.
pub(crate) fn minimise(references: &[Point2<f64>], factors: &[Factor]) -> Vec<Vector3<f64>> {
    let n = references.len();
    let mut blocks: Vec<BTreeMap<usize, Matrix3<f64>>> = vec![BTreeMap::new(); n];
    let mut right = vec![Vector3::zeros(); n];
    let mut weight = 0.0f64;
    for f in factors {
        let (ja, jb) = (lever(references[f.a], f.centre), lever(references[f.b], f.centre));
        let (ha, hb) = (ja.transpose() * f.hessian, jb.transpose() * f.hessian);
        *blocks[f.a].entry(f.a).or_default() += ha * ja;
        *blocks[f.b].entry(f.b).or_default() += hb * jb;
        *blocks[f.a].entry(f.b).or_default() -= ha * jb;
        *blocks[f.b].entry(f.a).or_default() -= hb * ja;
        right[f.a] -= ja.transpose() * f.gradient;
        right[f.b] += jb.transpose() * f.gradient;
        weight = weight.max(f.hessian.diagonal().max());
    }
    // Gauge: the first node of each connected part is held; a trace of damping on the rest for slack contacts.
    let mut seen = vec![false; n];
    for root in 0..n {
        if !seen[root] {
            let mut stack = vec![root];
            seen[root] = true;
            while let Some(k) = stack.pop() {
                for &j in blocks[k].keys() {
                    if !seen[j] {
                        seen[j] = true;
                        stack.push(j);
                    }
                }
            }
            *blocks[root].entry(root).or_default() += Matrix3::identity() * (1e6 * weight.max(1.0));
        }
        *blocks[root].entry(root).or_default() += Matrix3::identity() * (1e-9 * weight.max(1e-9));
    }
    let mut queue: BTreeSet<(usize, usize)> = blocks.iter().enumerate().map(|(k, b)| (b.len(), k)).collect();
    let mut order = Vec::with_capacity(n);
    let mut columns: Vec<Column> = Vec::with_capacity(n);
    while let Some((_, k)) = queue.pop_first() {
        let mut row = std::mem::take(&mut blocks[k]);
        let pivot = row.remove(&k).unwrap_or_default();
        let inverse = pivot.try_inverse().unwrap_or_default();
        let others: Vec<(usize, Matrix3<f64>)> = row.into_iter().collect();
        for (i, _) in &others {
            queue.remove(&(blocks[*i].len(), *i));
        }
        for (i, a_ki) in &others {
            let scaled = a_ki.transpose() * inverse;
            for (j, a_kj) in &others {
                *blocks[*i].entry(*j).or_default() -= scaled * a_kj;
            }
            blocks[*i].remove(&k);
            let pivot_right = right[k];
            right[*i] -= scaled * pivot_right;
        }
        for (i, _) in &others {
            queue.insert((blocks[*i].len(), *i));
        }
        order.push(k);
        columns.push((inverse, others));
    }
    let mut motion = vec![Vector3::zeros(); n];
    for (k, (inverse, others)) in order.into_iter().zip(columns).rev() {
        let mut v = right[k];
        for (j, a_kj) in others {
            v -= a_kj * motion[j];
        }
        motion[k] = inverse * v;
    }
    motion
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
        let motion = minimise(&references, &factors);
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
