//! Euclidean skeleton.

use crate::Point;

/// A point of the skeleton with the radius of the largest empty disc around it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SkeletonPoint {
    /// Where.
    pub point: Point,
    /// Distance to the border, in pixels.
    pub distance: f64,
}

/// A skeleton: branches that run from a junction or an end to the next one.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Skeleton {
    /// The branches, each with at least two points.
    pub branches: Vec<Vec<SkeletonPoint>>,
}
