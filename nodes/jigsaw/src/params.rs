//! What the user may choose, and how long a solution may take.

use serde::{Deserialize, Serialize};
use std::time::Instant;
use thiserror::Error;

/// Which rules decide.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Policy {
    /// Refined poses with clearance, loop closure, pose graph, verification on the outlines.
    #[default]
    Standard,
    /// The literal rules of Webster et al. 1990 on correlation poses.
    Paper,
}

/// Parameters of the solver. The defaults suit any puzzle: scale, noise and clearance are measured from the pieces.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Which rules decide.
    pub policy: Policy,
    /// Seconds that one solution may take; the best assembly so far is given, marked partial, when they are over.
    /// 0 means no limit.
    pub time_budget: f64,
    /// Threads for matching; 0 means one for each processor.
    pub threads: usize,
    /// A piece or mating less sure than this is left out of the assembly, in `0..1`.
    pub minimum_confidence: f64,
    /// How many tabs the shape index keeps for a mouth.
    pub candidates: usize,
    /// Times the search may go back on a decision.
    pub backtracks: usize,
    /// Accept matings by loop closure (the pieces round a corner). Off only to measure what it brings.
    pub loops: bool,
    /// Adjust all poses together while growing. Off only to measure what it brings.
    pub pose_graph: bool,
    /// Fit the clearance of each joint. Off only to measure what it brings.
    pub fit_clearance: bool,
    /// Calibrate windows and clearance from the puzzle itself. Off only to measure what it brings.
    pub recalibrate: bool,
    /// Merge islands that fit together. Off only to measure what it brings.
    pub merge_islands: bool,
}

impl Default for Params {
    fn default() -> Self {
        Self {
            policy: Policy::Standard,
            time_budget: 0.0,
            threads: 0,
            minimum_confidence: 0.5,
            candidates: 40,
            backtracks: 1000,
            loops: true,
            pose_graph: true,
            fit_clearance: true,
            recalibrate: true,
            merge_islands: true,
        }
    }
}

/// A parameter out of its range.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum ParamsError {
    /// Not a number of seconds.
    #[error("invalid time_budget={0}: must be a finite number of seconds >= 0 (0 = no limit)")]
    TimeBudget(f64),
    /// Not a probability below 1.
    #[error("invalid minimum_confidence={0}: must be >= 0 and < 1")]
    MinimumConfidence(f64),
    /// The index must keep something.
    #[error("invalid candidates={0}: must be 1..={max}", max = Params::MAX_CANDIDATES)]
    Candidates(usize),
    /// No part of the method is called so.
    #[error("invalid switch {0:?}: must be one of {switches}", switches = Params::SWITCHES.join(", "))]
    Switch(String),
    /// More threads than any machine this runs on.
    #[error("invalid threads={0}: must be 0..={max} (0 = one for each processor)", max = Params::MAX_THREADS)]
    Threads(usize),
}

impl Params {
    /// The switches that [`Params::switch_off`] knows.
    pub const SWITCHES: [&str; 5] = ["loops", "pose_graph", "fit_clearance", "recalibrate", "merge_islands"];

    /// Switches a part of the method off by its name, to measure what it brings.
    ///
    /// # Errors
    /// There is no such switch.
    pub fn switch_off(&mut self, name: &str) -> Result<(), ParamsError> {
        let switch = match name {
            "loops" => &mut self.loops,
            "pose_graph" => &mut self.pose_graph,
            "fit_clearance" => &mut self.fit_clearance,
            "recalibrate" => &mut self.recalibrate,
            "merge_islands" => &mut self.merge_islands,
            _ => return Err(ParamsError::Switch(name.to_owned())),
        };
        *switch = false;
        Ok(())
    }

    /// Most candidates a mouth may keep: beyond it chance loops drown the true ones and memory grows for nothing.
    pub const MAX_CANDIDATES: usize = 1000;
    /// Most threads that may be asked for.
    pub const MAX_THREADS: usize = 1024;

    /// Checks every value against its range.
    ///
    /// # Errors
    /// The first value that is out of range.
    pub fn validate(&self) -> Result<(), ParamsError> {
        if !(self.time_budget >= 0.0 && self.time_budget.is_finite()) {
            return Err(ParamsError::TimeBudget(self.time_budget));
        }
        if !(0.0..1.0).contains(&self.minimum_confidence) {
            return Err(ParamsError::MinimumConfidence(self.minimum_confidence));
        }
        if !(1..=Self::MAX_CANDIDATES).contains(&self.candidates) {
            return Err(ParamsError::Candidates(self.candidates));
        }
        if self.threads > Self::MAX_THREADS {
            return Err(ParamsError::Threads(self.threads));
        }
        Ok(())
    }
}

/// When a solution has to come to an end. [`Solver::solve`](crate::Solver::solve) measures the time against [`Params::time_budget`]; another
/// measure can be given to [`Solver::solve_within`](crate::Solver::solve_within).
pub trait Budget: Sync {
    /// The part that is used up; from 1 on the best assembly so far is taken.
    fn spent(&self) -> f64;
}

/// Wall-clock time; without a limit it never runs out.
pub(crate) struct Time {
    pub(crate) begin: Instant,
    pub(crate) seconds: f64,
}

impl Budget for Time {
    fn spent(&self) -> f64 {
        if self.seconds > 0.0 { self.begin.elapsed().as_secs_f64() / self.seconds } else { 0.0 }
    }
}
