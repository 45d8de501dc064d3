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
//! The convex hull of points stands in [`hull`].
//!
//! Coordinates are pixels of the source frame: x right, y **down**, pixel centres at whole numbers.

mod changes;
pub mod contour;
mod cutout;
pub mod hull;
pub mod isthmus;
pub mod mask;
pub mod profile;
pub mod skeleton;
pub mod wide;

use crate::skeleton::Polarity;

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

/// Why a shape has no features.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// No border.
    #[error(transparent)]
    Contour(#[from] contour::ContourError),
    /// No triangulation.
    #[error(transparent)]
    Triangulation(#[from] skeleton::TriangulationError),
}

impl Features {
    /// Features of a border. `noise` is the standard deviation of a border point across the border, in pixels (0 for an
    /// outline that is exact).
    ///
    /// # Errors
    /// [`Error`] where the border spans no triangle.
    pub fn from_border(border: contour::Border, noise: f64) -> Result<Self, Error> {
        Extractor::default().analyse(border, noise)
    }
}

/// Extracts features, keeping its buffers from one shape to the next.
#[derive(Debug, Clone, Default)]
pub struct Extractor {
    tracer: contour::Tracer,
    triangulation: skeleton::Triangulation,
}

impl Extractor {
    /// Features of a cutout.
    ///
    /// # Errors
    /// [`Error`] where the cutout is inconsistent or shows no shape.
    pub fn extract(&mut self, cutout: &mask::Cutout) -> Result<Features, Error> {
        let (border, noise) = self.tracer.trace(cutout)?;
        self.analyse(border, noise)
    }

    /// Features of a border, as [`Features::from_border`].
    ///
    /// # Errors
    /// [`Error`] where the border spans no triangle.
    pub fn analyse(&mut self, border: contour::Border, noise: f64) -> Result<Features, Error> {
        self.triangulation.rebuild(&border)?;
        let isthmuses = isthmus::find(&border, &self.triangulation, noise);
        let skeleton = |polarity| self.triangulation.skeleton(&border, polarity, noise);
        let (endoskeleton, exoskeleton) = (skeleton(Polarity::Positive), skeleton(Polarity::Negative));
        Ok(Features { border, noise, isthmuses, endoskeleton, exoskeleton })
    }
}

/// The examples of the README, compiled and run with the tests.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
