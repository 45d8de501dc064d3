//! Filling what is left: a piece whose isthmuses alone don't decide is laid where its whole border fits best.
//!
//! Worn isthmuses, waves without a neck and corner pieces may have one bad candidate, or two that agree badly; pieces
//! that a scanner stretched agree with none. For each piece left over and each candidate that leads to a free place:
//! 1. *Settle*: the pose is adjusted to all contacts of the outlines there, the assembly held.
//! 2. *Gap*: mean distance, clearance and a small strain of the piece taken off, between its border and the nearest
//!    border of the assembly, wherever one runs along it: overlap, underlap and misfit in one figure (the paper's GAP
//!    over path length).
//! 3. *Decision*: how large that figure is for pieces that are placed, and for strangers in the places of such, is
//!    measured, and how many strangers overlap so much that they drop out, the more the more the place is enclosed; a
//!    piece is placed if it fits like one of the former, given how many places were tried for it, and leads its rivals.
//! 4. *Small islands* that would not join are taken apart and filled in likewise, all of their pieces or none.
//!
//! Complexity O(pieces left · candidates · neighbours · border) in each round; a round places all that are sure. A piece
//! that touches the assembly nowhere, or that strangers equal, stays left over.

use super::Assembler;
use super::adjust::COARSE;
use super::learn::{FOUND, Model, spread_of};
use super::outcome::STRAY_SHARE;
use crate::posegraph::{Factor, minimise};
use isthmus::Point;
use nalgebra::{Isometry2, Matrix6, Vector2, Vector6};
use rayon::prelude::*;
use std::collections::HashMap;

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
/// Two poses whose centroids are nearer than this, in piece scales, claim the same place.
const SAME_PLACE: f64 = 0.3;
/// Two poses that differ by more than this, in radians, are different ways to lie in a place.
const TURN: f64 = 0.5;
/// Adjustments until a pose has settled.
const ROUNDS: usize = 4;
/// Pieces are strained by about so much: flatbed scanners measure one axis 0.6 % longer, card swells, rows of a scan are
/// 2 % off where the carriage jerks.
const STRAIN: f64 = 0.01;
/// Placed pieces that are looked at to learn how well they fit.
const SAMPLE: usize = 100;
/// Strangers that are tried in the places of others, to learn how badly they fit.
const STRANGERS: usize = 400;
/// Of these the ones whose place is most like another are compared with what is tried there.
const ALIKE: usize = 100;
/// So many of those that fit in without overlap, the ones with the most alike places, show what strangers cost...
const COSTS: usize = 48;
/// ... by the best of them, one in so many: it is these that a wrong piece would be one of.
const BEST: usize = 2;
/// One in so many strangers may be the twin of the piece in whose place it is tried, and so no stranger there.
const TWINS: usize = 20;
/// A piece whose cost is this many deviations above that of placed ones fits like none of them.
const UNLIKE: f64 = 4.0;
/// An island of so many pieces shows by itself how pieces fit in it.
const MANY: usize = 24;
/// Fewer figures don't show how they spread.
const FEW: usize = 4;
/// Strangers fit worse by this much (natural logarithm) if all overlap.
const STRANGE: f64 = 1.0;
/// How much of the surroundings is left around a piece that is taken to be away, as the cosine of the angle from one
/// neighbour: the half plane on its side, all.
const OPEN: [f64; 2] = [-0.2, -1.0];

/// An island, and what of it is taken to be away.
#[derive(Debug, Clone, Copy)]
struct Place {
    island: usize,
    away: Option<Away>,
}

/// A piece of an island that is taken to be away, and with it all that lie, as seen from there, in other directions than
/// one of its neighbours: so many (cosine of the angle between) that the gap is as open as that at a rim.
#[derive(Debug, Clone, Copy)]
struct Away {
    piece: usize,
    towards: usize,
    cosine: f64,
}

/// How badly a piece fits in a place.
#[derive(Debug, Clone, Copy)]
struct Misfit {
    /// Logarithm of the mean gap.
    cost: f64,
    /// Part of the border that has another near.
    share: f64,
    /// Greatest overlap with another piece, in squared piece scales.
    overlap: f64,
}

/// A piece in a place: by which candidate, in which pose (island from image), and how badly it fits.
#[derive(Debug, Clone, Copy)]
struct Trial {
    piece: usize,
    edge: usize,
    island: usize,
    pose: Isometry2<f64>,
    centre: Point,
    misfit: Misfit,
    /// Poses in which this piece was tried.
    tries: usize,
}

/// How pieces fit that are placed, and how strangers do in their places.
#[derive(Debug, Clone)]
struct Fitting {
    /// Mean and deviation of what pieces cost that are placed.
    right: (f64, f64),
    /// How enclosed each stranger was, and whether it fits in without overlap; by the former.
    strangers: Vec<(f64, bool)>,
    /// How enclosed those were that do, and what they cost; by the former.
    costs: Vec<(f64, f64)>,
}

/// What is known of islands, and of all of them together.
type Learnt = HashMap<Option<usize>, Option<Fitting>>;

impl Fitting {
    /// Logarithm of the odds that a piece belongs where it is tried: how much likelier its cost is for a piece that is
    /// placed than for a stranger in a place as enclosed, and how rarely such a one doesn't overlap.
    fn evidence(&self, trial: &Trial) -> f64 {
        if trial.misfit.cost > self.right.0 + UNLIKE * self.right.1 {
            return f64::NEG_INFINITY;
        }
        let strangers = alike(&self.strangers, trial.misfit.share, ALIKE);
        let rarity = (strangers.len() + 1) as f64 / (strangers.iter().filter(|s| s.1).count() + 1) as f64;
        let mut costs: Vec<f64> = alike(&self.costs, trial.misfit.share, COSTS).iter().map(|s| s.1).collect();
        costs.sort_by(f64::total_cmp);
        let near = self.nearness(trial.misfit.cost, &costs[costs.len() / TWINS..]);
        costs.truncate(costs.len().div_ceil(BEST));
        let wrong = if costs.len() < FEW { (self.right.0 + STRANGE, self.right.1) } else { spread_of(&mut costs) };
        let model = Model::between(self.right, wrong);
        model.evidence(trial.misfit.cost).min(near) + rarity.ln() - (trial.tries.max(1) as f64).ln()
    }

    /// Logarithm of how much likelier a cost is for a piece that is placed than for one of the strangers as they are (kernel
    /// density, Rosenblatt 1956): a few that nearly fit don't show in the middle and the spread of all.
    fn nearness(&self, cost: f64, strangers: &[f64]) -> f64 {
        let (middle, deviation) = self.right;
        let cost = cost.max(middle);
        let kernel = |centre: f64| (-0.5 * ((cost - centre) / deviation).powi(2)).exp();
        let wrong = strangers.iter().map(|s| kernel(*s)).sum::<f64>() / strangers.len().max(1) as f64;
        (kernel(middle) / wrong.max(f64::MIN_POSITIVE)).ln()
    }
}

/// About so many of a row of figures as lie around one of them.
fn alike<T>(sorted: &[(f64, T)], share: f64, count: usize) -> &[(f64, T)] {
    let before = sorted.partition_point(|s| s.0 < share);
    let first = before.saturating_sub(count / 2).min(sorted.len().saturating_sub(count));
    &sorted[first..(first + count).min(sorted.len())]
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
    /// Places pieces left over. Islands that are small beside the largest and whose candidates contradict (strained pieces
    /// are off by more than others) are then taken apart and laid down piece by piece, if all find a place so.
    pub(super) fn fill(&mut self) {
        let mut fittings = Learnt::new();
        self.fill_alone(&mut fittings, None);
        let most = self.state.largest() / STRAY_SHARE;
        let mut small: Vec<usize> =
            self.state.islands().filter(|k| (2..=most).contains(&self.state.size(*k))).collect();
        small.sort_by_key(|k| self.state.size(*k));
        for island in small {
            // What has been placed meanwhile may have joined it.
            let island = self.state.island(island);
            if self.state.size(island) > most || self.backtracks >= self.params.backtracks || self.late() {
                continue;
            }
            let saved = self.state.clone();
            let members: Vec<usize> = self.state.members(island).collect();
            self.detach(&members, &[]);
            self.fill_alone(&mut fittings, Some(&members));
            if members.into_iter().any(|k| self.state.alone(k)) {
                self.state = saved;
                self.backtracks += 1;
            }
        }
    }

    /// Places single pieces, the best fitting first, as long as some fit like those that are placed, and as long as one of
    /// those `wanted` does. How these do is learnt where it is not known yet.
    fn fill_alone(&mut self, learnt: &mut Learnt, wanted: Option<&[usize]>) {
        while !self.late() {
            // The others, which are rivals, need not be looked at where none of the wanted fits.
            if let Some(wanted) = wanted {
                let trials = self.trials(|piece| wanted.contains(&piece));
                self.learn_fitting(&trials, learnt);
                if trials.iter().all(|t| self.evidence(learnt, t) < FOUND) {
                    return;
                }
            }
            let trials = self.trials(|_| true);
            if trials.is_empty() {
                return;
            }
            self.learn_fitting(&trials, learnt);
            let evidences: Vec<f64> = trials.iter().map(|t| self.evidence(learnt, t)).collect();
            let sure = |(t, evidence): (&Trial, &f64)| {
                let others = trials.iter().zip(&evidences);
                let rivals = others.filter(|(o, _)| (o.piece == t.piece) != self.same_place(o, t));
                let lead = rivals.map(|(_, other)| evidence - other).fold(f64::INFINITY, f64::min);
                (evidence.min(lead) >= FOUND).then_some((*evidence, *t))
            };
            let mut sure: Vec<(f64, Trial)> = trials.iter().zip(&evidences).filter_map(sure).collect();
            sure.sort_by(|p, q| q.0.total_cmp(&p.0).then(p.1.edge.cmp(&q.1.edge)));
            let mut islands: Vec<usize> = Vec::new();
            for (_, t) in sure {
                // What has been placed beside it meanwhile has a say.
                let now = self.trial(t.edge, t.piece, None).filter(|now| now.misfit.overlap <= self.tolerated_here());
                let now = now.map(|now| Trial { tries: t.tries, ..now }).map(|now| (self.evidence(learnt, &now), now));
                let Some((evidence, now)) = now.filter(|now| now.0 >= FOUND && self.free(t.edge)) else { continue };
                self.place(&now, evidence);
                islands.push(now.island);
            }
            if islands.is_empty() {
                return;
            }
            islands.sort_unstable();
            islands.dedup();
            // What fits beside them is judged by where they come to lie among their neighbours.
            if self.params.pose_graph {
                islands.into_iter().for_each(|island| self.adjust(island, COARSE));
            }
        }
    }

    /// Learns how pieces fit where some are tried, if it is not known.
    fn learn_fitting(&self, trials: &[Trial], learnt: &mut Learnt) {
        for t in trials {
            let of = self.fits_like(t.island);
            learnt.entry(of).or_insert_with(|| self.fitting(of));
        }
    }

    /// Logarithm of the odds that a piece belongs where it is tried, given how others fit there.
    fn evidence(&self, learnt: &Learnt, trial: &Trial) -> f64 {
        let fitting = learnt.get(&self.fits_like(trial.island)).and_then(Option::as_ref);
        fitting.map_or(f64::NEG_INFINITY, |fitting| fitting.evidence(trial))
    }

    /// Overlap that is tolerated: what is strained sticks out by so much more on one side.
    fn tolerated_here(&self) -> f64 {
        self.tolerated() + STRAIN
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
    }

    /// Every wanted piece left over in every free place that some candidate leads to; of one place the best pose.
    fn trials(&self, wanted: impl Fn(usize) -> bool) -> Vec<Trial> {
        let edges: Vec<(usize, usize)> = (0..self.edges.len())
            .filter(|k| self.state.alone(self.edges[*k].a) != self.state.alone(self.edges[*k].b))
            .map(|k| (k, if self.state.alone(self.edges[k].a) { self.edges[k].a } else { self.edges[k].b }))
            .filter(|(k, piece)| wanted(*piece) && self.free(*k))
            .collect();
        let mut trials: Vec<Trial> = edges.par_iter().filter_map(|(k, piece)| self.trial(*k, *piece, None)).collect();
        trials.sort_by(|p, q| {
            p.piece.cmp(&q.piece).then(p.misfit.cost.total_cmp(&q.misfit.cost)).then(p.edge.cmp(&q.edge))
        });
        let mut kept: Vec<Trial> = Vec::new();
        for of_piece in trials.chunk_by(|p, q| p.piece == q.piece) {
            // Several candidates may lead to one pose: that is one try, whether it overlaps or not.
            let turned = |p: &Trial, q: &Trial| p.pose.rotation.angle_to(&q.pose.rotation).abs() > TURN;
            let is_new =
                |(i, t): &(usize, &Trial)| !of_piece[..*i].iter().any(|o| self.same_place(o, t) && !turned(o, t));
            let tries = of_piece.iter().enumerate().filter(is_new).count();
            let first = kept.len();
            for t in of_piece.iter().filter(|t| t.misfit.overlap <= self.tolerated_here()) {
                if !kept[first..].iter().any(|o| self.same_place(o, t)) {
                    kept.push(Trial { tries, ..*t });
                }
            }
        }
        kept
    }

    /// A piece of a candidate where the other one says it belongs, as if some pieces weren't there.
    fn trial(&self, edge: usize, piece: usize, away: Option<Away>) -> Option<Trial> {
        let e = &self.edges[edge];
        let (held, pose) = if piece == e.a {
            (e.b, self.state.pose[e.b] * e.b_from_a)
        } else {
            (e.a, self.state.pose[e.a] * e.b_from_a.inverse())
        };
        let island = self.state.island(held);
        let place = Place { island, away };
        let pose = self.settled(piece, place, pose);
        let misfit = self.misfit(piece, place, &pose)?;
        let centre = pose * self.outlines[piece].centroid;
        Some(Trial { piece, edge, island, pose, centre, misfit, tries: 1 })
    }

    /// Pieces of an island, but for those away, near enough to touch a piece in a pose.
    fn around(&self, piece: usize, place: Place, pose: &Isometry2<f64>) -> Vec<usize> {
        let centre = pose * self.outlines[piece].centroid;
        let reach = self.outlines[piece].radius + NEAR * self.scale;
        let near = |q: &usize| (self.centre_of(*q) - centre).norm() <= reach + self.outlines[*q].radius;
        let there = |q: &usize| {
            place.away.is_none_or(|away| {
                let [to, other] = [away.towards, *q].map(|k| self.centre_of(k) - self.centre_of(away.piece));
                *q != away.piece && to.dot(&other) >= away.cosine * to.norm() * other.norm()
            })
        };
        self.state.members(place.island).filter(|q| *q != piece).filter(near).filter(there).collect()
    }

    /// The pose of a piece adjusted to all contacts with an island, which is held.
    fn settled(&self, piece: usize, place: Place, pose: Isometry2<f64>) -> Isometry2<f64> {
        let mut settled = pose;
        for _ in 0..ROUNDS {
            let factors: Vec<Factor> = self
                .around(piece, place, &settled)
                .into_iter()
                // The island is the first node, which stays where it is.
                .filter_map(|q| self.factor((piece, 1), (q, 0), &[settled, self.state.pose[q]], COARSE))
                .collect();
            if factors.is_empty() {
                return settled;
            }
            let centre = settled * self.outlines[piece].centroid;
            settled = self.moved(piece, &settled, &minimise(&[centre, centre], &factors)[1]);
        }
        settled
    }

    /// How badly a piece fits in a pose; `None` where it hardly touches anything.
    fn misfit(&self, piece: usize, place: Place, pose: &Isometry2<f64>) -> Option<Misfit> {
        let outline = self.outlines[piece];
        let stride = ((outline.scale * COARSE / outline.spacing) as usize).max(1);
        let (near, cap) = (NEAR * self.scale, CAP * self.scale);
        let around: Vec<(usize, Isometry2<f64>)> =
            self.around(piece, place, pose).into_iter().map(|q| (q, self.state.pose[q].inverse() * pose)).collect();
        let touch = |(p, own): (&Point, &Vector2<f32>)| {
            let gaps = around.iter().filter_map(|(q, q_from_piece)| {
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
        let share = touches.len() as f64 / outline.points.len().div_ceil(stride) as f64;
        if share < LEAST_SHARE {
            return None;
        }
        let mut gaps: Vec<f64> = unstrained(&touches).into_iter().map(|g| g.abs().min(cap)).collect();
        gaps.sort_by(f64::total_cmp);
        gaps.truncate((FOLLOWS * gaps.len() as f64).ceil() as usize);
        let sum: f64 = gaps.iter().sum();
        let overlap = around
            .iter()
            .map(|(q, q_from_piece)| {
                let other = self.outlines[*q];
                self.memory.overlap(outline, other, q_from_piece) / (outline.scale * other.scale)
            })
            .fold(0.0, f64::max);
        Some(Misfit { cost: (sum / gaps.len() as f64).max(1e-4).ln(), share, overlap })
    }

    /// The pieces by which it is judged how one fits in an island: those of the island if they are many enough (puzzles in
    /// one heap may be cut and pictured differently), or all.
    fn fits_like(&self, island: usize) -> Option<usize> {
        (self.state.size(island) >= MANY).then(|| self.state.island(island))
    }

    /// How badly pieces fit that are placed, in an island or anywhere, and how badly strangers in their places; `None`
    /// where there is nothing to learn from.
    fn fitting(&self, island: Option<usize>) -> Option<Fitting> {
        /// Nine tenths of a normal distribution lie below its mean and this many deviations.
        const NORMAL_90: f64 = 1.2816;
        let counts = |k: usize| self.state.size(k) > FEW && island.is_none_or(|island| self.state.island(k) == island);
        let placed: Vec<usize> = (0..self.outlines.len()).filter(|k| counts(*k)).collect();
        let sample: Vec<usize> = placed.iter().copied().step_by(placed.len().div_ceil(SAMPLE).max(1)).collect();
        let cost = |k: &usize| {
            Some(self.misfit(*k, Place { island: self.state.island(*k), away: None }, &self.state.pose[*k])?.cost)
        };
        let mut right: Vec<f64> = sample.par_iter().filter_map(cost).collect();
        if right.len() < FEW {
            return None;
        }
        // Worn pieces make the upper side the wider one.
        right.sort_by(f64::total_cmp);
        let upper = (right[right.len() * 9 / 10] - right[right.len() / 2]) / NORMAL_90;
        let (middle, deviation) = spread_of(&mut right);
        let right = (middle, deviation.max(upper));
        // Every other candidate of an isthmus that has a mating leads a stranger to the place of the piece there.
        let instead = |k: &usize| {
            let ends = self.edges[*k].slots;
            [(ends[0], ends[1].piece), (ends[1], ends[0].piece)].into_iter().flat_map(move |(held, piece)| {
                let others = self.at[held.piece].iter().filter_map(move |j| {
                    let [tab, mouth] = self.edges[*j].slots;
                    let stranger = if tab == held { mouth.piece } else { tab.piece };
                    ((tab == held || mouth == held) && stranger != piece).then_some((*j, stranger, held.piece, piece))
                });
                others.filter(|(_, stranger, ..)| !self.aside[*stranger])
            })
        };
        let large = self.state.joined().iter().filter(|k| counts(self.edges[**k].a));
        let exchanges: Vec<(usize, usize, usize, usize)> = large.flat_map(instead).collect();
        let some: Vec<_> = exchanges.iter().step_by(exchanges.len().div_ceil(STRANGERS).max(1)).collect();
        let tried = some.par_iter().enumerate().filter_map(|(n, (k, stranger, held, piece))| {
            let away = Away { piece: *piece, towards: *held, cosine: OPEN[n % OPEN.len()] };
            Some(self.trial(*k, *stranger, Some(away))?.misfit)
        });
        let mut tried: Vec<Misfit> = tried.collect();
        tried.sort_by(|p, q| p.share.total_cmp(&q.share).then(p.cost.total_cmp(&q.cost)));
        let fits = |m: &Misfit| m.overlap <= self.tolerated_here();
        let strangers = tried.iter().map(|m| (m.share, fits(m))).collect();
        let costs = tried.iter().filter(|m| fits(m)).map(|m| (m.share, m.cost)).collect();
        Some(Fitting { right, strangers, costs })
    }
}
