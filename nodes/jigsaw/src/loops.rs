//! Loop closure: which candidates are supported by the pieces that meet round a corner.
//!
//! Where four pieces meet, two ways lead from one piece to the one across: over the left and over the right
//! neighbour. For true matings the two poses agree to a fraction of a percent of the piece scale; for false ones
//! agreement is chance. Three pieces round a corner (brickwork, mosaics) close the same way. A loop is a set of three
//! or four candidates whose poses agree, each piece entering and leaving by different isthmuses.
//!
//! Complexity O(pieces · degree²) for the two-step ways, which are compared only where they meet. The tolerance is
//! calibrated from the loops themselves: among the best candidates of each mouth, true closures crowd near zero.

use crate::outline::Outline;
use nalgebra::{Isometry2, Vector2};

/// A candidate mating as the assembly sees it: pieces are ranks by id.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Edge {
    /// Piece with the tab, and position in its `tabs`.
    pub(crate) a: usize,
    pub(crate) tab: usize,
    /// Piece with the mouth, and position in its `mouths`.
    pub(crate) b: usize,
    pub(crate) mouth: usize,
    pub(crate) b_from_a: Isometry2<f64>,
    /// Logarithmic cost; less is better.
    pub(crate) cost: f64,
    /// Place among the candidates of the mouth and of the tab, 0 the best.
    pub(crate) mouth_rank: usize,
    pub(crate) tab_rank: usize,
    /// Loops it takes part in.
    pub(crate) support: usize,
}

/// One isthmus of one piece.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) struct Slot {
    pub(crate) piece: usize,
    pub(crate) tab: bool,
    pub(crate) index: usize,
}

impl Edge {
    pub(crate) fn slots(&self) -> [Slot; 2] {
        [Slot { piece: self.a, tab: true, index: self.tab }, Slot { piece: self.b, tab: false, index: self.mouth }]
    }
}

/// Whether two isthmuses of one piece claim the same stretch of border: more than half of the shorter one.
pub(crate) fn conflict(outline: &Outline, p: Slot, q: Slot) -> bool {
    if p.piece != q.piece {
        return false;
    }
    if p == q {
        return true;
    }
    let segment = |s: Slot| if s.tab { &outline.tabs[s.index] } else { &outline.mouths[s.index] };
    let (p, q) = (segment(p), segment(q));
    let length = outline.length;
    // Overlap of two arcs of a circle: one begins inside the other.
    let ahead = (q.arc - p.arc).rem_euclid(length);
    let behind = (p.arc - q.arc).rem_euclid(length);
    let shared = if ahead < p.path {
        (p.path - ahead).min(q.path)
    } else if behind < q.path {
        (q.path - behind).min(p.path)
    } else {
        0.0
    };
    shared > 0.5 * p.path.min(q.path)
}

/// A closed loop: its candidates, and how far it fails to close, as a fraction of the tolerance.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Loop {
    pub(crate) edges: Vec<usize>,
    pub(crate) error: f64,
}

/// How far the two ways may differ: position in piece scales, angle in radians.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Tolerance {
    pub(crate) position: f64,
    pub(crate) angle: f64,
}

/// A step or two from one piece to another.
#[derive(Clone, Copy)]
struct Way {
    to: usize,
    via: Option<usize>,
    pose: Isometry2<f64>,
    edges: [usize; 2],
    leaves: Slot,
    arrives: Slot,
}

/// How far two poses of a piece are apart: of its centroid in piece scales, and in angle.
pub(crate) fn difference(outline: &Outline, p: &Isometry2<f64>, q: &Isometry2<f64>) -> (f64, f64) {
    let d: Vector2<f64> = p * outline.centroid - q * outline.centroid;
    (d.norm() / outline.scale, p.rotation.angle_to(&q.rotation).abs())
}

/// All loops of the candidates `active` (positions in `edges`).
pub(crate) fn find(edges: &[Edge], active: &[usize], outlines: &[&Outline], tolerance: Tolerance) -> Vec<Loop> {
    let n = outlines.len();
    let mut ways: Vec<Vec<Way>> = vec![Vec::new(); n];
    for &k in active {
        let e = &edges[k];
        let [tab, mouth] = e.slots();
        let way = |to, pose, leaves, arrives| Way { to, via: None, pose, edges: [k, k], leaves, arrives };
        ways[e.b].push(way(e.a, e.b_from_a, mouth, tab));
        ways[e.a].push(way(e.b, e.b_from_a.inverse(), tab, mouth));
    }
    use rayon::prelude::*;
    let found: Vec<Vec<Loop>> = (0..n).into_par_iter().map(|a| loops_from(a, &ways, outlines, tolerance)).collect();
    found.into_iter().flatten().collect()
}

/// The loops in which `a` has the least rank.
fn loops_from(a: usize, ways: &[Vec<Way>], outlines: &[&Outline], tolerance: Tolerance) -> Vec<Loop> {
    let mut long: Vec<Way> = Vec::new();
    for first in ways[a].iter().filter(|w| w.to > a) {
        long.push(*first);
        for second in ways[first.to].iter().filter(|w| w.to > a && w.to != first.to) {
            if conflict(outlines[first.to], first.arrives, second.leaves) {
                continue;
            }
            long.push(Way {
                to: second.to,
                via: Some(first.to),
                pose: first.pose * second.pose,
                edges: [first.edges[0], second.edges[0]],
                leaves: first.leaves,
                arrives: second.arrives,
            });
        }
    }
    long.sort_by_key(|w| w.to);
    let mut found = Vec::new();
    for group in long.chunk_by(|p, q| p.to == q.to) {
        if group.len() < 2 {
            continue;
        }
        let outline = outlines[group[0].to];
        // Sorted by x the comparison stays near the diagonal.
        let mut placed: Vec<(f64, &Way)> = group.iter().map(|w| ((w.pose * outline.centroid).x, w)).collect();
        placed.sort_by(|p, q| p.0.total_cmp(&q.0).then(p.1.edges.cmp(&q.1.edges)));
        let reach = tolerance.position * outline.scale;
        for (i, (x, p)) in placed.iter().enumerate() {
            for (y, q) in &placed[i + 1..] {
                if y - x > reach {
                    break;
                }
                let triangle = match (p.via, q.via) {
                    (None, None) => continue,
                    (Some(u), Some(v)) if u == v => continue,
                    (Some(_), Some(_)) => false,
                    // A triangle is seen from `a` twice; take it once.
                    (Some(v), None) | (None, Some(v)) if v > p.to => true,
                    _ => continue,
                };
                if conflict(outlines[a], p.leaves, q.leaves) || conflict(outline, p.arrives, q.arrives) {
                    continue;
                }
                let (d, turn) = difference(outline, &p.pose, &q.pose);
                if d > tolerance.position || turn > tolerance.angle {
                    continue;
                }
                let mut members = vec![p.edges[0], q.edges[0]];
                if triangle {
                    let long = if p.via.is_some() { p } else { q };
                    members = vec![if p.via.is_some() { q.edges[0] } else { p.edges[0] }, long.edges[0], long.edges[1]];
                } else {
                    members.extend([p.edges[1], q.edges[1]]);
                }
                let error = (d / tolerance.position).hypot(turn / tolerance.angle);
                found.push(Loop { edges: members, error });
            }
        }
    }
    found
}
