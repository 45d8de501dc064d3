//! Cast shadows, told from the shapes that cast them.
//!
//! # Method
//! The border of a shape is as sharp all round as the picture shows edges. Where a shadow lies beside the shape its outer edge is taken for the border instead, and that is
//! soft, or the border is right but the ground beside it is not as elsewhere, and half-way lies elsewhere.
//! 1. *Suspicion*: at some rows' ends the levels on either side of the border are compared (also to tell whether a border is worth the look of `across`). Only where a part of it is far softer than most, or has other ground beside it, the
//!    rest is done.
//! 2. *Watershed* (L. Vincent, P. Soille, *Watersheds in digital spaces*, IEEE Trans. PAMI 13, 1991): the crop is flooded from its rim and from the depths of
//!    its shapes, over the steepness of the levels beyond that of their surroundings, which slow changes hardly have. The floods meet along the sharpest line between the two.
//! 3. *Levels* near that line are stretched to what they would be without shadow, by the means on its two sides; beyond, ground is made plain. The border is half-way between the
//!    two levels then, as everywhere.
//!
//! A line that does not run along an edge all the way, or leaves something with sharp edges to the ground, is none: everything stays as it was.
//!
//! # Cost
//! A hundred places of each border. With a shadow linear in the pixels of the crop.

use super::crop::Crop;
use super::runs::Components;
use super::segmentation::Parameters;
use super::statistics::median;
use std::collections::VecDeque;

/// Rows of a shape at whose ends its border is looked at, about: a share of them is known to a twentieth.
const ROWS: usize = 32;
/// An edge is soft if its step is less than this part of the upper quartile of all: noise of an eighth of the contrast makes few such.
const SOFT: f32 = 0.7;
/// Difference of the ground beside a border from that elsewhere that shows shadow, as a part of the contrast: the ground itself varies by less than half of it.
const SHADE: f32 = 0.15;
/// An edge by which a border is looked at more closely, likewise, and how many of them: some more than what print, grain and noise of pieces that are told all the way do to most.
const SOFTER: f32 = 0.8;
const SHADIER: f32 = 0.1;
const LEAST_UNLIKE: usize = 2;
/// Least part of a border that lies in shadow. A lamp leaves a third to a half of it there; of scanned print up to a tenth is soft.
const LEAST_SHARE: f64 = 0.15;
/// Most noise at which shadows are told, as a part of the contrast: as for threads, pixels on the wrong side are no chance.
const MAX_NOISE: f32 = 1.0 / 16.0;
/// Depth of what is shape beyond doubt, as a part of the greatest of its component: shadows are narrower than shapes.
const CORE_DEPTH: f32 = 0.7;
/// Radii of the squares over which steepness is measured, in pixels: against noise, and that of the surroundings; wider than the blur of pictures in focus, narrower than the edges of
/// shadows.
const FINE: usize = 1;
const COARSE: usize = 4;
/// Steps of the steepness.
const STEPS: usize = 256;
/// Distances from the line between which the levels on its sides are measured, in pixels: near it, since shadows fall off, and beyond the edge's own blur.
const NEAR: u8 = 2;
const FAR: u8 = 4;
/// Least difference of the two levels, as a part of the contrast, at an edge.
const LEAST_STEP: f32 = 0.1;
/// Least shadow that matters, as a part of the contrast: it moves half-way by a twentieth of the edge's blur.
const LEAST_SHADE: f32 = 0.05;
/// Most of the line that may run along no edge, and of what is left to the ground that may be sharp: specks.
const EXCEPTIONS: f32 = 0.05;
/// How far beyond the levels of ground and shape stretched noise may go, as a part of the contrast.
const OVERSHOOT: f32 = 0.2;

/// Which flood came to a pixel.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
enum Side {
    #[default]
    Neither,
    Ground,
    Shape,
}

/// What a border is like at a place, in parts of the contrast.
#[derive(Debug, Clone, Copy)]
struct Edge {
    /// The step across it, in the direction where that is greatest.
    step: f32,
    /// By how much the ground beside it differs from the ground's level, in the direction where that is least.
    shade: f32,
}

/// What is found beside the shapes of a crop.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Beside {
    /// Whether there was a shadow, told from its shape.
    pub(super) is_shaded: bool,
    /// Whether a border may not be told all the way.
    pub(super) is_doubtful: bool,
}

/// Finds shadows, keeping its buffers from one component to the next.
#[derive(Debug, Clone, Default)]
pub(super) struct Shadows {
    /// At the outer ends of rows, and at the other ends.
    edges: Vec<Edge>,
    inner: Vec<Edge>,
    /// Levels in parts of the contrast: 0 for ground, 1 for shape.
    levels: Vec<f32>,
    steepness: Vec<u8>,
    /// Distance from what is no shape, in thirds of a pixel.
    depth: Vec<u16>,
    sides: Vec<Side>,
    /// Distance from the line where the floods met, in steps from pixel to pixel from 1 on; more than [`FAR`] beyond.
    distance: Vec<u8>,
    queues: Vec<VecDeque<usize>>,
}

impl Crop {
    /// Makes ground of the shadows beside the shapes found. To be labelled again where there are any.
    pub(super) fn lift_shadows(
        &mut self,
        components: &Components,
        shadows: &mut Shadows,
        parameters: &Parameters,
    ) -> Beside {
        if self.noise_level > MAX_NOISE * (self.shape_level - self.ground_level).abs() {
            return Beside { is_shaded: false, is_doubtful: true };
        }
        let labels = || (0..components.list.len()).filter(|label| components.list[*label].area >= parameters.min_area);
        let Shadows { edges, inner, .. } = shadows;
        edges.clear();
        inner.clear();
        labels().for_each(|label| self.look_along(components, label, [&mut *edges, &mut *inner]));
        let (are_suspected, are_unlike) = shadows.are_unlike();
        let is_doubtful = are_unlike || labels().any(|label| components.list[label].is_hollow);
        let is_shaded = are_suspected && shadows.find(self, components, parameters.min_area) && shadows.lift(self);
        Beside { is_shaded, is_doubtful: is_shaded || is_doubtful }
    }

    /// Looks at the border of a component, at the outer ends of some of its rows and at the other ends of runs there.
    fn look_along(&self, components: &Components, label: usize, [outer, inner]: [&mut Vec<Edge>; 2]) {
        let width = self.width as isize;
        let scale = 1.0 / (self.shape_level - self.ground_level);
        // The crop's margin is wider than what is looked at.
        let level = |at: isize| {
            self.pixels.get(at as usize).map_or(0.0, |pixel| (f32::from(*pixel) - self.ground_level) * scale)
        };
        let edge = |row: usize, column: usize, outwards: isize| {
            let place = row as isize * width + column as isize;
            // Two places on either side, and one beyond the blur of the edge; diagonal steps are longer.
            let (straight, diagonal) = ([2, 4, 7], [1, 3, 5]);
            let directions = [
                (outwards, straight),
                (width, straight),
                (-width, straight),
                (outwards + width, diagonal),
                (outwards - width, diagonal),
            ];
            directions.iter().fold(Edge { step: f32::MIN, shade: f32::MAX }, |edge, (way, [near, far, beyond])| {
                let at = |steps: isize| level(place + steps * way);
                let step = (at(-near) + at(-far) - at(*near) - at(*far)) / 2.0;
                Edge { step: edge.step.max(step), shade: edge.shade.min(at(*beyond).abs()) }
            })
        };
        let c = components.list[label];
        let step = ((c.bottom - c.top) / ROWS).max(1);
        let mut runs = components.runs_of(label).filter(|run| run.row.is_multiple_of(step)).peekable();
        let mut row = None;
        while let Some(run) = runs.next() {
            let is_first = row.replace(run.row) != Some(run.row);
            let is_last = runs.peek().is_none_or(|next| next.row != run.row);
            (if is_first { &mut *outer } else { &mut *inner }).push(edge(run.row, run.start, -1));
            (if is_last { &mut *outer } else { &mut *inner }).push(edge(run.row, run.end - 1, 1));
        }
    }
}

impl Shadows {
    /// Whether so much of the border looked at is softer than the rest, or has other ground beside it, that it lies in shadow; whether some of it is.
    fn are_unlike(&mut self) -> (bool, bool) {
        let Self { edges, inner, .. } = self;
        let Some(last) = edges.len().checked_sub(1) else { return (false, false) };
        let usual = edges.select_nth_unstable_by(last * 3 / 4, |a, b| a.step.total_cmp(&b.step)).1.step;
        let clear = edges.select_nth_unstable_by(last / 4, |a, b| a.shade.total_cmp(&b.shade)).1.shade;
        let count = |edges: &[Edge], soft: f32, shade: f32| {
            edges.iter().filter(|edge| edge.step < soft * usual || edge.shade > clear + shade).count()
        };
        let unlike = count(edges, SOFTER, SHADIER) + count(inner, SOFTER, SHADIER);
        (count(edges, SOFT, SHADE) as f64 >= LEAST_SHARE * edges.len() as f64, unlike >= LEAST_UNLIKE)
    }

    /// Finds the line between ground and shapes, and what lies on either side; whether it is one.
    fn find(&mut self, crop: &Crop, components: &Components, least_area: usize) -> bool {
        let (width, height) = (crop.width, crop.pixels.len() / crop.width);
        let scale = 1.0 / (crop.shape_level - crop.ground_level);
        self.levels.clear();
        self.levels.extend(crop.pixels.iter().map(|p| (f32::from(*p) - crop.ground_level) * scale));
        self.find_depth(components, least_area, width, height);
        self.find_steepness(width, height);
        self.flood(components, width, height);
        self.find_distance(width, height);
        let line = || self.distance.iter().zip(&self.steepness).filter(|(d, _)| **d == 1).map(|(_, s)| *s);
        let sharp = (median(&line().map(f32::from).collect::<Vec<_>>()) / 2.0) as u8;
        let is_left = |k: &usize| self.depth[*k] > 0 && self.sides[*k] == Side::Ground && self.distance[*k] > FAR;
        let left: Vec<usize> = (0..self.levels.len()).filter(is_left).collect();
        let edged = left.iter().filter(|k| self.steepness[**k] > sharp).count();
        line().next().is_some() && edged as f32 <= EXCEPTIONS * left.len() as f32
    }

    /// Stretches the levels along the line to those without shadow, and makes the ground plain beyond; whether the line runs along an edge.
    fn lift(&self, crop: &mut Crop) -> bool {
        let (width, height) = (crop.width, crop.pixels.len() / crop.width);
        let range = crop.shape_level - crop.ground_level;
        let reach = usize::from(FAR);
        let (mut line, mut flat) = (0, 0);
        let mut pixels = crop.pixels.clone();
        for (k, pixel) in pixels.iter_mut().enumerate() {
            if self.distance[k] > FAR {
                *pixel = if self.sides[k] == Side::Ground { crop.ground_pixel() } else { *pixel };
                continue;
            }
            let (x, y) = (k % width, k / width);
            let mut sums = [(0.0, 0.0); 2];
            for v in y.saturating_sub(reach)..height.min(y + reach + 1) {
                for j in v * width + x.saturating_sub(reach)..v * width + width.min(x + reach + 1) {
                    if (NEAR..=FAR).contains(&self.distance[j]) {
                        let (sum, count) = &mut sums[usize::from(self.sides[j] == Side::Shape)];
                        *sum += self.levels[j];
                        *count += 1.0;
                    }
                }
            }
            // Specks of one side have no such distance.
            let [ground, shape] = sums.map(|(sum, count): (f32, f32)| sum / count.max(1.0));
            let step = shape - ground;
            let is_flat = step.abs() < LEAST_STEP;
            if self.distance[k] == 1 {
                line += 1;
                flat += usize::from(is_flat);
            }
            if !is_flat && ground.abs() > LEAST_SHADE {
                let level = ((self.levels[k] - ground) / step).clamp(-OVERSHOOT, 1.0 + OVERSHOOT);
                *pixel = (crop.ground_level + range * level).round().clamp(0.0, 255.0) as u8;
            }
        }
        let is_edge = flat as f32 <= EXCEPTIONS * line as f32;
        if is_edge {
            crop.pixels = pixels;
        }
        is_edge
    }

    /// Chamfer distances (G. Borgefors, *Distance transformations in digital images*, 1986) with steps of 3 and 4.
    fn find_depth(&mut self, components: &Components, least_area: usize, width: usize, height: usize) {
        /// Beyond any distance, with room for a step.
        const DEEP: u16 = u16::MAX - 4;
        let depth = &mut self.depth;
        depth.clear();
        depth.resize(width * height, 0);
        for run in components.runs.iter().filter(|run| components.list[run.label].area >= least_area) {
            depth[run.row * width + run.start..run.row * width + run.end].fill(DEEP);
        }
        let inner = || (1..height - 1).flat_map(|y| (1..width - 1).map(move |x| y * width + x));
        let mut relax = |k: usize, [straight, other, left, right]: [usize; 4]| {
            let least = (depth[straight].min(depth[other]) + 3).min(depth[left].min(depth[right]) + 4);
            depth[k] = depth[k].min(least);
        };
        inner().for_each(|k| relax(k, [k - 1, k - width, k - width - 1, k - width + 1]));
        inner().rev().for_each(|k| relax(k, [k + 1, k + width, k + width + 1, k + width - 1]));
    }

    /// Finds by how much the levels are steeper at each pixel than about it.
    fn find_steepness(&mut self, width: usize, height: usize) {
        let [fine, coarse] = [FINE, COARSE].map(|radius| box_mean(&self.levels, [width, height], radius));
        let slope = |levels: &[f32], k: usize| {
            ((levels[k + 1] - levels[k - 1]).powi(2) + (levels[k + width] - levels[k - width]).powi(2)).sqrt() / 2.0
        };
        self.steepness.clear();
        self.steepness.resize(width * height, 0);
        for k in (1..height - 1).flat_map(|y| (1..width - 1).map(move |x| y * width + x)) {
            // No slope of a step of one is more than a third after the mean of three; a number turned into a byte stays within.
            self.steepness[k] = (3.0 * STEPS as f32 * (slope(&fine, k) - slope(&coarse, k))) as u8;
        }
    }

    /// Floods the crop from its rim and from the depths of each component that is half as deep as the deepest: shadows apart from their shapes are
    /// not.
    fn flood(&mut self, components: &Components, width: usize, height: usize) {
        self.sides.clear();
        self.sides.resize(width * height, Side::Neither);
        self.queues.resize_with(STEPS, VecDeque::new);
        let Self { depth, steepness, sides, queues, .. } = self;
        let mut begin = |k: usize, side: Side| {
            sides[k] = side;
            queues[0].push_back(k);
        };
        let mut deepest = vec![0; components.list.len()];
        let pixels = |row: usize, start: usize, end: usize| row * width + start..row * width + end;
        for run in &components.runs {
            let most = depth[pixels(run.row, run.start, run.end)].iter().max().copied().unwrap_or(0);
            deepest[run.label] = most.max(deepest[run.label]);
        }
        let least = deepest.iter().max().copied().unwrap_or(0) / 2;
        for run in components.runs.iter().filter(|run| deepest[run.label] > least) {
            let core = (CORE_DEPTH * f32::from(deepest[run.label])) as u16;
            pixels(run.row, run.start, run.end).filter(|k| depth[*k] > core).for_each(|k| begin(k, Side::Shape));
        }
        for x in 0..width {
            [x, (height - 1) * width + x].into_iter().for_each(|k| begin(k, Side::Ground));
        }
        for y in 1..height - 1 {
            [y * width, y * width + width - 1].into_iter().for_each(|k| begin(k, Side::Ground));
        }
        let mut height_of_water = 0;
        while height_of_water < STEPS {
            let Some(k) = queues[height_of_water].pop_front() else {
                height_of_water += 1;
                continue;
            };
            for j in neighbours(k, width, height) {
                if sides[j] == Side::Neither {
                    sides[j] = sides[k];
                    queues[usize::from(steepness[j]).max(height_of_water)].push_back(j);
                }
            }
        }
    }

    /// Finds the distances from the line where the floods met.
    fn find_distance(&mut self, width: usize, height: usize) {
        let Self { sides, distance, queues, .. } = self;
        let queue = &mut queues[0];
        distance.clear();
        distance.resize(width * height, u8::MAX);
        for k in 0..width * height {
            if neighbours(k, width, height).any(|j| sides[j] != sides[k]) {
                distance[k] = 1;
                queue.push_back(k);
            }
        }
        while let Some(k) = queue.pop_front() {
            for j in neighbours(k, width, height) {
                if distance[k] < FAR && distance[j] == u8::MAX {
                    distance[j] = distance[k] + 1;
                    queue.push_back(j);
                }
            }
        }
    }
}

/// The four neighbours of a pixel, as many as there are.
pub(super) fn neighbours(k: usize, width: usize, height: usize) -> impl Iterator<Item = usize> {
    let x = k % width;
    let list = [
        (x > 0, k.wrapping_sub(1)),
        (x + 1 < width, k + 1),
        (k >= width, k.wrapping_sub(width)),
        (k + width < width * height, k + width),
    ];
    list.into_iter().filter(|(is_there, _)| *is_there).map(|(_, k)| k)
}

/// Means over squares of `2 radius + 1` pixels; beyond the rim it is as along the rim.
pub(super) fn box_mean(levels: &[f32], [width, height]: [usize; 2], radius: usize) -> Vec<f32> {
    let pass = |from: &[f32], [count, stride]: [usize; 2], [lines, line_stride]: [usize; 2]| {
        let mut to = vec![0.0; from.len()];
        for begin in (0..lines).map(|line| line * line_stride) {
            // Place `i` of a line that is longer by the radius at its beginning.
            let at = |i: usize| from[begin + i.saturating_sub(radius).min(count - 1) * stride];
            let mut sum: f32 = (0..2 * radius).map(at).sum();
            for i in 0..count {
                sum += at(i + 2 * radius);
                to[begin + i * stride] = sum / (2 * radius + 1) as f32;
                sum -= at(i);
            }
        }
        to
    };
    let across = pass(levels, [width, 1], [height, width]);
    pass(&across, [height, width], [width, 1])
}
