//! Necks of planar shapes, after Webster, Ross, LaFollette and Stafford, *A computer vision system that assembles
//! canonical jigsaw puzzles using the Euclidean skeleton and isthmus critical points*, MVA 1990.
//!
//! A grey frame goes through five modules, each one step:
//!
//! | module | in | out |
//! | --- | --- | --- |
//! | [`mask`] | grey or colour frame | one [`mask::Cutout`] for each connected shape, levels, noise |
//! | [`contour`] | cutout | [`contour::Border`]: closed, sub-pixel, equally spaced |
//! | [`skeleton`] | border | endo- and exoskeleton as branches with distance values |
//! | [`isthmus`] | border, skeleton | [`isthmus::Isthmus`]es with critical points and match segment |
//! | [`profile`] | isthmus, border | isthmus distance function (IDF) |
//!
//! Coordinates are pixels of the source frame: x right, y **down**, pixel centres at whole numbers.

pub mod contour;
pub mod isthmus;
pub mod mask;
pub mod profile;
pub mod skeleton;

/// A point of the source frame: pixels, x right, y down, pixel centres at whole numbers.
pub type Point = nalgebra::Point2<f64>;

/// What the shape analysis finds on one shape.
#[derive(Debug, Clone, PartialEq)]
pub struct Features {
    /// The border of the shape, in the source frame.
    pub border: contour::Border,
    /// Standard deviation of a border point across the border, in pixels, measured from the cutout.
    pub noise: f64,
    /// All isthmuses; real necks and mouths (`salient`) first, then by falling persistence.
    pub isthmuses: Vec<isthmus::Isthmus>,
    /// Skeleton inside the shape.
    pub endoskeleton: skeleton::Skeleton,
    /// Skeleton outside the shape, bounded by the area of interest.
    pub exoskeleton: skeleton::Skeleton,
}
