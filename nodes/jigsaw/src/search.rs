//! Assembly: from candidate matings to poses.
//!
//! Steps (Webster et al. 1990 descend the ranked table and backtrack; what follows keeps that and adds evidence):
//! 1. *Cost* of each candidate from its residual and from how unusual its clearance is for this puzzle.
//! 2. *Loops* ([`crate::loops`]): candidates that close round a corner. Tolerances come from the puzzle itself.
//! 3. *Islands*: loops are taken best first; a candidate joins two islands if neither isthmus is taken, if it agrees
//!    with the poses where they are fixed already, and if the outlines don't overlap. Islands are adjusted by the pose
//!    graph ([`crate::posegraph`]) over all contacts of their outlines as they grow.
//! 4. *Growth and coagulation*: islands and single pieces are joined by the number of candidates that agree on a pose
//!    and by the contact of the outlines; single candidates only if mutually best and clear of their rivals.
//! 5. *Verification*: pieces that overlap or don't follow their neighbours are taken out (islands split at bad
//!    contacts), and growth is tried again without them; a step that loses more than it brings is undone.

mod fill;
mod state;

use crate::contact::{ClearancePrior, Contact, Memory};
use crate::copies::copies;
use crate::loops::{self, Closure, Edge, Said, Tolerance, difference};
use crate::outline::Outline;
use crate::params::Budget;
use crate::placement::Joint;
use crate::posegraph::{Factor, Plan, turned};
use crate::slots::{Slot, Slots};
use crate::{Params, Policy, placement};
use nalgebra::{Isometry2, Matrix3, Point2, Translation2, UnitComplex, Vector2, Vector3};
use state::State;
use std::cmp::Reverse;
use std::collections::{BTreeMap, HashMap, HashSet};

/// Overlap of two pieces that can't be a matter of drift or clearance, in squared piece scales.
const OVERLAP: f64 = 0.02;
/// The same for poses that are not refined, which are off by a degree.
const UNREFINED_OVERLAP: f64 = 0.05;
/// Loops of refined poses close to within this on real pieces (0.8 % and 0.44° measured); calibration tightens it.
const LOOSE: Tolerance = Tolerance { position: 0.04, angle: 0.05 };
/// True loops close this many times as wide as the borders' residuals say, as a first guess: neighbouring residuals
/// are alike (1 to 2 on generated pieces, 4 to 12 on real ones, which don't keep their shape exactly).
const STIFFNESS: f64 = 3.0;
/// Pose agreement of candidates with an island that has been adjusted.
const AGREE: Tolerance = Tolerance { position: 0.05, angle: 0.08 };
/// So little is always agreement: adjusted islands drift by it.
const MIN_AGREE: Tolerance = Tolerance { position: 0.015, angle: 0.02 };
/// Steps along the border in an adjustment, in piece scales: while growing, and at the end, where 200 points around a
/// piece leave a tenth of the noise of one.
const COARSE: f64 = 0.05;
const FINE: f64 = 0.02;
/// An island of at most so many pieces is stray if the largest is this many times as large: pieces that lie face down
/// or twice may well mate with one another, but where they belong is taken. Halves of mixed puzzles are larger.
const STRAY: usize = 5;
const STRAY_SHARE: usize = 4;
/// Adjustments at the end: two bring the poses to a tenth of what the border's noise leaves.
const FINAL_ROUNDS: usize = 2;
/// Candidates of each mouth (and tab) that take part in loops: more and chance loops drown the true ones.
const LOOP_RANKS: usize = 6;
/// The same for the loops by which the puzzle is calibrated.
const FIRST_RANKS: usize = 2;
/// Candidates of each mouth and tab that take part in growth.
const GROWTH_RANKS: usize = 12;
/// Rounds of verification and growth at most: a contradiction that comes back each time stays out.
const REGROWTHS: usize = 3;
/// Contact of outlines is looked for within this distance, in piece scales.
const CONTACT_BAND: f64 = 0.035;

/// A joint that is a mating.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Mated {
    pub(crate) joint: usize,
    pub(crate) confidence: f64,
    /// How far apart the two borders run where the pieces lie, in pixels.
    pub(crate) clearance: f64,
}

/// The poses found.
#[derive(Debug, Clone, Default)]
pub(crate) struct Outcome {
    /// The candidates, and behind them so many contacts that the assembly showed.
    pub(crate) joints: Vec<Joint>,
    pub(crate) contacts: usize,
    /// Island and pose (island from image) of each piece; `None` if left over.
    pub(crate) poses: Vec<Option<(usize, Isometry2<f64>)>>,
    /// Loop support of each joint.
    pub(crate) support: Vec<usize>,
    /// Matings of the assembly.
    pub(crate) matings: Vec<Mated>,
    /// Confidence of each piece.
    pub(crate) confidence: Vec<f64>,
    pub(crate) backtracks: usize,
    pub(crate) partial: bool,
}

/// Costs (logarithms of residuals) of right candidates, and of the best wrong one beside each: mean and deviation.
#[derive(Debug, Clone, Copy)]
struct Model {
    right: (f64, f64),
    wrong: (f64, f64),
}

impl Model {
    /// From mean and deviation of either. Deviations are kept within what is reasonable: never so narrow that a good
    /// candidate looks bad, never so wide that everything looks alike. Wrong ones cost no less and spread no less than
    /// right ones, so that a greater cost is never better evidence.
    fn between(right: (f64, f64), wrong: (f64, f64)) -> Self {
        let right = (right.0.min(wrong.0), right.1.clamp(0.15, 0.5));
        Self { right, wrong: (wrong.0, wrong.1.clamp(0.2, 0.7).max(right.1)) }
    }

    /// Logarithm of how much likelier a cost is for a right candidate than for the best wrong one of a mouth.
    fn evidence(&self, cost: f64) -> f64 {
        let density = |(mean, deviation): (f64, f64)| {
            let z = (cost.max(self.right.0) - mean) / deviation;
            -0.5 * z * z - f64::ln(deviation)
        };
        (density(self.right) - density(self.wrong)).clamp(-STRONG, STRONG)
    }
}

/// Evidence beyond which more doesn't count (natural logarithm of odds).
const STRONG: f64 = 12.0;
/// Evidence of one more candidate that agrees on a pose, or of one closed loop: chance agreement is rarer than this.
const AGREEMENT: f64 = 4.0;
/// Evidence that a join must have: odds of twenty to one.
const ACCEPT: f64 = 3.0;
/// Evidence that a loop must have, on which all else is built: odds of a hundred to one.
const FOUND: f64 = 4.5;
/// Evidence below which a candidate is no mating, whatever supports it.
const IMPLAUSIBLE: f64 = -6.0;
/// Most that one candidate counts against the pose that it shares with others.
const WORN: f64 = -3.0;
/// Candidates that agree on how two islands lie to each other, and the evidence for it.
#[derive(Debug, Clone)]
struct Group {
    members: Vec<usize>,
    evidence: f64,
}

struct Assembler<'a> {
    outlines: &'a [&'a Outline],
    params: &'a Params,
    memory: &'a Memory,
    budget: &'a dyn Budget,
    joints: Vec<Joint>,
    /// What the search needs of the joints, one by one.
    edges: Vec<Edge>,
    /// How many of them were found as contacts.
    contacts: usize,
    /// Candidates at each piece.
    at: Vec<Vec<usize>>,
    scale: f64,
    prior: ClearancePrior,
    /// What true and false candidates cost.
    model: Model,
    /// How loops close.
    closure: Closure,
    /// Pieces that wait: copies of others, until those are placed.
    aside: Vec<bool>,
    slots: Slots<'a>,
    state: State,
    /// How the last island that was adjusted is eliminated: the next one is often the same.
    plan: Option<Plan>,
    backtracks: usize,
    partial: bool,
}

/// Assembles; `joints`, the candidates, are in the order of ranks.
pub(crate) fn assemble(
    outlines: &[&Outline],
    joints: Vec<Joint>,
    params: &Params,
    memory: &Memory,
    budget: &dyn Budget,
) -> Outcome {
    let n = outlines.len();
    if n == 0 {
        return Outcome::default();
    }
    let mut scales: Vec<f64> = outlines.iter().map(|o| o.scale).collect();
    let scale = *scales.select_nth_unstable_by(n / 2, f64::total_cmp).1;
    let slots = Slots::new(outlines);
    let mut edges: Vec<Edge> = joints.iter().map(|j| edge(j, outlines, &slots)).collect();
    rank(&mut edges, &slots);
    let mut at = vec![Vec::new(); n];
    for (k, e) in edges.iter().enumerate() {
        at[e.a].push(k);
        at[e.b].push(k);
    }
    let noise = outlines.iter().map(|o| o.noise).sum::<f64>() / n as f64;
    let mut assembler = Assembler {
        outlines,
        params,
        memory,
        budget,
        joints,
        edges,
        contacts: 0,
        at,
        scale,
        prior: ClearancePrior { mean: 0.0, deviation: 0.01 * scale, noise: noise.max(0.02) },
        model: Model {
            right: ((1.5 * noise + 0.001 * scale).ln(), 0.4),
            wrong: ((1.5 * noise + 0.01 * scale).ln(), 0.5),
        },
        closure: Closure::guess(0.02, 1.0),
        aside: vec![false; n],
        state: State::new(n, &slots),
        slots,
        plan: None,
        backtracks: 0,
        partial: false,
    };
    match params.policy {
        Policy::Standard => assembler.run(),
        Policy::Paper => assembler.descend(),
    }
}

/// A joint as the search sees it.
fn edge(joint: &Joint, outlines: &[&Outline], slots: &Slots) -> Edge {
    let Joint { a, tab, b, mouth, fit } = joint;
    Edge {
        a: *a,
        b: *b,
        slots: [slots.tab(*a, *tab), slots.mouth(*b, *mouth)],
        b_from_a: fit.negative_from_positive,
        covariance: covariance(&fit.information, outlines[*b].scale),
        at: outlines[*b].mouths[*mouth].origin,
        cost: fit.residual.max(1e-4).ln(),
        mouth_rank: 0,
        tab_rank: 0,
        support: 0,
    }
}

/// Covariance of a pose, given what a contact tells about it; what it doesn't tell is known to a scale and a radian.
fn covariance(information: &Matrix3<f64>, scale: f64) -> Matrix3<f64> {
    let known = Matrix3::from_diagonal(&Vector3::new(scale.powi(-2), scale.powi(-2), 1.0));
    (information + known).try_inverse().unwrap_or_else(Matrix3::identity)
}

/// Ranks the candidates of each mouth and tab by cost.
fn rank(edges: &mut [Edge], slots: &Slots) {
    let mut order: Vec<usize> = (0..edges.len()).collect();
    order.sort_unstable_by(|p, q| edges[*p].cost.total_cmp(&edges[*q].cost).then(p.cmp(q)));
    let mut counts = vec![0; slots.count()];
    for k in order {
        let [tab, mouth] = edges[k].slots.map(|s| s.number);
        (edges[k].tab_rank, edges[k].mouth_rank) = (counts[tab], counts[mouth]);
        counts[tab] += 1;
        counts[mouth] += 1;
    }
}

fn median(values: &mut [f64]) -> Option<f64> {
    if values.is_empty() {
        return None;
    }
    let middle = values.len() / 2;
    Some(*values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// Median and robust deviation.
fn spread_of(values: &mut [f64]) -> (f64, f64) {
    let middle = median(values).unwrap_or(0.0);
    let mut off: Vec<f64> = values.iter().map(|v| (v - middle).abs()).collect();
    (middle, 1.48 * median(&mut off).unwrap_or(0.0))
}

impl Assembler<'_> {
    fn run(&mut self) -> Outcome {
        // Of pieces that are there twice one makes the puzzle: two would take each other's place.
        self.aside = copies(self.outlines);
        self.model = self.first_model();
        let outstanding = self.outstanding();
        self.learn(&outstanding);
        let found = if self.params.loops { self.close_loops() } else { Vec::new() };
        self.islands(&found);
        let trusted: Vec<usize> = self.state.joined().to_vec();
        self.learn(&trusted);
        self.refine_all(1, COARSE);
        self.grow();
        // What was taken out leaves room for what it kept out.
        for _ in 0..REGROWTHS {
            if !self.verify() {
                break;
            }
            self.grow();
        }
        self.reconcile();
        self.improve();
        if self.aside.contains(&true) {
            self.aside.fill(false);
            self.grow();
            self.verify();
        }
        if self.state.largest() < self.outlines.len() {
            self.refine_all(1, FINE);
            self.fill();
        }
        self.refine_all(FINAL_ROUNDS, FINE);
        self.add_contacts();
        self.finish_sure()
    }

    /// The outcome without the pieces and matings that are less sure than asked for.
    fn finish_sure(&mut self) -> Outcome {
        let least = self.params.minimum_confidence;
        let mut outcome = self.finish();
        // Each round takes something out, so there are no more rounds than pieces and matings.
        for _ in 0..self.outlines.len() + self.state.joined().len() {
            let unsure: Vec<usize> = (0..self.outlines.len())
                .filter(|k| outcome.poses[*k].is_some() && outcome.confidence[*k] < least)
                .collect();
            let weak: Vec<usize> = outcome.matings.iter().filter(|m| m.confidence < least).map(|m| m.joint).collect();
            let joined: Vec<usize> = weak.into_iter().filter(|k| self.holds(*k)).collect();
            if unsure.is_empty() && joined.is_empty() {
                break;
            }
            self.detach(&unsure, &joined);
            outcome = self.finish();
        }
        outcome.matings.retain(|m| m.confidence >= least);
        outcome.contacts = self.contacts;
        outcome.joints = std::mem::take(&mut self.joints);
        outcome
    }

    /// The paper's assembly: down the ranked table, mating whatever fits without intolerable overlap; when pieces are
    /// left that can't be joined up, or mouths that nothing fills, back. Decisions are taken back by limited discrepancy search (Harvey and
    /// Ginsberg 1995): every descent that differs from the greedy one in one decision, the weakest first, then in two.
    fn descend(&mut self) -> Outcome {
        let n = self.outlines.len();
        let mut ranked: Vec<usize> = (0..self.edges.len()).collect();
        ranked.sort_by(|p, q| self.edges[*p].cost.total_cmp(&self.edges[*q].cost).then(p.cmp(q)));
        let mut queue = std::collections::VecDeque::from([Vec::new()]);
        let mut best: Option<((usize, Reverse<usize>), State)> = None;
        while let Some(skipped) = queue.pop_front() {
            self.state = State::new(n, &self.slots);
            let mut decisions = Vec::new();
            for &k in &ranked {
                if !skipped.contains(&k) && !self.same_island(k) && self.join(k) {
                    decisions.push(k);
                }
            }
            let worth = (self.state.largest(), Reverse(self.open_mouths()));
            if best.as_ref().is_none_or(|b| worth > b.0) {
                best = Some((worth, self.state.clone()));
            }
            if worth == (n, Reverse(0)) || self.backtracks >= self.params.backtracks || self.late() {
                break;
            }
            self.backtracks += 1;
            // Each set of decisions once: only later ones than the last taken back are added to a set.
            let last = skipped.last().and_then(|k| ranked.iter().position(|r| r == k));
            for &k in decisions.iter().rev() {
                if last.is_none_or(|l| ranked.iter().position(|r| *r == k).is_some_and(|r| r > l)) {
                    let mut more = skipped.clone();
                    more.push(k);
                    queue.push_back(more);
                }
            }
        }
        if let Some((_, state)) = best {
            self.state = state;
        }
        let trusted = self.state.joined().to_vec();
        self.learn(&trusted);
        self.finish_sure()
    }

    /// Mouths of placed pieces in whose middle no other piece of their island lies.
    fn open_mouths(&self) -> usize {
        let filled = |piece: usize, at: Point2<f64>| {
            self.state.members(self.state.island(piece)).filter(|q| *q != piece).any(|q| {
                let raster = &self.outlines[q].raster;
                raster.cell_of(self.state.pose[q].inverse() * at).is_some_and(|cell| raster.distance[cell] < 0.0)
            })
        };
        let placed = (0..self.outlines.len()).filter(|k| !self.state.alone(*k));
        let mouths = placed.flat_map(|k| self.outlines[k].mouths.iter().map(move |mouth| (k, mouth)));
        mouths
            .filter(|(k, mouth)| {
                let middle = mouth.origin + Vector2::new(f64::from(mouth.middle[0]), f64::from(mouth.middle[1]));
                !filled(*k, self.state.pose[*k] * middle)
            })
            .count()
    }

    fn late(&mut self) -> bool {
        if self.budget.spent() >= 1.0 {
            self.partial = true;
        }
        self.partial
    }

    /// Finds loops among the best candidates to calibrate closure, clearance and residual, then, with what was learnt,
    /// among more. The best come first; what is more likely chance is left out.
    fn close_loops(&mut self) -> Vec<loops::Loop> {
        self.closure = self.first_guess();
        let (mut first, decoys) = self.ways(FIRST_RANKS).close();
        if self.params.recalibrate {
            self.closure = self.weigh(&decoys, &mut first);
            let sure = first.iter().filter(|l| l.evidence >= FOUND);
            let mut supported: Vec<usize> = sure.flat_map(|l| l.edges.iter().copied()).collect();
            supported.sort_unstable();
            supported.dedup();
            self.calibrate(&supported);
            rank(&mut self.edges, &self.slots);
            self.learn(&supported);
        }
        // The fewer candidates take part, the fewer loops close by chance: those of the best ones say more.
        let (all, more_decoys) = self.ways(LOOP_RANKS).close();
        let among = |l: &loops::Loop| l.edges.iter().all(|k| self.among(*k, FIRST_RANKS));
        let (mut best, others): (Vec<loops::Loop>, Vec<loops::Loop>) = all.into_iter().partition(among);
        self.weigh(&decoys, &mut best);
        let mut found = best;
        found.extend(others);
        self.closure = self.weigh(&more_decoys, &mut found);
        self.sorted(found)
    }

    /// Whether a candidate is among so many of its mouth and of its tab, and its pieces don't wait.
    fn among(&self, k: usize, ranks: usize) -> bool {
        self.edges[k].mouth_rank < ranks && self.edges[k].tab_rank < ranks && !self.waits(k)
    }

    /// The ways along the best candidates.
    fn ways(&self, ranks: usize) -> loops::Ways<'_> {
        let active: Vec<usize> = (0..self.edges.len()).filter(|k| self.among(*k, ranks)).collect();
        loops::Ways::new((&self.edges, &active), (self.outlines, &self.slots), LOOSE)
    }

    /// How loops close, beside those of decoys; gives each loop the evidence that follows, unless it has more already.
    fn weigh(&self, decoys: &loops::Decoys, found: &mut [loops::Loop]) -> Closure {
        let closure = Closure::fit(&self.first_guess(), found, decoys);
        for l in found {
            l.evidence = l.evidence.max(closure.evidence(l.distance));
        }
        closure
    }

    /// How loops should close, by the residuals of the best candidates and the tolerance of the search.
    fn first_guess(&self) -> Closure {
        let best = self.edges.iter().filter(|e| e.mouth_rank == 0);
        let residual = median(&mut best.clone().map(|e| e.cost.exp()).collect::<Vec<f64>>()).unwrap_or(1.0);
        // The box of the tolerance, in units of what four candidates leave open.
        let open = |e: &Edge| (64.0 * e.covariance.determinant()).max(f64::MIN_POSITIVE).sqrt();
        let open = median(&mut best.map(open).collect::<Vec<f64>>()).unwrap_or(1.0);
        let volume = (LOOSE.position * self.scale).powi(2) * LOOSE.angle;
        Closure::guess(STIFFNESS * residual, (volume / open).cbrt())
    }

    /// Counts what supports what, leaves out loops that are more likely chance, and puts the best first.
    fn sorted(&mut self, found: Vec<loops::Loop>) -> Vec<loops::Loop> {
        let value = |l: &loops::Loop| {
            let costs = l.edges.iter().map(|k| self.model.evidence(self.edges[*k].cost).max(WORN));
            l.evidence + costs.sum::<f64>()
        };
        let mut keyed: Vec<(f64, loops::Loop)> = found.into_iter().map(|l| (value(&l), l)).collect();
        keyed.retain(|(value, l)| *value >= FOUND && l.evidence >= 0.0);
        keyed.sort_by(|p, q| q.0.total_cmp(&p.0).then_with(|| p.1.edges.cmp(&q.1.edges)));
        for (_, l) in &keyed {
            for &k in &l.edges {
                self.edges[k].support += 1;
            }
        }
        keyed.into_iter().map(|(_, l)| l).collect()
    }

    /// Clearance and residual of true matings, from supported ones; costs follow.
    fn calibrate(&mut self, supported: &[usize]) {
        let mut clearances: Vec<f64> = supported.iter().map(|k| self.joints[*k].fit.clearance).collect();
        let Some(mean) = median(&mut clearances) else { return };
        let mut off: Vec<f64> = clearances.iter().map(|c| (c - mean).abs()).collect();
        let deviation = 1.48 * median(&mut off).unwrap_or(0.0);
        // Small sets measure the deviation badly, and clearances may differ from cut to cut.
        self.prior.mean = mean;
        self.prior.deviation = deviation.max(0.002 * self.scale);
        for (k, e) in self.edges.iter_mut().enumerate() {
            let z = (self.joints[k].fit.clearance - mean) / self.prior.deviation;
            e.cost = self.joints[k].fit.residual.max(1e-4).ln() + 0.06 * (z * z).min(9.0);
        }
    }

    /// Learns what right and wrong candidates cost: right ones are those `trusted`, wrong ones the best others of
    /// their mouths.
    fn learn(&mut self, trusted: &[usize]) {
        /// Fewer say too little about the spread.
        const FEW: usize = 4;
        let mut right: Vec<f64> = trusted.iter().map(|k| self.edges[*k].cost).collect();
        let mut wrong = Vec::new();
        for &k in trusted {
            let mouth = self.edges[k].slots[1];
            let others = self.at[mouth.piece].iter().map(|j| (*j, &self.edges[*j]));
            let best =
                others.filter(|(j, e)| *j != k && e.slots[1] == mouth).map(|(_, e)| e.cost).min_by(f64::total_cmp);
            wrong.extend(best);
        }
        if right.len() < FEW || wrong.len() < FEW {
            return;
        }
        self.model = Model::between(spread_of(&mut right), spread_of(&mut wrong));
    }

    /// Before anything is trusted: right candidates cost what noise and sampling make them, wrong ones what the second
    /// and third of the mouths do.
    fn first_model(&self) -> Model {
        let runners_up = self.edges.iter().filter(|e| (1..=2).contains(&e.mouth_rank));
        match spread_of(&mut runners_up.map(|e| e.cost).collect::<Vec<f64>>()) {
            (_, 0.0) => self.model,
            wrong => Model::between(self.model.right, wrong),
        }
    }

    /// Candidates that are the best of their tab and of their mouth by a wide margin: what to learn from without loops.
    fn outstanding(&self) -> Vec<usize> {
        const WIDE: f64 = 0.7; // half the residual of any rival
        (0..self.edges.len())
            .filter(|&k| {
                let e = &self.edges[k];
                let clear = |slot: Slot| {
                    self.at[slot.piece].iter().all(|j| {
                        *j == k || !self.edges[*j].slots.contains(&slot) || self.edges[*j].cost > e.cost + WIDE
                    })
                };
                e.mouth_rank == 0 && e.tab_rank == 0 && e.slots.into_iter().all(clear)
            })
            .collect()
    }

    fn islands(&mut self, found: &[loops::Loop]) {
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
            let saved = (order.iter().any(|k| !self.same_island(*k))).then(|| self.state.clone());
            let ok = order.iter().all(|k| self.join(*k));
            if let (false, Some(saved)) = (ok, saved) {
                self.state = saved;
            }
        }
    }

    fn same_island(&self, k: usize) -> bool {
        let e = &self.edges[k];
        self.state.island(e.a) == self.state.island(e.b)
    }

    /// Whether one of a candidate's pieces has been set aside.
    fn waits(&self, k: usize) -> bool {
        self.aside[self.edges[k].a] || self.aside[self.edges[k].b]
    }

    /// Whether no other mating has taken either stretch of border, and its pieces don't wait.
    fn free(&self, k: usize) -> bool {
        !self.waits(k) && self.edges[k].slots.iter().all(|s| self.open(*s, k))
    }

    /// Whether no mating but `k` has taken an isthmus or one that claims the same stretch of border.
    fn open(&self, slot: Slot, k: usize) -> bool {
        let taken = |other: &Slot| self.state.mating_at(*other).is_some_and(|j| j != k);
        !self.slots.rivals(slot).iter().any(taken)
    }

    /// Whether a candidate is a mating.
    fn holds(&self, k: usize) -> bool {
        self.state.mating_at(self.edges[k].slots[0]) == Some(k)
    }

    fn admissible(&self, k: usize) -> bool {
        if !self.free(k) {
            return false;
        }
        !self.same_island(k) || self.agrees(k)
    }

    /// Whether the poses of its pieces, in one island, say the same as the candidate.
    fn agrees(&self, k: usize) -> bool {
        let e = &self.edges[k];
        let actual = self.state.pose[e.b].inverse() * self.state.pose[e.a];
        let (d, turn) = difference(self.outlines[e.a], &actual, &e.b_from_a);
        let within = |t: Tolerance| d <= t.position && turn <= t.angle;
        within(MIN_AGREE)
            || (within(AGREE) && self.closure.admits(loops::deviation(e, &actual, self.outlines[e.a].centroid)))
    }

    /// Joins the islands of a candidate; false if they contradict.
    fn join(&mut self, k: usize) -> bool {
        if !self.admissible(k) {
            return false;
        }
        if self.same_island(k) {
            self.take(k);
            return true;
        }
        let e = &self.edges[k];
        let (ia, ib) = (self.state.island(e.a), self.state.island(e.b));
        let b_from_a = self.state.pose[e.b] * e.b_from_a * self.state.pose[e.a].inverse();
        if !self.merge(ia, ib, &b_from_a) {
            return false;
        }
        self.take(k);
        true
    }

    /// Joins two islands in the pose that suits all of several candidates best.
    fn join_by_all(&mut self, members: &[usize]) -> bool {
        let (ia, ib, pose) = self.common_pose(members);
        if ia == ib || !self.merge(ia, ib, &pose) {
            return false;
        }
        self.take(members[0]);
        true
    }

    /// The islands that some candidates would join, and the pose of the first in the second that suits them best.
    fn common_pose(&self, members: &[usize]) -> (usize, usize, Isometry2<f64>) {
        let first = &self.edges[members[0]];
        let (ia, ib) = (self.state.island(first.a), self.state.island(first.b));
        let (mut here, mut there) = (Vec::new(), Vec::new());
        for &k in members {
            let e = &self.edges[k];
            let centre = self.slots.segment(e.slots[0]).origin;
            for (dx, dy) in [(0.3, 0.0), (-0.3, 0.0), (0.0, 0.3), (0.0, -0.3)] {
                let p = centre + Vector2::new(dx, dy) * self.scale;
                let (in_a, in_b) = (self.state.pose[e.a] * p, self.state.pose[e.b] * (e.b_from_a * p));
                let forward = self.state.island(e.a) == ia;
                here.push(if forward { in_a } else { in_b });
                there.push(if forward { in_b } else { in_a });
            }
        }
        (ia, ib, placement::rigid_fit(&here, &there))
    }

    /// Where a piece's centroid lies in its island.
    fn centre_of(&self, piece: usize) -> Point2<f64> {
        self.state.pose[piece] * self.outlines[piece].centroid
    }

    fn take(&mut self, k: usize) {
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
            self.state.pose[k] = motion * self.state.pose[k];
        }
        self.state.unite(from, to);
        // Drift grows with the way through the island; adjusting at every doubling keeps it small at little cost.
        let size = self.state.size(to);
        if self.params.pose_graph
            && self.params.policy == Policy::Standard
            && size >= 6
            && size >= 3 * self.state.adjusted[to].max(2) / 2
        {
            self.state.adjusted[to] = size;
            self.adjust(to, COARSE);
        }
        true
    }

    /// Overlap that is tolerated when islands are joined.
    fn tolerated(&self) -> f64 {
        if self.params.policy == Policy::Paper { UNREFINED_OVERLAP } else { OVERLAP }
    }

    /// Greatest overlap of two pieces of different islands, in squared piece scales.
    fn islands_overlap(&self, ia: usize, ib: usize, b_from_a: &Isometry2<f64>) -> f64 {
        let mut worst = 0.0f64;
        for p in self.state.members(ia) {
            let pose = b_from_a * self.state.pose[p];
            let centre = pose * self.outlines[p].centroid;
            for q in self.state.members(ib) {
                let reach = self.outlines[p].radius + self.outlines[q].radius;
                let other = self.state.pose[q] * self.outlines[q].centroid;
                if (centre - other).norm_squared() > reach * reach {
                    continue;
                }
                let q_from_p = self.state.pose[q].inverse() * pose;
                let area = self.memory.overlap(self.outlines[p], self.outlines[q], &q_from_p);
                worst = worst.max(area / (self.outlines[p].scale * self.outlines[q].scale));
                if worst > self.tolerated() {
                    return worst;
                }
            }
        }
        worst
    }

    /// Pairs of pieces of one island near enough to touch.
    fn neighbours(&self, island: usize) -> Vec<(usize, usize)> {
        let members = || self.state.members(island);
        let mut placed: Vec<(f64, f64, usize)> =
            members().map(|k| (self.centre_of(k), k)).map(|(c, k)| (c.x, c.y, k)).collect();
        placed.sort_by(|p, q| p.0.total_cmp(&q.0));
        let reach = 2.0 * members().map(|k| self.outlines[k].radius).fold(0.0, f64::max);
        let mut pairs = Vec::new();
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
        pairs.sort_unstable();
        pairs
    }

    /// Adjusts all poses of an island to all contacts of its outlines.
    fn adjust(&mut self, island: usize, step: f64) {
        let members: Vec<usize> = self.state.members(island).collect();
        if members.len() < 2 {
            return;
        }
        let mut place = vec![0; self.outlines.len()];
        for (i, k) in members.iter().enumerate() {
            place[*k] = i;
        }
        let references: Vec<Point2<f64>> =
            members.iter().map(|k| self.state.pose[*k] * self.outlines[*k].centroid).collect();
        let pairs = self.neighbours(island);
        use rayon::prelude::*;
        let factors: Vec<Factor> = pairs
            .par_iter()
            .filter_map(|&(p, q)| {
                let poses = [self.state.pose[p], self.state.pose[q]];
                self.factor((p, place[p]), (q, place[q]), &poses, step)
            })
            .collect();
        let plan = self.plan.take().filter(|plan| plan.suits(members.len(), &factors));
        let plan = plan.unwrap_or_else(|| Plan::new(&references, &factors));
        let motion = plan.minimise(&references, &factors);
        self.plan = Some(plan);
        for (i, &k) in members.iter().enumerate() {
            let m = motion[i];
            // A step beyond this isn't an adjustment; it would mean that the contacts were wrong.
            let shift = Vector2::new(m.x, m.y).cap_magnitude(0.05 * self.scale);
            let turn = UnitComplex::new(m.z.clamp(-0.05, 0.05));
            let centre = references[i].coords;
            let about = Translation2::from(centre + shift) * turn * Translation2::from(-centre);
            self.state.pose[k] = about * self.state.pose[k];
        }
    }

    /// What the contact of two pieces says about the motion of their nodes, given their poses in one island.
    fn factor(
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

    fn contact_of(&self, p: usize, q: usize, q_from_p: &Isometry2<f64>, step: f64) -> Option<Contact> {
        self.memory.contact(self.outlines[p], self.outlines[q], q_from_p, (CONTACT_BAND, step), &self.prior)
    }

    fn refine_all(&mut self, rounds: usize, step: f64) {
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

    /// Joins islands and single pieces, best evidence first.
    fn grow(&mut self) {
        loop {
            if self.late() {
                return;
            }
            let mut hypotheses = self.hypotheses();
            hypotheses.sort_by(|p, q| q.0.total_cmp(&p.0).then_with(|| p.1.cmp(&q.1)));
            let mut joined = 0;
            for (_, members) in hypotheses {
                // Earlier joins may have changed what is admissible; `join` checks again. A single candidate must
                // still lead its rivals.
                if self.same_island(members[0]) || (members.len() > 1 && members.iter().any(|k| !self.free(*k))) {
                    continue;
                }
                let ok = if members.len() > 1 { self.join_by_all(&members) } else { self.join(members[0]) };
                if ok {
                    joined += 1;
                    for k in &members[1..] {
                        if self.admissible(*k) {
                            self.take(*k);
                        }
                    }
                }
            }
            if joined == 0 {
                return;
            }
            self.refine_all(1, COARSE);
        }
    }

    /// Ways to join two islands: the evidence, the candidates that agree.
    fn hypotheses(&self) -> Vec<(f64, Vec<usize>)> {
        let mut between: BTreeMap<(usize, usize), Vec<usize>> = BTreeMap::new();
        for (k, e) in self.edges.iter().enumerate() {
            if e.mouth_rank.min(e.tab_rank) >= GROWTH_RANKS || self.same_island(k) || !self.free(k) {
                continue;
            }
            let (ia, ib) = (self.state.island(e.a), self.state.island(e.b));
            between.entry((ia.min(ib), ia.max(ib))).or_default().push(k);
        }
        let mut grouped: BTreeMap<usize, Group> = BTreeMap::new();
        for ((low, high), candidates) in between {
            if !self.params.merge_islands && !self.state.alone(low) && !self.state.alone(high) {
                continue;
            }
            let said: Vec<Said> = candidates.iter().map(|k| self.said(*k, low)).collect();
            for (i, k) in candidates.iter().enumerate() {
                grouped.insert(*k, self.group(i, low, &candidates, &said));
            }
        }
        // A candidate must be likely by itself, and lead whatever else would take its place.
        let acceptable = grouped.values().filter(|g| g.evidence >= ACCEPT && self.lead(g, &grouped) >= ACCEPT);
        acceptable.map(|g| (g.evidence, g.members.clone())).collect()
    }

    /// What a candidate says about where the island `moving` lies in the other one.
    fn said(&self, k: usize, moving: usize) -> Said<'_> {
        let e = &self.edges[k];
        let b_from_a = self.state.pose[e.b] * e.b_from_a * self.state.pose[e.a].inverse();
        let (from, pose) = if self.state.island(e.a) == moving { (e.b, b_from_a) } else { (e.a, b_from_a.inverse()) };
        Said { edge: e, from, fixed: self.state.pose[from], pose }
    }

    /// The candidates that agree with the one at `i` on the pose of the island `moving`.
    fn group(&self, i: usize, moving: usize, candidates: &[usize], said: &[Said]) -> Group {
        // A worn joint among agreeing ones doesn't refute them.
        let single = |k: usize| self.model.evidence(self.edges[k].cost).max(WORN);
        let mut group = Group { members: vec![candidates[i]], evidence: single(candidates[i]) };
        for (j, other) in candidates.iter().enumerate().filter(|(j, _)| *j != i) {
            let e = &self.edges[*other];
            let piece = if self.state.island(e.a) == moving { e.a } else { e.b };
            let distance = loops::disagreement(&said[i], &said[j], self.centre_of(piece));
            let slots = e.slots;
            let clashes = |g: &usize| {
                let taken = self.edges[*g].slots;
                taken.iter().any(|s| slots.iter().any(|t| self.slots.conflict(*s, *t)))
            };
            if self.closure.admits(distance) && !group.members.iter().any(clashes) {
                group.members.push(*other);
                group.evidence += single(*other) + self.closure.agreement(distance).clamp(0.0, STRONG);
            }
        }
        group
    }

    /// By how much a group of candidates leads its free rivals for the same tabs and mouths, as evidence.
    fn lead(&self, group: &Group, all: &BTreeMap<usize, Group>) -> f64 {
        let mut lead = STRONG;
        let mut strangers: BTreeMap<usize, f64> = BTreeMap::new();
        let size = |piece: usize| self.state.size(piece);
        for &k in &group.members {
            let e = &self.edges[k];
            let largest = size(e.a).max(size(e.b));
            for slot in e.slots {
                for &j in &self.at[slot.piece] {
                    let other = &self.edges[j];
                    if group.members.contains(&j)
                        || !other.slots.iter().any(|s| self.slots.conflict(*s, slot))
                        || !self.free(j)
                    {
                        continue;
                    }
                    if size(slot.piece) >= largest {
                        let stranger = if other.a == slot.piece { other.b } else { other.a };
                        let behind = self.model.evidence(other.cost) - self.model.evidence(e.cost).max(WORN);
                        let chance = strangers.entry(stranger).or_default();
                        *chance = chance.max(behind.min(0.0).exp());
                    }
                    let rival = all.get(&j);
                    let evidence = rival.map_or_else(|| self.model.evidence(other.cost), |r| r.evidence);
                    let mut ahead = group.evidence - evidence;
                    // Costs below the typical are alike as evidence, but between rivals the better one still leads.
                    if group.members.len() == 1 && rival.is_none_or(|r| r.members.len() == 1) {
                        ahead = ahead.max((other.cost - e.cost) / self.model.right.1);
                    }
                    lead = lead.min(ahead);
                }
            }
        }
        // Candidates that agree might do so by chance, and any that vies for the same place might have been the one,
        // the likelier the better it fits.
        let tries = if group.members.len() > 1 { (1.0 + strangers.values().sum::<f64>()).ln() } else { 0.0 };
        lead.min(group.evidence - tries)
    }

    /// Takes out pieces that overlap others, the less supported one of a pair; islands that fall apart are split.
    /// Tells whether anything was taken out.
    fn verify(&mut self) -> bool {
        let mut changed = false;
        for _ in 0..4 {
            let mut evict: Vec<usize> = Vec::new();
            let joined = self.joined_at();
            for island in self.state.islands() {
                for (p, q) in self.neighbours(island) {
                    let pose = self.state.pose[q].inverse() * self.state.pose[p];
                    let area = self.memory.overlap(self.outlines[p], self.outlines[q], &pose);
                    if area <= OVERLAP * self.outlines[p].scale * self.outlines[q].scale {
                        continue;
                    }
                    evict.push(if self.weight(&joined[p]) < self.weight(&joined[q]) { p } else { q });
                }
            }
            // Matings that the adjusted poses contradict hold nothing.
            let broken: Vec<usize> = self.state.joined().iter().copied().filter(|k| !self.agrees(*k)).collect();
            if evict.is_empty() && broken.is_empty() {
                break;
            }
            changed = true;
            self.detach(&evict, &broken);
            self.refine_all(1, COARSE);
        }
        changed
    }

    /// Joined candidates at each piece.
    fn joined_at(&self) -> Vec<Vec<usize>> {
        let mut joined = vec![Vec::new(); self.outlines.len()];
        for &k in self.state.joined() {
            joined[self.edges[k].a].push(k);
            joined[self.edges[k].b].push(k);
        }
        joined
    }

    /// Undoes all matings of some pieces and some more matings; what no longer hangs together becomes islands apart.
    fn detach(&mut self, pieces: &[usize], matings: &[usize]) {
        let gone = |p: &usize| pieces.contains(p);
        self.state.fitted.retain(|k, _| !gone(k));
        let edges = &self.edges;
        self.state.keep(edges, |k| !matings.contains(&k) && !gone(&edges[k].a) && !gone(&edges[k].b));
    }

    /// Islands that fit together but for a few pieces of one that lie where pieces of the other lie already (copies, or
    /// wrong ones): those are taken out, unless that is worth less than before.
    fn reconcile(&mut self) {
        if !self.params.merge_islands {
            return;
        }
        let mut tried = std::collections::HashSet::new();
        loop {
            let mut hypotheses = self.hypotheses();
            hypotheses.retain(|(_, group)| {
                let e = &self.edges[group[0]];
                let size = |p: usize| self.state.size(p);
                size(e.a).min(size(e.b)) > 1 && !tried.contains(group)
            });
            hypotheses.sort_by(|p, q| q.0.total_cmp(&p.0).then_with(|| p.1.cmp(&q.1)));
            let Some((_, group)) = hypotheses.into_iter().next() else { return };
            if self.backtracks >= self.params.backtracks || self.late() {
                return;
            }
            let saved = self.state.clone();
            let before = self.worth();
            let losers = self.losers(&group);
            self.detach(&losers, &[]);
            if losers.is_empty() || !self.join_by_all(&group) {
                self.state = saved;
                tried.insert(group);
                continue;
            }
            for k in &group[1..] {
                if self.admissible(*k) {
                    self.take(*k);
                }
            }
            self.refine_all(1, COARSE);
            self.grow();
            self.verify();
            if self.worth() <= before + 1e-9 {
                self.state = saved;
                self.backtracks += 1;
            }
            tried.insert(group);
        }
    }

    /// The pieces, of two islands that some candidates would join, that lie on others and have less evidence than
    /// those; none if they are too many to be exceptions.
    fn losers(&self, group: &[usize]) -> Vec<usize> {
        /// At most one piece in this many of the smaller island may have to go.
        const EXCEPTIONS: usize = 4;
        let (ia, ib, pose) = self.common_pose(group);
        let joined = self.joined_at();
        let mut losers = Vec::new();
        for p in self.state.members(ia) {
            let here = pose * self.state.pose[p];
            for q in self.state.members(ib) {
                let q_from_p = self.state.pose[q].inverse() * here;
                let area = self.memory.overlap(self.outlines[p], self.outlines[q], &q_from_p);
                if area > self.tolerated() * self.outlines[p].scale * self.outlines[q].scale {
                    losers.push(if self.weight(&joined[p]) < self.weight(&joined[q]) { p } else { q });
                }
            }
        }
        losers.sort_unstable();
        losers.dedup();
        let smaller = self.state.size(ia).min(self.state.size(ib));
        if losers.len() * EXCEPTIONS > smaller { Vec::new() } else { losers }
    }

    /// What the assembly is worth: the evidence of its matings.
    fn worth(&self) -> f64 {
        self.weight(self.state.joined())
    }

    /// The evidence of some matings.
    fn weight(&self, matings: &[usize]) -> f64 {
        matings.iter().map(|k| AGREEMENT + self.model.evidence(self.edges[*k].cost)).sum()
    }

    /// Backtracking: a piece left over that would fit where another sits is tried in its place; what is worth less
    /// than before is undone.
    fn improve(&mut self) {
        let mut tried = std::collections::HashSet::new();
        loop {
            let mut options: Vec<(f64, usize)> = (0..self.edges.len())
                .filter(|k| !tried.contains(k) && !self.same_island(*k) && !self.free(*k))
                .filter(|k| {
                    let e = &self.edges[*k];
                    self.state.alone(e.a) || self.state.alone(e.b)
                })
                .map(|k| (self.model.evidence(self.edges[k].cost), k))
                .filter(|(evidence, _)| *evidence >= ACCEPT)
                .collect();
            options.sort_by(|p, q| q.0.total_cmp(&p.0).then(p.1.cmp(&q.1)));
            let Some(&(_, k)) = options.first() else { return };
            if self.backtracks >= self.params.backtracks || self.late() {
                return;
            }
            tried.insert(k);
            let saved = self.state.clone();
            let before = self.worth();
            let mut occupants = Vec::new();
            for slot in self.edges[k].slots {
                for j in self.slots.rivals(slot).iter().filter_map(|s| self.state.mating_at(*s)) {
                    let e = &self.edges[j];
                    occupants.push(if e.a == slot.piece { e.b } else { e.a });
                }
            }
            occupants.sort_unstable();
            occupants.dedup();
            self.detach(&occupants, &[]);
            if self.join(k) {
                self.grow();
                self.verify();
            }
            if self.worth() <= before + 1e-9 {
                self.state = saved;
                self.backtracks += 1;
            }
        }
    }

    /// Tabs that lie in mouths although that was no candidate (others resembled either more): where nothing else is
    /// joined, what the borders say there becomes a candidate. Of several at one stretch of border the nearest counts.
    fn add_contacts(&mut self) {
        /// Isthmus points of a tab and of its mouth are no farther apart, in piece scales: flat minima slide along the neck.
        const NEAR: f64 = 0.15;
        let agreeing = self.edges.iter().enumerate().filter(|(k, _)| self.same_island(*k) && self.agrees(*k));
        let mut settled: HashSet<Slot> = agreeing.flat_map(|(_, e)| e.slots).collect();
        let mut met: Vec<(f64, [usize; 2], [usize; 2])> = Vec::new();
        for (p, q) in self.state.islands().flat_map(|k| self.neighbours(k)) {
            for [a, b] in [[p, q], [q, p]] {
                let b_from_a = self.state.pose[b].inverse() * self.state.pose[a];
                for (tab, t) in self.outlines[a].tabs.iter().enumerate() {
                    for (mouth, m) in self.outlines[b].mouths.iter().enumerate() {
                        met.push(((b_from_a * t.origin - m.origin).norm(), [a, tab], [b, mouth]));
                    }
                }
            }
        }
        met.retain(|(distance, _, [b, _])| *distance <= NEAR * self.outlines[*b].scale);
        met.sort_by(|p, q| p.0.total_cmp(&q.0).then((p.1, p.2).cmp(&(q.1, q.2))));
        let mut feet = placement::Feet::default();
        for (_, [a, tab], [b, mouth]) in met {
            let ends = [self.slots.tab(a, tab), self.slots.mouth(b, mouth)];
            if ends.iter().any(|s| self.slots.rivals(*s).iter().any(|rival| settled.contains(rival))) {
                continue;
            }
            let b_from_a = self.state.pose[b].inverse() * self.state.pose[a];
            let (t, m) = (&self.outlines[a].tabs[tab], &self.outlines[b].mouths[mouth]);
            let from = (&b_from_a, self.prior.mean);
            let scale = self.outlines[b].scale;
            let Some(fit) = placement::refine(t, m, from, scale, self.params.fit_clearance, &mut feet) else {
                continue;
            };
            settled.extend(ends);
            let joint = Joint { a, tab, b, mouth, fit };
            self.edges.push(edge(&joint, self.outlines, &self.slots));
            self.joints.push(joint);
            self.contacts += 1;
        }
    }

    fn finish(&mut self) -> Outcome {
        let n = self.outlines.len();
        let mut matings = Vec::new();
        let mut taken: HashMap<Slot, usize> = HashMap::new();
        let paper = self.params.policy == Policy::Paper;
        // Unrefined poses contradict each other too much to recognise contacts that weren't decided on.
        let mut order: Vec<usize> = if paper {
            self.state.joined().to_vec()
        } else {
            (0..self.edges.len()).filter(|k| self.same_island(*k) && self.agrees(*k)).collect()
        };
        let largest = self.state.largest();
        let stray = if paper { 1 } else { (largest / STRAY_SHARE).clamp(1, STRAY) };
        order.retain(|k| self.state.size(self.edges[*k].a) > stray);
        order.sort_by(|p, q| self.joints[*p].fit.residual.total_cmp(&self.joints[*q].fit.residual).then(p.cmp(q)));
        // Contacts that agree with a piece's pose: each beyond the first confirms it.
        let candidates = self.edges.len() - self.contacts;
        let mut evidence = vec![0.0f64; n];
        let mut chosen = Vec::new();
        for k in order {
            let slots = self.edges[k].slots;
            let own = self.model.evidence(self.edges[k].cost);
            let loops = self.edges[k].support.min(2) as f64 * AGREEMENT;
            if slots.iter().any(|s| taken.contains_key(s)) || (!paper && own + loops < IMPLAUSIBLE) {
                continue;
            }
            // What was only looked for because the pieces lie there is no further evidence that they do.
            let more = if k < candidates { own.max(0.0) + AGREEMENT } else { 0.0 };
            for s in slots {
                taken.insert(s, k);
                evidence[s.piece] += more;
            }
            chosen.push(k);
        }
        for (k, fitted) in &self.state.fitted {
            evidence[*k] = evidence[*k].max(fitted + AGREEMENT);
        }
        let sure = |evidence: f64| 1.0 / (1.0 + (-evidence).exp());
        for k in chosen {
            let [tab, mouth] = self.edges[k].slots;
            // The first contact of a piece confirms nothing beside itself.
            let least = (evidence[tab.piece].min(evidence[mouth.piece]) - AGREEMENT).max(0.0);
            // All of the border where they lie says more than the segment by which they were matched.
            let e = &self.edges[k];
            let b_from_a = self.state.pose[e.b].inverse() * self.state.pose[e.a];
            let contact = (!paper).then(|| self.contact_of(e.a, e.b, &b_from_a, FINE)).flatten();
            let clearance = contact.map_or(self.joints[k].fit.clearance, |c| c.clearance);
            matings.push(Mated { joint: k, confidence: sure(least), clearance });
        }
        let confidence: Vec<f64> = evidence.iter().map(|e| sure((e - AGREEMENT).max(0.0))).collect();
        Outcome {
            poses: (0..n)
                .map(|k| (self.state.size(k) > stray).then(|| (self.state.island(k), self.state.pose[k])))
                .collect(),
            support: self.edges.iter().map(|e| e.support).collect(),
            matings,
            confidence,
            backtracks: self.backtracks,
            partial: self.partial,
            ..Outcome::default()
        }
    }
}
