//! Convex hulls.
//!
//! Points are taken in the order of `x`; what lies within a turn the wrong way is dropped again (A. M. Andrew, *Another efficient algorithm for
//! convex hulls in two dimensions*, Inf. Proc. Letters 9, 1979). `O(n log n)`, of points in order linear.

use crate::Point;

/// The convex hull of points, as their places in the list, without those on its sides, running so that the turn is never negative: clockwise
/// as seen with y down. Empty where there are no two different points.
///
/// ```
/// use isthmus::{Point, hull::convex_hull};
/// let points = [(0.0, 0.0), (2.0, 0.0), (1.0, 1.0), (2.0, 2.0), (0.0, 2.0), (1.0, 2.0)].map(|(x, y)| Point::new(x, y));
/// assert_eq!(convex_hull(&points), [0, 1, 3, 4]);
/// ```
#[must_use]
pub fn convex_hull(points: &[Point]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..points.len()).collect();
    order.sort_unstable_by(|a, b| points[*a].x.total_cmp(&points[*b].x).then(points[*a].y.total_cmp(&points[*b].y)));
    let turns = |a: usize, b: usize, c: usize| (points[b] - points[a]).perp(&(points[c] - points[a])) > 0.0;
    let mut hull = half(order.iter().copied(), turns);
    // The last point of one half is the first one of the other.
    hull.pop();
    let mut back = half(order.iter().rev().copied(), turns);
    back.pop();
    hull.append(&mut back);
    hull
}

/// Of points in order those at which the line through them turns.
pub(crate) fn half<P: Copy>(points: impl Iterator<Item = P>, turns: impl Fn(P, P, P) -> bool) -> Vec<P> {
    let mut hull: Vec<P> = Vec::new();
    for point in points {
        while let [.., a, b] = hull[..] {
            if turns(a, b, point) {
                break;
            }
            hull.pop();
        }
        hull.push(point);
    }
    hull
}
