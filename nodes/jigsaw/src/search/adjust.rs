//! Adjustment: the poses of an island moved by what all contacts of its outlines say.

use super::Assembler;
use crate::contact::Contact;
use crate::posegraph::{Factor, Plan, turned};
use nalgebra::{Isometry2, Point2, Translation2, UnitComplex, Vector3};
use rayon::prelude::*;

/// Steps along the border in an adjustment, in piece scales: while growing, and at the end, where 200 points around a
/// piece leave a tenth of the noise of one.
pub(super) const COARSE: f64 = 0.05;
pub(super) const FINE: f64 = 0.02;
/// Contact of outlines is looked for within this distance, in piece scales.
const CONTACT_BAND: f64 = 0.035;
/// Pairs of pieces that one thread looks at before others are asked: to wake a thread takes as long as some contacts that are new, or some
/// tens that are remembered.
const PAIRS: usize = 16;

impl Assembler<'_> {
    /// Pairs of pieces of one island near enough to touch.
    pub(super) fn neighbours(&self, island: usize) -> Vec<(usize, usize)> {
        /// In a grid there are so many pairs for each piece, with those that touch at a corner.
        const PAIRS_EACH: usize = 4;
        let members = || self.state.members(island);
        let mut placed: Vec<(f64, f64, usize)> =
            members().map(|k| (self.centre_of(k), k)).map(|(c, k)| (c.x, c.y, k)).collect();
        placed.sort_by(|p, q| p.0.total_cmp(&q.0));
        let reach = 2.0 * members().map(|k| self.outlines[k].radius).fold(0.0, f64::max);
        let mut pairs = Vec::with_capacity(PAIRS_EACH * placed.len());
        // A sweep along x: only what is within reach there is compared.
        for (i, (x, y, p)) in placed.iter().enumerate() {
            for (other_x, other_y, q) in &placed[i + 1..] {
                if other_x - x > reach {
                    break;
                }
                let near = self.outlines[*p].radius + self.outlines[*q].radius;
                if (other_x - x).powi(2) + (other_y - y).powi(2) <= near * near {
                    pairs.push((*p.min(q), *p.max(q)));
                }
            }
        }
        pairs
    }

    /// Adjusts all poses of an island to all contacts of its outlines.
    pub(super) fn adjust(&mut self, island: usize, step: f64) {
        let members: Vec<usize> = self.state.members(island).collect();
        if members.len() < 2 {
            return;
        }
        let mut place = vec![0; self.outlines.len()];
        for (i, k) in members.iter().enumerate() {
            place[*k] = i;
        }
        let references: Vec<Point2<f64>> =
            members.iter().map(|k| self.state.pose(*k) * self.outlines[*k].centroid).collect();
        let pairs = self.neighbours(island);
        let factors: Vec<Factor> = pairs
            .par_iter()
            .with_min_len(PAIRS)
            .filter_map(|&(p, q)| {
                let poses = [*self.state.pose(p), *self.state.pose(q)];
                self.factor((p, place[p]), (q, place[q]), &poses, step)
            })
            .collect();
        let plan = self.plan.take().filter(|plan| plan.suits(members.len(), &factors));
        let plan = plan.unwrap_or_else(|| Plan::new(members.len(), &factors));
        let motion = plan.minimise(&references, &factors);
        self.plan = Some(plan);
        for (k, motion) in members.into_iter().zip(motion) {
            self.state.lay(k, self.moved(k, self.state.pose(k), &motion));
        }
    }

    /// A pose of a piece after a small motion (x, y, turn about its centroid).
    pub(super) fn moved(&self, piece: usize, pose: &Isometry2<f64>, motion: &Vector3<f64>) -> Isometry2<f64> {
        /// A step beyond this, in piece scales and radians, isn't an adjustment; it would mean that contacts were wrong.
        const STEP: f64 = 0.05;
        let centre = (pose * self.outlines[piece].centroid).coords;
        let shift = motion.xy().cap_magnitude(STEP * self.scale);
        let turn = UnitComplex::new(motion.z.clamp(-STEP, STEP));
        Translation2::from(centre + shift) * turn * Translation2::from(-centre) * pose
    }

    /// What the contact of two pieces says about the motion of their nodes, given their poses in one island.
    pub(super) fn factor(
        &self,
        (p, a): (usize, usize),
        (q, b): (usize, usize),
        poses: &[Isometry2<f64>; 2],
        step: f64,
    ) -> Option<Factor> {
        let c = self.contact_of(p, q, &(poses[1].inverse() * poses[0]), step)?;
        let turn = turned(poses[1].rotation);
        let (hessian, gradient) = (turn * c.hessian * turn.transpose(), turn * c.gradient);
        Some(Factor { a, b, centre: poses[1] * c.centre, hessian, gradient })
    }

    pub(super) fn contact_of(&self, p: usize, q: usize, q_from_p: &Isometry2<f64>, step: f64) -> Option<Contact> {
        self.memory.contact(self.outlines[p], self.outlines[q], q_from_p, (CONTACT_BAND, step), &self.prior)
    }

    pub(super) fn refine_all(&mut self, rounds: usize, step: f64) {
        if !self.params.pose_graph {
            return;
        }
        let islands: Vec<usize> = self.state.islands().filter(|k| !self.state.alone(*k)).collect();
        for island in islands {
            for _ in 0..rounds {
                self.adjust(island, step);
            }
        }
    }
}
