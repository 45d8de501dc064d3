//! Isthmuses: locally shortest chords.

use crate::Point;

/// On which side of the border an isthmus line runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Polarity {
    /// Inside the shape (endoskeleton): the neck of a tab.
    Positive,
    /// Outside (exoskeleton): the mouth of a blank.
    Negative,
}

/// An isthmus line with its match segment.
#[derive(Debug, Clone, PartialEq)]
pub struct Isthmus {
    /// Neck or mouth.
    pub polarity: Polarity,
    /// Isthmus point `I_p`: midpoint of the isthmus line.
    pub point: Point,
    /// Isthmus critical points (ICPs): the ends of the isthmus line, first the one where the match segment begins
    /// when one walks forward along the border.
    pub critical_points: [Point; 2],
    /// Positions of the critical points on the border: arc length from `border.points[0]`, in pixels, each in
    /// `0..border length`; the match segment runs forward from the first to the second (it may wrap round).
    pub arc: [f64; 2],
    /// Length of the isthmus line, in pixels.
    pub width: f64,
    /// Length of the match segment, in pixels.
    pub path_length: f64,
    /// By how much the shape widens (in pixels of width) before the branch ends on the narrower of the two sides.
    pub persistence: f64,
    /// Whether this is taken for a real neck or mouth rather than a shallow waist of the body.
    pub salient: bool,
}
