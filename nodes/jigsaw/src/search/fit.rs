//! How well a piece fits in a place: by its whole border, not by its isthmuses alone.
//!
//! 1. *First sight*: how much of its border has another near, and how deep it lies in others. Most places are too open, or
//!    taken, and are left at that.
//! 2. *Settle*: the pose is adjusted to all contacts of the outlines there, the assembly held.
//! 3. *Misfit*: mean distance, clearance and a small strain of the piece taken off, between its border and the nearest
//!    border of the assembly, wherever one runs along it: overlap, underlap and misfit in one figure (the paper's GAP
//!    over path length). A few points tell first whether it is worth all of them.
//!
//! Complexity O(neighbours · border).

use super::Assembler;
use super::adjust::COARSE;
use super::learn::spread_of;
use crate::posegraph::{self, Factor};
use isthmus::Point;
use nalgebra::{Isometry2, Matrix6, Vector2, Vector6};

/// Border farther than this from any other, in piece scales, lies open and says nothing.
const NEAR: f64 = 0.12;
/// Distances count at most this, in piece scales: one corner that is off shall not hide that all else fits.
const CAP: f64 = 0.05;
/// Borders that follow one another have opposite normals, to 60° (cosine): elsewhere they part at a corner.
const TURNED: f64 = -0.5;
/// Part of the border that follows another by which a piece is judged: frays and rounded corners may be off.
const FOLLOWS: f64 = 0.9;
/// Part of a piece's border that must follow others: more than a side, for what leads to a place fits on one side always.
const LEAST_SHARE: f64 = 0.4;
/// Border points along a piece scale that are looked at to see whether a place is worth more.
const SIGHT_STEPS: f64 = 8.0;
/// An overlap at first sight, in squared piece scales, that settling doesn't mend: poses move by a few hundredths of a
/// scale.
const HOPELESS: f64 = 0.1;
/// One in so many points tells the cost to within this (natural logarithm): enough for most, which are far off.
const GLANCE: f64 = 4.0;
const DOUBT: f64 = 0.7;
/// Adjustments at most until a pose has settled, that is, moves by less than this, in piece scales and radians.
const ROUNDS: usize = 4;
const SETTLED: f64 = 0.001;
/// Pieces are strained by about so much: flatbed scanners measure one axis 0.6 % longer, card swells, rows of a scan are
/// 2 % off where the carriage jerks.
pub(super) const STRAIN: f64 = 0.01;

/// A piece of an island that is taken to be away, and with it all that lie, as seen from there, in other directions than
/// one of its neighbours: so many (cosine of the angle between) that the gap is as open as that at a rim.
#[derive(Debug, Clone, Copy)]
pub(super) struct Away {
    pub(super) piece: usize,
    pub(super) towards: usize,
    pub(super) cosine: f64,
}

/// A piece in a place of an island that isn't too open, in the pose (island from image) that a candidate says.
#[derive(Debug, Clone)]
pub(super) struct Place {
    pub(super) piece: usize,
    pub(super) edge: usize,
    pub(super) island: usize,
    pose: Isometry2<f64>,
    /// Pieces of the island that it may touch.
    beside: Vec<usize>,
    /// Part of its border that has another near, whichever way that runs, and greatest overlap.
    share: f64,
    overlap: f64,
}

/// How badly a piece fits in a place.
#[derive(Debug, Clone, Copy)]
pub(super) struct Misfit {
    /// Logarithm of the mean gap.
    pub(super) cost: f64,
    /// Part of the border that has another near, at first sight: how enclosed the place is.
    pub(super) share: f64,
    /// Greatest overlap with another piece, in squared piece scales.
    pub(super) overlap: f64,
}

/// Where a piece's border has another near: place about the centroid, normal of the other border, and gap, clearance
/// taken off, in the piece's own axes.
struct Touch {
    at: Vector2<f64>,
    normal: Vector2<f64>,
    gap: f64,
}

impl Touch {
    /// How the gap grows with the motion (x, y, turn) and the strain (along x, along y, shear) of the piece.
    fn slope(&self) -> Vector6<f64> {
        let (r, n) = (self.at, self.normal);
        Vector6::new(n.x, n.y, r.x * n.y - r.y * n.x, r.x * n.x, r.y * n.y, r.y * n.x + r.x * n.y)
    }
}

/// The gaps that are left when a piece is moved, stretched and sheared a little to close them: robust least squares by
/// reweighting, with a prior on the strain.
fn unstrained(touches: &[Touch]) -> Vec<f64> {
    let mut gaps: Vec<f64> = touches.iter().map(|t| t.gap).collect();
    for _ in 0..ROUNDS {
        let (middle, spread) = spread_of(&mut gaps.clone());
        let width = (3.0 * spread).max(f64::MIN_POSITIVE);
        let mut h = Matrix6::from_diagonal(&Vector6::new(0.0, 0.0, 0.0, 1.0, 1.0, 1.0)) * (spread / STRAIN).powi(2);
        let mut g = Vector6::zeros();
        for (touch, gap) in touches.iter().zip(&gaps) {
            let weight = 1.0 / (1.0 + ((gap - middle) / width).powi(2)).powi(2);
            let slope = touch.slope();
            h += slope * slope.transpose() * weight;
            g -= slope * (weight * touch.gap);
        }
        let Some(motion) = h.cholesky().map(|h| h.solve(&g)) else { break };
        gaps = touches.iter().map(|t| t.gap + t.slope().dot(&motion)).collect();
    }
    gaps
}

impl Assembler<'_> {
    /// A piece of a candidate where the other one says it belongs, as if some pieces weren't there; `None` where that is too
    /// open.
    pub(super) fn place_of(&self, edge: usize, piece: usize, away: Option<Away>) -> Option<Place> {
        let e = &self.edges[edge];
        let (held, pose) = if piece == e.a {
            (e.b, self.state.pose(e.b) * e.b_from_a)
        } else {
            (e.a, self.state.pose(e.a) * e.b_from_a.inverse())
        };
        let island = self.state.island(held);
        let beside = self.beside(piece, island, away, &pose);
        let seen = self.seen_from(&beside, &pose);
        let share = self.share_at_first_sight(piece, &seen);
        if share < LEAST_SHARE {
            return None;
        }
        let overlap = self.greatest_overlap(piece, &seen);
        Some(Place { piece, edge, island, pose, beside, share, overlap })
    }

    /// The pose in which a piece fits best in a place, and how badly. What costs more than `most`, or overlaps for good,
    /// costs infinitely much; `None` where it hardly touches anything.
    pub(super) fn fit(&self, place: &Place, most: f64) -> Option<(Isometry2<f64>, Misfit)> {
        let out = Misfit { cost: f64::INFINITY, share: place.share, overlap: place.overlap };
        if place.overlap > HOPELESS {
            return Some((place.pose, out));
        }
        let pose = self.settled(place);
        let seen = self.seen_from(&place.beside, &pose);
        if most.is_finite()
            && self.gap_cost(place.piece, &seen, GLANCE * COARSE).is_some_and(|cost| cost > most + DOUBT)
        {
            return Some((pose, out));
        }
        let cost = self.gap_cost(place.piece, &seen, COARSE)?;
        Some((pose, Misfit { cost, share: place.share, overlap: self.greatest_overlap(place.piece, &seen) }))
    }

    /// What a piece costs where it lies.
    pub(super) fn cost_of_placed(&self, piece: usize) -> Option<f64> {
        let pose = self.state.pose(piece);
        let beside = self.beside(piece, self.state.island(piece), None, pose);
        self.gap_cost(piece, &self.seen_from(&beside, pose), COARSE)
    }

    /// Pieces of an island, but for those away, near enough to touch a piece in a pose, or in one a little off.
    fn beside(&self, piece: usize, island: usize, away: Option<Away>, pose: &Isometry2<f64>) -> Vec<usize> {
        let centre = pose * self.outlines[piece].centroid;
        let reach = self.outlines[piece].radius + 2.0 * NEAR * self.scale;
        let near = |q: &usize| (self.centre_of(*q) - centre).norm() <= reach + self.outlines[*q].radius;
        let there = |q: &usize| {
            away.is_none_or(|away| {
                let [to, other] = [away.towards, *q].map(|k| self.centre_of(k) - self.centre_of(away.piece));
                *q != away.piece && to.dot(&other) >= away.cosine * to.norm() * other.norm()
            })
        };
        self.state.members(island).filter(|q| *q != piece).filter(near).filter(there).collect()
    }

    /// Part of the border of a piece that has another near, of those from which it is seen in some poses.
    fn share_at_first_sight(&self, piece: usize, seen: &[(usize, Isometry2<f64>)]) -> f64 {
        let outline = self.outlines[piece];
        let stride = ((outline.scale / SIGHT_STEPS / outline.spacing) as usize).max(1);
        let near = NEAR * self.scale;
        let has_near = |p: &&Point| {
            seen.iter().any(|(q, q_from_piece)| {
                let raster = &self.outlines[*q].raster;
                raster.cell_of(q_from_piece * **p).is_some_and(|cell| f64::from(raster.distance[cell]) <= near)
            })
        };
        let points = outline.points.iter().step_by(stride);
        points.clone().filter(has_near).count() as f64 / points.len() as f64
    }

    /// Pieces, and a pose as seen from each of them.
    fn seen_from(&self, pieces: &[usize], pose: &Isometry2<f64>) -> Vec<(usize, Isometry2<f64>)> {
        pieces.iter().map(|q| (*q, self.state.pose(*q).inverse() * pose)).collect()
    }

    /// Greatest overlap of a piece with others from which it is seen in some poses, in squared piece scales.
    fn greatest_overlap(&self, piece: usize, seen: &[(usize, Isometry2<f64>)]) -> f64 {
        let outline = self.outlines[piece];
        let overlap = |(q, q_from_piece): &(usize, Isometry2<f64>)| {
            let other = self.outlines[*q];
            self.memory.overlap(outline, other, q_from_piece) / (outline.scale * other.scale)
        };
        seen.iter().map(overlap).fold(0.0, f64::max)
    }

    /// The pose of a piece adjusted to all contacts in its place, the others held.
    fn settled(&self, place: &Place) -> Isometry2<f64> {
        let mut pose = place.pose;
        for _ in 0..ROUNDS {
            let contact = |q: &usize| self.factor((place.piece, 1), (*q, 0), &[pose, *self.state.pose(*q)], COARSE);
            let factors: Vec<Factor> = place.beside.iter().filter_map(contact).collect();
            let centre = pose * self.outlines[place.piece].centroid;
            let Some(motion) = posegraph::settle(centre, &factors) else { break };
            pose = self.moved(place.piece, &pose, &motion);
            if motion.xy().norm() < SETTLED * self.scale && motion.z.abs() < SETTLED {
                break;
            }
        }
        pose
    }

    /// Logarithm of the mean gap of a piece to others from which it is seen in some poses, looked at from a point each
    /// `step` scales; `None` where it hardly touches any.
    fn gap_cost(&self, piece: usize, seen: &[(usize, Isometry2<f64>)], step: f64) -> Option<f64> {
        let outline = self.outlines[piece];
        let stride = ((outline.scale * step / outline.spacing) as usize).max(1);
        let (near, cap) = (NEAR * self.scale, CAP * self.scale);
        let touch = |(p, own): (&Point, &Vector2<f32>)| {
            let gaps = seen.iter().filter_map(|(q, q_from_piece)| {
                let (gap, normal) = self.outlines[*q].gap(q_from_piece * p, near)?;
                Some((gap, q_from_piece.rotation.inverse() * normal))
            });
            let (gap, normal) = gaps.min_by(|a, b| a.0.abs().total_cmp(&b.0.abs()))?;
            let follows = normal.dot(&own.cast::<f64>()) < TURNED;
            // Where it runs inside another piece it doesn't follow, but it is no corner either.
            (follows || gap < 0.0).then(|| Touch { at: p - outline.centroid, normal, gap: gap - self.prior.mean })
        };
        let touches: Vec<Touch> =
            outline.points.iter().zip(&outline.normals).step_by(stride).filter_map(touch).collect();
        if (touches.len() as f64) < LEAST_SHARE * outline.points.len().div_ceil(stride) as f64 {
            return None;
        }
        let mut gaps: Vec<f64> = unstrained(&touches).into_iter().map(|g| g.abs().min(cap)).collect();
        gaps.sort_by(f64::total_cmp);
        gaps.truncate((FOLLOWS * gaps.len() as f64).ceil() as usize);
        Some((gaps.iter().sum::<f64>() / gaps.len() as f64).max(1e-4).ln())
    }
}
