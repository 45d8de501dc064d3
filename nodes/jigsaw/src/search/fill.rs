//! Filling what is left: a piece whose isthmuses alone don't decide is laid where its whole border fits best.
//!
//! Worn isthmuses, waves without a neck and corner pieces may have one bad candidate, or two that agree badly. For
//! each piece left over and each candidate that leads to a free place:
//! 1. *Settle*: the pose is adjusted to all contacts of the outlines there, the assembly held.
//! 2. *Gap*: mean distance, clearance taken off, between the piece's border and the nearest border of the assembly,
//!    wherever there is one near: overlap, underlap and misfit in one figure (the paper's GAP over path length).
//! 3. *Decision*: how large that figure is for pieces that are placed, and for strangers in the same places, is
//!    measured, and how many strangers overlap so much that they drop out; a piece is placed if it fits like one of the
//!    former, given how many places were tried for it, and leads its rivals.
//!
//! Complexity O(pieces left · candidates · neighbours · border). A piece that touches the assembly nowhere, or that
//! strangers equal, stays left over.

use super::{ACCEPT, Assembler, COARSE, Model, spread_of};
use crate::posegraph::{Factor, minimise};
use isthmus::Point;
use nalgebra::{Isometry2, Translation2, UnitComplex};
use rayon::prelude::*;

/// Border farther than this from any other, in piece scales, lies open and says nothing.
const NEAR: f64 = 0.12;
/// Distances count at most this, in piece scales: one corner that is off shall not hide that all else fits.
const CAP: f64 = 0.05;
/// Part of the border near another that follows it: the rest turns away round the corners.
const FOLLOWS: f64 = 0.75;
/// Part of a piece's border that must have another near: less than a side says little.
const LEAST_SHARE: f64 = 0.2;
/// Two poses whose centroids are nearer than this, in piece scales, claim the same place.
const SAME_PLACE: f64 = 0.3;
/// Adjustments until a pose has settled.
const ROUNDS: usize = 4;
/// Placed pieces that are looked at to learn how well they fit.
const SAMPLE: usize = 100;
/// Strangers that are tried in the gaps, to learn how badly they fit.
const STRANGERS: usize = 300;

/// A piece in a place: by which candidate, in which pose (island from image), and how badly it fits (logarithm).
#[derive(Debug, Clone, Copy)]
struct Trial {
    piece: usize,
    edge: usize,
    island: usize,
    pose: Isometry2<f64>,
    centre: Point,
    cost: f64,
    /// Candidates by which a place was looked for, for this piece.
    tries: usize,
}

/// How pieces fit that are placed, and how strangers do.
#[derive(Debug, Clone, Copy)]
struct Fitting {
    model: Model,
    /// Logarithm of how rarely a stranger doesn't overlap.
    rarity: f64,
}

impl Fitting {
    /// Logarithm of the odds that a piece belongs where it is tried.
    fn evidence(&self, trial: &Trial) -> f64 {
        self.model.evidence(trial.cost) + self.rarity - (trial.tries.max(1) as f64).ln()
    }
}

impl Assembler<'_> {
    /// Places pieces left over, the best fitting first, as long as one fits like those that are placed.
    pub(super) fn fill(&mut self) {
        while !self.late() {
            let trials = self.trials();
            let Some(fitting) = self.fitting(&trials) else { return };
            let best = trials.iter().filter_map(|t| {
                let evidence = fitting.evidence(t);
                let lead = trials
                    .iter()
                    .filter(|o| (o.piece == t.piece) != self.same_place(o, t))
                    .map(|o| evidence - fitting.evidence(o))
                    .fold(f64::INFINITY, f64::min);
                (evidence.min(lead) >= ACCEPT).then_some((evidence, t))
            });
            let Some((evidence, trial)) = best.max_by(|p, q| p.0.total_cmp(&q.0).then(q.1.edge.cmp(&p.1.edge))) else {
                return;
            };
            let trial = *trial;
            self.place(&trial, evidence);
        }
    }

    fn same_place(&self, p: &Trial, q: &Trial) -> bool {
        p.island == q.island && (p.centre - q.centre).norm() < SAME_PLACE * self.scale
    }

    fn place(&mut self, trial: &Trial, evidence: f64) {
        self.state.unite(trial.piece, trial.island);
        self.state.pose[trial.piece] = trial.pose;
        self.state.fitted.insert(trial.piece, evidence);
        self.take(trial.edge);
        // Whatever else agrees with the pose is a mating as well.
        for k in self.at[trial.piece].clone() {
            if self.same_island(k) && self.admissible(k) {
                self.take(k);
            }
        }
        // What fits beside it is judged by where it comes to lie among its neighbours.
        if self.params.pose_graph {
            self.adjust(trial.island, COARSE);
        }
    }

    /// Every piece left over in every free place that some candidate leads to; of one place the best pose.
    fn trials(&self) -> Vec<Trial> {
        let edges: Vec<(usize, usize)> = (0..self.edges.len())
            .filter(|k| self.state.alone(self.edges[*k].a) != self.state.alone(self.edges[*k].b) && self.free(*k))
            .map(|k| (k, if self.state.alone(self.edges[k].a) { self.edges[k].a } else { self.edges[k].b }))
            .collect();
        let mut tries = vec![0; self.outlines.len()];
        edges.iter().for_each(|(_, piece)| tries[*piece] += 1);
        let tried = edges.par_iter().filter_map(|(k, piece)| self.trial(*k, *piece));
        let mut trials: Vec<Trial> = tried.map(|t| Trial { tries: tries[t.piece], ..t }).collect();
        trials.sort_by(|p, q| p.piece.cmp(&q.piece).then(p.cost.total_cmp(&q.cost)).then(p.edge.cmp(&q.edge)));
        let mut kept: Vec<Trial> = Vec::new();
        for t in trials {
            if !kept.iter().rev().take_while(|o| o.piece == t.piece).any(|o| self.same_place(o, &t)) {
                kept.push(t);
            }
        }
        kept
    }

    /// A piece of a candidate where the other one says it belongs.
    fn trial(&self, edge: usize, piece: usize) -> Option<Trial> {
        let e = &self.edges[edge];
        let (held, pose) = if piece == e.a {
            (e.b, self.state.pose[e.b] * e.b_from_a)
        } else {
            (e.a, self.state.pose[e.a] * e.b_from_a.inverse())
        };
        let island = self.state.island(held);
        let pose = self.settled(piece, island, pose);
        let (cost, worst) = self.misfit(piece, island, &pose)?;
        let centre = pose * self.outlines[piece].centroid;
        (worst <= self.tolerated()).then_some(Trial { piece, edge, island, pose, centre, cost, tries: 1 })
    }

    /// Pieces of an island near enough to touch a piece in a pose.
    fn around(&self, piece: usize, island: usize, pose: &Isometry2<f64>) -> Vec<usize> {
        let centre = pose * self.outlines[piece].centroid;
        let reach = self.outlines[piece].radius + NEAR * self.scale;
        let near = |q: &usize| *q != piece && (self.centre_of(*q) - centre).norm() <= reach + self.outlines[*q].radius;
        self.state.members(island).filter(near).collect()
    }

    /// The pose of a piece adjusted to all contacts with an island, which is held.
    fn settled(&self, piece: usize, island: usize, pose: Isometry2<f64>) -> Isometry2<f64> {
        let mut settled = pose;
        for _ in 0..ROUNDS {
            let factors: Vec<Factor> = self
                .around(piece, island, &settled)
                .into_iter()
                // The island is the first node, which stays where it is.
                .filter_map(|q| self.factor((piece, 1), (q, 0), &[settled, self.state.pose[q]], COARSE))
                .collect();
            if factors.is_empty() {
                return settled;
            }
            let centre = settled * self.outlines[piece].centroid;
            let motion = minimise(&[centre, centre], &factors)[1];
            let shift = motion.xy().cap_magnitude(CAP * self.scale);
            let turn = UnitComplex::new(motion.z.clamp(-CAP, CAP));
            settled = Translation2::from(centre.coords + shift) * turn * Translation2::from(-centre.coords) * settled;
        }
        settled
    }

    /// Logarithm of the mean gap between a piece in a pose and an island, and the greatest overlap with one of its
    /// pieces in squared piece scales; `None` where they hardly touch.
    fn misfit(&self, piece: usize, island: usize, pose: &Isometry2<f64>) -> Option<(f64, f64)> {
        let outline = self.outlines[piece];
        let stride = ((outline.scale * COARSE / outline.spacing) as usize).max(1);
        let (near, cap) = (NEAR * self.scale, CAP * self.scale);
        let around: Vec<(usize, Isometry2<f64>)> =
            self.around(piece, island, pose).into_iter().map(|q| (q, self.state.pose[q].inverse() * pose)).collect();
        let gap = |p: &Point| {
            let gaps = around.iter().filter_map(|(q, q_from_piece)| self.outlines[*q].gap(q_from_piece * p, near));
            gaps.min_by(|a, b| a.abs().total_cmp(&b.abs()))
        };
        let gaps: Vec<f64> = outline.points.iter().step_by(stride).filter_map(gap).collect();
        if (gaps.len() as f64) < LEAST_SHARE * outline.points.len().div_ceil(stride) as f64 {
            return None;
        }
        let mut gaps: Vec<f64> = gaps.into_iter().map(|g| (g - self.prior.mean).abs().min(cap)).collect();
        gaps.sort_by(f64::total_cmp);
        gaps.truncate((FOLLOWS * gaps.len() as f64).ceil() as usize);
        let sum: f64 = gaps.iter().sum();
        let worst = around
            .iter()
            .map(|(q, q_from_piece)| {
                let other = self.outlines[*q];
                self.memory.overlap(outline, other, q_from_piece) / (outline.scale * other.scale)
            })
            .fold(0.0, f64::max);
        Some(((sum / gaps.len() as f64).max(1e-4).ln(), worst))
    }

    /// How badly pieces fit that are placed, and how badly strangers do in the places that are free; `None` where there
    /// is nothing to try or nothing to learn from.
    fn fitting(&self, trials: &[Trial]) -> Option<Fitting> {
        /// Fewer placed pieces don't show how well they fit.
        const FEW: usize = 4;
        /// Nine tenths of a normal distribution lie below its mean and this many deviations.
        const NORMAL_90: f64 = 1.2816;
        /// Strangers fit worse by this much (natural logarithm) if none can be tried.
        const STRANGE: f64 = 1.0;
        if trials.is_empty() {
            return None;
        }
        let placed: Vec<usize> = (0..self.outlines.len()).filter(|k| self.state.size(*k) > FEW).collect();
        let sample: Vec<usize> = placed.iter().copied().step_by(placed.len().div_ceil(SAMPLE).max(1)).collect();
        let costs = |k: &usize| self.misfit(*k, self.state.island(*k), &self.state.pose[*k]).map(|(cost, _)| cost);
        let mut right: Vec<f64> = sample.par_iter().filter_map(costs).collect();
        if right.len() < FEW {
            return None;
        }
        // Worn pieces make the upper side the wider one.
        right.sort_by(f64::total_cmp);
        let upper = (right[right.len() * 9 / 10] - right[right.len() / 2]) / NORMAL_90;
        let (middle, deviation) = spread_of(&mut right);
        let right = (middle, deviation.max(upper));
        // Pieces that belong elsewhere, where candidates would put them among the gaps.
        let strangers: Vec<(usize, usize)> = (0..self.edges.len())
            .filter(|k| {
                let e = &self.edges[*k];
                [e.a, e.b].iter().all(|p| self.state.size(*p) > FEW)
            })
            .flat_map(|k| self.edges[k].slots().map(|s| (k, s)))
            .filter(|(k, held)| self.open(*held, *k))
            .map(|(k, held)| (k, self.edges[k].slots().into_iter().find(|s| *s != held).map_or(0, |s| s.piece)))
            .filter(|(k, piece)| !(self.aside[*piece] || self.same_island(*k) && self.agrees(*k)))
            .take(STRANGERS)
            .collect();
        let elsewhere = |t: &Trial| {
            t.island != self.state.island(t.piece)
                || (t.centre - self.centre_of(t.piece)).norm() > SAME_PLACE * self.scale
        };
        let tried = strangers.par_iter().filter_map(|(k, piece)| self.trial(*k, *piece)).filter(elsewhere);
        let mut wrong: Vec<f64> = tried.map(|t| t.cost).collect();
        let rarity = ((strangers.len() + 1) as f64 / (wrong.len() + 1) as f64).ln();
        let wrong = if wrong.len() < FEW { (right.0 + STRANGE, right.1) } else { spread_of(&mut wrong) };
        Some(Fitting { model: Model::between(right, wrong), rarity })
    }
}
