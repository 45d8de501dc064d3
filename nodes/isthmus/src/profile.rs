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
    let step = if count > 1 { isthmus.path_length / (count - 1) as f64 } else { 0.0 };
    (0..count).map(|i| (border.point_at(isthmus.arc[0] + i as f64 * step) - isthmus.point).norm()).collect()
}
