//! One solution, made in a worker thread: what it is given, and what it gives back.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use jigsaw::{Assembly, Budget, Params, Piece, Solver, SolverError};

/// What a run of the worker is given.
pub(super) struct Job {
    /// None where there is no solver yet.
    pub(super) solver: Option<Solver>,
    pub(super) params: Params,
    /// Pieces that the solver does not have yet.
    pub(super) incoming: Vec<Piece>,
    /// Whether the solution is of no use any more.
    pub(super) abandoned: Arc<AtomicBool>,
    /// Given back as it is.
    pub(super) generation: u64,
}

/// What one run of the worker gives back.
pub(super) struct Done {
    pub(super) solver: Option<Solver>,
    /// None where it was abandoned.
    pub(super) assembly: Option<Assembly>,
    /// Pieces the solver did not take, with its reasons.
    pub(super) refused: Vec<(String, String)>,
    pub(super) generation: u64,
    pub(super) seconds: f64,
}

/// A solver with these parameters, and the pieces that it must be given again where they have changed.
fn with_params(solver: Option<Solver>, params: Params) -> Result<(Solver, Vec<Piece>), SolverError> {
    match solver {
        Some(solver) if *solver.params() == params => Ok((solver, Vec::new())),
        other => {
            let kept = other.map(|solver| solver.pieces().to_vec()).unwrap_or_default();
            Ok((Solver::new(params)?, kept))
        }
    }
}

impl Job {
    /// Takes in what has come, and solves.
    pub(super) fn run(self) -> Done {
        let Self { solver, params, incoming, abandoned, generation } = self;
        let allowance = Allowance { begin: Instant::now(), seconds: params.time_budget, abandoned };
        let mut refused = Vec::new();
        let mut solved = None;
        match with_params(solver, params) {
            Ok((mut solver, kept)) => {
                for piece in kept.into_iter().chain(incoming) {
                    let id = piece.id.clone();
                    if let Err(e) = solver.insert(piece) {
                        refused.push((id, e.to_string()));
                    }
                }
                let assembly = solver.solve_within(&allowance);
                solved = Some((solver, assembly));
            }
            Err(e) => refused.extend(incoming.into_iter().map(|piece| (piece.id, e.to_string()))),
        }
        let (solver, assembly) = solved.unzip();
        let assembly = (!allowance.is_abandoned()).then(|| assembly.unwrap_or_default());
        Done { solver, assembly, refused, generation, seconds: allowance.begin.elapsed().as_secs_f64() }
    }
}

/// The time that a solution may take, and whether it is wanted still.
struct Allowance {
    begin: Instant,
    /// \[s\]; 0 for no limit.
    seconds: f64,
    abandoned: Arc<AtomicBool>,
}

impl Allowance {
    fn is_abandoned(&self) -> bool {
        self.abandoned.load(Ordering::Relaxed)
    }
}

impl Budget for Allowance {
    fn spent(&self) -> f64 {
        match self.seconds {
            _ if self.is_abandoned() => f64::INFINITY,
            limit if limit > 0.0 => self.begin.elapsed().as_secs_f64() / limit,
            _ => 0.0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_solution_that_nobody_waits_for_has_no_time_left() {
        let abandoned = Arc::new(AtomicBool::new(false));
        let allowance = |seconds| Allowance { begin: Instant::now(), seconds, abandoned: Arc::clone(&abandoned) };
        let (unlimited, limited) = (allowance(0.0), allowance(3600.0));
        assert!(unlimited.spent() == 0.0 && limited.spent() < 0.5);
        abandoned.store(true, Ordering::Relaxed);
        assert!(unlimited.spent() >= 1.0 && limited.spent() >= 1.0);
    }
}
