//! Sub-pixel border of a shape.

use crate::Point;

/// A closed border: the last point joins the first. Points are equally spaced along it and run so that the shoelace
/// area in (x right, y down) is positive: clockwise as seen on a screen, the outward normal being `(dy, -dx)`.
#[derive(Debug, Clone, PartialEq)]
pub struct Border {
    /// Points in the source frame.
    pub points: Vec<Point>,
    /// Arc length between consecutive points, in pixels.
    pub spacing: f64,
}
