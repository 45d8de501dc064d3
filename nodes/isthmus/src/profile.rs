//! Isthmus distance functions.
//!
//! # Method
//! The isthmus distance function (IDF; Webster et al., MVA 1990, section 4) of an isthmus is the distance from the isthmus
//! point `I_p` to the border as a function of path length along the match segment. Here it is sampled at equal steps of
//! path length, ends included, on the polygon of the sub-pixel border.
//!
//! # Cost
//! Linear in the number of samples.
//!
//! ```
//! use isthmus::{Features, Point, contour::Border, profile};
//! // A dumb-bell: two squares joined by a neck 10 wide.
//! let outline = [(0, 0), (40, 0), (40, 15), (60, 15), (60, 0), (100, 0), (100, 40), (60, 40), (60, 25), (40, 25), (40, 40), (0, 40)];
//! let outline = outline.map(|(x, y)| Point::new(f64::from(x), f64::from(y)));
//! let features = Features::from_border(Border::from_points(&outline)?, 0.0)?;
//! let idf = profile::distance_function(&features.border, &features.isthmuses[0], 64);
//! assert_eq!(idf.len(), 64);
//! assert!((idf[0] - 5.0).abs() < 0.5, "it starts at a critical point, half a neck away: {}", idf[0]);
//! # Ok::<(), isthmus::Error>(())
//! ```

use crate::contour::Border;
use crate::isthmus::Isthmus;

/// Distance from the isthmus point to the border at `count` equally spaced points of the match segment, in pixels;
/// first and last are the critical points.
#[must_use]
pub fn distance_function(border: &Border, isthmus: &Isthmus, count: usize) -> Vec<f64> {
    extended_distance_function(border, isthmus, 0.0, count)
}

/// As [`distance_function`], of the match segment made longer by `extension` pixels at both ends (the shoulders).
#[must_use]
pub fn extended_distance_function(border: &Border, isthmus: &Isthmus, extension: f64, count: usize) -> Vec<f64> {
    let path = isthmus.path_length + 2.0 * extension;
    let step = if count > 1 { path / (count - 1) as f64 } else { 0.0 };
    let start = isthmus.arc[0] - extension;
    (0..count).map(|i| (border.point_at(start + i as f64 * step) - isthmus.point).norm()).collect()
}
