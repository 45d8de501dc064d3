//! Levels of a component and of the ground round it.

use super::frame::Frame;
use super::ground::{Ground, Surface, median, quantile};
use super::standing::{MAX_DEPTH, Standing};

/// Most spread of the shape's level (between its quartiles, noise aside), as a part of the contrast, at which the pixels are cut out
/// as they are: the contour half-way moves by a thirtieth of the edge's blur at most.
const UNIFORM: f32 = 0.06;
/// Most difference of the ground's level round a shape, as a part of the contrast, at which the pixels are cut out as they are.
const UNIFORM_GROUND: f32 = 0.06;
/// Depth of the blocks all of whose neighbours belong to the shape.
const INNER_DEPTH: u8 = 2;
/// How deep within a shape its level is measured, as a part of the square root of its area: few blocks of it lie deeper in its tabs, and
/// most in its body.
const LEVEL_DEPTH: f64 = 1.0 / 12.0;
/// ... and at most, in pixels: the blur of an edge worth measuring is left behind there.
const MAX_LEVEL_DEPTH: usize = 20;
/// The blur of the edge is left behind where the median level of blocks is this part of that of the blocks next deeper.
const SETTLED: f32 = 0.985;
/// Most noise of the map of local contrasts, as a part of the contrast: it moves the contour by a hundredth of the edge's blur.
const MAP_NOISE: f32 = 0.004;
/// How many blocks beyond its border a shape's levels matter: the blur of its edge, and the interpolation.
const BORDER_BLOCKS: usize = 3;
/// Least contrast that a smooth course may fall to in the surroundings of a shape, as a part of the median: far from the blocks it was
/// learned from, it must not change its sign.
const LEAST_LIGHT: f32 = 0.1;
/// Blocks of a shape looked at to measure its levels, roughly: beyond, medians get no better.
const LEVEL_SAMPLES: usize = 1_000;

/// How a contrast runs over a component's bounding box, in blocks.
#[derive(Debug, Default)]
enum Course {
    /// One pair of levels will do.
    #[default]
    Uniform,
    /// As light falls off: smoothly.
    Smooth(Surface),
    /// As print has it: one for each block.
    Map(Vec<f32>),
}

/// Contrast of a component against the ground.
#[derive(Debug, Default)]
pub(super) struct Levels {
    left: usize,
    top: usize,
    width: usize,
    height: usize,
    /// Median contrast.
    pub(super) contrast: f32,
    /// How it runs over the component.
    course: Course,
    /// 1 for a shape brighter than the ground, -1 for a darker one (grey frames only).
    pub(super) sense: f32,
    /// Whether the sense is the same everywhere.
    one_sided: bool,
    /// Ground level (grey frames only).
    pub(super) ground: f32,
}

impl Levels {
    /// Levels of a component and of the ground round it.
    pub(super) fn of(standing: &Standing<'_>, k: usize) -> Self {
        let Standing { blocks, ground, components, .. } = *standing;
        let c = components.list[k];
        let columns = blocks.columns;
        let surface = |column: usize, row: usize| -> f32 {
            ground.surfaces.first().map_or(0.0, |s| s.at(column as f64, row as f64))
        };
        let middle_block = ((c.left + c.right) / 2, (c.top + c.bottom) / 2);
        let corners = [(c.left, c.top), (c.right, c.top), (c.left, c.bottom), (c.right, c.bottom), middle_block]
            .map(|(column, row)| surface(column, row));
        let (low, high) = corners.iter().fold((f32::MAX, f32::MIN), |(l, h), v| (l.min(*v), h.max(*v)));
        let grey = blocks.planes.len() == 1;
        let step = (((c.area / LEVEL_SAMPLES) as f64).sqrt() as usize).max(1);
        let mut levels = Self {
            left: c.left,
            top: c.top,
            width: c.right - c.left,
            height: c.bottom - c.top,
            ground: corners.iter().sum::<f32>() / corners.len() as f32,
            ..Self::default()
        };
        let reach = ((LEVEL_DEPTH * (c.area as f64).sqrt()) as usize).clamp(1, MAX_LEVEL_DEPTH / blocks.size);
        // A block from which all directions lead through the component for a while, or out of the frame.
        let inside = |column: usize, row: usize| -> bool {
            [row.saturating_sub(reach), row, (row + reach).min(blocks.rows - 1)].into_iter().all(|row| {
                [column.saturating_sub(reach), column, (column + reach).min(columns - 1)]
                    .into_iter()
                    .all(|column| standing.is_of(k, column, row))
            })
        };
        let mut list = Vec::new();
        let mut signed = Vec::new();
        let blocks_in = |step: usize| {
            (c.top..c.bottom).step_by(step).flat_map(move |r| (c.left..c.right).step_by(step).map(move |c| (c, r)))
        };
        for (column, row) in blocks_in(step).filter(|(column, row)| inside(*column, *row)) {
            let block = row * columns + column;
            list.push(ground.residual[block]);
            if grey {
                signed.push(blocks.planes[0][block] - surface(column, row));
            }
        }
        levels.take_sense(&signed, grey);
        levels.contrast = quantile(&mut list, 0.5);
        let is_ground_even = |contrast| high - low <= UNIFORM_GROUND * contrast && (levels.one_sided || !grey);
        if !list.is_empty() && is_ground_even(levels.contrast) && is_uniform(&mut list, levels.contrast, ground.scatter)
        {
            return levels;
        }
        // The edge's blur reaches some blocks deep: the shape's own level is found beyond it.
        let depths = standing.depths(k);
        let settled = settled_depth(&depths, |i| {
            ground.residual[(c.top + i / levels.width) * columns + c.left + i % levels.width]
        });
        let residual = |(column, row): (usize, usize)| ground.residual[row * columns + column];
        let deep = || blocks_in(1).zip(&depths).filter(|(_, depth)| **depth >= settled).map(|(block, _)| block);
        list.clear();
        list.extend(deep().map(residual));
        if settled < INNER_DEPTH {
            // Thinner than three blocks: the strongest blocks are the best there is.
            levels.contrast = quantile(&mut list, 0.9);
            let is_uniform = is_ground_even(levels.contrast);
            levels.course = if is_uniform { Course::Uniform } else { Course::Map(vec![levels.contrast; depths.len()]) };
            return levels;
        }
        levels.contrast = quantile(&mut list, 0.5);
        if is_ground_even(levels.contrast) && is_uniform(&mut list, levels.contrast, ground.scatter) {
            return levels;
        }
        let local = |(column, row): (usize, usize)| [(column - c.left) as f64, (row - c.top) as f64];
        let stride = (list.len() / LEVEL_SAMPLES).max(1);
        let light =
            Surface::fit([levels.width, levels.height], deep().step_by(stride).map(|b| (local(b), residual(b))));
        let off = |block| {
            let [column, row] = local(block);
            residual(block) - light.at(column, row)
        };
        list.clear();
        list.extend(deep().step_by(stride).map(off));
        levels.course = if is_uniform(&mut list, levels.contrast, ground.scatter) {
            Course::Smooth(light)
        } else {
            let map = blocks_in(1).zip(&depths).map(|(b, depth)| if *depth >= settled { residual(b) } else { 0.0 });
            let noise = ground.scatter / levels.contrast.max(f32::MIN_POSITIVE);
            let reach = usize::from(settled) + BORDER_BLOCKS;
            Course::Map(levels.spread_out(map.collect(), 2.0 * ground.threshold, reach, noise))
        };
        levels
    }

    /// Whether one pair of levels will do.
    pub(super) fn is_uniform(&self) -> bool {
        matches!(self.course, Course::Uniform)
    }

    /// Whether the shape is brighter or darker than the ground, from blocks' signed residuals.
    fn take_sense(&mut self, signed: &[f32], grey: bool) {
        let brighter = signed.iter().filter(|s| **s > 0.0).count();
        self.sense = if 2 * brighter >= signed.len() { 1.0 } else { -1.0 };
        // A twentieth of the blocks may be specks or print.
        self.one_sided = grey && !signed.is_empty() && brighter.min(signed.len() - brighter) * 20 <= signed.len();
    }

    /// Spreads the levels of the inner blocks out over the box, each block taking the mean of its neighbours that have a level;
    /// none stays below `least`. `noise` is the standard deviation of a block's level as a part of the contrast.
    fn spread_out(&self, mut map: Vec<f32>, least: f32, reach: usize, noise: f32) -> Vec<f32> {
        let (width, height) = (self.width, self.height);
        let neighbours = move |k: usize| {
            let (x, y) = (k % width, k / width);
            (y.saturating_sub(1)..height.min(y + 2))
                .flat_map(move |v| (x.saturating_sub(1)..width.min(x + 2)).map(move |u| v * width + u))
        };
        let mean = move |map: &[f32], k: usize| {
            let known = neighbours(k).map(|k| map[k]).filter(|level| *level > 0.0);
            let (sum, count) = known.fold((0.0, 0.0), |(sum, count), level| (sum + level, count + 1.0));
            (count > 0.0).then(|| sum / count)
        };
        // Each round takes the mean of nine, and leaves a third of the deviation at most.
        let mut left = noise;
        while left > MAP_NOISE {
            let smoothed = |k: usize| if map[k] > 0.0 { mean(&map, k).unwrap_or(map[k]) } else { 0.0 };
            map = (0..map.len()).map(smoothed).collect();
            left /= 3.0;
        }
        let mut open: Vec<usize> = (0..map.len()).filter(|&k| map[k] == 0.0).collect();
        for _ in 0..reach {
            let filled: Vec<(usize, f32)> =
                open.iter().filter_map(|&k| mean(&map, k).map(|level| (k, level))).collect();
            for (k, level) in filled {
                map[k] = level;
            }
            open.retain(|&k| map[k] == 0.0);
        }
        for level in &mut map {
            *level = if *level == 0.0 { self.contrast } else { level.max(least) };
        }
        map
    }

    /// Fills `line` with the reciprocal contrast of the pixels of row `y` from column `from` on, between the blocks' centres.
    fn fill_reciprocals(&self, block: usize, (y, from): (usize, usize), line: &mut [f32]) {
        // Block k has its centre at pixel k * block + (block - 1) / 2.
        let in_blocks = |pixel: usize| (pixel as f32 - (block - 1) as f32 / 2.0) / block as f32;
        let map = match &self.course {
            Course::Uniform => {
                line.fill(1.0 / self.contrast.max(f32::MIN_POSITIVE));
                return;
            }
            Course::Smooth(light) => {
                let (column, row) = (in_blocks(from) - self.left as f32, in_blocks(y) - self.top as f32);
                light.fill_line(f64::from(row), f64::from(column), 1.0 / block as f64, line);
                let least = LEAST_LIGHT * self.contrast;
                line.iter_mut().for_each(|contrast| *contrast = 1.0 / contrast.max(least));
                return;
            }
            Course::Map(map) => map,
        };
        let row = (in_blocks(y) - self.top as f32).clamp(0.0, (self.height - 1) as f32);
        let (j, t) = (row as usize, row.fract());
        let upper = &map[j * self.width..][..self.width];
        let lower = &map[(j + 1).min(self.height - 1) * self.width..][..self.width];
        let reciprocal = |i: usize| 1.0 / (upper[i] + (lower[i] - upper[i]) * t);
        // The column of a pixel is a whole number of blocks and one of few fractions.
        let mut i = usize::MAX;
        let (mut left, mut right) = (0.0, 0.0);
        for (x, value) in line.iter_mut().enumerate() {
            let column = (in_blocks(from + x) - self.left as f32).clamp(0.0, (self.width - 1) as f32);
            let at = column as usize;
            if at != i {
                (left, right) = (reciprocal(at), reciprocal((at + 1).min(self.width - 1)));
                i = at;
            }
            *value = left + (right - left) * (column - at as f32);
        }
    }

    /// Fills a row of pixels with their difference from the ground, divided by the local contrast unless that is uniform.
    pub(super) fn fill_row(&self, rows: &RowSource<'_>, (y, from): (usize, usize), out: &mut [u8], levels: [f32; 2]) {
        let RowSource { frame, ground, block } = *rows;
        let in_blocks = |pixel: usize| (pixel as f64 - (block - 1) as f64 / 2.0) / block as f64;
        let channels = frame.format.channels();
        let source = &frame.row(y)[from * channels..];
        let mut difference = vec![0.0f32; out.len()];
        let mut line = vec![0.0f32; out.len()];
        for (c, surface) in ground.surfaces.iter().enumerate() {
            surface.fill_line(in_blocks(y), in_blocks(from), 1.0 / block as f64, &mut line);
            let places = difference.iter_mut().zip(&line);
            if self.one_sided {
                // One channel: neighbouring pixels go through the processor together.
                for ((d, g), p) in places.zip(source) {
                    *d = self.sense * (f32::from(*p) - g);
                }
            } else {
                for ((d, g), p) in places.zip(source.iter().skip(c).step_by(channels)) {
                    *d = d.max((f32::from(*p) - g).abs());
                }
            }
        }
        let [shape_level, ground_level] = levels;
        self.fill_reciprocals(block, (y, from), &mut line);
        for ((out, d), reciprocal) in out.iter_mut().zip(&difference).zip(&line) {
            // Half a level up and cut off is rounded; beyond 0 and 255 the conversion saturates.
            *out = (ground_level + 0.5 + (shape_level - ground_level) * d * reciprocal) as u8;
        }
    }
}

/// Where the pixels of a row come from.
#[derive(Clone, Copy)]
pub(super) struct RowSource<'a> {
    pub(super) frame: &'a Frame<'a>,
    pub(super) ground: &'a Ground,
    pub(super) block: usize,
}

/// Whether levels (of which the order gets lost) vary little, beside a contrast and what noise accounts for.
fn is_uniform(levels: &mut [f32], contrast: f32, scatter: f32) -> bool {
    /// Distance between the quartiles of a normal distribution, in standard deviations.
    const QUARTILES: f32 = 1.349;
    let spread = quantile(levels, 0.75) - quantile(levels, 0.25);
    let excess = (spread.powi(2) - (QUARTILES * scatter).powi(2)).max(0.0).sqrt();
    excess <= UNIFORM * contrast
}

/// The depth from which on blocks of a shape have its own level, the blur of its edge being left behind: the first whose median
/// residual is nearly that of the next.
fn settled_depth(depths: &[u8], residual: impl Fn(usize) -> f32) -> u8 {
    let mut by_depth: [Vec<f32>; MAX_DEPTH as usize + 1] = Default::default();
    for (i, depth) in depths.iter().enumerate().filter(|(_, depth)| **depth > 0) {
        by_depth[usize::from(*depth)].push(residual(i));
    }
    let counts = by_depth.each_ref().map(Vec::len);
    let most = counts.iter().max().copied().unwrap_or(0);
    let medians = by_depth.map(median);
    // Few blocks are no measure, and too few to learn local levels from.
    let enough = |depth: u8| counts[usize::from(depth)] * 4 >= most;
    let deepest = (1..=MAX_DEPTH).rev().find(|d| enough(*d)).unwrap_or(1);
    let settled = |d: &u8| medians[usize::from(*d)] >= SETTLED * medians[usize::from(*d) + 1];
    (INNER_DEPTH.min(deepest)..deepest).find(settled).unwrap_or(deepest)
}
