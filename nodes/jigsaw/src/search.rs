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

use crate::contact::{ClearancePrior, Contact, Memory};
use crate::loops::{self, Edge, Slot, Tolerance, conflict, difference};
use crate::outline::Outline;
use crate::posegraph::{Factor, minimise};
use crate::solver::Budget;
use crate::{Params, Policy, placement};
use nalgebra::{Isometry2, Matrix3, Point2, Translation2, UnitComplex, Vector2};
use std::collections::{BTreeMap, HashMap};

/// Overlap of two pieces that can't be a matter of drift or clearance, in squared piece scales.
const OVERLAP: f64 = 0.02;
/// The same for poses that are not refined, which are off by a degree.
const UNREFINED_OVERLAP: f64 = 0.05;
/// Loops of refined poses close to within this on real pieces (0.8 % and 0.44° measured); calibration tightens it.
const LOOSE: Tolerance = Tolerance { position: 0.04, angle: 0.05 };
/// A closure this many times the typical one is no closure.
const CLOSURE_FACTOR: f64 = 5.0;
/// So many loops tell a puzzle's closures from chance if their median error is at most this part of the loose
/// tolerance: true closures crowd near zero, chance ones spread over the whole of it (median near 0.7).
const CROWD: (usize, f64) = (4, 0.4);
/// Tolerance never tighter than this: below it only the noise of the noise is measured.
const TIGHT: Tolerance = Tolerance { position: 0.003, angle: 0.003 };
/// Pose agreement of candidates with an island that has been adjusted.
const AGREE: Tolerance = Tolerance { position: 0.05, angle: 0.08 };
/// The same when calibrated, at least.
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

/// A candidate given to the assembly.
#[derive(Debug, Clone)]
pub(crate) struct Joint {
    pub(crate) a: usize,
    pub(crate) tab: usize,
    pub(crate) b: usize,
    pub(crate) mouth: usize,
    pub(crate) fit: placement::Fit,
}

/// The poses found.
#[derive(Debug, Clone, Default)]
pub(crate) struct Outcome {
    /// Island and pose (island from image) of each piece; `None` if left over.
    pub(crate) poses: Vec<Option<(usize, Isometry2<f64>)>>,
    /// Loop support of each joint given.
    pub(crate) support: Vec<usize>,
    /// Joints that are matings of the assembly, with their confidence.
    pub(crate) matings: Vec<(usize, f64)>,
    /// Confidence of each piece.
    pub(crate) confidence: Vec<f64>,
    pub(crate) backtracks: usize,
    pub(crate) partial: bool,
}

/// Islands and poses: what backtracking saves and restores.
#[derive(Debug, Clone)]
struct State {
    island: Vec<usize>,
    members: Vec<Vec<usize>>,
    pose: Vec<Isometry2<f64>>,
    joined: Vec<usize>,
    used: HashMap<Slot, usize>,
    refined: Vec<usize>,
}

impl State {
    fn new(n: usize) -> Self {
        Self {
            island: (0..n).collect(),
            members: (0..n).map(|k| vec![k]).collect(),
            pose: vec![Isometry2::identity(); n],
            joined: Vec::new(),
            used: HashMap::new(),
            refined: vec![1; n],
        }
    }
}

/// Costs (logarithms of residuals) of right candidates, and of the best wrong one beside each: mean and deviation.
#[derive(Debug, Clone, Copy)]
struct Model {
    right: (f64, f64),
    wrong: (f64, f64),
}

impl Model {
    /// Logarithm of how much likelier a cost is for a right candidate than for the best wrong one of a mouth.
    fn evidence(&self, cost: f64) -> f64 {
        let density = |(mean, deviation): (f64, f64)| {
            let z = (cost.max(self.right.0) - mean) / deviation;
            -0.5 * z * z - f64::ln(deviation)
        };
        // Beyond the mean of the wrong ones the two densities cross again; there it is simply wrong.
        if cost > self.wrong.0.max(self.right.0 + self.right.1) {
            return -STRONG;
        }
        (density(self.right) - density(self.wrong)).clamp(-STRONG, STRONG)
    }
}

/// Evidence beyond which more doesn't count (natural logarithm of odds).
const STRONG: f64 = 12.0;
/// Evidence of one more candidate that agrees on a pose, or of one closed loop: chance agreement is rarer than this.
const AGREEMENT: f64 = 4.0;
/// Evidence that a join must have: odds of fifty to one.
const ACCEPT: f64 = 4.0;
/// Evidence below which a candidate is no mating, whatever supports it.
const IMPLAUSIBLE: f64 = -6.0;
/// Most that one candidate counts against the pose that it shares with others.
const WORN: f64 = -3.0;
/// How much farther apart the poses of two candidates may be for each scale that lies between them (their turn).
const SWING: f64 = 0.008;

struct Assembler<'a> {
    outlines: &'a [&'a Outline],
    params: &'a Params,
    memory: &'a Memory,
    budget: &'a dyn Budget,
    edges: Vec<Edge>,
    /// Candidates at each piece.
    at: Vec<Vec<usize>>,
    scale: f64,
    prior: ClearancePrior,
    /// What true and false candidates cost.
    model: Model,
    /// How far poses of true candidates may differ from an adjusted island.
    agree: Tolerance,
    state: State,
    backtracks: usize,
    partial: bool,
}

/// Assembles; `joints` are in the order of ranks.
pub(crate) fn assemble(
    outlines: &[&Outline],
    joints: &[Joint],
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
    let mut edges: Vec<Edge> = joints
        .iter()
        .map(|j| Edge {
            a: j.a,
            tab: j.tab,
            b: j.b,
            mouth: j.mouth,
            b_from_a: j.fit.negative_from_positive,
            cost: j.fit.residual.max(1e-4).ln(),
            mouth_rank: 0,
            tab_rank: 0,
            support: 0,
        })
        .collect();
    rank(&mut edges);
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
        edges,
        at,
        scale,
        prior: ClearancePrior { mean: 0.0, deviation: 0.01 * scale, noise: noise.max(0.02) },
        model: Model {
            right: ((1.5 * noise + 0.001 * scale).ln(), 0.4),
            wrong: ((1.5 * noise + 0.01 * scale).ln(), 0.5),
        },
        agree: AGREE,
        state: State::new(n),
        backtracks: 0,
        partial: false,
    };
    match params.policy {
        Policy::Standard => assembler.run(joints),
        Policy::Paper => assembler.descend(joints),
    }
}

/// Ranks the candidates of each mouth and tab by cost.
fn rank(edges: &mut [Edge]) {
    let mut order: Vec<usize> = (0..edges.len()).collect();
    order.sort_by(|p, q| edges[*p].cost.total_cmp(&edges[*q].cost).then(p.cmp(q)));
    let mut count: HashMap<Slot, usize> = HashMap::new();
    for k in order {
        let [tab, mouth] = edges[k].slots();
        let c = count.entry(tab).or_default();
        edges[k].tab_rank = *c;
        *c += 1;
        let c = count.entry(mouth).or_default();
        edges[k].mouth_rank = *c;
        *c += 1;
    }
}

fn median(values: &mut [f64]) -> Option<f64> {
    if values.is_empty() {
        return None;
    }
    let middle = values.len() / 2;
    Some(*values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

impl Assembler<'_> {
    fn run(&mut self, joints: &[Joint]) -> Outcome {
        let outstanding = self.outstanding();
        self.learn(&outstanding);
        let found = if self.params.loops { self.close_loops(joints) } else { Vec::new() };
        self.islands(&found);
        let trusted: Vec<usize> = self.state.joined.clone();
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
        self.refine_all(FINAL_ROUNDS, FINE);
        self.finish_sure(joints)
    }

    /// The outcome without the pieces and matings that are less sure than asked for.
    fn finish_sure(&mut self, joints: &[Joint]) -> Outcome {
        let least = self.params.minimum_confidence;
        let mut outcome = self.finish(joints);
        // Each round takes something out, so there are no more rounds than pieces and matings.
        for _ in 0..self.outlines.len() + self.state.joined.len() {
            let unsure: Vec<usize> = (0..self.outlines.len())
                .filter(|k| outcome.poses[*k].is_some() && outcome.confidence[*k] < least)
                .collect();
            let weak: Vec<usize> = outcome.matings.iter().filter(|m| m.1 < least).map(|m| m.0).collect();
            let joined: Vec<usize> = weak.into_iter().filter(|k| self.state.joined.contains(k)).collect();
            if unsure.is_empty() && joined.is_empty() {
                break;
            }
            self.detach(&unsure, &joined);
            outcome = self.finish(joints);
        }
        outcome.matings.retain(|m| m.1 >= least);
        outcome
    }

    /// The paper's assembly: down the ranked table, mating whatever fits without intolerable overlap; when pieces are
    /// left that can't be joined up, back. Decisions are taken back by limited discrepancy search (Harvey and
    /// Ginsberg 1995): every descent that differs from the greedy one in one decision, the weakest first, then in two.
    fn descend(&mut self, joints: &[Joint]) -> Outcome {
        let n = self.outlines.len();
        let mut ranked: Vec<usize> = (0..self.edges.len()).collect();
        ranked.sort_by(|p, q| self.edges[*p].cost.total_cmp(&self.edges[*q].cost).then(p.cmp(q)));
        let mut queue = std::collections::VecDeque::from([Vec::new()]);
        let mut best: Option<(usize, State)> = None;
        while let Some(skipped) = queue.pop_front() {
            self.state = State::new(n);
            let mut decisions = Vec::new();
            for &k in &ranked {
                if !skipped.contains(&k) && !self.same_island(k) && self.join(k) {
                    decisions.push(k);
                }
            }
            let placed = self.state.members.iter().map(Vec::len).max().unwrap_or(0);
            if best.as_ref().is_none_or(|b| placed > b.0) {
                best = Some((placed, self.state.clone()));
            }
            if placed == n || self.backtracks >= self.params.backtracks || self.late() {
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
        let trusted = self.state.joined.clone();
        self.learn(&trusted);
        self.finish_sure(joints)
    }

    fn late(&mut self) -> bool {
        if self.budget.spent() >= 1.0 {
            self.partial = true;
        }
        self.partial
    }

    fn active(&self) -> Vec<usize> {
        (0..self.edges.len())
            .filter(|k| self.edges[*k].mouth_rank < LOOP_RANKS && self.edges[*k].tab_rank < LOOP_RANKS)
            .collect()
    }

    /// Finds loops twice: loosely to calibrate closure, clearance and residual, then with what was learnt.
    fn close_loops(&mut self, joints: &[Joint]) -> Vec<loops::Loop> {
        let mut tolerance = LOOSE;
        let active = self.active();
        let low = |e: &Edge| e.mouth_rank < FIRST_RANKS && e.tab_rank < FIRST_RANKS;
        let best: Vec<usize> = active.iter().copied().filter(|k| low(&self.edges[*k])).collect();
        let first = loops::find(&self.edges, &best, self.outlines, tolerance);
        let typical = median(&mut first.iter().map(|l| l.error).collect::<Vec<f64>>()).unwrap_or(1.0);
        if self.params.recalibrate && (first.len() < CROWD.0 || typical > CROWD.1) {
            return self.outstanding_loops(first);
        }
        if self.params.recalibrate {
            let factor = (CLOSURE_FACTOR * typical).min(1.0);
            tolerance.position = (LOOSE.position * factor).max(TIGHT.position);
            tolerance.angle = (LOOSE.angle * factor).max(TIGHT.angle);
            let mut supported: Vec<usize> =
                first.iter().filter(|l| l.error <= 2.0 * typical).flat_map(|l| l.edges.iter().copied()).collect();
            supported.sort_unstable();
            supported.dedup();
            self.calibrate(joints, &supported);
            rank(&mut self.edges);
            self.learn(&supported);
            // Two steps of a loop err more than one; an island's drift is not known, so it may be twice that.
            self.agree = Tolerance {
                position: (2.0 * tolerance.position).clamp(MIN_AGREE.position, AGREE.position),
                angle: (2.0 * tolerance.angle).clamp(MIN_AGREE.angle, AGREE.angle),
            };
        }
        let active = self.active();
        let found = loops::find(&self.edges, &active, self.outlines, tolerance);
        self.sorted(found)
    }

    /// Loops of so few or so loose ones that they may be chance: those whose candidates lead their rivals as well.
    fn outstanding_loops(&mut self, found: Vec<loops::Loop>) -> Vec<loops::Loop> {
        let lead = |l: &loops::Loop| l.edges.iter().map(|k| self.lead(*k)).sum::<f64>();
        let (kept, _) = found.into_iter().partition(|l| lead(l) >= ACCEPT);
        self.sorted(kept)
    }

    /// Counts what supports what, and puts the best loops first.
    fn sorted(&mut self, mut found: Vec<loops::Loop>) -> Vec<loops::Loop> {
        for l in &found {
            for &k in &l.edges {
                self.edges[k].support += 1;
            }
        }
        let value = |l: &loops::Loop| {
            let cost: f64 = l.edges.iter().map(|k| self.edges[*k].cost).sum::<f64>() / l.edges.len() as f64;
            let support: f64 =
                l.edges.iter().map(|k| (self.edges[*k].support as f64).min(4.0)).sum::<f64>() / l.edges.len() as f64;
            cost + 0.5 * l.error - 0.5 * support
        };
        let mut keyed: Vec<(f64, loops::Loop)> = found.drain(..).map(|l| (value(&l), l)).collect();
        keyed.sort_by(|p, q| p.0.total_cmp(&q.0).then_with(|| p.1.edges.cmp(&q.1.edges)));
        keyed.into_iter().map(|(_, l)| l).collect()
    }

    /// Clearance and residual of true matings, from supported ones; costs follow.
    fn calibrate(&mut self, joints: &[Joint], supported: &[usize]) {
        let mut clearances: Vec<f64> = supported.iter().map(|k| joints[*k].fit.clearance).collect();
        let Some(mean) = median(&mut clearances) else { return };
        let mut off: Vec<f64> = clearances.iter().map(|c| (c - mean).abs()).collect();
        let deviation = 1.48 * median(&mut off).unwrap_or(0.0);
        // Small sets measure the deviation badly, and clearances may differ from cut to cut.
        self.prior.mean = mean;
        self.prior.deviation = deviation.max(0.002 * self.scale);
        for (k, e) in self.edges.iter_mut().enumerate() {
            let z = (joints[k].fit.clearance - mean) / self.prior.deviation;
            e.cost = joints[k].fit.residual.max(1e-4).ln() + 0.06 * (z * z).min(9.0);
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
            let mouth = self.edges[k].slots()[1];
            let others = self.at[mouth.piece].iter().map(|j| (*j, &self.edges[*j]));
            let best =
                others.filter(|(j, e)| *j != k && e.slots()[1] == mouth).map(|(_, e)| e.cost).min_by(f64::total_cmp);
            wrong.extend(best);
        }
        if right.len() < FEW || wrong.len() < FEW {
            return;
        }
        let fit = |values: &mut Vec<f64>, low: f64, high: f64| {
            let middle = median(values).unwrap_or(0.0);
            let mut off: Vec<f64> = values.iter().map(|v| (v - middle).abs()).collect();
            (middle, (1.48 * median(&mut off).unwrap_or(low)).clamp(low, high))
        };
        // Widths: never so narrow that a good candidate looks bad, never so wide that everything looks alike.
        self.model = Model { right: fit(&mut right, 0.15, 0.5), wrong: fit(&mut wrong, 0.2, 0.7) };
    }

    /// Candidates that are the best of their tab and of their mouth by a wide margin: what to learn from without loops.
    fn outstanding(&self) -> Vec<usize> {
        const WIDE: f64 = 0.7; // half the residual of any rival
        (0..self.edges.len())
            .filter(|&k| {
                let e = &self.edges[k];
                let clear = |slot: Slot| {
                    self.at[slot.piece].iter().all(|j| {
                        *j == k || !self.edges[*j].slots().contains(&slot) || self.edges[*j].cost > e.cost + WIDE
                    })
                };
                e.mouth_rank == 0 && e.tab_rank == 0 && e.slots().into_iter().all(clear)
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
        self.state.island[e.a] == self.state.island[e.b]
    }

    /// Whether no other mating has taken the stretch of border.
    fn free(&self, k: usize) -> bool {
        self.edges[k].slots().iter().all(|s| {
            let outline = self.outlines[s.piece];
            let taken = |tab: bool, count: usize| {
                (0..count).any(|index| {
                    let other = Slot { piece: s.piece, tab, index };
                    self.state.used.get(&other).is_some_and(|j| *j != k) && conflict(outline, *s, other)
                })
            };
            !taken(true, outline.tabs.len()) && !taken(false, outline.mouths.len())
        })
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
        d <= self.agree.position && turn <= self.agree.angle
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
        let (ia, ib) = (self.state.island[e.a], self.state.island[e.b]);
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
        let (ia, ib) = (self.state.island[first.a], self.state.island[first.b]);
        let (mut here, mut there) = (Vec::new(), Vec::new());
        for &k in members {
            let e = &self.edges[k];
            let centre = self.outlines[e.a].tabs[e.tab].origin;
            for (dx, dy) in [(0.3, 0.0), (-0.3, 0.0), (0.0, 0.3), (0.0, -0.3)] {
                let p = centre + Vector2::new(dx, dy) * self.scale;
                let (in_a, in_b) = (self.state.pose[e.a] * p, self.state.pose[e.b] * (e.b_from_a * p));
                let forward = self.state.island[e.a] == ia;
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
        for s in self.edges[k].slots() {
            self.state.used.insert(s, k);
        }
        if !self.state.joined.contains(&k) {
            self.state.joined.push(k);
        }
    }

    /// Moves the smaller of two islands into the frame of the other, unless they overlap.
    fn merge(&mut self, ia: usize, ib: usize, b_from_a: &Isometry2<f64>) -> bool {
        if self.islands_overlap(ia, ib, b_from_a) > self.tolerated() {
            return false;
        }
        let (from, to, motion) = if self.state.members[ia].len() <= self.state.members[ib].len() {
            (ia, ib, *b_from_a)
        } else {
            (ib, ia, b_from_a.inverse())
        };
        let moved = std::mem::take(&mut self.state.members[from]);
        for &k in &moved {
            self.state.pose[k] = motion * self.state.pose[k];
            self.state.island[k] = to;
        }
        self.state.members[to].extend(moved);
        // Drift grows with the way through the island; adjusting at every doubling keeps it small at little cost.
        let size = self.state.members[to].len();
        if self.params.pose_graph
            && self.params.policy == Policy::Standard
            && size >= 6
            && size >= 3 * self.state.refined[to].max(2) / 2
        {
            self.state.refined[to] = size;
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
        for &p in &self.state.members[ia] {
            let pose = b_from_a * self.state.pose[p];
            let centre = pose * self.outlines[p].centroid;
            for &q in &self.state.members[ib] {
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
        let members = &self.state.members[island];
        let mut placed: Vec<(f64, f64, usize)> =
            members.iter().map(|k| (self.centre_of(*k), *k)).map(|(c, k)| (c.x, c.y, k)).collect();
        placed.sort_by(|p, q| p.0.total_cmp(&q.0));
        let reach = 2.0 * members.iter().map(|k| self.outlines[*k].radius).fold(0.0, f64::max);
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
        let members = self.state.members[island].clone();
        if members.len() < 2 {
            return;
        }
        let mut place = HashMap::new();
        for (i, k) in members.iter().enumerate() {
            place.insert(*k, i);
        }
        let references: Vec<Point2<f64>> =
            members.iter().map(|k| self.state.pose[*k] * self.outlines[*k].centroid).collect();
        let pairs = self.neighbours(island);
        use rayon::prelude::*;
        let factors: Vec<Factor> = pairs
            .par_iter()
            .filter_map(|&(p, q)| {
                let c = self.contact_of(p, q, &(self.state.pose[q].inverse() * self.state.pose[p]), step)?;
                let pose = self.state.pose[q];
                let r = pose.rotation.to_rotation_matrix();
                let mut turn = Matrix3::identity();
                turn.fixed_view_mut::<2, 2>(0, 0).copy_from(r.matrix());
                Some(Factor {
                    a: place[&p],
                    b: place[&q],
                    centre: pose * c.centre,
                    hessian: turn * c.hessian * turn.transpose(),
                    gradient: turn * c.gradient,
                })
            })
            .collect();
        let motion = minimise(&references, &factors);
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

    fn contact_of(&self, p: usize, q: usize, q_from_p: &Isometry2<f64>, step: f64) -> Option<Contact> {
        self.memory.contact(self.outlines[p], self.outlines[q], q_from_p, (CONTACT_BAND, step), &self.prior)
    }

    fn refine_all(&mut self, rounds: usize, step: f64) {
        if !self.params.pose_graph {
            return;
        }
        for island in 0..self.state.members.len() {
            if self.state.members[island].len() > 1 {
                for _ in 0..rounds {
                    self.adjust(island, step);
                }
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
            let (ia, ib) = (self.state.island[e.a], self.state.island[e.b]);
            between.entry((ia.min(ib), ia.max(ib))).or_default().push(k);
        }
        let mut found = Vec::new();
        for ((low, high), candidates) in between {
            if !self.params.merge_islands && self.state.members[low].len() > 1 && self.state.members[high].len() > 1 {
                continue;
            }
            // Pose of the lower island in the higher.
            let poses: Vec<Isometry2<f64>> = candidates
                .iter()
                .map(|k| {
                    let e = &self.edges[*k];
                    let b_from_a = self.state.pose[e.b] * e.b_from_a * self.state.pose[e.a].inverse();
                    if self.state.island[e.a] == low { b_from_a } else { b_from_a.inverse() }
                })
                .collect();
            for (i, k) in candidates.iter().enumerate() {
                let mut group = vec![*k];
                for (j, other) in candidates.iter().enumerate() {
                    let e = &self.edges[*other];
                    let piece = if self.state.island[e.a] == low { e.a } else { e.b };
                    let (d, turn) = difference(
                        self.outlines[piece],
                        &(poses[i] * self.state.pose[piece]),
                        &(poses[j] * self.state.pose[piece]),
                    );
                    // The turn of one joint swings what is far from it.
                    let own = &self.edges[*k];
                    let here = if self.state.island[own.a] == low { own.a } else { own.b };
                    let far = (self.centre_of(here) - self.centre_of(piece)).norm() / self.scale;
                    let slots = e.slots();
                    let distinct = group.iter().all(|g| {
                        self.edges[*g]
                            .slots()
                            .iter()
                            .all(|s| slots.iter().all(|t| !conflict(self.outlines[s.piece], *s, *t)))
                    });
                    if j != i && distinct && d < AGREE.position + SWING * far && turn < AGREE.angle {
                        group.push(*other);
                    }
                }
                if let Some(evidence) = self.evidence(&group) {
                    found.push((evidence, group));
                }
            }
        }
        found
    }

    /// Evidence that candidates which agree on a pose are right; `None` if it isn't enough to act on.
    fn evidence(&self, group: &[usize]) -> Option<f64> {
        let mut sum = AGREEMENT * (group.len() - 1) as f64;
        for &k in group {
            // A worn joint among agreeing ones doesn't refute them.
            sum += self.model.evidence(self.edges[k].cost).max(WORN);
        }
        if group.len() == 1 {
            sum = sum.min(self.lead(group[0]));
        }
        (sum >= ACCEPT).then_some(sum)
    }

    /// By how much a candidate leads its free rivals for the same tab or mouth, as evidence.
    fn lead(&self, k: usize) -> f64 {
        let e = &self.edges[k];
        let own = self.model.evidence(e.cost);
        let mut lead = STRONG;
        for slot in e.slots() {
            for &j in &self.at[slot.piece] {
                let other = &self.edges[j];
                if j == k
                    || !other.slots().iter().any(|s| conflict(self.outlines[slot.piece], *s, slot))
                    || !self.free(j)
                {
                    continue;
                }
                // Costs below the typical are alike as evidence, but between rivals the better one still leads.
                let ahead = (own - self.model.evidence(other.cost)).max((other.cost - e.cost) / self.model.right.1);
                lead = lead.min(ahead);
            }
        }
        lead
    }

    /// Takes out pieces that overlap others, the less supported one of a pair; islands that fall apart are split.
    /// Tells whether anything was taken out.
    fn verify(&mut self) -> bool {
        let mut changed = false;
        for _ in 0..4 {
            let mut evict: Vec<usize> = Vec::new();
            let joined = self.joined_at();
            for island in 0..self.state.members.len() {
                for (p, q) in self.neighbours(island) {
                    let pose = self.state.pose[q].inverse() * self.state.pose[p];
                    let area = self.memory.overlap(self.outlines[p], self.outlines[q], &pose);
                    if area <= OVERLAP * self.outlines[p].scale * self.outlines[q].scale {
                        continue;
                    }
                    let weight = |k: usize| {
                        joined[k].iter().map(|j| AGREEMENT + self.model.evidence(self.edges[*j].cost)).sum::<f64>()
                    };
                    evict.push(if weight(p) < weight(q) { p } else { q });
                }
            }
            // Matings that the adjusted poses contradict hold nothing.
            let broken: Vec<usize> = self.state.joined.iter().copied().filter(|k| !self.agrees(*k)).collect();
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
        for &k in &self.state.joined {
            joined[self.edges[k].a].push(k);
            joined[self.edges[k].b].push(k);
        }
        joined
    }

    /// Undoes all matings of some pieces and some more matings; what no longer hangs together becomes islands apart.
    fn detach(&mut self, pieces: &[usize], matings: &[usize]) {
        let edges = &self.edges;
        self.state
            .joined
            .retain(|k| !matings.contains(k) && !pieces.contains(&edges[*k].a) && !pieces.contains(&edges[*k].b));
        let joined = &self.state.joined;
        self.state.used.retain(|_, k| joined.contains(k));
        let n = self.outlines.len();
        let at = self.joined_at();
        let old = std::mem::replace(&mut self.state.members, vec![Vec::new(); n]);
        let mut seen = vec![false; n];
        for members in old {
            for &root in &members {
                if seen[root] {
                    continue;
                }
                let mut part = vec![root];
                seen[root] = true;
                let mut next = 0;
                while next < part.len() {
                    for &k in &at[part[next]] {
                        for piece in [self.edges[k].a, self.edges[k].b] {
                            if !seen[piece] {
                                seen[piece] = true;
                                part.push(piece);
                            }
                        }
                    }
                    next += 1;
                }
                for &k in &part {
                    self.state.island[k] = root;
                }
                self.state.refined[root] = part.len();
                self.state.members[root] = part;
            }
        }
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
                let size = |p: usize| self.state.members[self.state.island[p]].len();
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
        let weight =
            |k: usize| joined[k].iter().map(|j| AGREEMENT + self.model.evidence(self.edges[*j].cost)).sum::<f64>();
        let mut losers = Vec::new();
        for &p in &self.state.members[ia] {
            let here = pose * self.state.pose[p];
            for &q in &self.state.members[ib] {
                let q_from_p = self.state.pose[q].inverse() * here;
                let area = self.memory.overlap(self.outlines[p], self.outlines[q], &q_from_p);
                if area > self.tolerated() * self.outlines[p].scale * self.outlines[q].scale {
                    losers.push(if weight(p) < weight(q) { p } else { q });
                }
            }
        }
        losers.sort_unstable();
        losers.dedup();
        let smaller = self.state.members[ia].len().min(self.state.members[ib].len());
        if losers.len() * EXCEPTIONS > smaller { Vec::new() } else { losers }
    }

    /// What the assembly is worth: the evidence of its matings.
    fn worth(&self) -> f64 {
        self.state.joined.iter().map(|k| AGREEMENT + self.model.evidence(self.edges[*k].cost)).sum()
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
                    let alone = |p: usize| self.state.members[self.state.island[p]].len() == 1;
                    alone(e.a) || alone(e.b)
                })
                .map(|k| (self.model.evidence(self.edges[k].cost), k))
                .filter(|(evidence, _)| *evidence > 0.0)
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
            for slot in self.edges[k].slots() {
                for (other, j) in &self.state.used {
                    if conflict(self.outlines[slot.piece], *other, slot) {
                        let e = &self.edges[*j];
                        occupants.push(if e.a == slot.piece { e.b } else { e.a });
                    }
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

    fn finish(&mut self, joints: &[Joint]) -> Outcome {
        let n = self.outlines.len();
        let mut matings = Vec::new();
        let mut taken: HashMap<Slot, usize> = HashMap::new();
        let paper = self.params.policy == Policy::Paper;
        // Unrefined poses contradict each other too much to recognise contacts that weren't decided on.
        let mut order: Vec<usize> = if paper {
            self.state.joined.clone()
        } else {
            (0..self.edges.len()).filter(|k| self.same_island(*k) && self.agrees(*k)).collect()
        };
        let largest = self.state.members.iter().map(Vec::len).max().unwrap_or(0);
        let stray = if paper { 1 } else { (largest / STRAY_SHARE).clamp(1, STRAY) };
        order.retain(|k| self.state.members[self.state.island[self.edges[*k].a]].len() > stray);
        order.sort_by(|p, q| joints[*p].fit.residual.total_cmp(&joints[*q].fit.residual).then(p.cmp(q)));
        // Contacts that agree with a piece's pose: each beyond the first confirms it.
        let mut evidence = vec![0.0f64; n];
        let mut chosen = Vec::new();
        for k in order {
            let slots = self.edges[k].slots();
            let own = self.model.evidence(self.edges[k].cost);
            let loops = self.edges[k].support.min(2) as f64 * AGREEMENT;
            if slots.iter().any(|s| taken.contains_key(s)) || (!paper && own + loops < IMPLAUSIBLE) {
                continue;
            }
            for s in slots {
                taken.insert(s, k);
                evidence[s.piece] += own.max(0.0) + AGREEMENT;
            }
            chosen.push(k);
        }
        let sure = |evidence: f64| 1.0 / (1.0 + (-evidence).exp());
        for k in chosen {
            let [tab, mouth] = self.edges[k].slots();
            // The first contact of a piece confirms nothing beside itself.
            let least = (evidence[tab.piece].min(evidence[mouth.piece]) - AGREEMENT).max(0.0);
            matings.push((k, sure(least)));
        }
        let confidence: Vec<f64> = evidence.iter().map(|e| sure((e - AGREEMENT).max(0.0))).collect();
        Outcome {
            poses: (0..n)
                .map(|k| {
                    let island = self.state.island[k];
                    (self.state.members[island].len() > stray).then(|| (island, self.state.pose[k]))
                })
                .collect(),
            support: self.edges.iter().map(|e| e.support).collect(),
            matings,
            confidence,
            backtracks: self.backtracks,
            partial: self.partial,
        }
    }
}
