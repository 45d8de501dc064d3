//! Synthetic jigsaw puzzles with truth.
//!
//! A puzzle is made in four steps, each reproducible from one seed:
//!
//! 1. **Cut** (`cut`): the sheet is divided into faces by joints. A joint is a smooth closed-form curve (a chain of
//!    cubic Béziers with a neck, drawn through a smooth warp of the whole sheet) sampled so densely that it stands for
//!    the true border.
//! 2. **Kerf**: each piece's outline is the loop of its joints, moved inward by half of each joint's clearance.
//! 3. **Heap** (`heap`): pieces are taken away, doubled, turned face down, shuffled, turned and laid into frames.
//! 4. **Frames** (`render`): exact area coverage of each outline, Gaussian blur, vignette, sensor noise, 8 bit.
//!
//! The true critical points of a neck are the ends of the locally shortest chord between the two flanks of the curve.
//! That chord is normal to the curve at both ends, so that a kerf moves them along the chord: the neck of the tab
//! becomes narrower by the clearance and the mouth of the blank wider by it, exactly.
//!
//! Axes and units: pixels, x right, y **down**, pixel centres at whole numbers. Cost: linear in the number of pieces
//! and in the pixels of the frames; 10 000 outlines take seconds.
//!
//! ```
//! use jigsaw::generate::{Options, Puzzle};
//!
//! let puzzle = Puzzle::generate(&Options { rows: 2, columns: 3, seed: 7, ..Options::default() })?;
//! assert_eq!(puzzle.pieces().len(), 6);
//! let frame = puzzle.render(0);
//! assert_eq!((frame.width, frame.height), (1024, 1024));
//! # Ok::<(), jigsaw::generate::GenerateError>(())
//! ```

mod cut;
mod heap;
mod observe;
mod options;
mod render;
#[cfg(test)]
mod tests;
mod truth;

use isthmus::Point;
use nalgebra::Isometry2;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

use cut::Sheet;
use heap::{Heap, frame_stem, mirror, oriented_outline};
pub use observe::ObserveError;
pub use options::{Cut, GenerateError, Lighting, Options, Rim};
pub use render::Frame;
pub use truth::{FrameLabel, JointTruth, PieceTruth, PoseTruth, Score, SideTruth, Truth};

/// Standard deviations after which a Gaussian is cut off: what is left is less than a quarter of a grey level.
const BLUR_REACH: f64 = 3.5;
/// Random streams of one seed; frames use one each from `FRAMES` on.
mod stream {
    pub(super) const HEAP: u64 = 0;
    pub(super) const SHEETS: u64 = 1;
    pub(super) const FRAMES: u64 = 1 << 32;
}

fn rng(seed: u64, stream: u64) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(stream);
    rng
}

/// Kind of one side of a piece.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SideKind {
    /// Rim of the puzzle.
    Rim,
    /// The piece has the tab.
    Tab,
    /// The piece has the blank.
    Blank,
    /// A joint without a neck.
    Wave,
}

/// One side of a piece as it lies.
#[derive(Debug, Clone, PartialEq)]
pub struct Side {
    /// Number of the joint within its puzzle: the two sides of a joint share it.
    pub joint: usize,
    /// Kind of the side.
    pub kind: SideKind,
    /// Index of the piece on the other side (the original where there is a duplicate); none at the rim and beside a
    /// missing piece.
    pub neighbour: Option<usize>,
    /// Isthmus critical points in the frame, as the match segment runs; none without a neck.
    pub critical_points: Option<[Point; 2]>,
    /// Clearance of the joint, in pixels.
    pub clearance: f64,
}

/// One piece of the heap.
#[derive(Debug, Clone, PartialEq)]
pub struct TruePiece {
    /// `<file stem>` of its frame, or `<file stem>_<k>` in reading order where a frame holds more than one.
    pub id: String,
    /// Which puzzle of the heap it belongs to.
    pub puzzle: usize,
    /// Row in its puzzle.
    pub row: usize,
    /// Column in its puzzle.
    pub column: usize,
    /// Index of its frame.
    pub frame: usize,
    /// Whether it lies face down.
    pub flipped: bool,
    /// Index of the piece it is a copy of.
    pub duplicate_of: Option<usize>,
    face: usize,
    pose: Isometry2<f64>,
}

/// A heap of pieces with everything there is to know about them.
#[derive(Debug, Clone)]
pub struct Puzzle {
    options: Options,
    sheets: Vec<Sheet>,
    heap: Heap,
}

impl Puzzle {
    /// Generates a puzzle. The same options give the same puzzle.
    ///
    /// # Errors
    /// An option out of its range, or a piece that doesn't fit into its frame.
    pub fn generate(options: &Options) -> Result<Self, GenerateError> {
        options.check()?;
        let sheets: Vec<Sheet> = (0..options.puzzles as u64)
            .map(|sheet| Sheet::cut(options, &mut rng(options.seed, stream::SHEETS + sheet)))
            .collect();
        let heap = Heap::mix(options, &sheets, &mut rng(options.seed, stream::HEAP))?;
        Ok(Self { options: options.clone(), sheets, heap })
    }

    /// What it was generated from.
    pub fn options(&self) -> &Options {
        &self.options
    }

    /// The pieces, in the order of their frames.
    pub fn pieces(&self) -> &[TruePiece] {
        &self.heap.pieces
    }

    /// How many frames there are.
    pub fn frame_count(&self) -> usize {
        self.heap.frames
    }

    /// File stem of a frame.
    pub fn frame_stem(&self, frame: usize) -> String {
        frame_stem(self.options.pieces_per_frame, frame)
    }

    /// True outline of a piece in its frame: clockwise as seen on a screen, points about half a pixel apart. The last
    /// point joins the first.
    pub fn outline(&self, piece: usize) -> Vec<Point> {
        let piece = &self.heap.pieces[piece];
        let mut outline = oriented_outline(&self.sheets[piece.puzzle], piece.face, piece.flipped);
        outline.iter_mut().for_each(|p| *p = piece.pose * *p);
        outline
    }

    /// True border of a piece in its frame, resampled to equal steps of about `spacing` pixels: what a perfect
    /// segmentation would find.
    pub fn border(&self, piece: usize, spacing: f64) -> isthmus::contour::Border {
        let (points, spacing) = cut::resample_closed(&self.outline(piece), spacing);
        isthmus::contour::Border { points, spacing }
    }

    /// True pose: `p_puzzle = puzzle_from_image * p_image`. None for a piece that lies face down.
    pub fn puzzle_from_image(&self, piece: usize) -> Option<Isometry2<f64>> {
        let piece = &self.heap.pieces[piece];
        (!piece.flipped).then(|| piece.pose.inverse())
    }

    /// The sides of a piece, as they follow one another along its outline.
    pub fn sides(&self, piece: usize) -> Vec<Side> {
        let piece = &self.heap.pieces[piece];
        let sheet = &self.sheets[piece.puzzle];
        let place = |p: Point| piece.pose * if piece.flipped { mirror(p) } else { p };
        let mut sides: Vec<Side> = sheet.faces[piece.face]
            .sides
            .iter()
            .map(|&side| {
                let joint = &sheet.joints[side.joint];
                let kind = joint.kind_for(side);
                let critical_points = joint.critical_points_for(side).map(|[a, b]| {
                    let (a, b) = (place(a), place(b));
                    if piece.flipped { [b, a] } else { [a, b] }
                });
                let neighbour = joint.other_face(side).and_then(|face| self.heap.piece_of_face[piece.puzzle][face]);
                Side { joint: side.joint, kind, neighbour, critical_points, clearance: joint.clearance }
            })
            .collect();
        if piece.flipped {
            sides.reverse();
        }
        sides
    }
}
