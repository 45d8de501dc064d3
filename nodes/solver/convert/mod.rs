//! Messages to what the solver knows, and back: features to pieces, goals to budgets, solutions to messages.

mod features;
mod solution;

use std::time::Duration;

use jigsaw_msgs::action::AssembleGoal;

pub use features::{FeaturesError, MAX_POINTS_KEPT, Sighting, check_scale, fingerprint, piece};
pub use solution::{Naming, Solution};

/// Why a goal of `assemble` is rejected.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum GoalError {
    /// A time that is none.
    #[error("time_budget is {sec} s and {nanosec} ns: must be 0 s or more, and less than 1000000000 ns")]
    Budget {
        /// Seconds.
        sec: i32,
        /// Nanoseconds.
        nanosec: u32,
    },
}

/// The time that a goal of `assemble` gives, if it is limited.
///
/// # Errors
/// A time that is none.
pub fn budget(goal: &AssembleGoal) -> Result<Option<Duration>, GoalError> {
    const NANOS: u32 = 1_000_000_000;
    let (sec, nanosec) = (goal.time_budget.sec, goal.time_budget.nanosec);
    match u64::try_from(sec) {
        Ok(whole) if nanosec < NANOS => Ok(Some(Duration::new(whole, nanosec)).filter(|budget| !budget.is_zero())),
        _ => Err(GoalError::Budget { sec, nanosec }),
    }
}
