//! The incremental solver: pieces come and go, candidates are kept, a solution is made on demand.

use crate::{Assembly, Params, ParamsError, Piece};
use nalgebra::Isometry2;
use std::collections::HashMap;
use thiserror::Error;

/// A rule that drops a candidate.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, serde::Serialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum Rule {
    /// The mouth is too narrow (or far too wide) for the neck.
    Opening,
    /// The match segments differ too much in length.
    PathLength,
    /// Other tabs resemble the mouth more: outside the index's nearest.
    Shape,
    /// Eq. 1 is too low.
    Correlation,
    /// The two overlap too much, or the borders don't follow each other.
    Overlap,
    /// Another mating of the tab, the mouth or the two pieces is better.
    Rival,
    /// No other contact of the assembly supports it, and it isn't clear by itself.
    Support,
}

/// What became of a candidate.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Fate {
    /// It is a mating of the assembly.
    Mated,
    /// It was dropped by a rule.
    Dropped(Rule),
}

/// A tab and a mouth of two pieces that may belong together.
#[derive(Debug, Clone, PartialEq)]
pub struct Candidate {
    /// Index of the piece with the tab in [`Solver::pieces`].
    pub positive_piece: usize,
    /// Index of its isthmus.
    pub positive_isthmus: usize,
    /// Index of the piece with the mouth.
    pub negative_piece: usize,
    /// Index of its isthmus.
    pub negative_isthmus: usize,
    /// Width of the mouth less width of the neck, in pixels.
    pub opening: f64,
    /// Path length of the mouth less that of the neck, in pixels.
    pub path_difference: f64,
    /// Root mean square difference of the two IDFs, means removed, in pixels.
    pub shape_distance: f64,
    /// Best value of Eq. 1.
    pub correlation: f64,
    /// Area of overlap (POS-GAP), in square pixels.
    pub pos_gap: f64,
    /// Area of underlap (NEG-GAP), in square pixels.
    pub neg_gap: f64,
    /// Mean gap along the match segment, clearance taken off, in pixels.
    pub ave_gap: f64,
    /// Fitted clearance, in pixels.
    pub clearance: f64,
    /// How many loops of pieces close over it.
    pub support: usize,
    /// Pose: `p_negative_image = negative_from_positive * p_positive_image`.
    pub negative_from_positive: Isometry2<f64>,
    /// What became of it in the last solution.
    pub fate: Fate,
}

/// A piece that can't be taken in.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum SolverError {
    /// A parameter is out of range.
    #[error(transparent)]
    Params(#[from] ParamsError),
    /// The id is taken.
    #[error("duplicate piece id {0:?}: ids must be unique")]
    DuplicateId(String),
    /// Too few points, or coordinates that aren't numbers.
    #[error("invalid border of piece {id:?}: {points} points; must be at least {min} finite points", min = Solver::MIN_BORDER_POINTS)]
    Border {
        /// The piece.
        id: String,
        /// How many points its border has.
        points: usize,
    },
}

/// The solver.
#[derive(Debug, Clone)]
pub struct Solver {
    params: Params,
    pieces: Vec<Piece>,
    index_of: HashMap<String, usize>,
    candidates: Vec<Candidate>,
}

impl Solver {
    /// A border with fewer points has no shape to speak of.
    pub const MIN_BORDER_POINTS: usize = 8;

    /// An empty solver.
    ///
    /// # Errors
    /// A parameter out of range.
    pub fn new(params: Params) -> Result<Self, ParamsError> {
        params.validate()?;
        Ok(Self { params, pieces: Vec::new(), index_of: HashMap::new(), candidates: Vec::new() })
    }

    /// The parameters in force.
    pub fn params(&self) -> &Params {
        &self.params
    }

    /// The pieces; indices in results point here.
    pub fn pieces(&self) -> &[Piece] {
        &self.pieces
    }

    /// All candidates with their figures, as the last [`Solver::solve`] left them.
    pub fn candidates(&self) -> &[Candidate] {
        &self.candidates
    }

    /// Takes a piece in and returns its index. Computes only what the new piece brings.
    ///
    /// # Errors
    /// The id is taken, or the border is no border.
    pub fn insert(&mut self, piece: Piece) -> Result<usize, SolverError> {
        if self.index_of.contains_key(&piece.id) {
            return Err(SolverError::DuplicateId(piece.id));
        }
        let points = &piece.features.border.points;
        if points.len() < Self::MIN_BORDER_POINTS || points.iter().any(|p| !(p.x.is_finite() && p.y.is_finite())) {
            return Err(SolverError::Border { points: points.len(), id: piece.id });
        }
        let index = self.pieces.len();
        self.index_of.insert(piece.id.clone(), index);
        self.pieces.push(piece);
        Ok(index)
    }

    /// Takes a piece out again; the pieces behind it move up by one index. `None` if there is no such piece.
    pub fn remove(&mut self, id: &str) -> Option<Piece> {
        let index = self.index_of.remove(id)?;
        for other in self.index_of.values_mut().filter(|other| **other > index) {
            *other -= 1;
        }
        Some(self.pieces.remove(index))
    }

    /// Forgets all pieces.
    pub fn reset(&mut self) {
        self.pieces.clear();
        self.index_of.clear();
        self.candidates.clear();
    }

    /// The best assembly of the pieces that are there.
    pub fn solve(&mut self) -> Assembly {
        Assembly { unplaced: (0..self.pieces.len()).collect(), ..Assembly::default() }
    }
}

/// Assembles a whole set of pieces at once; indices in the result point into `pieces`.
///
/// # Errors
/// As [`Solver::new`] and [`Solver::insert`].
pub fn assemble(pieces: &[Piece], params: &Params) -> Result<Assembly, SolverError> {
    let mut solver = Solver::new(*params)?;
    for piece in pieces {
        solver.insert(piece.clone())?;
    }
    Ok(solver.solve())
}
