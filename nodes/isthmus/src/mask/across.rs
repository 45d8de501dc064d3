//! Levels across the border of a shape: whether it is crisp, and whether it is told all the way.
//!
//! A border lies where the level falls off from the shape's to the ground's. Where print has the ground's level, gloss lies on the shape, or a shadow, glare or dirt
//! beside it, another line is taken for it, and the levels on either side say so: what lies beyond is not ground as elsewhere, or the step is far less, or the shape itself is. Print of the very
//! level of the ground has a border as crisp as the shape's own; only holes within the shape show that there is such.

use super::runs::{Component, Components};
use super::statistics::median;
use crate::Point;
use crate::contour::{Border, Tracer};
use crate::cutout::Cutout;
use std::ops::RangeInclusive;

/// How far on either side of a border levels are compared to tell a crisp edge, as a part of the square root of the shape's area: light that falls off
/// from a spot's middle to its rim does so little there.
const EDGE_REACH: f64 = 0.05;
/// ... at least and at most, in pixels: beyond the blur of usual pictures, and within the margin of a cutout.
const MIN_EDGE_REACH: f64 = 2.0;
const MAX_EDGE_REACH: f64 = 6.0;
/// Least part of a shape's contrast that a crisp edge has within that reach: a spot of light has a sixth, an edge in focus all.
const CRISP_EDGE: f64 = 0.6;

/// How far from the border, in pixels, its step is measured, the shape beside it, and the ground: about the edge's blur, and beyond it.
const STEP: RangeInclusive<usize> = NEAREST..=3;
const SHAPE: RangeInclusive<usize> = 3..=5;
const GROUND: RangeInclusive<usize> = 3..=FARTHEST;
/// Levels are taken from the nearest of these on to the farthest, and how many that are.
const NEAREST: usize = 2;
const FARTHEST: usize = 6;
const DEPTH: usize = FARTHEST - NEAREST + 1;
/// Points of a border on either side of one whose levels are averaged with its own, against noise.
const ALONG: usize = 6;
/// Most difference of the ground beside a told border from that along most of it, as a part of the contrast: pieces on plain ground have less than half of it.
const MOST_SHADE: f32 = 0.1;
/// ... and by so many median deviations more where the ground is grained.
const DEVIATIONS: f32 = 1.5;
/// Least step, and least level of the shape beside the border, as a part of the median along it.
const LEAST_STEP: f32 = 0.5;
/// Least part of a border that is untold: specks of dust and noise make less.
const LEAST_SHARE: f64 = 0.02;
/// Least size of a hole, as a part of the square root of the shape's area: specks of print and noise make smaller ones.
const LEAST_HOLE: f64 = 0.04;

/// A cutout with its border.
struct Across<'a> {
    cutout: &'a Cutout,
    border: Border,
    /// One by the contrast.
    scale: f32,
}

impl<'a> Across<'a> {
    fn new(cutout: &'a Cutout, tracer: &mut Tracer) -> Option<Self> {
        let (border, _) = tracer.trace(cutout).ok()?;
        Some(Self { cutout, border, scale: 1.0 / (cutout.shape_level - cutout.ground_level) })
    }

    /// The way out of the shape at a point of the border.
    fn outwards(&self, k: usize) -> nalgebra::Vector2<f64> {
        let points = &self.border.points;
        let last = points.len() - 1;
        let along = (points[if k < last { k + 1 } else { 0 }] - points[if k > 0 { k - 1 } else { last }]).normalize();
        // Clockwise on a screen, y down: the shape is on the right.
        nalgebra::Vector2::new(along.y, -along.x)
    }

    /// The level at a place, in parts of the contrast: 0 for ground, 1 for shape.
    #[inline]
    fn level(&self, p: Point) -> f32 {
        let Cutout { window, pixels, ground_level, .. } = self.cutout;
        let (width, height) = (window.width as i32, window.height as i32);
        // A cast cuts off towards zero: within the window that is rounding down, and what lies beyond is clamped.
        let [x, y] = [p.x - f64::from(window.x), p.y - f64::from(window.y)].map(|v| (v + 0.5) as i32);
        let pixel = pixels[(y.clamp(0, height - 1) * width + x.clamp(0, width - 1)) as usize];
        (f32::from(pixel) - ground_level) * self.scale
    }
}

/// Whether the level falls off at the border of a shape rather than all over it: the edge of a piece, however faint, does, those of glare and
/// shadows don't.
pub(super) fn has_crisp_edge(cutout: &Cutout, tracer: &mut Tracer) -> bool {
    let Some(across) = Across::new(cutout, tracer) else { return false };
    let points = &across.border.points;
    let reach = (EDGE_REACH * across.border.area().sqrt()).clamp(MIN_EDGE_REACH, MAX_EDGE_REACH);
    let step = |k: usize| {
        let outwards = reach * across.outwards(k);
        f64::from(across.level(points[k] - outwards) - across.level(points[k] + outwards))
    };
    (0..points.len()).map(step).sum::<f64>() / points.len() as f64 >= CRISP_EDGE
}

/// Whether a part of the border is not told: another line may lie there.
pub(super) fn is_untold(cutout: &Cutout, tracer: &mut Tracer) -> bool {
    let Some(across) = Across::new(cutout, tracer) else { return false };
    let points = &across.border.points;
    let hole = (largest_hole(cutout) as f64).sqrt();
    if hole > LEAST_HOLE * across.border.area().sqrt() {
        return true;
    }
    let [mut steps, mut shape, mut ground]: [Vec<f32>; 3] = Default::default();
    for (k, point) in points.iter().enumerate() {
        let outwards = across.outwards(k);
        let levels = |sense: f64| -> [f32; DEPTH] {
            let level = |distance| across.level(point + sense * distance as f64 * outwards).clamp(-1.0, 2.0);
            std::array::from_fn(|i| level(i + NEAREST))
        };
        let mean = |levels: &[f32; DEPTH], distances: RangeInclusive<usize>| {
            let levels = &levels[distances.start() - NEAREST..=distances.end() - NEAREST];
            levels.iter().sum::<f32>() / levels.len() as f32
        };
        let [inside, outside] = [-1.0, 1.0].map(levels);
        steps.push(mean(&inside, STEP) - mean(&outside, STEP));
        shape.push(mean(&inside, SHAPE));
        ground.push(mean(&outside, GROUND));
    }
    let [steps, shape, ground] = [steps, shape, ground].map(|levels| smooth(&levels));
    let [step, level, clear] = [&steps, &shape, &ground].map(|levels| median(levels));
    let shade: Vec<f32> = ground.iter().map(|ground| (ground - clear).abs()).collect();
    let most = MOST_SHADE + DEVIATIONS * median(&shade);
    let is_untold = |k: &usize| shade[*k] > most || steps[*k] < LEAST_STEP * step || shape[*k] < LEAST_STEP * level;
    (0..points.len()).filter(is_untold).count() as f64 >= LEAST_SHARE * points.len() as f64
}

/// Means along a border, which has more points than a mean takes on either side ([`crate::contour::MIN_POINTS`]).
fn smooth(levels: &[f32]) -> Vec<f32> {
    let (head, tail) = (&levels[..ALONG], &levels[levels.len() - ALONG..]);
    let round = [tail, levels, head].concat();
    round.windows(2 * ALONG + 1).map(|window| window.iter().sum::<f32>() / window.len() as f32).collect()
}

/// Area of the largest hole in what a cutout shows, in pixels.
fn largest_hole(cutout: &Cutout) -> usize {
    let (width, height) = (cutout.window.width as usize, cutout.window.height as usize);
    let half = (cutout.shape_level + cutout.ground_level) / 2.0;
    let is_bright = cutout.shape_level > cutout.ground_level;
    let mut ground = Components::default();
    for (y, row) in cutout.pixels.chunks_exact(width).enumerate() {
        ground.begin_row(y);
        ground.add_row(row, |p| (f32::from(p) > half) != is_bright);
    }
    ground.close();
    let is_within = |c: &&Component| c.left > 0 && c.top > 0 && c.right < width && c.bottom < height;
    ground.list.iter().filter(is_within).map(|c| c.area).max().unwrap_or(0)
}
