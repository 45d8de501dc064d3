//! Joining: when a candidate may become a mating, and what becomes of the islands of its pieces.
//!
//! A candidate is admissible if no mating has taken either stretch of border and, within an island, if the poses say
//! the same as it does; it joins two islands if their outlines don't overlap where it lays them. Loops are joined whole
//! or not at all. The smaller island moves; as islands grow they are adjusted.

use super::Assembler;
use super::adjust::COARSE;
use crate::Policy;
use crate::loops::{self, Tolerance};
use crate::placement;
use crate::slots::Slot;
use nalgebra::{Isometry2, Point2, Vector2};

/// Overlap of two pieces that can't be a matter of drift or clearance, in squared piece scales.
pub(super) const OVERLAP: f64 = 0.02;
/// The same for poses that are not refined, which are off by a degree.
const UNREFINED_OVERLAP: f64 = 0.05;
/// Pose agreement of candidates with an island that has been adjusted.
const AGREE: Tolerance = Tolerance { position: 0.05, angle: 0.08 };
/// So little is always agreement: adjusted islands drift by it.
const MIN_AGREE: Tolerance = Tolerance { position: 0.015, angle: 0.02 };

impl Assembler<'_> {
    pub(super) fn islands(&mut self, found: &[loops::Loop]) {
        for l in found {
            if self.late() {
                return;
            }
            let mut order = l.edges.clone();
            order.sort_by(|p, q| self.edges[*p].cost.total_cmp(&self.edges[*q].cost).then(p.cmp(q)));
            // All or nothing: a loop of which one candidate contradicts is no evidence for the others.
            if order.iter().any(|k| !self.admissible(*k)) {
                continue;
            }
            self.state.begin();
            let joined = order.iter().all(|k| self.join(*k));
            self.state.end(joined);
        }
    }

    pub(super) fn same_island(&self, k: usize) -> bool {
        let e = &self.edges[k];
        self.state.island(e.a) == self.state.island(e.b)
    }

    /// Whether one of a candidate's pieces has been set aside.
    pub(super) fn waits(&self, k: usize) -> bool {
        self.aside[self.edges[k].a] || self.aside[self.edges[k].b]
    }

    /// Whether no other mating has taken either stretch of border, and its pieces don't wait.
    pub(super) fn free(&self, k: usize) -> bool {
        !self.waits(k) && self.edges[k].slots.iter().all(|s| self.open(*s, Some(k)))
    }

    /// Whether no mating (`but` one) has taken an isthmus or one that claims the same stretch of border.
    pub(super) fn open(&self, slot: Slot, but: Option<usize>) -> bool {
        let taken = |other: &Slot| self.state.mating_at(*other).is_some_and(|j| Some(j) != but);
        !self.slots.rivals(slot).iter().any(taken)
    }

    /// Whether a candidate is a mating.
    pub(super) fn holds(&self, k: usize) -> bool {
        self.state.mating_at(self.edges[k].slots[0]) == Some(k)
    }

    pub(super) fn admissible(&self, k: usize) -> bool {
        if !self.free(k) {
            return false;
        }
        !self.same_island(k) || self.agrees(k)
    }

    /// Whether the poses of its pieces, in one island, say the same as the candidate.
    pub(super) fn agrees(&self, k: usize) -> bool {
        let e = &self.edges[k];
        let actual = self.state.pose(e.b).inverse() * self.state.pose(e.a);
        let within = |t: Tolerance| t.allows(self.outlines[e.a], &actual, &e.b_from_a);
        within(MIN_AGREE)
            || (within(AGREE) && self.closure.admits(&loops::deviation(e, &actual, self.outlines[e.a].centroid)))
    }

    /// Joins the islands of a candidate; false if they contradict.
    pub(super) fn join(&mut self, k: usize) -> bool {
        if !self.admissible(k) {
            return false;
        }
        if self.same_island(k) {
            self.take(k);
            return true;
        }
        let e = &self.edges[k];
        let (ia, ib) = (self.state.island(e.a), self.state.island(e.b));
        let b_from_a = self.state.pose(e.b) * e.b_from_a * self.state.pose(e.a).inverse();
        if !self.merge(ia, ib, &b_from_a) {
            return false;
        }
        self.take(k);
        true
    }

    /// Joins two islands in the pose that suits all of several candidates best.
    pub(super) fn join_by_all(&mut self, members: &[usize]) -> bool {
        let (ia, ib, pose) = self.common_pose(members);
        if ia == ib || !self.merge(ia, ib, &pose) {
            return false;
        }
        self.take(members[0]);
        true
    }

    /// The islands that some candidates would join, and the pose of the first in the second that suits them best.
    pub(super) fn common_pose(&self, members: &[usize]) -> (usize, usize, Isometry2<f64>) {
        let first = &self.edges[members[0]];
        let (ia, ib) = (self.state.island(first.a), self.state.island(first.b));
        let (mut here, mut there) = (Vec::new(), Vec::new());
        for &k in members {
            let e = &self.edges[k];
            let centre = self.slots.segment(e.slots[0]).origin;
            for (dx, dy) in [(0.3, 0.0), (-0.3, 0.0), (0.0, 0.3), (0.0, -0.3)] {
                let p = centre + Vector2::new(dx, dy) * self.scale;
                let (in_a, in_b) = (self.state.pose(e.a) * p, self.state.pose(e.b) * (e.b_from_a * p));
                let forward = self.state.island(e.a) == ia;
                here.push(if forward { in_a } else { in_b });
                there.push(if forward { in_b } else { in_a });
            }
        }
        (ia, ib, placement::rigid_fit(&here, &there))
    }

    /// Where a piece's centroid lies in its island.
    pub(super) fn centre_of(&self, piece: usize) -> Point2<f64> {
        self.state.pose(piece) * self.outlines[piece].centroid
    }

    pub(super) fn take(&mut self, k: usize) {
        self.state.take(k, self.edges[k].slots);
    }

    /// Moves the smaller of two islands into the frame of the other, unless they overlap.
    fn merge(&mut self, ia: usize, ib: usize, b_from_a: &Isometry2<f64>) -> bool {
        if self.islands_overlap(ia, ib, b_from_a) > self.tolerated() {
            return false;
        }
        let (from, to, motion) =
            if self.state.size(ia) <= self.state.size(ib) { (ia, ib, *b_from_a) } else { (ib, ia, b_from_a.inverse()) };
        let moved: Vec<usize> = self.state.members(from).collect();
        for k in moved {
            self.state.lay(k, motion * self.state.pose(k));
        }
        self.state.unite(from, to);
        // Drift grows with the way through the island; adjusting when it is half as large again keeps it small at little cost.
        let size = self.state.size(to);
        if self.params.pose_graph
            && self.params.policy == Policy::Standard
            && size >= 6
            && size >= 3 * self.state.adjusted(to).max(2) / 2
        {
            self.state.note_adjusted(to);
            self.adjust(to, COARSE);
        }
        true
    }

    /// Overlap that is tolerated when islands are joined.
    pub(super) fn tolerated(&self) -> f64 {
        if self.params.policy == Policy::Paper { UNREFINED_OVERLAP } else { OVERLAP }
    }

    /// Greatest overlap of two pieces of different islands, in squared piece scales.
    fn islands_overlap(&self, ia: usize, ib: usize, b_from_a: &Isometry2<f64>) -> f64 {
        let mut worst = 0.0f64;
        let others: Vec<(usize, Point2<f64>)> = self.state.members(ib).map(|q| (q, self.centre_of(q))).collect();
        for p in self.state.members(ia) {
            let centre = b_from_a * self.centre_of(p);
            for &(q, other) in &others {
                let reach = self.outlines[p].radius + self.outlines[q].radius;
                if (centre - other).norm_squared() > reach * reach {
                    continue;
                }
                let q_from_p = self.state.pose(q).inverse() * b_from_a * self.state.pose(p);
                let area = self.memory.overlap(self.outlines[p], self.outlines[q], &q_from_p);
                worst = worst.max(area / (self.outlines[p].scale * self.outlines[q].scale));
                if worst > self.tolerated() {
                    return worst;
                }
            }
        }
        worst
    }
}
