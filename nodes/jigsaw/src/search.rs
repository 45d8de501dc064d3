//! Assembly: from candidate matings to poses.
//!
//! Webster et al. 1990 descend the ranked table and backtrack; [`descent`] does just that. The standard policy keeps the
//! table and adds evidence, step by step, each in a module of its own:
//! 1. [`learn`]: what right and wrong candidates cost, and how loops of them ([`crate::loops`]) close in this puzzle.
//! 2. [`join`]: islands, from loops, best first; [`adjust`]: their poses, over all contacts of the outlines
//!    ([`crate::posegraph`]).
//! 3. [`grow`]: islands and single pieces joined by the candidates that agree on a pose.
//! 4. [`verify`]: pieces that overlap or contradict their neighbours are taken out, and others tried in their place.
//! 5. [`widen`], [`fill`]: what is left over, by a second look at what is open, and by how whole borders [`fit`].
//! 6. [`outcome`]: which contacts are matings, and how sure all that is.
//!
//! What the steps change and take back is [`state`].

mod adjust;
mod descent;
mod fill;
mod fit;
mod grow;
mod join;
mod learn;
mod outcome;
mod state;
mod verify;
mod widen;

use crate::contact::ClearancePrior;
use crate::loops::{Closure, Edge};
use crate::memory::Memory;
use crate::outline::Outline;
use crate::params::Budget;
use crate::placement::Joint;
use crate::posegraph::Plan;
use crate::slots::Slots;
use crate::{Params, Policy};
use adjust::{COARSE, FINE};
use learn::{Model, rank};
use nalgebra::{Isometry2, Matrix3, Vector3};
use state::State;

/// Adjustments at the end: two bring the poses to a tenth of what the border's noise leaves.
const FINAL_ROUNDS: usize = 2;
/// Rounds of verification and growth at most: a contradiction that comes back each time stays out.
const REGROWTHS: usize = 3;

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
    /// The candidates, and behind them so many that the assembly brought up: contacts, and what a second look found.
    pub(crate) joints: Vec<Joint>,
    pub(crate) brought_up: usize,
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

struct Assembler<'a> {
    outlines: &'a [&'a Outline],
    params: &'a Params,
    memory: &'a Memory,
    budget: &'a dyn Budget,
    joints: Vec<Joint>,
    /// What the search needs of the joints, one by one.
    edges: Vec<Edge>,
    /// How many were given, and how many were found as contacts.
    given: usize,
    contacts: usize,
    /// Usual residual of right candidates.
    usual: f64,
    /// Candidates at each piece.
    at: Vec<Vec<usize>>,
    /// What the best two candidates of each isthmus cost.
    best: Vec<[f64; 2]>,
    scale: f64,
    prior: ClearancePrior,
    /// Whether the clearance is known from this puzzle.
    calibrated: bool,
    /// What true and false candidates cost, and whether that is known from this puzzle.
    model: Model,
    learnt: bool,
    /// Logarithm of the odds that what belongs in a mouth is there at all.
    present: f64,
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

/// Assembles; `joints`, the candidates, are in the order of ranks. Pieces `aside` wait until the others are placed.
pub(crate) fn assemble(
    outlines: &[&Outline],
    joints: Vec<Joint>,
    aside: Vec<bool>,
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
    let mut edges: Vec<Edge> = joints.iter().map(|j| edge(j, outlines, &slots, 1.0)).collect();
    let best = rank(&mut edges, &slots);
    let first = (0..edges.len()).filter(|k| edges[*k].mouth_rank == 0);
    let usual = learn::median(&mut first.map(|k| joints[k].fit.residual).collect::<Vec<f64>>()).unwrap_or(1.0);
    edges.iter_mut().zip(&joints).for_each(|(e, j)| e.variance = variance(j.fit.residual, usual));
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
        given: joints.len(),
        usual,
        joints,
        edges,
        contacts: 0,
        at,
        best,
        scale,
        prior: ClearancePrior { mean: 0.0, deviation: 0.01 * scale, noise: noise.max(0.02) },
        calibrated: false,
        model: Model {
            right: ((1.5 * noise + 0.001 * scale).ln(), 0.4),
            wrong: ((1.5 * noise + 0.01 * scale).ln(), 0.5),
        },
        learnt: false,
        present: 0.0,
        closure: Closure::guess(0.02, 1.0, 0.0),
        aside,
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

/// A joint as the search sees it; `usual` is what residuals usually are.
fn edge(joint: &Joint, outlines: &[&Outline], slots: &Slots, usual: f64) -> Edge {
    let Joint { a, tab, b, mouth, fit } = joint;
    Edge {
        a: *a,
        b: *b,
        slots: [slots.tab(*a, *tab), slots.mouth(*b, *mouth)],
        b_from_a: fit.negative_from_positive,
        covariance: covariance(&fit.information, outlines[*b].scale),
        variance: variance(fit.residual, usual),
        at: outlines[*b].mouths[*mouth].origin,
        cost: fit.residual.max(1e-4).ln(),
        mouth_rank: 0,
        tab_rank: 0,
        support: 0,
    }
}

/// Variance of the residuals of a joint, in units of what is usual in the puzzle. One joint shows its own badly, for residuals
/// hang together along the border; what is usual counts twice as much.
fn variance(residual: f64, usual: f64) -> f64 {
    const USUAL: f64 = 2.0;
    ((residual / usual).powi(2) + USUAL) / (1.0 + USUAL)
}

/// Covariance of a pose, given what a contact tells about it; what it doesn't tell is known to a scale and a radian.
fn covariance(information: &Matrix3<f64>, scale: f64) -> Matrix3<f64> {
    let known = Matrix3::from_diagonal(&Vector3::new(scale.powi(-2), scale.powi(-2), 1.0));
    (information + known).try_inverse().unwrap_or_else(Matrix3::identity)
}

impl Assembler<'_> {
    /// The standard policy.
    fn run(&mut self) -> Outcome {
        self.model = self.first_model();
        self.learn_from_outstanding();
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
            if self.widen() {
                self.grow();
                self.verify();
            }
            self.refine_all(1, FINE);
            self.fill();
        }
        self.refine_all(FINAL_ROUNDS, FINE);
        self.add_contacts();
        self.outcome()
    }

    /// Whether the budget is spent.
    fn late(&mut self) -> bool {
        if self.budget.spent() >= 1.0 {
            self.partial = true;
        }
        self.partial
    }
}
