//! Levels of a component and of the ground round it.

use super::frame::Frame;
use super::ground::{Ground, median, quantile};
use super::standing::{MAX_DEPTH, Standing};

/// Most spread of the shape's level (between its quartiles, noise aside), as a part of the contrast, at which the pixels are cut out
/// as they are: the contour half-way moves by a thirtieth of the edge's blur at most.
const UNIFORM: f32 = 0.06;
/// Most difference of the ground's level round a shape, as a part of the contrast, at which the pixels are cut out as they are.
const UNIFORM_GROUND: f32 = 0.06;
/// Depth of the blocks all of whose neighbours belong to the shape.
const INNER_DEPTH: u8 = 2;
/// The blur of the edge is left behind where the median level of blocks is this part of that of the blocks next deeper.
const SETTLED: f32 = 0.985;
/// Most noise of the map of local contrasts, as a part of the contrast: it moves the contour by a hundredth of the edge's blur.
const MAP_NOISE: f32 = 0.004;
/// How many blocks beyond its border a shape's levels matter: the blur of its edge, and the interpolation.
const BORDER_BLOCKS: usize = 3;
/// Blocks of a shape looked at to measure its levels, roughly: beyond, medians get no better.
const LEVEL_SAMPLES: usize = 1_000;

/// Contrast of a coarse component against the ground.
#[derive(Debug, Default)]
pub(super) struct Levels {
    left: usize,
    top: usize,
    width: usize,
    height: usize,
    /// Median contrast.
    pub(super) contrast: f32,
    /// Contrast of each block of the component's bounding box, unless one pair of levels will do.
    map: Vec<f32>,
    /// Whether one pair of levels will do.
    pub(super) uniform: bool,
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
        // A block all of whose neighbours belong to the component, those beyond the frame included.
        let inside = |column: usize, row: usize| -> bool {
            standing.is_of(k, column, row)
                && (row.saturating_sub(1)..blocks.rows.min(row + 2))
                    .all(|r| (column.saturating_sub(1)..columns.min(column + 2)).all(|c| standing.is_of(k, c, r)))
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
        levels.take_contrast(&mut list, ground.scatter);
        levels.uniform &= high - low <= UNIFORM_GROUND * levels.contrast && (levels.one_sided || !grey);
        if !list.is_empty() && levels.uniform {
            return levels;
        }
        // The edge's blur reaches some blocks deep: the shape's own level is found beyond it.
        let depths = standing.depths(k);
        let settled = settled_depth(&depths, |i| {
            ground.residual[(c.top + i / levels.width) * columns + c.left + i % levels.width]
        });
        list.clear();
        let residual = blocks_in(1).map(|(column, row)| ground.residual[row * columns + column]);
        levels.map.extend(residual.zip(&depths).map(|(r, depth)| if *depth >= settled { r } else { 0.0 }));
        list.extend(levels.map.iter().filter(|r| **r > 0.0));
        let is_thin = settled < INNER_DEPTH;
        if is_thin {
            // Thinner than three blocks: the strongest blocks are the best there is.
            let top = quantile(&mut list, 0.9);
            list = vec![top];
        }
        levels.take_contrast(&mut list, ground.scatter);
        levels.uniform &= high - low <= UNIFORM_GROUND * levels.contrast && (levels.one_sided || !grey);
        if levels.uniform || is_thin {
            levels.map.fill(levels.contrast);
        } else {
            let noise = ground.scatter / levels.contrast.max(f32::MIN_POSITIVE);
            levels.spread_out(2.0 * ground.threshold, usize::from(settled) + BORDER_BLOCKS, noise);
        }
        levels
    }

    /// Takes the median of blocks' residuals for the contrast, and their spread, less what noise accounts for, for the
    /// uniformity.
    fn take_contrast(&mut self, list: &mut [f32], scatter: f32) {
        /// Distance between the quartiles of a normal distribution, in standard deviations.
        const QUARTILES: f32 = 1.349;
        self.contrast = quantile(list, 0.5);
        let spread = quantile(list, 0.75) - quantile(list, 0.25);
        let excess = (spread.powi(2) - (QUARTILES * scatter).powi(2)).max(0.0).sqrt();
        self.uniform = excess <= UNIFORM * self.contrast;
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
    fn spread_out(&mut self, least: f32, reach: usize, noise: f32) {
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
            let map = std::mem::take(&mut self.map);
            let smoothed = |k: usize| if map[k] > 0.0 { mean(&map, k).unwrap_or(map[k]) } else { 0.0 };
            self.map = (0..map.len()).map(smoothed).collect();
            left /= 3.0;
        }
        let mut open: Vec<usize> = (0..self.map.len()).filter(|&k| self.map[k] == 0.0).collect();
        for _ in 0..reach {
            let filled: Vec<(usize, f32)> =
                open.iter().filter_map(|&k| mean(&self.map, k).map(|level| (k, level))).collect();
            for (k, level) in filled {
                self.map[k] = level;
            }
            open.retain(|&k| self.map[k] == 0.0);
        }
        for level in &mut self.map {
            *level = if *level == 0.0 { self.contrast } else { level.max(least) };
        }
    }

    /// Fills `line` with the reciprocal contrast of the pixels of row `y` from column `from` on, between the blocks' centres.
    fn fill_reciprocals(&self, block: usize, (y, from): (usize, usize), line: &mut [f32]) {
        if self.uniform {
            line.fill(1.0 / self.contrast.max(f32::MIN_POSITIVE));
            return;
        }
        // Block k has its centre at pixel k * block + (block - 1) / 2.
        let in_blocks = |pixel: usize| (pixel as f32 - (block - 1) as f32 / 2.0) / block as f32;
        let row = (in_blocks(y) - self.top as f32).clamp(0.0, (self.height - 1) as f32);
        let (j, t) = (row as usize, row.fract());
        let upper = &self.map[j * self.width..][..self.width];
        let lower = &self.map[(j + 1).min(self.height - 1) * self.width..][..self.width];
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
            for ((d, g), p) in difference.iter_mut().zip(&line).zip(source.iter().skip(c).step_by(channels)) {
                let signed = f32::from(*p) - g;
                *d = if self.one_sided { self.sense * signed } else { d.max(signed.abs()) };
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
