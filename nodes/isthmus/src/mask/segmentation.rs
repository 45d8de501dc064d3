//! What is asked of the shapes in a frame, and what is found.

use crate::cutout::{Aoi, Cutout};

/// What a shape must be like to be accepted.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct Parameters {
    /// Least area in pixels. Default 256: the smallest real pieces with a measurable outline (16 px across).
    pub min_area: usize,
    /// Least area as a part of the frame's typical shape (the one that half of all shape area is in shapes at least as
    /// large as). Default 0.2: pieces of one puzzle differ by less; printed labels and crumbs are smaller.
    pub min_relative_area: f64,
    /// Least contrast as a part of the frame's typical shape, of what has no crisp edge. Default 0.2: glare and shadows have less.
    pub min_relative_contrast: f64,
    /// Least part of its bounding box that a shape fills. Default 0.08: hairs and scanner edges fill less.
    pub min_fill: f64,
    /// Greatest width of the threads that are taken off a shape, as a part of the square root of its area (and up to 6 px). Default 0.016: hairs are
    /// thinner beside a puzzle's pieces, necks wider by far. 0 for shapes whose own branches may be that thin.
    pub max_thread: f64,
}

impl Default for Parameters {
    fn default() -> Self {
        Self { min_area: 256, min_relative_area: 0.2, min_relative_contrast: 0.2, min_fill: 0.08, max_thread: 0.016 }
    }
}

/// Why something that differs from the ground is not taken for a shape.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Reason {
    /// The frame's edge cuts it.
    CutByFrame,
    /// It is too small, by itself or beside the other shapes.
    Small,
    /// It is a thread: a hair, the edge of the scanner's glass.
    Thread,
    /// It has no crisp edge as the other shapes have, or differs far less from the ground: glare, a shadow.
    Faint,
    /// Two shapes touch.
    Touching,
    /// It has no bays, as other shapes have: a coin, a label, a ruler.
    Convex,
}

/// Something that differs from the ground and is not taken for a shape.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rejected {
    /// Its bounding box.
    pub aoi: Aoi,
    /// Its area in pixels.
    pub area: usize,
    /// Why.
    pub reason: Reason,
}

/// What a frame shows.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Segmentation {
    /// The shapes, in reading order of the top left corners of their bounding boxes.
    pub cutouts: Vec<Cutout>,
    /// What was left out, specks of less than [`MIN_REPORTED_AREA`] pixels aside, in the same order.
    pub rejected: Vec<Rejected>,
    /// Bounding boxes of shapes that touched and were cut apart, in the same order; their border is a straight line where they
    /// touched.
    pub separated: Vec<Aoi>,
    /// Bounding boxes of shapes beside which a shadow was told from them, in the same order; their border there is that of shape and shadow.
    pub shaded: Vec<Aoi>,
    /// Bounding boxes of shapes whose border is not told all the way, in the same order: what lies beside it, or the step across it, is not as elsewhere (print of the ground's level, gloss, dirt,
    /// a shadow), or they have holes. Another line may be taken for their border there.
    pub untold: Vec<Aoi>,
}

/// Specks smaller than this, in pixels, are not reported: noise and dust make any number of them.
pub const MIN_REPORTED_AREA: usize = 64;
