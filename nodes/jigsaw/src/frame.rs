//! The puzzle frame: which way up an assembly lies, and where.
//!
//! An assembly is known up to a rigid motion. The gauge: straight edges of the outline lie along the axes (the
//! direction most of their length agrees on); without enough of them, the rectangle of least area about the convex
//! hull does (Freeman and Shapira 1975: one side lies on a hull edge). The long side runs along x; of the turns that
//! are left (half or quarter), the one that turns the first piece least. Top left of the bounding box at the origin;
//! further assemblies stand to the right of it, a piece's width apart.

use crate::outline::{Outline, convex_hull};
use isthmus::Point;
use nalgebra::{Isometry2, Translation2, UnitComplex, Vector2};
use rayon::prelude::*;
use std::f64::consts::{FRAC_PI_2, PI};

/// Straight edges decide if their length is at least this part of half the hull's perimeter.
const STRAIGHT_SHARE: f64 = 0.5;
/// Straight edges within this angle (radians) of the common direction count for it.
const STRAIGHT_SPREAD: f64 = 0.03;
/// Sides that differ by less than this fraction count as a square, which may be turned by quarters.
const SQUARE: f64 = 0.02;

/// Motions of the islands (lists of pieces, largest first) from their own frame to the puzzle frame.
pub(crate) fn lay_out(
    outlines: &[&Outline],
    poses: &[Isometry2<f64>],
    islands: &[Vec<usize>],
) -> Vec<(Vec<usize>, Isometry2<f64>)> {
    let mut left = 0.0;
    islands
        .iter()
        .map(|members| {
            let hull = hull(outlines, poses, members);
            let turn = upright(outlines, poses, members, &hull);
            let (low, high) = bounds(&hull, &turn);
            let motion = Isometry2::from_parts(Translation2::new(left - low.x, -low.y), turn);
            left += high.x - low.x + outlines[members[0]].scale;
            (members.clone(), motion)
        })
        .collect()
}

/// Convex hull of an island. Most pieces lie well within that of all centroids and can't touch it.
fn hull(outlines: &[&Outline], poses: &[Isometry2<f64>], members: &[usize]) -> Vec<Point> {
    let centre = |k: usize| poses[k] * outlines[k].centroid;
    let inner = convex_hull(members.iter().map(|k| centre(*k)).collect());
    let sides: Vec<(Point, Vector2<f64>)> = inner
        .iter()
        .zip(inner.iter().cycle().skip(1))
        .filter_map(|(p, q)| Some((*p, (q - p).try_normalize(f64::EPSILON)?)))
        .collect();
    // The hull runs anticlockwise about what is to the left of each side.
    let within = |k: usize| {
        let (at, radius) = (centre(k), outlines[k].radius);
        sides.len() > 2 && sides.iter().all(|(p, along)| along.perp(&(at - p)) >= radius)
    };
    let outer = members.par_iter().filter(|k| !within(**k));
    convex_hull(outer.flat_map_iter(|k| outlines[*k].hull().iter().map(move |p| poses[*k] * p)).collect())
}

/// Least and greatest coordinates of turned points.
fn bounds(points: &[Point], turn: &UnitComplex<f64>) -> (Vector2<f64>, Vector2<f64>) {
    let nothing = (Vector2::repeat(f64::INFINITY), Vector2::repeat(f64::NEG_INFINITY));
    points.iter().map(|p| turn * p.coords).fold(nothing, |(low, high), p| (low.inf(&p), high.sup(&p)))
}

/// The turn that lays an island with this hull down straight.
fn upright(outlines: &[&Outline], poses: &[Isometry2<f64>], members: &[usize], hull: &[Point]) -> UnitComplex<f64> {
    let perimeter: f64 = (0..hull.len()).map(|i| (hull[(i + 1) % hull.len()] - hull[i]).norm()).sum();
    let edges: Vec<Vector2<f64>> = members
        .iter()
        .flat_map(|k| outlines[*k].straights.iter().map(move |s| poses[*k] * s.to - poses[*k] * s.from))
        .collect();
    let angle = straight_direction(&edges, perimeter).unwrap_or_else(|| least_rectangle(hull));
    let mut turn = UnitComplex::new(-angle);
    let (low, high) = bounds(hull, &turn);
    let size = high - low;
    let square = (size.x - size.y).abs() <= SQUARE * size.x.max(size.y);
    if !square && size.y > size.x {
        turn *= UnitComplex::new(FRAC_PI_2);
    }
    let quarter = if square { FRAC_PI_2 } else { PI };
    let first = members.iter().min().copied().unwrap_or(0);
    let now = (turn * poses[first].rotation).angle();
    turn * UnitComplex::new(-(now / quarter).round() * quarter)
}

/// The direction, within a quarter turn, that straight edges agree on; `None` if there are too few.
fn straight_direction(edges: &[Vector2<f64>], perimeter: f64) -> Option<f64> {
    let mean = |near: Option<f64>| {
        let (mut sum, mut length) = (Vector2::zeros(), 0.0);
        for e in edges {
            let a = e.y.atan2(e.x);
            let off = |n: f64| ((a - n) / FRAC_PI_2 - ((a - n) / FRAC_PI_2).round()).abs() * FRAC_PI_2;
            if near.is_none_or(|n| off(n) < STRAIGHT_SPREAD) {
                sum += Vector2::new((4.0 * a).cos(), (4.0 * a).sin()) * e.norm();
                length += e.norm();
            }
        }
        (sum.y.atan2(sum.x) / 4.0, length)
    };
    let (rough, _) = mean(None);
    let (angle, length) = mean(Some(rough));
    (length > 0.0 && length >= STRAIGHT_SHARE * 0.5 * perimeter).then_some(angle)
}

/// Direction of one side of the rectangle of least area about a convex polygon.
fn least_rectangle(hull: &[Point]) -> f64 {
    let mut best = (f64::INFINITY, 0.0);
    for i in 0..hull.len() {
        let d = hull[(i + 1) % hull.len()] - hull[i];
        let Some(d) = d.try_normalize(f64::EPSILON) else { continue };
        let across = Vector2::new(-d.y, d.x);
        let (mut low, mut high) = (Vector2::repeat(f64::INFINITY), Vector2::repeat(f64::NEG_INFINITY));
        for p in hull {
            let v = Vector2::new(p.coords.dot(&d), p.coords.dot(&across));
            low = low.inf(&v);
            high = high.sup(&v);
        }
        let size = high - low;
        if size.x * size.y < best.0 {
            best = (size.x * size.y, d.y.atan2(d.x));
        }
    }
    best.1
}
