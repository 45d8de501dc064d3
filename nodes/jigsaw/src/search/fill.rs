//! Filling what is left: a piece whose isthmuses alone don't decide is laid where its whole border fits best.
//!
//! Worn isthmuses, waves without a neck and corner pieces may have one bad candidate, or two that agree badly; pieces
//! that a scanner stretched agree with none. For each piece left over and each candidate that leads to a free place:
//! 1. *Fit*: how badly it fits there ([`super::fit`]).
//! 2. *Decision*: how large that figure is for pieces that are placed, and for strangers in the places of such, is
//!    measured, and how many strangers overlap so much that they drop out, the more the more the place is enclosed; a
//!    piece is placed if it fits like one of the former, given how many places were tried for it and are free, and leads
//!    its rivals.
//! 3. *Small islands* that would not join are taken apart and filled in likewise, all of their pieces or none.
//!
//! Complexity O(pieces left · candidates · neighbours · border) in each round; a round places all that are sure. A piece
//! that touches the assembly nowhere, or that strangers equal, stays left over.

use super::Assembler;
use super::adjust::COARSE;
use super::fit::{Away, Misfit, Place, STRAIN};
use super::learn::{FOUND, Model, spread_of};
use super::outcome::STRAY_SHARE;
use isthmus::Point;
use nalgebra::Isometry2;
use rayon::prelude::*;
use std::collections::HashMap;

/// Two poses whose centroids are nearer than this, in piece scales, claim the same place.
const SAME_PLACE: f64 = 0.3;
/// Two poses that differ by more than this, in radians, are different ways to lie in a place.
const TURN: f64 = 0.5;
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
    /// Places in which it was tried and didn't overlap.
    free: usize,
}

/// How pieces fit that are placed, and how strangers do in their places.
#[derive(Debug, Clone)]
struct Fitting {
    /// Mean and deviation of what pieces cost that are placed.
    right: (f64, f64),
    /// Known as soon as some piece fits like those.
    strangers: Option<Strangers>,
}

/// How strangers fit in the places of others.
#[derive(Debug, Clone)]
struct Strangers {
    /// How enclosed each stranger was, and whether it fits in without overlap; by the former.
    all: Vec<(f64, bool)>,
    /// How enclosed those were that do, and what they cost; by the former.
    costs: Vec<(f64, f64)>,
}

/// What is known of islands, and of all of them together.
type Learnt = HashMap<Option<usize>, Option<Fitting>>;

impl Fitting {
    /// The cost of a piece that fits as if it belonged where it is tried, at most; never mind how strangers fit there.
    fn most(&self) -> f64 {
        self.right.0 + UNLIKE * self.right.1
    }

    /// Logarithm of the odds that a piece belongs where it is tried: how much likelier its cost is for a piece that is
    /// placed than for a stranger in a place as enclosed, and how rarely such a one doesn't overlap.
    fn evidence(&self, trial: &Trial) -> f64 {
        let Some(strangers) = self.strangers.as_ref().filter(|_| trial.misfit.cost <= self.most()) else {
            return f64::NEG_INFINITY;
        };
        let all = alike(&strangers.all, trial.misfit.share, ALIKE);
        let rarity = (all.len() + 1) as f64 / (all.iter().filter(|s| s.1).count() + 1) as f64;
        let mut costs: Vec<f64> = alike(&strangers.costs, trial.misfit.share, COSTS).iter().map(|s| s.1).collect();
        costs.sort_by(f64::total_cmp);
        let near = self.nearness(trial.misfit.cost, &costs[costs.len() / TWINS..]);
        costs.truncate(costs.len().div_ceil(BEST));
        let wrong = if costs.len() < FEW { (self.right.0 + STRANGE, self.right.1) } else { spread_of(&mut costs) };
        let model = Model::between(self.right, wrong);
        // So many strangers would be free by chance. How many are varies from place to place far more than independent tries
        // would: like a count whose rate is exponential, P(n) = q^n (1 - q), of which the piece is one more.
        let chance = trial.tries.max(1) as f64 / rarity;
        let one_more = (1.0 + chance) / (chance * trial.free.max(1) as f64);
        model.evidence(trial.misfit.cost).min(near) + one_more.ln()
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
    /// those `wanted` does. How placed pieces and strangers do is learnt where it is not known yet.
    fn fill_alone(&mut self, learnt: &mut Learnt, wanted: Option<&[usize]>) {
        while !self.late() {
            // The others, which are rivals, need not be looked at where none of the wanted fits.
            let is_wanted = |piece: usize| wanted.is_none_or(|wanted| wanted.contains(&piece));
            let those = self.places(is_wanted);
            let mut trials = self.trials(&those, learnt);
            if trials.iter().all(|t| self.evidence(learnt, t) < FOUND) {
                return;
            }
            trials.extend(self.trials(&self.places(|piece| !is_wanted(piece)), learnt));
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
                let now = self.place_of(t.edge, t.piece, None).and_then(|place| self.trial(&place, learnt));
                let now = now.filter(|now| now.misfit.overlap <= self.tolerated_here());
                let now = now
                    .map(|now| Trial { tries: t.tries, free: t.free, ..now })
                    .map(|now| (self.evidence(learnt, &now), now));
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
        self.state.lay(trial.piece, trial.pose);
        self.state.fitted.insert(trial.piece, evidence);
        self.take(trial.edge);
        // Whatever else agrees with the pose is a mating as well.
        for k in self.at[trial.piece].clone() {
            if self.same_island(k) && self.admissible(k) {
                self.take(k);
            }
        }
    }

    /// Every wanted piece left over in every free place that some candidate leads to.
    fn places(&self, wanted: impl Fn(usize) -> bool) -> Vec<Place> {
        let choose = |k: usize| {
            let (a, b) = (self.edges[k].a, self.edges[k].b);
            let (piece, held) = if self.state.alone(a) { (a, b) } else { (b, a) };
            (self.state.alone(piece) && !self.state.alone(held) && wanted(piece) && self.free(k)).then_some((k, piece))
        };
        let chosen: Vec<(usize, usize)> = (0..self.edges.len()).filter_map(choose).collect();
        chosen.par_iter().filter_map(|(k, piece)| self.place_of(*k, *piece, None)).collect()
    }

    /// Pieces in places where they fit like placed ones; of one place the best pose. How placed pieces fit there, and
    /// strangers, is learnt as far as it is not known and matters.
    fn trials(&self, places: &[Place], learnt: &mut Learnt) -> Vec<Trial> {
        for place in places {
            let of = self.fits_like(place.island);
            learnt.entry(of).or_insert_with(|| self.fitting(of));
        }
        let known: &Learnt = learnt;
        let mut trials: Vec<Trial> = places.par_iter().filter_map(|place| self.trial(place, known)).collect();
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
            let fits = |t: &&Trial| t.misfit.cost.is_finite() && t.misfit.overlap <= self.tolerated_here();
            for t in of_piece.iter().filter(fits) {
                if !kept[first..].iter().any(|o| self.same_place(o, t)) {
                    kept.push(Trial { tries, ..*t });
                }
            }
            let free = kept.len() - first;
            kept[first..].iter_mut().for_each(|t| t.free = free);
        }
        for t in &kept {
            let of = self.fits_like(t.island);
            if let Some(fitting) = learnt.get_mut(&of).and_then(Option::as_mut).filter(|f| t.misfit.cost <= f.most()) {
                fitting.strangers.get_or_insert_with(|| self.strangers(of));
            }
        }
        kept
    }

    /// A piece tried in a place, if it is known how pieces fit there.
    fn trial(&self, place: &Place, learnt: &Learnt) -> Option<Trial> {
        let most = learnt.get(&self.fits_like(place.island))?.as_ref()?.most();
        let (pose, misfit) = self.fit(place, most)?;
        let Place { piece, edge, island, .. } = *place;
        Some(Trial {
            piece,
            edge,
            island,
            pose,
            centre: pose * self.outlines[piece].centroid,
            misfit,
            tries: 1,
            free: 1,
        })
    }

    /// The pieces by which it is judged how one fits in an island: those of the island if they are many enough (puzzles in
    /// one heap may be cut and pictured differently), or all.
    fn fits_like(&self, island: usize) -> Option<usize> {
        (self.state.size(island) >= MANY).then(|| self.state.island(island))
    }

    /// Whether a piece is one of those by which it is judged how others fit.
    fn counts(&self, piece: usize, island: Option<usize>) -> bool {
        self.state.size(piece) > FEW && island.is_none_or(|island| self.state.island(piece) == island)
    }

    /// How badly pieces fit that are placed, in an island or anywhere; `None` where there is nothing to learn from.
    fn fitting(&self, island: Option<usize>) -> Option<Fitting> {
        /// Nine tenths of a normal distribution lie below its mean and this many deviations.
        const NORMAL_90: f64 = 1.2816;
        let placed: Vec<usize> = (0..self.outlines.len()).filter(|k| self.counts(*k, island)).collect();
        let sample: Vec<usize> = placed.iter().copied().step_by(placed.len().div_ceil(SAMPLE).max(1)).collect();
        let mut right: Vec<f64> = sample.par_iter().filter_map(|k| self.cost_of_placed(*k)).collect();
        if right.len() < FEW {
            return None;
        }
        // Worn pieces make the upper side the wider one.
        right.sort_by(f64::total_cmp);
        let upper = (right[right.len() * 9 / 10] - right[right.len() / 2]) / NORMAL_90;
        let (middle, deviation) = spread_of(&mut right);
        Some(Fitting { right: (middle, deviation.max(upper)), strangers: None })
    }

    /// How strangers fit in the places of pieces of an island, or of any.
    fn strangers(&self, island: Option<usize>) -> Strangers {
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
        let large = self.state.joined().iter().filter(|k| self.counts(self.edges[**k].a, island));
        let exchanges: Vec<(usize, usize, usize, usize)> = large.flat_map(instead).collect();
        let some: Vec<_> = exchanges.iter().step_by(exchanges.len().div_ceil(STRANGERS).max(1)).collect();
        let tried = some.par_iter().enumerate().filter_map(|(n, (k, stranger, held, piece))| {
            let away = Away { piece: *piece, towards: *held, cosine: OPEN[n % OPEN.len()] };
            Some(self.fit(&self.place_of(*k, *stranger, Some(away))?, f64::INFINITY)?.1)
        });
        let mut tried: Vec<Misfit> = tried.collect();
        tried.sort_by(|p, q| p.share.total_cmp(&q.share).then(p.cost.total_cmp(&q.cost)));
        let fits = |m: &Misfit| m.overlap <= self.tolerated_here();
        let all = tried.iter().map(|m| (m.share, fits(m))).collect();
        let costs = tried.iter().filter(|m| fits(m)).map(|m| (m.share, m.cost)).collect();
        Strangers { all, costs }
    }
}
