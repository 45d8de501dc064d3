//! Copies: pieces that are there twice, as two pictures of one piece or two pieces from one die.
//!
//! Pieces of nearly equal area and length are laid on one another by the distance of their border from the centroid,
//! walked along the border (the lag at which the two agree best, then a rigid fit); copies are those that coincide
//! within their noise. Pieces that merely resemble each other differ more somewhere. Complexity O(n log n) to sort by
//! area, O(samples²) for each pair of nearly equal area. A copy that lies face down is no copy.
//!
//! Of copies seen at different times the last is kept: it is the piece where it lies now, and nothing lies any more where it
//! was seen earlier. Of those seen at once the first by its id is kept: they are two pieces, and the other waits.

use crate::outline::Outline;
use isthmus::Point;
use nalgebra::Isometry2;
use std::cmp::Ordering;

/// What a piece is beside others of its shape.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Standing {
    /// The one that is kept, or the only one.
    Kept,
    /// A copy of one that was seen at the same time: another picture of it, or a piece from the same die.
    Copy,
    /// A copy of one that was seen later.
    Earlier,
}

/// Which pieces, in the order of their ids, are copies of others.
///
/// Outlines of nearly equal area and length are laid on one another by their distance from the centroid, walked along
/// the border; copies are those that coincide within their noise.
pub(crate) fn copies(outlines: &[&Outline]) -> Vec<Standing> {
    let mut order: Vec<usize> = (0..outlines.len()).collect();
    order.sort_by(|p, q| outlines[*p].area.total_cmp(&outlines[*q].area).then(p.cmp(q)));
    let mut standings = vec![Standing::Kept; outlines.len()];
    for (i, &p) in order.iter().enumerate() {
        for &q in &order[i + 1..] {
            let (a, b) = (outlines[p], outlines[q]);
            let tolerance = sameness(a, b);
            if b.area - a.area > tolerance * a.length {
                break;
            }
            // A border that is off by the tolerance at every point may be longer by that share of the way round.
            let alike = (a.length - b.length).abs() <= tolerance * a.length / a.scale * LONGER;
            if alike && alike_in_reach(a, b) && overlay(a, b).is_some_and(|b_from_a| coincide(a, b, &b_from_a)) {
                let (copy, standing) = match a.seen.cmp(&b.seen) {
                    Ordering::Less => (p, Standing::Earlier),
                    Ordering::Equal => (p.max(q), Standing::Copy),
                    Ordering::Greater => (q, Standing::Earlier),
                };
                standings[copy] = standings[copy].max(standing);
            }
        }
    }
    standings
}

/// Roughness lengthens a border by some more than a shift does.
const LONGER: f64 = 10.0;
/// Points of the border by which copies are recognised.
const OVERLAY_SAMPLES: usize = 128;

/// How far the borders of two pictures of one piece lie apart at most, but for a few points: three deviations of both
/// noises, and what resampling adds, in pixels. Pieces that merely resemble each other differ more somewhere.
fn sameness(a: &Outline, b: &Outline) -> f64 {
    3.0 * a.noise.hypot(b.noise) + 0.1
}

/// Whether the borders of two pieces lie equally far from their centroids, point by point in the order of distance: what
/// copies do, however they are turned, and few others.
fn alike_in_reach(a: &Outline, b: &Outline) -> bool {
    /// Where few points lie between two quantiles, sampling adds this many times what the border is off.
    const SPARSE: f64 = 3.0;
    let tolerance = (SPARSE * sameness(a, b)) as f32;
    a.reaches().iter().zip(b.reaches()).all(|(p, q)| (p - q).abs() <= tolerance)
}

/// The pose that lays one outline on the other best, if they are one shape.
fn overlay(a: &Outline, b: &Outline) -> Option<Isometry2<f64>> {
    const N: usize = OVERLAY_SAMPLES;
    let samples = |o: &Outline| -> Vec<Point> { (0..N).map(|k| o.at_arc(k as f64 * o.length / N as f64)).collect() };
    let (p, q) = (samples(a), samples(b));
    let radii =
        |o: &Outline, points: &[Point]| -> Vec<f64> { points.iter().map(|p| (p - o.centroid).norm()).collect() };
    let (f, g) = (radii(a, &p), radii(b, &q));
    let off = |lag: usize| (0..N).map(|k| (f[k] - g[(k + lag) % N]).powi(2)).sum::<f64>();
    let lag = (0..N).min_by(|i, j| off(*i).total_cmp(&off(*j)))?;
    // Between the samples: where a parabola through the three least has its minimum.
    let (before, least, after) = (off((lag + N - 1) % N), off(lag), off((lag + 1) % N));
    let curvature = before - 2.0 * least + after;
    let part = if curvature > 0.0 { (0.5 * (before - after) / curvature).clamp(-0.5, 0.5) } else { 0.0 };
    let q: Vec<Point> = (0..N).map(|k| b.at_arc((k as f64 + lag as f64 + part) * b.length / N as f64)).collect();
    let b_from_a = crate::placement::rigid_fit(&p, &q);
    let rest = p.iter().zip(&q).map(|(p, q)| (b_from_a * p - q).norm_squared()).sum::<f64>() / N as f64;
    // Along the border the samples may be off by what the parabola can't tell.
    (rest.sqrt() <= sameness(a, b) + 0.1 * b.length / N as f64).then_some(b_from_a)
}

/// Whether two pieces in a given pose lie on one another within their noise, nearly everywhere and in the mean.
fn coincide(a: &Outline, b: &Outline, b_from_a: &Isometry2<f64>) -> bool {
    /// Points that may be off, one in so many: where the two were sampled differently at a corner.
    const FEW: usize = 50;
    /// Root mean square distance of copies at most, in deviations of both noises, and what resampling adds, in pixels: seen
    /// of copies up to 1.5 and 0.05; edges 98 % alike leave 2.1 deviations and more.
    const MEAN: f64 = 1.5;
    const RESAMPLED: f64 = 0.06;
    let tolerance = sameness(a, b);
    let stride = (a.points.len() / OVERLAY_SAMPLES).max(1);
    let gaps = a.points.iter().step_by(stride).filter_map(|p| b.gap(b_from_a * *p, tolerance));
    let (near, squares) = gaps.fold((0, 0.0), |(near, squares), (gap, _)| (near + 1, squares + gap * gap));
    let all = a.points.len().div_ceil(stride);
    let most = (MEAN * a.noise.hypot(b.noise)).hypot(RESAMPLED);
    (all - near) * FEW <= all && squares <= near as f64 * most * most
}
