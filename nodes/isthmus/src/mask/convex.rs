//! Convex shapes among others: coins, labels, cards, rulers, boxes.
//!
//! What interlocks has bays: of 404 real pieces each has one of a fifth of its size, of generated pieces with a single neck each one of a twelfth. A shape
//! without any is of another kind. Two looks: the area between the outermost ends of rows beside that of the hull of these, linear in the
//! rows, which few shapes with bays pass; then the depth of the bays of the border itself.

use super::runs::{Component, Run};
use crate::Point;
use crate::contour::Border;
use crate::cutout::Cutout;
use crate::hull::{convex_hull, half};

/// Rows of a shape that are looked at, about: between any two of them a convex shape is so but for a thousandth of its area.
const ROWS: usize = 48;
/// Least part of the hull of its rows' ends that a convex shape fills: steps from pixel to pixel take off half of the rest.
const LEAST_FILL: f64 = 0.97;
/// Most depth of the bays of a convex shape, as a part of the square root of its area: a third of that of pieces with the least bays.
const MOST_DEPTH: f64 = 0.03;
/// Least size of shapes that are told, as the square root of the area in pixels: there the depth is that of a pixel.
const LEAST_SIZE: f64 = 1.0 / MOST_DEPTH;

/// Whether a component may be convex, by the runs of its rows.
pub(super) fn may_be_convex<'a>(component: &Component, runs: impl Iterator<Item = &'a Run>) -> bool {
    let step = ((component.bottom - component.top) / ROWS).max(1);
    let (mut starts, mut ends): (Vec<i64>, Vec<i64>) = Default::default();
    let mut row = None;
    for run in runs.filter(|run| (run.row - component.top).is_multiple_of(step)) {
        if row.replace(run.row) != Some(run.row) {
            starts.push(-(run.start as i64));
            ends.push(run.end as i64 - 1);
        } else if let Some(end) = ends.last_mut() {
            *end = run.end as i64 - 1;
        }
    }
    let own = |ends: &[i64]| ends.windows(2).map(|ends| ends[0] + ends[1]).sum::<i64>();
    let area = own(&starts) + own(&ends);
    area as f64 >= LEAST_FILL * (area_below_hull(&starts) + area_below_hull(&ends)) as f64
}

/// Twice the area below the least concave line above some heights that are a step apart.
fn area_below_hull(heights: &[i64]) -> i64 {
    let points = heights.iter().enumerate().map(|(at, height)| [at as i64, *height]);
    let hull = half(points, |a, b, c| (b[1] - a[1]) * (c[0] - a[0]) > (c[1] - a[1]) * (b[0] - a[0]));
    hull.windows(2).map(|w| (w[1][0] - w[0][0]) * (w[0][1] + w[1][1])).sum()
}

/// Whether a shape is convex but for small bays; shapes too small to tell are not.
pub(super) fn is_convex(cutout: &Cutout) -> bool {
    let Ok((border, _)) = Border::from_cutout(cutout) else { return false };
    let size = border.area().sqrt();
    size >= LEAST_SIZE && bay_depth(&border.points) <= MOST_DEPTH * size
}

/// Depth of the deepest bay of a border: the greatest distance of one of its points from the hull.
fn bay_depth(border: &[Point]) -> f64 {
    let mut hull = convex_hull(border);
    // The hull's points follow each other as they do along the border, with a bay between any two.
    hull.sort_unstable();
    let bay = |(from, to): (usize, usize)| {
        let (a, b) = (border[from], border[to]);
        let points = border.iter().cycle().skip(from).take((to + border.len() - from) % border.len());
        points.map(|p| (b - a).perp(&(p - a)).abs() / (b - a).norm().max(f64::MIN_POSITIVE)).fold(0.0, f64::max)
    };
    let next = hull.iter().copied().cycle().skip(1);
    hull.iter().copied().zip(next).map(bay).fold(0.0, f64::max)
}
