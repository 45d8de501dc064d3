//! Apictorial jigsaw puzzles: candidate matings from isthmuses, placement with clearance, assembly with backtracking.
//!
//! Coordinates are pixels: x right, y **down**. Transforms are `target_from_source`.

pub mod generate;

use nalgebra::Isometry2;

mod contact;
mod copies;
pub mod correlation;
mod frame;
mod index;
mod loops;
mod matching;
mod memory;
mod outline;
mod paper;
pub mod params;
pub mod placement;
mod posegraph;
mod search;
mod slots;
pub mod solver;

pub use params::{Budget, Params, ParamsError, Policy};
pub use solver::{Candidate, Fate, Posed, Rule, Solver, SolverError, assemble};

/// A piece as the solver knows it.
#[derive(Debug, Clone, PartialEq)]
pub struct Piece {
    /// Unique name.
    pub id: String,
    /// When it was seen, in whatever unit grows with time; the same for all where that is not known. Of pieces of one shape the one
    /// seen last is where it is now, and the others are where it was.
    pub seen: u64,
    /// Its shape.
    pub features: isthmus::Features,
}

/// Counts of the candidate table after each rule (paper, section on heuristics). Contacts that only the assembly showed
/// count as left by all rules.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize)]
pub struct TableCounts {
    /// Positive isthmuses.
    pub positive: usize,
    /// Negative isthmuses.
    pub negative: usize,
    /// Pairs of a positive and a negative isthmus of different pieces.
    pub pairs: usize,
    /// Left after the opening rule.
    pub after_opening: usize,
    /// Left after the path length rule.
    pub after_length: usize,
    /// Left after the correlation.
    pub after_correlation: usize,
    /// Left after the overlap rule.
    pub after_overlap: usize,
    /// Times the assembly went back on a mating.
    pub backtracks: usize,
}

/// Two pieces joined at a positive and a negative isthmus.
#[derive(Debug, Clone, PartialEq)]
pub struct Mating {
    /// Index of the piece with the tab.
    pub positive_piece: usize,
    /// Index of its isthmus.
    pub positive_isthmus: usize,
    /// Index of the piece with the blank.
    pub negative_piece: usize,
    /// Index of its isthmus.
    pub negative_isthmus: usize,
    /// Best value of Eq. 1, in `-1..=1`.
    pub correlation: f64,
    /// Mean gap along the match segment after refinement, clearance taken off, in pixels.
    pub ave_gap: f64,
    /// Fitted clearance (kerf) between the two borders, in pixels; negative where they overlap.
    pub clearance: f64,
    /// Probability that the mating is right.
    pub confidence: f64,
}

/// Where a piece belongs.
#[derive(Debug, Clone, PartialEq)]
pub struct Placement {
    /// Index of the piece.
    pub piece: usize,
    /// `p_puzzle = puzzle_from_image * p_image`.
    pub puzzle_from_image: Isometry2<f64>,
    /// Connected assembly it belongs to; 0 is the largest.
    pub component: usize,
    /// Probability that the piece is where it belongs.
    pub confidence: f64,
}

/// The result of the solver. All components lie in one puzzle frame, side by side, without overlap; the main one
/// has its top left corner at the origin.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Assembly {
    /// The placed pieces.
    pub placements: Vec<Placement>,
    /// All contacts between them.
    pub matings: Vec<Mating>,
    /// Pieces left over.
    pub unplaced: Vec<usize>,
    /// Neither placed nor left over: earlier sightings of pieces that were seen elsewhere since.
    pub earlier: Vec<usize>,
    /// The candidate table after each rule.
    pub table: TableCounts,
    /// Whether the time budget ran out, so that this is the best assembly so far.
    pub partial: bool,
    /// Where the time went.
    pub timings: Timings,
}

impl Assembly {
    /// All pieces that have no place: those left over, then the earlier sightings.
    pub fn without_place(&self) -> impl Iterator<Item = usize> {
        self.unplaced.iter().chain(&self.earlier).copied()
    }
}

/// Wall-clock seconds of the solver's stages.
#[derive(Debug, Clone, Copy, PartialEq, Default, serde::Serialize)]
pub struct Timings {
    /// Preparing pieces and finding and refining candidates (of the pieces inserted since the last solution).
    pub matching: f64,
    /// Assembling.
    pub assembly: f64,
}
