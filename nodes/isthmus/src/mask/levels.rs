//! Levels of a component and of the ground round it.

use super::frame::Frame;
use super::ground::{Ground, Surface, median, quantile};
use super::standing::{MAX_DEPTH, Standing};

/// Most spread of the shape's level (between its quartiles, noise aside), as a part of the contrast, at which the pixels are cut out
/// as they are: the contour half-way moves by a thirtieth of the edge's blur at most.
const UNIFORM: f32 = 0.06;
/// Most difference of the ground's level round a shape, as a part of the contrast, at which the pixels are cut out as they are: half of it
/// either way moves the contour half-way by a fiftieth of the edge's blur, and all of a side alike.
const UNIFORM_GROUND: f32 = 0.03;
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
/// Least contrast that a smooth course may fall to at the corners of a shape's box, as a part of the median: light on a shape varies less,
/// glare and shadows, which are no shapes, more.
const LEAST_LIGHT: f32 = 0.5;
/// Blocks of a shape looked at to measure its levels, roughly: beyond, medians get no better.
const LEVEL_SAMPLES: usize = 1_000;
/// The same where they are noisy and their course is sought.
const NOISY_SAMPLES: usize = 8_000;

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
        let mut levels = Self {
            left: c.left,
            top: c.top,
            width: c.right - c.left,
            height: c.bottom - c.top,
            ground: corners.iter().sum::<f32>() / corners.len() as f32,
            ..Self::default()
        };
        let contrast_of = |(column, row): (usize, usize)| ground.contrast(blocks, column, row);
        // Blocks from which all directions lead through the component for a while, or out of the frame.
        let reach = ((LEVEL_DEPTH * (c.area as f64).sqrt()) as usize).clamp(1, MAX_LEVEL_DEPTH / blocks.size);
        let inner_blocks = |samples: usize| {
            let step = (((c.area / samples) as f64).sqrt() as usize).max(1);
            let mut inner: Vec<(usize, usize)> = Vec::with_capacity(c.area / (step * step) + 1);
            for run in components.runs_of(k).filter(|run| (run.row - c.top) % step == 0) {
                let from = if run.start == 0 { 0 } else { run.start + reach };
                let to = if run.end == columns { columns } else { run.end.saturating_sub(reach) };
                let rows = [run.row.saturating_sub(reach), (run.row + reach).min(blocks.rows - 1)];
                inner.extend((from..to).step_by(step).map(|column| (column, run.row)).filter(|(column, _)| {
                    let across = [column.saturating_sub(reach), *column, (column + reach).min(columns - 1)];
                    rows.iter().all(|row| across.iter().all(|column| standing.is_of(k, *column, *row)))
                }));
            }
            inner
        };
        let mut inner = inner_blocks(LEVEL_SAMPLES);
        let mut list: Vec<f32> = inner.iter().map(|block| contrast_of(*block)).collect();
        let is_brighter =
            |(column, row): &(usize, usize)| blocks.planes[0][row * columns + column] > surface(*column, *row);
        levels.take_sense(inner.iter().filter(|block| grey && is_brighter(block)).count(), inner.len(), grey);
        levels.contrast = quantile(&mut list, 0.5);
        let is_ground_even = |contrast| high - low <= UNIFORM_GROUND * contrast && (levels.one_sided || !grey);
        if !list.is_empty() {
            if is_ground_even(levels.contrast) && is_uniform(&mut list, levels.contrast, ground.scatter) {
                return levels;
            }
            if ground.scatter > MAP_NOISE * levels.contrast {
                inner = inner_blocks(NOISY_SAMPLES);
            }
            if let Some(light) = levels.smooth(&inner, &mut list, ground.scatter, contrast_of) {
                levels.course = Course::Smooth(light);
                return levels;
            }
        }
        // The edge's blur reaches some blocks deep: the shape's own level is found beyond it.
        let depths = standing.depths(k);
        let settled = settled_depth(&depths, |i| {
            ground.residual[(c.top + i / levels.width) * columns + c.left + i % levels.width]
        });
        let blocks_in = || (c.top..c.bottom).flat_map(|row| (c.left..c.right).map(move |column| (column, row)));
        let is_deep = |depth: u8| depth >= settled;
        inner.clear();
        inner.extend(blocks_in().zip(&depths).filter(|(_, depth)| is_deep(**depth)).map(|(block, _)| block));
        list.clear();
        list.extend(inner.iter().map(|block| contrast_of(*block)));
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
        levels.course = if let Some(light) = levels.smooth(&inner, &mut list, ground.scatter, contrast_of) {
            Course::Smooth(light)
        } else {
            let map = blocks_in().zip(&depths).map(|(b, depth)| if is_deep(*depth) { contrast_of(b) } else { 0.0 });
            let noise = ground.scatter / levels.contrast.max(f32::MIN_POSITIVE);
            let reach = usize::from(settled) + BORDER_BLOCKS;
            Course::Map(levels.spread_out(map.collect(), 2.0 * ground.threshold, reach, noise))
        };
        levels
    }

    /// The contrast of blocks as a smooth surface over the component, if it is one; `list` is memory to be used.
    fn smooth(
        &self,
        inner: &[(usize, usize)],
        list: &mut Vec<f32>,
        scatter: f32,
        contrast_of: impl Fn((usize, usize)) -> f32,
    ) -> Option<Surface> {
        let local = |(column, row): (usize, usize)| [(column - self.left) as f64, (row - self.top) as f64];
        let chosen = || inner.iter().step_by((inner.len() / NOISY_SAMPLES).max(1));
        let light = Surface::fit([self.width, self.height], chosen().map(|b| (local(*b), contrast_of(*b))));
        list.clear();
        list.extend(chosen().map(|block| {
            let [column, row] = local(*block);
            contrast_of(*block) - light.at(column, row)
        }));
        let [right, bottom] = [self.width, self.height].map(|side| (side - 1) as f64);
        let corners = [(0.0, 0.0), (right, 0.0), (0.0, bottom), (right, bottom)];
        let is_light = corners.iter().all(|(x, y)| light.at(*x, *y) >= LEAST_LIGHT * self.contrast);
        (is_light && is_uniform(list, self.contrast, scatter)).then_some(light)
    }

    /// Whether one pair of levels will do.
    pub(super) fn is_uniform(&self) -> bool {
        matches!(self.course, Course::Uniform)
    }

    /// Whether the shape is brighter or darker than the ground, from the number of blocks that are brighter.
    fn take_sense(&mut self, brighter: usize, all: usize, grey: bool) {
        self.sense = if 2 * brighter >= all { 1.0 } else { -1.0 };
        // A twentieth of the blocks may be specks or print.
        self.one_sided = grey && all > 0 && brighter.min(all - brighter) * 20 <= all;
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
    pub(super) fn fill_row(
        &self,
        rows: &mut RowSource<'_>,
        (y, from): (usize, usize),
        out: &mut [u8],
        levels: [f32; 2],
    ) {
        /// Floating point numbers of this size have no fraction.
        const WHOLE: f32 = 8_388_608.0;
        let (frame, ground, block) = (rows.frame, rows.ground, rows.block);
        let in_blocks = |pixel: usize| (pixel as f64 - (block - 1) as f64 / 2.0) / block as f64;
        let channels = frame.format.channels();
        let source = &frame.row(y)[from * channels..];
        let [difference, line] = &mut rows.lines;
        for line in [&mut *difference, &mut *line] {
            line.clear();
            line.resize(out.len(), 0.0);
        }
        for (c, surface) in ground.surfaces.iter().enumerate() {
            surface.fill_line(in_blocks(y), in_blocks(from), 1.0 / block as f64, line);
            let places = difference.iter_mut().zip(&*line);
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
        self.fill_reciprocals(block, (y, from), line);
        for ((out, d), reciprocal) in out.iter_mut().zip(&*difference).zip(&*line) {
            let level = ground_level + (shape_level - ground_level) * d * reciprocal;
            // Added to 2^23, a number from 0 to 255 is rounded, and its whole part is the lowest byte.
            *out = (level.clamp(0.0, 255.0) + WHOLE).to_bits() as u8;
        }
    }
}

/// Where the pixels of a row come from.
pub(super) struct RowSource<'a> {
    pub(super) frame: &'a Frame<'a>,
    pub(super) ground: &'a Ground,
    pub(super) block: usize,
    /// Memory for figures of the row's pixels.
    pub(super) lines: [Vec<f32>; 2],
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
