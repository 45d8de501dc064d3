//! Loop closure: which candidates are supported by the pieces that meet round a corner.
//!
//! Where four pieces meet, two ways lead from one piece to the one across: over the left and over the right
//! neighbour. For true matings the two poses agree to a fraction of a percent of the piece scale; for false ones
//! agreement is chance. Three pieces round a corner (brickwork, mosaics) close the same way. A loop is a set of three
//! or four candidates whose poses agree, each piece entering and leaving by different isthmuses.
//!
//! 1. *Misclosure*: how far a loop fails to close is measured against what its candidates leave open (Mahalanobis
//!    distance; each candidate carries the covariance of its pose, transported round the loop). A tab that may slide
//!    along its mouth is forgiven just that slide, and a worn joint, whose residuals are large, more than a good one.
//! 2. *Chance*: the same search with one piece of each way exchanged for another one of the puzzle (decoys, as in the
//!    target-decoy method of Elias and Gygi 2007) shows how many loops close by chance, and how closely. The more alike
//!    the pieces are, the more do.
//! 3. *Mixture*: in three degrees of freedom distances follow a Maxwell distribution, narrow for true loops and wide for
//!    chance ones, which know nothing of residuals. The narrow one is fitted to this puzzle; the ratio of the two is the evidence of a loop.
//!
//! Complexity O(pieces · degree²) for the two-step ways, which are compared only where they meet. Where no loops close
//! (a strip, single joints) nothing is learnt, and what is known of the borders' noise has to serve.

use crate::outline::Outline;
use crate::placement::laid_on;
use crate::posegraph::{lever, turned};
use crate::slots::{Slot, Slots};
use isthmus::Point;
use isthmus::wide::widely;
use nalgebra::{Isometry2, Matrix3, Vector2, Vector3};
use rayon::prelude::*;

/// A candidate mating as the assembly sees it: pieces are ranks by id.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Edge {
    /// Piece with the tab, and piece with the mouth.
    pub(crate) a: usize,
    pub(crate) b: usize,
    /// The tab, and the mouth.
    pub(crate) slots: [Slot; 2],
    pub(crate) b_from_a: Isometry2<f64>,
    /// What the contact leaves open of that pose: covariance of (x, y, turn) of `a` about the point `at`, both in the
    /// image of `b`, for border residuals of variance one.
    pub(crate) covariance: Matrix3<f64>,
    /// Variance of the border residuals; about one.
    pub(crate) variance: f64,
    pub(crate) at: Point,
    /// Logarithmic cost; less is better.
    pub(crate) cost: f64,
    /// Place among the candidates of the mouth and of the tab, 0 the best.
    pub(crate) mouth_rank: usize,
    pub(crate) tab_rank: usize,
    /// Loops it takes part in.
    pub(crate) support: usize,
}

/// A closed loop: its candidates, by how much it fails to close, and the evidence (natural logarithm of odds) that it
/// doesn't close by chance.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Loop {
    pub(crate) edges: Vec<usize>,
    pub(crate) misclosure: Misclosure,
    pub(crate) evidence: f64,
}

/// How far two poses of a piece that should be one are apart, measured against what candidates leave open of them
/// (Mahalanobis distances).
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Misclosure {
    /// As if all residuals had the same variance.
    plain: f64,
    /// With the candidates' own variances, and the logarithm of how much less these leave open, by volume.
    own: f64,
    narrower: f64,
}

/// What is open of a pose: as if all residuals had the same variance, and with the candidates' own ones.
#[derive(Clone, Copy)]
struct Spread {
    plain: Matrix3<f64>,
    own: Matrix3<f64>,
}

impl std::ops::Add for Spread {
    type Output = Self;
    fn add(self, other: Self) -> Self {
        Self { plain: self.plain + other.plain, own: self.own + other.own }
    }
}

impl Misclosure {
    /// Its density among loops that are right, which close `scale` times as widely as their own residuals say, in the
    /// measure of [`maxwell`].
    fn density_if_right(&self, scale: f64) -> f64 {
        shell(self.plain, scale) * (self.narrower - 0.5 * (self.own / scale).powi(2)).exp()
    }
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
    /// The isthmuses by which it leaves the piece from which it starts, and by which it arrives.
    ends: [Slot; 2],
}

impl Way {
    /// This step, and one more from where it leads.
    fn then(&self, second: &Self) -> Self {
        let edges = [self.edges[0], second.edges[0]];
        let ends = [self.ends[0], second.ends[1]];
        Self { to: second.to, via: Some(self.to), pose: self.pose * second.pose, edges, ends }
    }
}

/// Where a way leads: the piece, and its centroid's place across the line on which ways are sorted.
#[derive(Clone, Copy)]
struct Place {
    to: usize,
    x: f64,
}

impl Tolerance {
    /// Whether two poses of a piece differ by no more.
    pub(crate) fn allows(&self, outline: &Outline, p: &Isometry2<f64>, q: &Isometry2<f64>) -> bool {
        let d: Vector2<f64> = p * outline.centroid - q * outline.centroid;
        d.norm() <= self.position * outline.scale && p.rotation.angle_to(&q.rotation).abs() <= self.angle
    }
}

/// Pose of the piece `e.a` (or `e.b`) as seen from the other one, and what the candidate leaves open of it at
/// `reference`, both in the frame of which `pose` tells how the piece left lies in it.
fn step(e: &Edge, from: usize, pose: &Isometry2<f64>, reference: Point) -> (Isometry2<f64>, Spread) {
    let (step, rotation, at) = if e.b == from {
        (e.b_from_a, pose.rotation, e.at)
    } else {
        let a_from_b = e.b_from_a.inverse();
        (a_from_b, pose.rotation * a_from_b.rotation, a_from_b * e.at)
    };
    let motion = lever(pose * at, reference) * turned(rotation);
    let plain = motion * e.covariance * motion.transpose();
    (pose * step, Spread { plain, own: plain * e.variance })
}

/// Covariance of where a way leads, at `reference`, both in the frame of the piece `start`.
fn uncertainty(edges: &[Edge], start: usize, way: &Way, reference: Point) -> Spread {
    let (pose, first) = step(&edges[way.edges[0]], start, &Isometry2::identity(), reference);
    match way.via {
        Some(via) => first + step(&edges[way.edges[1]], via, &pose, reference).1,
        None => first,
    }
}

/// How far two poses of a point are apart, given the sum of what is open of them there.
fn misclosure(p: &Isometry2<f64>, q: &Isometry2<f64>, point: Point, open: &Spread) -> Misclosure {
    let d = p * point - q * point;
    let delta = Vector3::new(d.x, d.y, q.rotation.angle_to(&p.rotation));
    let (Some(plain), Some(own)) = (open.plain.cholesky(), open.own.cholesky()) else {
        return Misclosure { plain: f64::INFINITY, own: f64::INFINITY, narrower: 0.0 };
    };
    let distance = |c: &nalgebra::Cholesky<f64, nalgebra::Const<3>>| delta.dot(&c.solve(&delta)).max(0.0).sqrt();
    let narrower = 0.5 * (plain.determinant() / own.determinant()).ln();
    Misclosure { plain: distance(&plain), own: distance(&own), narrower }
}

/// What a candidate says about where one island lies in another.
pub(crate) struct Said<'a> {
    pub(crate) edge: &'a Edge,
    /// The piece of the candidate that lies in the fixed island, and its pose there.
    pub(crate) from: usize,
    pub(crate) fixed: Isometry2<f64>,
    /// Pose of the moving island in the fixed one.
    pub(crate) pose: Isometry2<f64>,
}

/// How far apart is what two candidates between the same two islands say, at a point of the moving island.
pub(crate) fn disagreement(p: &Said, q: &Said, point: Point) -> Misclosure {
    let reference = q.pose * point;
    let open = step(p.edge, p.from, &p.fixed, reference).1 + step(q.edge, q.from, &q.fixed, reference).1;
    misclosure(&p.pose, &q.pose, point, &open)
}

/// How far what a candidate says is from how its pieces lie, at a point of its piece `a`.
pub(crate) fn deviation(edge: &Edge, b_from_a: &Isometry2<f64>, point: Point) -> Misclosure {
    let (_, open) = step(edge, edge.b, &Isometry2::identity(), b_from_a * point);
    misclosure(&edge.b_from_a, b_from_a, point, &open)
}

/// The ways between pieces, and all it takes to see which of them close.
pub(crate) struct Ways<'a> {
    edges: &'a [Edge],
    outlines: &'a [&'a Outline],
    slots: &'a Slots<'a>,
    tolerance: Tolerance,
    steps: Vec<Vec<Way>>,
}

/// What decoys show: distances of those that close, how many of those come from ways that really close, and how many
/// sets of decoys (one of every way) were tried.
#[derive(Debug, Clone, Default)]
pub(crate) struct Decoys {
    distances: Vec<f64>,
    akin: usize,
    sets: f64,
}

impl<'a> Ways<'a> {
    /// The ways along the candidates `active` (positions in `edges`).
    pub(crate) fn new(
        (edges, active): (&'a [Edge], &[usize]),
        (outlines, slots): (&'a [&'a Outline], &'a Slots<'a>),
        tolerance: Tolerance,
    ) -> Self {
        let mut counts = vec![0; outlines.len()];
        active.iter().flat_map(|k| [edges[*k].a, edges[*k].b]).for_each(|piece| counts[piece] += 1);
        let mut steps: Vec<Vec<Way>> = counts.into_iter().map(Vec::with_capacity).collect();
        for &k in active {
            let e = &edges[k];
            let [tab, mouth] = e.slots;
            let way = |to, pose, ends| Way { to, via: None, pose, edges: [k, k], ends };
            steps[e.b].push(way(e.a, e.b_from_a, [mouth, tab]));
            steps[e.a].push(way(e.b, e.b_from_a.inverse(), [tab, mouth]));
        }
        Self { edges, outlines, slots, tolerance, steps }
    }

    /// All loops that close within the tolerance, and what would close if the piece on each way of two steps were another
    /// one. Of large puzzles only a part of the decoys is tried.
    pub(crate) fn close(&self) -> (Vec<Loop>, Decoys) {
        /// Sets of decoys at most: a few pieces have too few ways to show what chance does.
        const SETS: u64 = 3;
        /// Ways tried at most, about: more don't make chance better known.
        const TRIES: f64 = 12_000.0;
        let n = self.outlines.len();
        let doors = [false, true].map(|tabs| (0..n).flat_map(|k| self.slots.of(k, tabs)).collect::<Vec<Slot>>());
        // Of the ways from each piece about half lead to pieces of higher rank.
        let ways: usize = self.steps.iter().map(|s| s.len() * s.len()).sum::<usize>() / 2;
        let share = (TRIES / (SETS * ways.max(1) as u64) as f64).min(1.0);
        let tried = |a: usize| (share * (a + 1) as f64).floor() > (share * a as f64).floor();
        let from = |leading: &mut Vec<u32>, a: usize| {
            let ways = self.from(a, leading);
            (self.close_at(a, &ways), tried(a).then(|| self.decoys_at(a, &ways, &doors, SETS)))
        };
        let found: Vec<(Vec<Loop>, Option<Decoys>)> = (0..n).into_par_iter().map_init(|| vec![0; n], from).collect();
        let sets = SETS as f64 * (0..n).filter(|a| tried(*a)).count() as f64 / n.max(1) as f64;
        let mut all = (Vec::new(), Decoys { sets, ..Decoys::default() });
        for (loops, decoys) in found {
            all.0.extend(loops);
            if let Some(some) = decoys {
                all.1.distances.extend(some.distances);
                all.1.akin += some.akin;
            }
        }
        all
    }

    /// Ways of one and two steps from `a` to pieces of higher rank to which others lead as well, ordered by the piece and by
    /// where they lead: compared in this order, what is near stays near. `leading` counts the ways to each piece; it is all
    /// zeros before and after.
    fn from(&self, a: usize, leading: &mut [u32]) -> Vec<(Place, Way)> {
        let steps = self.steps[a].iter().filter(|w| w.to > a);
        let mut long: Vec<(usize, &Way, Option<&Way>)> =
            Vec::with_capacity(steps.clone().map(|w| 1 + self.steps[w.to].len()).sum());
        for first in steps {
            long.push((first.to, first, None));
            let onwards = self.steps[first.to].iter().filter(|w| w.to > a && w.to != first.to);
            let free = onwards.filter(|second| !self.slots.conflict(first.ends[1], second.ends[0]));
            long.extend(free.map(|second| (second.to, first, Some(second))));
        }
        long.iter().for_each(|(to, ..)| leading[*to] += 1);
        // Most lead where no other does, and are not worth more than that.
        long.retain(|(to, ..)| leading[*to] > 1 || std::mem::take(&mut leading[*to]) > 1);
        long.iter().for_each(|(to, ..)| leading[*to] = 0);
        long.sort_unstable_by_key(|(to, ..)| *to);
        let mut ways: Vec<(Place, Way)> = Vec::with_capacity(long.len());
        ways.extend(long.into_iter().map(|(_, first, second)| {
            let way = second.map_or(*first, |second| first.then(second));
            (self.place(&way), way)
        }));
        let before =
            |(p, v): &(Place, Way), (q, w): &(Place, Way)| p.x.total_cmp(&q.x).then_with(|| v.edges.cmp(&w.edges));
        ways.chunk_by_mut(|p, q| p.0.to == q.0.to).for_each(|group| group.sort_unstable_by(before));
        ways
    }

    fn place(&self, way: &Way) -> Place {
        Place { to: way.to, x: (way.pose * self.outlines[way.to].centroid).x }
    }

    /// How far apart the places of two ways to a piece may be.
    fn reach(&self, to: usize) -> f64 {
        self.tolerance.position * self.outlines[to].scale
    }

    /// The loops in which `a` has the least rank, given the ways from it.
    fn close_at(&self, a: usize, ways: &[(Place, Way)]) -> Vec<Loop> {
        let mut found = Vec::new();
        for group in ways.chunk_by(|p, q| p.0.to == q.0.to) {
            let reach = self.reach(group[0].0.to);
            for (i, (place, p)) in group.iter().enumerate() {
                let near = group[i + 1..].iter().take_while(|(other, _)| other.x - place.x <= reach);
                found.extend(near.filter_map(|(_, q)| self.join(a, p, q)));
            }
        }
        found
    }

    /// The decoys of some sets among the loops in which `a` has the least rank.
    fn decoys_at(&self, a: usize, ways: &[(Place, Way)], doors: &[Vec<Slot>; 2], sets: u64) -> Decoys {
        let mut found = Decoys::default();
        for group in ways.chunk_by(|p, q| p.0.to == q.0.to).filter(|g| g.len() > 1) {
            let reach = self.reach(group[0].0.to);
            for (set, (_, p)) in (0..sets).flat_map(|set| group.iter().map(move |p| (set, p))) {
                let Some(decoy) = self.exchanged(a, p, doors, set) else { continue };
                let x = self.place(&decoy).x;
                let from = group.partition_point(|(place, _)| place.x < x - reach);
                let near = group[from..].iter().take_while(|(place, _)| place.x <= x + reach);
                for (_, q) in near.filter(|(_, q)| q.edges != p.edges) {
                    if let Some(l) = self.join(a, &decoy, q) {
                        found.distances.push(l.misclosure.plain);
                        found.akin += usize::from(self.join(a, p, q).is_some());
                    }
                }
            }
        }
        found
    }

    /// A way of two steps with the piece between them exchanged for some other one, which is entered and left by
    /// isthmuses of the same polarity; `None` for a single step.
    fn exchanged(&self, a: usize, way: &Way, doors: &[Vec<Slot>; 2], set: u64) -> Option<Way> {
        let via = way.via?;
        let [first, second] = way.edges.map(|k| &self.edges[k]);
        let of = |e: &Edge| e.slots.into_iter().find(|s| s.piece == via);
        let (enters, leaves) = (of(first)?, of(second)?);
        // Multiplication by a large odd number scatters what is looked up (Knuth 1973, Fibonacci hashing).
        let seed = [a, way.edges[0], way.edges[1]]
            .iter()
            .fold(set + 1, |s, k| (s ^ *k as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15).rotate_left(29));
        let doors = &doors[usize::from(self.slots.is_tab(enters))];
        let door = doors[(seed >> 8) as usize % doors.len()];
        let others = || self.slots.of(door.piece, self.slots.is_tab(leaves)).filter(|s| *s != door);
        let count = others().count();
        if door.piece == via || count == 0 {
            return None;
        }
        let other = others().nth((seed >> 40) as usize % count)?;
        // The stranger lies as its first isthmus says; its second one leads elsewhere than that of the piece it replaces.
        let by_first = self.laid(enters, door);
        let by_second = self.laid(leaves, other);
        let (to_via, _) = step(first, a, &Isometry2::identity(), Point::origin());
        let from_via = to_via.inverse() * way.pose;
        Some(Way { pose: to_via * by_first * by_second.inverse() * from_via, ..*way })
    }

    /// Pose of the piece of `other` in which its segment lies on that of `slot` best.
    fn laid(&self, slot: Slot, other: Slot) -> Isometry2<f64> {
        laid_on(self.slots.segment(other), self.slots.segment(slot))
    }

    /// The loop that two ways from `a` to one piece make, if they do.
    fn join(&self, a: usize, p: &Way, q: &Way) -> Option<Loop> {
        let triangle = match (p.via, q.via) {
            (None, None) => return None,
            (Some(u), Some(v)) if u == v => return None,
            (Some(_), Some(_)) => false,
            // A triangle is seen from `a` twice; take it once.
            (Some(v), None) | (None, Some(v)) if v > p.to => true,
            _ => return None,
        };
        let outline = self.outlines[p.to];
        if !self.tolerance.allows(outline, &p.pose, &q.pose) {
            return None;
        }
        if (0..2).any(|end| self.slots.conflict(p.ends[end], q.ends[end])) {
            return None;
        }
        let edges = if triangle {
            let (long, short) = if p.via.is_some() { (p, q) } else { (q, p) };
            vec![short.edges[0], long.edges[0], long.edges[1]]
        } else {
            vec![p.edges[0], q.edges[0], p.edges[1], q.edges[1]]
        };
        let reference = p.pose * outline.centroid;
        let open = uncertainty(self.edges, a, p, reference) + uncertainty(self.edges, a, q, reference);
        let misclosure = misclosure(&p.pose, &q.pose, outline.centroid, &open);
        Some(Loop { edges, misclosure, evidence: f64::NEG_INFINITY })
    }
}

/// How the loops of a puzzle close: true ones narrowly, chance ones widely.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Closure {
    /// Typical distance of true loops, and how many there are.
    narrow: f64,
    right: f64,
    /// Typical distance of chance loops, and how many there are.
    wide: f64,
    chance: f64,
    /// How often two candidates agree by chance where two right ones would.
    rate: f64,
    /// Logarithm of the odds that any of the loops are true.
    any: f64,
}

impl Closure {
    /// Before any loop is known: `narrow` from the noise of the borders, `wide` from the tolerance of the search, and `any`,
    /// the logarithm of the odds that there are true ones.
    pub(crate) fn guess(narrow: f64, wide: f64, any: f64) -> Self {
        /// The least that is believed of it: what decoys don't show they may just have missed.
        const RATE: f64 = 0.01;
        Self { narrow, right: 0.0, wide: wide.max(LEAST_RATIO * narrow), chance: 1.0, rate: RATE, any }
    }

    /// Fits the two distributions to the loops found (maximum posterior over a grid of both scales; the counts by
    /// expectation and maximisation). Decoys say beforehand how chance loops are, the guess how true ones are.
    pub(crate) fn fit(guess: &Self, found: &[Loop], decoys: &Decoys) -> Self {
        /// Each scale tried is this factor wider than the one before.
        const FINENESS: f64 = 1.35;
        /// How far (natural logarithm) the guess may be off: by 0.4 in the mean (root of squares) of whole sets, real and
        /// generated, and by more in heaps of few joints.
        const GUESS_DEVIATION: f64 = 1.0;
        /// How far decoys may be off: what is among the candidates resembles the right piece more than any stranger.
        const DECOY_DEVIATION: f64 = 0.7;
        /// Decoys exchange the two pieces on the ways; any of the four of a loop may be wrong.
        const OTHERS: f64 = 2.0;
        /// Expectation and maximisation of the counts, until they change by less than this part of all.
        const STEPS: usize = 12;
        const SETTLED: f64 = 1e-3;
        /// They grow from no less than this part, for from nothing they never would.
        const LEAST: f64 = 0.05;
        /// Loops that are looked at: more don't make the scales surer.
        const LOOPS: usize = 150;
        let sets = if decoys.sets > 0.0 { decoys.sets } else { 1.0 };
        let mut closed = decoys.distances.clone();
        closed.push(guess.wide);
        closed.sort_by(f64::total_cmp);
        let decoy_wide = closed[(closed.len() - 1) / 2] / MAXWELL_MEDIAN;
        let expected = OTHERS * closed.len() as f64 / sets;
        // What the decoys say of the number of chance loops weighs as so many loops: less if there are few, and never more
        // than decoys are like them (a gamma distribution, its greatest value at what is expected).
        let known = (1.0 / expected + DECOY_DEVIATION * DECOY_DEVIATION).recip();
        let rate = ((decoys.akin as f64 + 1.0) / (OTHERS * sets * found.len() as f64 + 1.0)).clamp(guess.rate, 1.0);
        let mut distances: Vec<Misclosure> = found.iter().map(|l| l.misclosure).collect();
        distances.sort_by(|p, q| p.plain.total_cmp(&q.plain));
        let stride = distances.len().div_ceil(LOOPS).max(1);
        let distances: Vec<Misclosure> = distances.into_iter().skip(stride / 2).step_by(stride).collect();
        let share = distances.len() as f64 / found.len().max(1) as f64;
        let scales = |from: f64, to: f64| {
            std::iter::successors(Some(from), |s| Some(s * FINENESS)).take_while(move |s| *s <= to)
        };
        let densities = |scale: f64| Lanes::of(distances.iter().map(|z| maxwell(z.plain, scale)));
        let reach = (3.0 * DECOY_DEVIATION).exp();
        let wides: Vec<(f64, Lanes)> =
            scales(decoy_wide / reach, decoy_wide * reach).map(|s| (s, densities(s))).collect();
        let mut best = (f64::NEG_INFINITY, Self { right: 0.0, wide: decoy_wide, chance: expected, rate, ..*guess });
        if distances.is_empty() {
            return best.1;
        }
        let prior = |scale: f64, expected: f64, deviation: f64| 0.5 * ((scale / expected).ln() / deviation).powi(2);
        let expected = expected * share;
        let count_prior = |chance: f64| known * (chance / expected - (chance / expected).ln());
        // The decoys' count weighs like the loops' own.
        let counted = |loops: f64| 0.5 * (loops + expected);
        // All of them by chance.
        let all = counted(distances.len() as f64);
        let by_chance = |(wide, densities): &(f64, Lanes)| {
            log_product(densities.iter().map(|g| all * g))
                - all
                - count_prior(all)
                - prior(*wide, decoy_wide, DECOY_DEVIATION)
        };
        let by_chance = wides.iter().map(by_chance).fold(f64::NEG_INFINITY, f64::max);
        let best_with = |narrow: &f64| {
            let (narrow, mut best) = (*narrow, best);
            let right_densities = Lanes::of(distances.iter().map(|m| m.density_if_right(narrow)));
            // Scales that are alike have counts that are: the next begin where the last have settled.
            let (mut right, mut chance) = (0.5 * distances.len() as f64, expected);
            for (wide, chance_densities) in wides.iter().filter(|w| w.0 >= LEAST_RATIO * narrow) {
                right = right.max(LEAST * distances.len() as f64);
                for _ in 0..STEPS {
                    let before = right;
                    let among_right = widely!(right_among((right, chance), &right_densities, chance_densities));
                    chance = counted(distances.len() as f64 - among_right);
                    right = among_right;
                    if (right - before).abs() <= SETTLED * distances.len() as f64 {
                        break;
                    }
                }
                let densities = right_densities.iter().zip(chance_densities.iter());
                let value = log_product(densities.map(|(f, g)| right * f + chance * g))
                    - right
                    - chance
                    - count_prior(chance)
                    - prior(narrow, guess.narrow, GUESS_DEVIATION)
                    - prior(*wide, decoy_wide, DECOY_DEVIATION);
                if value > best.0 {
                    let any = value - by_chance + guess.any;
                    best =
                        (value, Self { narrow, right: right / share, wide: *wide, chance: chance / share, rate, any });
                }
            }
            best
        };
        let narrows: Vec<f64> =
            scales(guess.narrow * (-2.0 * GUESS_DEVIATION).exp(), decoy_wide * reach / LEAST_RATIO).collect();
        let found: Vec<(f64, Self)> = narrows.par_iter().map(best_with).collect();
        // Of equals the first.
        best = found.into_iter().fold(best, |best, other| if other.0 > best.0 { other } else { best });
        best.1
    }

    /// Logarithm of the odds that a loop which fails to close by so much is right.
    pub(crate) fn evidence(&self, misclosure: &Misclosure) -> f64 {
        let this = self.ratio(misclosure, self.narrow) + (self.right.max(f64::MIN_POSITIVE) / self.chance).ln();
        // No loop is surer than that there are true ones.
        this.min(self.any)
    }

    /// Logarithm of how much likelier two candidates disagree by no more than `distance` if both are right than by
    /// chance.
    pub(crate) fn agreement(&self, misclosure: &Misclosure) -> f64 {
        self.ratio(misclosure, DRIFT * self.narrow) - self.rate.ln()
    }

    /// Whether right candidates may disagree as much.
    pub(crate) fn admits(&self, misclosure: &Misclosure) -> bool {
        /// A Maxwell distribution leaves one in 10⁵ beyond five times its scale.
        const BEYOND: f64 = 5.0;
        misclosure.own <= BEYOND * DRIFT * self.narrow
    }

    fn ratio(&self, misclosure: &Misclosure, narrow: f64) -> f64 {
        let log = |distance: f64, scale: f64| -3.0 * scale.ln() - 0.5 * (distance / scale).powi(2);
        misclosure.narrower + log(misclosure.own, narrow) - log(misclosure.plain, self.wide.max(narrow))
    }
}

/// Chance loops close at least this much wider than true ones: were it less, little could tell them apart; were it more,
/// true loops of worn pieces, which close half as wide, would pass for chance.
const LEAST_RATIO: f64 = 2.5;
/// Poses in islands are off by this much more than those of two steps.
const DRIFT: f64 = 1.5;

/// Numbers worked on side by side, in as many lanes as the registers of AVX2 have; zeros fill the last ones up.
struct Lanes {
    rows: Vec<[f64; 4]>,
    count: usize,
}

impl Lanes {
    fn of(numbers: impl ExactSizeIterator<Item = f64>) -> Self {
        let count = numbers.len();
        let mut rows = vec![[0.0; 4]; count.div_ceil(4)];
        rows.as_flattened_mut().iter_mut().zip(numbers).for_each(|(place, number)| *place = number);
        Self { rows, count }
    }

    fn iter(&self) -> impl Iterator<Item = f64> {
        self.rows.as_flattened().iter().take(self.count).copied()
    }
}

/// How many of some loops are right, given how many right and chance ones are expected and their densities among either.
#[inline(always)]
fn right_among((right, chance): (f64, f64), densities: &Lanes, chance_densities: &Lanes) -> f64 {
    let mut sums = [0.0; 4];
    for (f, g) in densities.rows.iter().zip(&chance_densities.rows) {
        for l in 0..4 {
            let right = right * f[l];
            sums[l] += right / (right + chance * g[l]).max(f64::MIN_POSITIVE);
        }
    }
    sums.iter().sum()
}

/// Logarithm of a product of positive numbers, which may be too small for one.
fn log_product(factors: impl Iterator<Item = f64>) -> f64 {
    /// The least that a factor is taken for, and the range in which products can take one more.
    const LEAST: f64 = 1e-200;
    const SAFE: std::ops::Range<f64> = 1e-100..1e100;
    let (sum, product) = factors.fold((0.0, 1.0), |(sum, product), factor| {
        let product: f64 = product * factor.max(LEAST);
        if SAFE.contains(&product) { (sum, product) } else { (sum + product.ln(), 1.0) }
    });
    sum + product.ln()
}

/// Median of a Maxwell distribution, in its scale.
const MAXWELL_MEDIAN: f64 = 1.538;

/// Density of the length of a vector of three normal deviates.
fn maxwell(distance: f64, scale: f64) -> f64 {
    shell(distance, scale) * (-0.5 * (distance / scale).powi(2)).exp()
}

/// What of that density doesn't fall off: the surface on which vectors of this length end.
fn shell(distance: f64, scale: f64) -> f64 {
    let z = distance / scale;
    (2.0 / std::f64::consts::PI).sqrt() * z * z / scale
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What is said of a loop of candidates of this variance that fails to close by so much.
    fn evidence(variance: f64, offset: f64) -> f64 {
        let open = Spread { plain: Matrix3::identity(), own: variance * Matrix3::identity() };
        let [here, there] = [0.0, offset].map(|x| Isometry2::translation(x, 0.0));
        let closure = Closure { narrow: 1.0, right: 1.0, wide: 10.0, chance: 1.0, rate: 1.0, any: f64::INFINITY };
        closure.evidence(&misclosure(&here, &there, Point::origin(), &open))
    }

    #[test]
    fn worn_joints_are_forgiven_more_and_prove_less() {
        assert!(evidence(4.0, 4.0) > evidence(1.0, 4.0));
        assert!(evidence(4.0, 0.5) < evidence(1.0, 0.5));
    }
}
