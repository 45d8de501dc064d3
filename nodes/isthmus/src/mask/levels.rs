//! Levels of a component and of the ground round it.

use super::frame::Frame;
use super::ground::{Ground, Hue};
use super::runs::Component;
use super::standing::{MAX_DEPTH, Standing};
use super::statistics::{median, quantile, quantiles};
use super::surface::{AlongRow, Surface};
use crate::wide::widely;

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
/// Most blocks that are looked at.
const MOST_SAMPLES: usize = 8_000;
/// Side of the tiles of blocks of which means are taken where blocks are noisy, and their course is sought: tiles of four blocks, of so many samples,
/// tell it to a thousandth of the contrast at any noise.
const TILE: usize = 2;

/// One in so many blocks of a shape may be specks or print of the other sense.
const SPECKS: usize = 20;

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
    /// The direction of the contrast in colour, where it is the same everywhere (colour frames only).
    pub(super) hue: Option<Hue>,
    /// Ground level (grey frames only).
    pub(super) ground: f32,
    /// By how much it differs over the component.
    ground_span: f32,
}

/// A block: column and row.
type Block = (usize, usize);

/// Its middle.
fn middle((column, row): Block) -> [f64; 2] {
    [column as f64, row as f64]
}

/// A component, block by block.
struct Region<'a> {
    standing: &'a Standing<'a>,
    k: usize,
    bounds: Component,
}

impl Region<'_> {
    fn is_grey(&self) -> bool {
        self.standing.blocks.planes.len() == 1
    }

    /// Level of the ground at a block, in the first channel.
    fn ground(&self, (column, row): Block) -> f32 {
        self.standing.ground.surfaces.first().map_or(0.0, |s| s.at(column as f64, row as f64))
    }

    fn contrast(&self, (column, row): Block, hue: Option<Hue>) -> f32 {
        self.standing.ground.contrast(self.standing.blocks, column, row, hue)
    }

    fn contrasts(&self, blocks: &[Block], hue: Option<Hue>) -> Vec<f32> {
        blocks.iter().map(|block| self.contrast(*block, hue)).collect()
    }

    fn is_brighter(&self, (column, row): Block) -> bool {
        let blocks = self.standing.blocks;
        blocks.planes[0][row * blocks.columns + column] > self.ground((column, row))
    }

    /// The blocks of the bounding box, row by row.
    fn blocks(&self) -> impl Iterator<Item = Block> + use<> {
        let c = self.bounds;
        (c.top..c.bottom).flat_map(move |row| (c.left..c.right).map(move |column| (column, row)))
    }

    /// Blocks from which all directions lead through the component for a while, or out of the frame: every so many in rows and columns.
    fn inner(&self, step: usize) -> Vec<Block> {
        let Standing { blocks, components, .. } = *self.standing;
        let c = self.bounds;
        let reach = ((LEVEL_DEPTH * (c.area as f64).sqrt()) as usize).clamp(1, MAX_LEVEL_DEPTH / blocks.size);
        // The box, wider by the reach on either side; beyond the frame it is as along the frame's edge.
        let width = c.right - c.left + 2 * reach;
        let within = c.left.saturating_sub(reach)..blocks.columns.min(c.right + reach);
        let [before, after] = [within.start + reach - c.left, c.right + reach - within.end];
        let mut own = Vec::with_capacity(width * (c.bottom - c.top));
        for row in c.top..c.bottom {
            own.extend(std::iter::repeat_n(self.standing.is_of(self.k, within.start, row), before));
            own.extend(self.standing.are_of(self.k, within.clone(), row));
            own.extend(std::iter::repeat_n(self.standing.is_of(self.k, within.end - 1, row), after));
        }
        let own_in = |row: usize| own.chunks_exact(width).nth(row.wrapping_sub(c.top));
        let mut inner = Vec::with_capacity(c.area / (step * step) + 1);
        let mut both = vec![false; width];
        for run in components.runs_of(self.k).filter(|run| (run.row - c.top).is_multiple_of(step)) {
            let rows = [run.row.saturating_sub(reach), (run.row + reach).min(blocks.rows - 1)];
            let [Some(above), Some(below)] = rows.map(own_in) else { continue };
            for (both, (above, below)) in both.iter_mut().zip(above.iter().zip(below)) {
                *both = above & below;
            }
            let from = if run.start == 0 { 0 } else { run.start + reach };
            let to = if run.end == blocks.columns { run.end } else { run.end.saturating_sub(reach) };
            let is_inner = |column: &usize| {
                let x = column - c.left;
                both[x] && both[x + reach] && both[x + 2 * reach]
            };
            inner.extend((from..to).step_by(step).filter(is_inner).map(|column| (column, run.row)));
        }
        inner
    }

    /// The depth from which on blocks have the shape's own level, the blur of its edge being left behind: the first whose median
    /// residual is nearly that of the next; `depths` are those of the box's blocks.
    fn settled_depth(&self, depths: &[u8]) -> u8 {
        let Standing { blocks, ground, .. } = *self.standing;
        let mut by_depth: [Vec<f32>; MAX_DEPTH as usize + 1] = Default::default();
        for ((column, row), depth) in self.blocks().zip(depths).filter(|(_, depth)| **depth > 0) {
            by_depth[usize::from(*depth)].push(ground.residual[row * blocks.columns + column]);
        }
        let counts = by_depth.each_ref().map(Vec::len);
        let most = counts.iter().max().copied().unwrap_or(0);
        let medians = by_depth.map(|levels| median(&levels));
        // Few blocks are no measure, and too few to learn local levels from.
        let enough = |depth: u8| counts[usize::from(depth)] * 4 >= most;
        let deepest = (1..=MAX_DEPTH).rev().find(|d| enough(*d)).unwrap_or(1);
        let settled = |d: &u8| medians[usize::from(*d)] >= SETTLED * medians[usize::from(*d) + 1];
        (INNER_DEPTH.min(deepest)..deepest).find(settled).unwrap_or(deepest)
    }
}

impl Levels {
    /// Levels of a component and of the ground round it.
    pub(super) fn of(standing: &Standing<'_>, k: usize) -> Self {
        let region = Region { standing, k, bounds: standing.components.list[k] };
        let mut levels = Self::of_ground(&region);
        if !levels.take_body(&region) {
            levels.take_depths(&region);
        }
        levels
    }

    /// Level of the ground round a component; those of the component are not known yet.
    fn of_ground(region: &Region<'_>) -> Self {
        let c = region.bounds;
        let middle = ((c.left + c.right) / 2, (c.top + c.bottom) / 2);
        let places = [(c.left, c.top), (c.right, c.top), (c.left, c.bottom), (c.right, c.bottom), middle];
        let levels = places.map(|block| region.ground(block));
        let (low, high) = levels.iter().fold((f32::MAX, f32::MIN), |(l, h), v| (l.min(*v), h.max(*v)));
        Self {
            left: c.left,
            top: c.top,
            width: c.right - c.left,
            height: c.bottom - c.top,
            ground: levels.iter().sum::<f32>() / levels.len() as f32,
            ground_span: high - low,
            ..Self::default()
        }
    }

    /// Takes sense and contrast from the body of a component; whether that has one contrast, or one that runs smoothly.
    fn take_body(&mut self, region: &Region<'_>) -> bool {
        let scatter = region.standing.ground.scatter;
        let step = (((region.bounds.area / LEVEL_SAMPLES) as f64).sqrt() as usize).max(1);
        let inner = region.inner(step);
        self.take_sense(region, &inner);
        // In one direction noise and grain weigh less than by the largest of the channels, and are no contrast.
        self.hue = region.standing.ground.hue(region.standing.blocks, &inner);
        if let Some(hue) = self.hue {
            let contrasts = region.contrasts(&inner, self.hue);
            self.contrast = median(&contrasts);
            let opposite = contrasts.iter().filter(|c| 2.0 * **c < self.contrast).count();
            if opposite * SPECKS <= inner.len()
                && self.take_even(region, &inner, &contrasts, (step, hue.gain * scatter))
            {
                return true;
            }
            self.hue = None;
        }
        let contrasts = region.contrasts(&inner, None);
        self.contrast = median(&contrasts);
        !inner.is_empty() && self.take_even(region, &inner, &contrasts, (step, scatter))
    }

    /// Takes the contrasts of blocks, every so many of them, for one contrast, or one that runs smoothly, if they are.
    fn take_even(
        &mut self,
        region: &Region<'_>,
        inner: &[Block],
        contrasts: &[f32],
        (step, scatter): (usize, f32),
    ) -> bool {
        if self.is_ground_even(region) && is_uniform(contrasts, self.contrast, scatter) {
            return true;
        }
        let side = if scatter > MAP_NOISE * self.contrast { step.min(TILE) } else { 1 };
        self.take_smooth(region, inner, contrasts, (side, scatter))
    }

    /// Takes the contrast of a component that has no even body (thin, or printed on) from its blocks beyond the blur of its edge.
    fn take_depths(&mut self, region: &Region<'_>) {
        let scatter = region.standing.ground.scatter;
        let depths = region.standing.depths(region.k);
        let settled = region.settled_depth(&depths);
        let is_deep = |depth: u8| depth >= settled;
        let deep: Vec<Block> =
            region.blocks().zip(&depths).filter(|(_, depth)| is_deep(**depth)).map(|(block, _)| block).collect();
        let contrasts = region.contrasts(&deep, None);
        if settled < INNER_DEPTH {
            // Thinner than three blocks: the strongest blocks are the best there is.
            self.contrast = quantile(&contrasts, 0.9);
            if !self.is_ground_even(region) {
                self.course = Course::Map(vec![self.contrast; depths.len()]);
            }
            return;
        }
        self.contrast = median(&contrasts);
        let is_even = self.is_ground_even(region) && is_uniform(&contrasts, self.contrast, scatter);
        if is_even || self.take_smooth(region, &deep, &contrasts, (1, scatter)) {
            return;
        }
        let contrast_of =
            |(block, depth): (Block, &u8)| if is_deep(*depth) { region.contrast(block, None) } else { 0.0 };
        let map = region.blocks().zip(&depths).map(contrast_of).collect();
        let noise = scatter / self.contrast.max(f32::MIN_POSITIVE);
        let reach = usize::from(settled) + BORDER_BLOCKS;
        self.course = Course::Map(self.spread_out(map, 2.0 * region.standing.ground.threshold, reach, noise));
    }

    /// Takes the contrast of blocks for a smooth surface over the component, if it is one; it is fitted to tiles of so many blocks a side.
    fn take_smooth(
        &mut self,
        region: &Region<'_>,
        inner: &[Block],
        contrasts: &[f32],
        (side, scatter): (usize, f32),
    ) -> bool {
        let local = |[column, row]: [f64; 2]| [column - self.left as f64, row - self.top as f64];
        let chosen = || inner.iter().zip(contrasts).step_by((inner.len() / MOST_SAMPLES).max(1));
        let light = Surface::fit(
            [self.width, self.height],
            chosen().map(|(block, contrast)| {
                let (middle, contrast) = if side > 1 {
                    region.standing.ground.tile_contrast(region.standing.blocks, *block, side, self.hue)
                } else {
                    (middle(*block), *contrast)
                };
                (local(middle), contrast)
            }),
        );
        let [right, bottom] = [self.width, self.height].map(|side| (side - 1) as f64);
        let corners = [(0.0, 0.0), (right, 0.0), (0.0, bottom), (right, bottom)];
        let is_light = corners.iter().all(|(x, y)| light.at(*x, *y) >= LEAST_LIGHT * self.contrast);
        let residual = |(block, contrast): (&Block, &f32)| {
            let [x, y] = local(middle(*block));
            contrast - light.at(x, y)
        };
        let residuals: Vec<f32> = chosen().map(residual).collect();
        let is_smooth = is_light && is_uniform(&residuals, self.contrast, scatter);
        if is_smooth {
            self.course = Course::Smooth(light);
        }
        is_smooth
    }

    /// Whether one level will do for the ground, and one sense for the shape.
    fn is_ground_even(&self, region: &Region<'_>) -> bool {
        self.ground_span <= UNIFORM_GROUND * self.contrast && (self.one_sided || !region.is_grey())
    }

    /// Whether the shape is brighter or darker than the ground, by blocks within it.
    fn take_sense(&mut self, region: &Region<'_>, inner: &[Block]) {
        let is_grey = region.is_grey();
        let all = inner.len();
        let brighter = inner.iter().filter(|block| is_grey && region.is_brighter(**block)).count();
        self.sense = if 2 * brighter >= all { 1.0 } else { -1.0 };
        self.one_sided = is_grey && all > 0 && brighter.min(all - brighter) * SPECKS <= all;
    }

    /// Whether one pair of levels will do.
    pub(super) fn is_uniform(&self) -> bool {
        matches!(self.course, Course::Uniform)
    }

    /// Whether it takes a map of blocks.
    pub(super) fn is_print(&self) -> bool {
        matches!(self.course, Course::Map(_))
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
        let map = match &self.course {
            Course::Uniform => {
                line.fill(1.0 / self.contrast.max(f32::MIN_POSITIVE));
                return;
            }
            Course::Smooth(light) => {
                let light = self.light_along(light, block, (y, from));
                line.iter_mut().enumerate().for_each(|(i, reciprocal)| *reciprocal = 1.0 / light(i));
                return;
            }
            Course::Map(map) => map,
        };
        let row = (in_blocks(y, block) as f32 - self.top as f32).clamp(0.0, (self.height - 1) as f32);
        let (j, t) = (row as usize, row.fract());
        let upper = &map[j * self.width..][..self.width];
        let lower = &map[(j + 1).min(self.height - 1) * self.width..][..self.width];
        let reciprocal = |i: usize| 1.0 / (upper[i] + (lower[i] - upper[i]) * t);
        // The column of a pixel is a whole number of blocks and one of few fractions.
        let mut i = usize::MAX;
        let (mut left, mut right) = (0.0, 0.0);
        for (x, value) in line.iter_mut().enumerate() {
            let column = (in_blocks(from + x, block) as f32 - self.left as f32).clamp(0.0, (self.width - 1) as f32);
            let at = column as usize;
            if at != i {
                (left, right) = (reciprocal(at), reciprocal((at + 1).min(self.width - 1)));
                i = at;
            }
            *value = left + (right - left) * (column - at as f32);
        }
    }

    /// A smooth contrast by the number of the pixel, along row `y` from column `from` on.
    fn light_along(&self, light: &Surface, block: usize, (y, from): (usize, usize)) -> impl Fn(usize) -> f32 + use<> {
        let (row, column) = (in_blocks(y, block) - self.top as f64, in_blocks(from, block) - self.left as f64);
        let light = light.along(row, column, 1.0 / block as f64);
        let least = LEAST_LIGHT * self.contrast;
        move |i| larger(light.at(i), least)
    }

    /// Fills a row of pixels with their difference from the ground, divided by the local contrast unless that is uniform.
    pub(super) fn fill_row(
        &self,
        rows: &mut RowSource<'_>,
        (y, from): (usize, usize),
        out: &mut [u8],
        [shape_level, ground_level]: [f32; 2],
    ) {
        let (frame, block) = (rows.frame, rows.block);
        let channels = frame.format.channels();
        let source = &frame.row(y)[from * channels..];
        let (row, column, step) = (in_blocks(y, block), in_blocks(from, block), 1.0 / block as f64);
        let range = shape_level - ground_level;
        let ground = rows.ground.along(row, column, step);
        let signed = ground.grey().filter(|_| self.one_sided);
        if let (Some(ground), Course::Smooth(light)) = (signed, &self.course) {
            let light = self.light_along(light, block, (y, from));
            widely!(divide_row(source, (ground, light), (self.sense * range, ground_level), out));
            return;
        }
        let [difference, reciprocals] = &mut rows.lines;
        for line in [&mut *difference, &mut *reciprocals] {
            line.clear();
            line.resize(out.len(), 0.0);
        }
        if let Some(hue) = self.hue {
            widely!(ground.fill_along(hue, source, difference));
        } else if let Some(ground) = signed {
            for (i, (d, p)) in difference.iter_mut().zip(source).enumerate() {
                *d = self.sense * (f32::from(*p) - ground.at(i));
            }
        } else {
            let values = |c: usize| source.iter().skip(c).step_by(channels).map(|p| f32::from(*p));
            ground.fill_differences(values, difference);
        }
        self.fill_reciprocals(block, (y, from), reciprocals);
        for ((out, d), reciprocal) in out.iter_mut().zip(&*difference).zip(&*reciprocals) {
            *out = rounded(ground_level + range * d * reciprocal);
        }
    }
}

/// Fills a row of pixels with their difference from the ground, divided by the light there; neighbouring ones go through the processor together,
/// all the way.
#[inline(always)]
fn divide_row(
    source: &[u8],
    (ground, light): (AlongRow, impl Fn(usize) -> f32),
    (range, level): (f32, f32),
    out: &mut [u8],
) {
    for (i, (out, p)) in out.iter_mut().zip(source).enumerate() {
        *out = rounded(level + range * (f32::from(*p) - ground.at(i)) / light(i));
    }
}

/// A place in blocks, from one in pixels: block k has its centre at pixel `k * block + (block - 1) / 2`.
pub(super) fn in_blocks(pixel: usize, block: usize) -> f64 {
    (pixel as f64 - (block - 1) as f64 / 2.0) / block as f64
}

/// A level of the 8-bit scale.
#[inline(always)]
fn rounded(level: f32) -> u8 {
    /// Floating point numbers of this size have no fraction: added to it, a number from 0 to 255 is rounded, and its whole part is the lowest
    /// byte.
    const WHOLE: f32 = 8_388_608.0;
    let positive = larger(level, 0.0);
    let within = if positive < 255.0 { positive } else { 255.0 };
    (within + WHOLE).to_bits() as u8
}

/// The larger of two numbers in one instruction of the processor: `f32::max` takes more, lest one is not a number.
#[inline(always)]
fn larger(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

/// Where the pixels of a row come from.
pub(super) struct RowSource<'a> {
    pub(super) frame: &'a Frame<'a>,
    pub(super) ground: &'a Ground,
    pub(super) block: usize,
    /// Memory for figures of the row's pixels.
    pub(super) lines: [Vec<f32>; 2],
}

/// Whether levels vary little, beside a contrast and what noise accounts for.
fn is_uniform(levels: &[f32], contrast: f32, scatter: f32) -> bool {
    /// Distance between the quartiles of a normal distribution, in standard deviations.
    const QUARTILES: f32 = 1.349;
    let [lower, upper] = quantiles(levels, [0.25, 0.75]);
    let excess = ((upper - lower).powi(2) - (QUARTILES * scatter).powi(2)).max(0.0).sqrt();
    excess <= UNIFORM * contrast
}
