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

use crate::loops::{self, Edge, Slot, Tolerance, conflict, difference};
use crate::outline::{ClearancePrior, Contact, Outline, contact, overlap_area};
use crate::posegraph::{Factor, minimise};
use crate::{Params, placement};
use nalgebra::{Isometry2, Matrix3, Point2, Translation2, UnitComplex, Vector2};
use std::collections::{BTreeMap, HashMap};
use std::time::Instant;

/// Overlap of two pieces that can't be a matter of drift or clearance, in squared piece scales.
const OVERLAP: f64 = 0.02;
/// Loops of refined poses close to within this on real pieces (0.8 % and 0.44° measured); calibration tightens it.
const LOOSE: Tolerance = Tolerance { position: 0.04, angle: 0.05 };
/// A closure this many times the typical one is no closure.
const CLOSURE_FACTOR: f64 = 5.0;
/// Tolerance never tighter than this: below it only the noise of the noise is measured.
const TIGHT: Tolerance = Tolerance { position: 0.003, angle: 0.003 };
/// Pose agreement of candidates with an island that has been adjusted.
const AGREE: Tolerance = Tolerance { position: 0.05, angle: 0.08 };
/// Candidates of each mouth (and tab) that take part in loops: more and chance loops drown the true ones.
const LOOP_RANKS: usize = 6;
/// Candidates of each mouth and tab that take part in growth.
const GROWTH_RANKS: usize = 12;
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

struct Assembler<'a> {
    outlines: &'a [&'a Outline],
    params: &'a Params,
    deadline: Option<Instant>,
    edges: Vec<Edge>,
    /// Candidates at each piece.
    at: Vec<Vec<usize>>,
    scale: f64,
    prior: ClearancePrior,
    /// Residual of a true mating: median and robust deviation of its logarithm.
    typical: (f64, f64),
    state: State,
    backtracks: usize,
    partial: bool,
}

/// Assembles; `joints` are in the order of ranks.
pub(crate) fn assemble(outlines: &[&Outline], joints: &[Joint], params: &Params, deadline: Option<Instant>) -> Outcome {
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
        deadline,
        edges,
        at,
        scale,
        prior: ClearancePrior { mean: 0.0, deviation: 0.01 * scale, noise: noise.max(0.02) },
        typical: ((1.5 * noise + 0.001 * scale).ln(), 0.5),
        state: State::new(n),
        backtracks: 0,
        partial: false,
    };
    assembler.run(joints)
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
        let found = if self.params.loops { self.close_loops(joints) } else { Vec::new() };
        self.islands(&found);
        self.refine_all(2);
        self.grow();
        self.verify();
        self.finish(joints)
    }

    fn late(&mut self) -> bool {
        if self.deadline.is_some_and(|d| Instant::now() >= d) {
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
        let best: Vec<usize> =
            active.iter().copied().filter(|k| self.edges[*k].mouth_rank < 2 && self.edges[*k].tab_rank < 2).collect();
        let first = loops::find(&self.edges, &best, self.outlines, tolerance);
        // Enough loops to tell the crowd at zero from chance.
        const ENOUGH: usize = 4;
        if self.params.recalibrate && first.len() >= ENOUGH {
            let mut errors: Vec<f64> = first.iter().map(|l| l.error).collect();
            let typical = median(&mut errors).unwrap_or(1.0);
            let factor = (CLOSURE_FACTOR * typical).min(1.0);
            tolerance.position = (LOOSE.position * factor).max(TIGHT.position);
            tolerance.angle = (LOOSE.angle * factor).max(TIGHT.angle);
            let mut supported: Vec<usize> =
                first.iter().filter(|l| l.error <= 2.0 * typical).flat_map(|l| l.edges.iter().copied()).collect();
            supported.sort_unstable();
            supported.dedup();
            self.calibrate(joints, &supported);
            rank(&mut self.edges);
        }
        let active = self.active();
        let mut found = loops::find(&self.edges, &active, self.outlines, tolerance);
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
        let mut residuals: Vec<f64> = supported.iter().map(|k| joints[*k].fit.residual.max(1e-4).ln()).collect();
        let middle = median(&mut residuals).unwrap_or(self.typical.0);
        let mut off: Vec<f64> = residuals.iter().map(|c| (c - middle).abs()).collect();
        self.typical = (middle, (1.48 * median(&mut off).unwrap_or(0.3)).clamp(0.15, 0.6));
        for (k, e) in self.edges.iter_mut().enumerate() {
            let z = (joints[k].fit.clearance - mean) / self.prior.deviation;
            e.cost = joints[k].fit.residual.max(1e-4).ln() + 0.06 * (z * z).min(9.0);
        }
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
        d <= AGREE.position && turn <= AGREE.angle
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
        if self.islands_overlap(ia, ib, b_from_a) > OVERLAP {
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
        if self.params.pose_graph && size >= 6 && size >= 3 * self.state.refined[to].max(2) / 2 {
            self.state.refined[to] = size;
            self.adjust(to);
        }
        true
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
                let area = overlap_area(self.outlines[p], self.outlines[q], &q_from_p);
                worst = worst.max(area / (self.outlines[p].scale * self.outlines[q].scale));
                if worst > OVERLAP {
                    return worst;
                }
            }
        }
        worst
    }

    /// Pairs of pieces of one island near enough to touch.
    fn neighbours(&self, island: usize) -> Vec<(usize, usize)> {
        let members = &self.state.members[island];
        let cell = members.iter().map(|k| self.outlines[*k].radius).fold(0.0, f64::max) * 2.0 + 1.0;
        let mut grid: BTreeMap<(i64, i64), Vec<usize>> = BTreeMap::new();
        let centre = |k: usize| self.state.pose[k] * self.outlines[k].centroid;
        for &k in members {
            let c = centre(k);
            grid.entry(((c.x / cell).floor() as i64, (c.y / cell).floor() as i64)).or_default().push(k);
        }
        let mut pairs = Vec::new();
        for &p in members {
            let c = centre(p);
            let (x, y) = ((c.x / cell).floor() as i64, (c.y / cell).floor() as i64);
            for (dx, dy) in (-1..=1).flat_map(|dx| (-1..=1).map(move |dy| (dx, dy))) {
                for &q in grid.get(&(x + dx, y + dy)).into_iter().flatten() {
                    if q > p && (centre(q) - c).norm() <= self.outlines[p].radius + self.outlines[q].radius {
                        pairs.push((p, q));
                    }
                }
            }
        }
        pairs.sort_unstable();
        pairs
    }

    /// Adjusts all poses of an island to all contacts of its outlines.
    fn adjust(&mut self, island: usize) {
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
                let c = self.contact_of(p, q, &(self.state.pose[q].inverse() * self.state.pose[p]))?;
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

    fn contact_of(&self, p: usize, q: usize, q_from_p: &Isometry2<f64>) -> Option<Contact> {
        let (a, b) = (self.outlines[p], self.outlines[q]);
        // About 200 points around a piece: more adds nothing to an adjustment.
        let stride = ((a.scale / 50.0 / a.spacing) as usize).max(1);
        contact(a, b, q_from_p, CONTACT_BAND * self.scale, stride, &self.prior)
    }

    fn refine_all(&mut self, rounds: usize) {
        if !self.params.pose_graph {
            return;
        }
        for island in 0..self.state.members.len() {
            if self.state.members[island].len() > 1 {
                for _ in 0..rounds {
                    self.adjust(island);
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
            hypotheses.sort_by(|p, q| q.0.cmp(&p.0).then(p.1.total_cmp(&q.1)).then(p.2.cmp(&q.2)));
            let mut joined = 0;
            for (_, _, members) in hypotheses {
                // Earlier joins may have changed what is admissible; `join` checks again.
                if self.same_island(members[0]) {
                    continue;
                }
                if self.join(members[0]) {
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
            self.refine_all(1);
        }
    }

    /// Ways to join two islands: agreeing candidates, their mean cost, the candidates.
    fn hypotheses(&self) -> Vec<(usize, f64, Vec<usize>)> {
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
                    let slots = e.slots();
                    let distinct = group.iter().all(|g| {
                        self.edges[*g]
                            .slots()
                            .iter()
                            .all(|s| slots.iter().all(|t| !conflict(self.outlines[s.piece], *s, *t)))
                    });
                    if j != i && distinct && d < AGREE.position && turn < AGREE.angle {
                        group.push(*other);
                    }
                }
                let cost = group.iter().map(|k| self.edges[*k].cost).sum::<f64>() / group.len() as f64;
                if group.len() > 1 || self.clear(*k) {
                    found.push((group.len(), cost, group));
                }
            }
        }
        found
    }

    /// A single candidate that may be believed: mutually best, as good as true ones are, and clear of its rivals.
    fn clear(&self, k: usize) -> bool {
        /// Rivals must cost this much more (natural logarithm of the residual).
        const MARGIN: f64 = 0.25;
        let e = &self.edges[k];
        if e.cost > self.typical.0 + 3.0 * self.typical.1 {
            return false;
        }
        let rival = |piece: usize, slot: Slot| {
            self.at[piece].iter().any(|j| {
                let other = &self.edges[*j];
                *j != k && other.slots().contains(&slot) && other.cost < e.cost + MARGIN && self.free(*j)
            })
        };
        let [tab, mouth] = e.slots();
        !rival(e.a, tab) && !rival(e.b, mouth)
    }

    /// Takes out what overlaps or doesn't follow its neighbours.
    fn verify(&mut self) {
        self.refine_all(2);
    }

    fn finish(&mut self, joints: &[Joint]) -> Outcome {
        let n = self.outlines.len();
        let mut matings = Vec::new();
        let mut taken: HashMap<Slot, usize> = HashMap::new();
        let mut order: Vec<usize> = (0..self.edges.len()).filter(|k| self.same_island(*k) && self.agrees(*k)).collect();
        order.sort_by(|p, q| joints[*p].fit.residual.total_cmp(&joints[*q].fit.residual).then(p.cmp(q)));
        for k in order {
            let slots = self.edges[k].slots();
            let limit = self.typical.0 + 6.0 * self.typical.1;
            if slots.iter().any(|s| taken.contains_key(s)) || self.edges[k].cost > limit {
                continue;
            }
            for s in slots {
                taken.insert(s, k);
            }
            matings.push((k, if self.edges[k].support > 0 { 0.99 } else { 0.9 }));
        }
        let mut confidence = vec![0.0f64; n];
        for (k, c) in &matings {
            for piece in [self.edges[*k].a, self.edges[*k].b] {
                confidence[piece] = confidence[piece].max(*c);
            }
        }
        Outcome {
            poses: (0..n)
                .map(|k| {
                    let island = self.state.island[k];
                    (self.state.members[island].len() > 1).then(|| (island, self.state.pose[k]))
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
