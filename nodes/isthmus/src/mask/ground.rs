//! The ground of a frame: what colour it has where, and what stands out from it.
//!
//! The frame is averaged over small blocks. Otsu's threshold on the channel that separates best, and the classes' share of
//! the frame's outer rows and columns, tell the ground from the shapes. A quadratic surface through the ground's
//! blocks follows uneven light; what differs from it by more than its scatter is shape. Of a colour frame differences are taken
//! in the metric of the ground's own scatter (P. C. Mahalanobis, 1936): grain of wood and folds of cloth differ in
//! brightness, hardly in hue. Where the light varies by more than shapes and ground differ, no threshold tells the two apart; then the ground is
//! sought along the frame's rim.

use super::clipping::Clipping;
use super::frame::Frame;
use nalgebra::{Matrix3, Matrix6, Vector3, Vector6};

/// Means over square blocks of pixels.
#[derive(Debug, Clone, Default)]
pub(super) struct Blocks {
    /// Pixels along the side of a block.
    pub(super) size: usize,
    pub(super) columns: usize,
    pub(super) rows: usize,
    /// One plane for a grey frame, three for a colour one.
    pub(super) planes: Vec<Vec<f32>>,
    /// The blocks that are looked at to find the ground, all over the frame.
    samples: Vec<Sample>,
    sums: Vec<u16>,
}

impl Blocks {
    /// Chooses the blocks that are looked at to find the ground.
    fn choose_samples(&mut self) {
        let (columns, rows) = (self.columns, self.rows);
        let step = ((columns * rows) as f64 / SAMPLES as f64).sqrt().round().max(1.0) as usize;
        // Frames of a few rows are looked at all along.
        let (across, down) = if rows < step {
            (step, 1)
        } else if columns < step {
            (1, step)
        } else {
            (step, step)
        };
        self.samples.clear();
        for row in (0..rows).step_by(down) {
            // Each row begins elsewhere, so that narrow upright shapes are hit as well.
            let from = if columns > across { row / down % across } else { 0 };
            for column in (from..columns).step_by(across) {
                self.samples.push(Sample { block: row * columns + column, column: column as u32, row: row as u32 });
            }
        }
    }

    pub(super) fn fill(&mut self, frame: &Frame<'_>) {
        let channels = frame.format.channels();
        let (width, height) = (frame.width, frame.height);
        self.size = block_size(width.min(height));
        self.columns = width.div_ceil(self.size);
        self.rows = height.div_ceil(self.size);
        self.choose_samples();
        self.planes.resize_with(channels, Vec::new);
        for plane in &mut self.planes {
            plane.clear();
            plane.reserve(self.columns * self.rows);
        }
        for block_row in 0..self.rows {
            let rows = block_row * self.size..height.min((block_row + 1) * self.size);
            // The usual blocks are summed eight pixels at a time; what is left of the row goes the common way.
            let done = match (&mut self.planes[..], self.size, rows.len()) {
                ([plane], 4, 4) => sum_blocks([0, 1, 2, 3].map(|k| frame.row(rows.start + k)), plane),
                _ => 0,
            };
            if done == width {
                continue;
            }
            let count = rows.len();
            self.sums.clear();
            self.sums.resize((width - done) * channels, 0);
            for y in rows {
                for (sum, p) in self.sums.iter_mut().zip(&frame.row(y)[done * channels..]) {
                    *sum += u16::from(*p);
                }
            }
            for (c, plane) in self.planes.iter_mut().enumerate() {
                plane.extend(self.sums.chunks(self.size * channels).map(|block| {
                    let sum: u32 = block.iter().skip(c).step_by(channels).map(|s| u32::from(*s)).sum();
                    sum as f32 / (block.len() / channels * count) as f32
                }));
            }
        }
    }
}

/// Appends the means of the blocks of 4 x 4 pixels of four rows, of two blocks at a time; gives the number of columns done.
fn sum_blocks(rows: [&[u8]; 4], means: &mut Vec<f32>) -> usize {
    /// Every other byte, and every other pair of bytes, of a word.
    const BYTES: u64 = 0x00ff_00ff_00ff_00ff;
    const PAIRS: u64 = 0x0000_ffff_0000_ffff;
    let [a, b, c, d] = rows.map(|row| row.as_chunks::<8>().0);
    let from = means.len();
    means.resize(from + 2 * a.len(), 0.0);
    let words = a.iter().zip(b).zip(c).zip(d).map(|(((a, b), c), d)| [a, b, c, d].map(|p| u64::from_le_bytes(*p)));
    for (means, words) in means[from..].as_chunks_mut::<2>().0.iter_mut().zip(words) {
        // Sums side by side in one word: of the pixels of a pair, then of two pairs. No sum outgrows its sixteen bits.
        let pairs = words.iter().fold(0, |sum, w| sum + (w & BYTES) + (w >> 8 & BYTES));
        let blocks = (pairs & PAIRS) + (pairs >> 16 & PAIRS);
        *means = [blocks as u32 as i32, (blocks >> 32) as i32].map(|sum| sum as f32 / 16.0);
    }
    a.len() * 8
}

/// Side of a block in pixels: small pictures have small shapes.
fn block_size(frame_side: usize) -> usize {
    match frame_side {
        0..128 => 1,
        128..700 => 2,
        _ => 4,
    }
}

/// A quadratic surface over a frame or a part of it, in block coordinates scaled to -1..1.
#[derive(Debug, Clone, Copy)]
pub(super) struct Surface {
    coefficients: Vector6<f64>,
    scale: [f64; 2],
}

impl Surface {
    /// Least squares fit to the levels of blocks (column, row, level) of a picture of so many columns and rows, repeated without what lies
    /// far from the first fit (specks, shadows): beyond three deviations.
    pub(super) fn fit(size: [usize; 2], levels: impl Iterator<Item = ([f64; 2], f32)>) -> Self {
        let scale = size.map(|n| 2.0 / (n.max(2) - 1) as f64);
        let samples: Vec<([f64; 2], f32)> = levels.collect();
        let mut sums = NormalEquations::default();
        for (place, level) in &samples {
            sums.add(scaled(scale, *place), f64::from(*level), 1.0);
        }
        let first = Self { coefficients: sums.solve(), scale };
        let residuals: Vec<f32> = samples.iter().map(|([x, y], level)| (level - first.at(*x, *y)).abs()).collect();
        let limit = (3.0 / NORMAL_MAD * median(residuals.clone())).max(1.0);
        for ((place, level), _) in samples.iter().zip(&residuals).filter(|(_, residual)| **residual > limit) {
            sums.add(scaled(scale, *place), f64::from(*level), -1.0);
        }
        Self { coefficients: sums.solve(), scale }
    }

    /// Level at a block.
    pub(super) fn at(&self, column: f64, row: f64) -> f32 {
        let c = &self.coefficients;
        let [u, v] = scaled(self.scale, [column, row]);
        (c[0] + v * (c[2] + v * c[5]) + u * (c[1] + v * c[4] + u * c[3])) as f32
    }

    /// The levels along a row, from a column in steps.
    pub(super) fn along(&self, row: f64, column: f64, step: f64) -> AlongRow {
        let c = self.coefficients;
        let [u, v] = scaled(self.scale, [column, row]);
        let step = step * self.scale[0];
        let slope = c[1] + v * c[4];
        let level = c[0] + v * (c[2] + v * c[5]) + u * (slope + u * c[3]);
        AlongRow([level, (slope + 2.0 * u * c[3]) * step, c[3] * step * step].map(|k| k as f32))
    }
}

/// Levels along a row: a quadratic polynomial of the number of the step.
#[derive(Debug, Clone, Copy)]
pub(super) struct AlongRow([f32; 3]);

impl AlongRow {
    /// Level after so many steps.
    pub(super) fn at(&self, steps: usize) -> f32 {
        // A row is no longer than a number of four bytes, which the processor turns into a float several at a time.
        let i = steps as i32 as f32;
        self.0[0] + i * (self.0[1] + i * self.0[2])
    }
}

/// A place in the coordinates of a surface.
fn scaled(scale: [f64; 2], [column, row]: [f64; 2]) -> [f64; 2] {
    [column * scale[0] - 1.0, row * scale[1] - 1.0]
}

/// Sums over samples that a least squares fit of a quadratic surface needs.
#[derive(Debug, Default)]
struct NormalEquations {
    count: f64,
    /// Sums of `u^a v^b` up to the fourth degree, degree by degree, rising in `b`.
    moments: [f64; 15],
    /// Sums of the level times those up to the second degree.
    right: [f64; 6],
}

impl NormalEquations {
    /// Adds a sample (of weight 1), or takes it away again (-1).
    fn add(&mut self, [u, v]: [f64; 2], level: f64, weight: f64) {
        let (uu, uv, vv) = (u * u, u * v, v * v);
        let powers =
            [1.0, u, v, uu, uv, vv, uu * u, uu * v, u * vv, v * vv, uu * uu, uu * uv, uu * vv, uv * vv, vv * vv];
        self.count += weight;
        for (sum, power) in self.moments.iter_mut().zip(powers) {
            *sum += weight * power;
        }
        for (sum, power) in self.right.iter_mut().zip(powers) {
            *sum += weight * level * power;
        }
    }

    /// Coefficients of 1, u, v, u^2, uv, v^2.
    fn solve(&self) -> Vector6<f64> {
        const EXPONENTS: [[usize; 2]; 6] = [[0, 0], [1, 0], [0, 1], [2, 0], [1, 1], [0, 2]];
        let normal = Matrix6::from_fn(|i, j| {
            let [a, b] = [0, 1].map(|k| EXPONENTS[i][k] + EXPONENTS[j][k]);
            let degree = a + b;
            self.moments[degree * (degree + 1) / 2 + b]
        });
        // A tiny ridge: the ground of a tight crop may not determine all coefficients.
        let normal = normal + Matrix6::identity() * (1e-6 * self.count.max(1.0));
        normal.cholesky().map_or_else(Vector6::zeros, |factor| factor.solve(&Vector6::from(self.right)))
    }
}

/// The ground and what stands out from it.
#[derive(Debug, Clone, Default)]
pub(super) struct Ground {
    /// Ground level of each channel.
    pub(super) surfaces: Vec<Surface>,
    /// By how much each block differs from the ground (largest of the channels), in grey levels.
    pub(super) residual: Vec<f32>,
    /// Blocks that differ by more than this belong to shapes.
    pub(super) threshold: f32,
    /// Standard deviation of the ground's blocks.
    pub(super) scatter: f32,
    /// How much blocks that stand out do so on the mean, in such deviations.
    pub(super) clarity: f32,
    /// The metric of differences in colour; none where the ground scatters alike in all directions.
    pub(super) metric: Option<Metric>,
    /// What noise beyond black and white does to the means of blocks; the surfaces are free of it, the residuals are not.
    clipping: Option<Clipping>,
}

impl Ground {
    /// By how much a block differs from the ground, clipping put right.
    pub(super) fn contrast(&self, blocks: &Blocks, column: usize, row: usize) -> f32 {
        let block = row * blocks.columns + column;
        let Some(clipping) = &self.clipping else { return self.residual[block] };
        self.difference([column as f64, row as f64], |c| clipping.level(blocks.planes[c][block]))
    }

    /// By how much the levels of a block differ from the ground: in the metric, by the largest of the channels.
    fn difference(&self, [column, row]: [f64; 2], level: impl Fn(usize) -> f32) -> f32 {
        let differences = self.surfaces.iter().enumerate().map(|(c, surface)| level(c) - surface.at(column, row));
        match &self.metric {
            None => differences.fold(0.0, |most, d| most.max(d.abs())),
            Some(metric) => {
                let mut colour = [0.0; 3];
                colour.iter_mut().zip(differences).for_each(|(colour, d)| *colour = d);
                metric.length(colour)
            }
        }
    }
}

/// Differences in colour, shortened where the ground itself scatters.
#[derive(Debug, Clone)]
pub(super) struct Metric([[f32; 3]; 3]);

impl Metric {
    /// Metric of the ground's differences from its surface; none for scatter that is little or the same in all directions.
    fn of(differences: &[Vector3<f32>]) -> Option<Self> {
        let mut sums = Matrix3::zeros();
        for d in differences {
            sums += d * d.transpose();
        }
        let eigen = sums.cast::<f64>().symmetric_eigen();
        let axes = eigen.eigenvectors.cast::<f32>();
        // What is no ground makes far outliers: medians rather than the sums themselves.
        let along = |axis: usize| median(differences.iter().map(|d| axes.column(axis).dot(d).abs()).collect());
        let scatter = [0, 1, 2].map(|axis| (along(axis) / NORMAL_MAD).max(MIN_SCATTER));
        let [least, most] = [f32::min, f32::max].map(|pick| scatter.into_iter().reduce(pick).unwrap_or(MIN_SCATTER));
        if most.is_nan() || most <= EVEN_SCATTER * least {
            return None;
        }
        let weights = Matrix3::from_diagonal(&Vector3::from(scatter.map(|s| least / s)));
        let metric = axes * weights * axes.transpose();
        Some(Self([0, 1, 2].map(|row| [0, 1, 2].map(|column| metric[(row, column)]))))
    }

    /// Length of a difference: the largest of the channels, as everywhere.
    pub(super) fn length(&self, [r, g, b]: [f32; 3]) -> f32 {
        let channel = |w: &[f32; 3]| (w[0] * r + w[1] * g + w[2] * b).abs();
        self.0.iter().map(channel).fold(0.0, |most, d| if d > most { d } else { most })
    }
}

/// Least scatter of the ground's blocks along an axis of colour, in grey levels: less is not told from rounding and compression.
const MIN_SCATTER: f32 = 2.0;
/// Scatter that differs by less than this factor between directions is taken for even: its measure is that of medians.
const EVEN_SCATTER: f32 = 1.5;

/// A block that differs from the ground by more than this many standard deviations of the ground's blocks is shape.
const OUTLIER: f32 = 6.0;
/// Least difference from the ground, in grey levels: compression leaves traces of a few levels.
const MIN_RESIDUAL: f32 = 6.0;
/// Least difference from the ground as a part of what shapes have on the middle: shadows and glare round them have less,
/// dark print on black more.
const MIN_RELATIVE_RESIDUAL: f32 = 0.12;
/// Shapes that stand out by at least so many deviations of the ground are a class of their own, told from it half-way; of what follows
/// from noise alone the upper class stands out by two.
const CLASS_CLARITY: f32 = 4.0;
/// Shapes that stand out by fewer deviations may do so from a wrong ground, one side of uneven light taken for shape.
const CLEAR: f32 = 2.0 * CLASS_CLARITY;
/// Blocks that are looked at to find the ground: a shape of a thousandth of the frame still has several among them.
const SAMPLES: usize = 5_000;
/// Blocks used for the fit: more do not make a quadratic any better.
const FIT_SAMPLES: usize = 800;
/// One in so many of the ground's blocks tells its scatter: a median of a thousand is known to a thirtieth.
const SCATTER_STEP: usize = 4;
/// Median absolute deviation of a normal distribution of standard deviation 1.
const NORMAL_MAD: f32 = 0.674_5;
/// Median of the largest of three such deviations: of those in three channels.
const LARGEST_OF_THREE: f32 = 1.260_8;
/// Rounds of fitting the ground and asking again what belongs to it.
const ROUNDS: usize = 3;
/// Depths in the frame, as parts of its smaller side, at which rows and columns vote for the ground: beyond scanner edges, and
/// before most shapes.
const RIM_DEPTHS: [f64; 4] = [0.0, 0.01, 0.02, 0.04];
/// Share of the rim from which a class is the ground beyond doubt. In a tight crop of a shape with two straight sides along
/// the rim about half the rim is shape.
const SURE_SHARE: f64 = 0.62;

/// A class of blocks taken for ground.
pub(super) struct Candidate {
    /// Whether each block of [`Blocks::samples`] is ground.
    is_ground: Vec<bool>,
}

/// A block that is looked at.
#[derive(Debug, Clone, Copy)]
struct Sample {
    block: usize,
    // Of four bytes, so that they become floating point numbers in one step.
    column: u32,
    row: u32,
}

/// What tells ground and shapes apart.
enum Channel {
    /// One of the frame's channels.
    Plane(usize),
    /// The brightest channel.
    Brightest,
    /// The darkest channel.
    Darkest,
    /// The largest difference from the colour along the rim.
    Difference([f32; 3]),
}

impl Channel {
    fn at(&self, planes: &[Vec<f32>], k: usize) -> f32 {
        let values = planes.iter().map(|p| p[k]);
        match self {
            Self::Plane(c) => planes[*c][k],
            Self::Brightest => values.fold(0.0, f32::max),
            Self::Darkest => values.fold(255.0, f32::min),
            Self::Difference(colour) => values.zip(colour).map(|(v, g)| (v - g).abs()).fold(0.0, f32::max),
        }
    }
}

/// Which blocks may be ground: one candidate, or both classes where the rim does not tell.
pub(super) fn candidates(blocks: &Blocks) -> Vec<Candidate> {
    let planes = &blocks.planes;
    let rim: Vec<usize> = rim_blocks(blocks).collect();
    let mut channels: Vec<Channel> = (0..planes.len()).map(Channel::Plane).collect();
    if let [r, g, b] = &planes[..] {
        let colour = [r, g, b].map(|plane| median(rim.iter().map(|&k| plane[k]).collect()));
        channels.extend([Channel::Brightest, Channel::Darkest, Channel::Difference(colour)]);
    }
    let best = channels
        .iter()
        .map(|channel| {
            let values: Vec<f32> = match channel {
                Channel::Plane(c) => blocks.samples.iter().map(|s| planes[*c][s.block]).collect(),
                _ => blocks.samples.iter().map(|s| channel.at(planes, s.block)).collect(),
            };
            let split = otsu(&values);
            (channel, values, split)
        })
        .max_by(|a, b| a.2.separation.total_cmp(&b.2.separation));
    let Some((channel, values, split)) = best else { return Vec::new() };
    let bright = rim.iter().filter(|&&k| channel.at(planes, k) > split.threshold).count();
    let share = bright as f64 / rim.len().max(1) as f64;
    let class =
        |bright: bool| Candidate { is_ground: values.iter().map(|v| (*v > split.threshold) == bright).collect() };
    let likelier = share > 0.5;
    let mut list = vec![class(likelier)];
    if share.max(1.0 - share) < SURE_SHARE {
        list.push(class(!likelier));
    }
    list
}

/// The blocks along the rim, at several depths.
fn rim_blocks(blocks: &Blocks) -> impl Iterator<Item = usize> {
    let (columns, rows) = (blocks.columns, blocks.rows);
    RIM_DEPTHS.into_iter().flat_map(move |depth| {
        let d = (depth * columns.min(rows) as f64) as usize;
        let across = (d..columns - d).flat_map(move |c| [d * columns + c, (rows - 1 - d) * columns + c]);
        let down = (d..rows - d).flat_map(move |r| [r * columns + d, r * columns + columns - 1 - d]);
        across.chain(down)
    })
}

/// Finds the ground that a class of blocks belongs to, or, where nothing stands out from that clearly, the rim; `residual` is memory to be
/// used again.
pub(super) fn find(frame: &Frame<'_>, blocks: &Blocks, candidate: Candidate, residual: Vec<f32>) -> Ground {
    let ground = fit(frame, blocks, candidate, residual);
    if ground.clarity >= CLEAR {
        return ground;
    }
    let rim = fit(frame, blocks, along_rim(blocks), Vec::new());
    if rim.clarity > ground.clarity { rim } else { ground }
}

/// The rim taken for ground: a surface through it runs under all shapes, whatever the light.
fn along_rim(blocks: &Blocks) -> Candidate {
    let (columns, rows) = (blocks.columns, blocks.rows);
    let depth = (RIM_DEPTHS[RIM_DEPTHS.len() - 1] * columns.min(rows) as f64) as usize;
    let is_near = |at: u32, count: usize| at as usize <= depth || at as usize + depth + 1 >= count;
    Candidate { is_ground: blocks.samples.iter().map(|s| is_near(s.column, columns) || is_near(s.row, rows)).collect() }
}

/// Fits the ground to a class of blocks, and finds what stands out from it; `residual` is memory to be used again.
fn fit(frame: &Frame<'_>, blocks: &Blocks, candidate: Candidate, residual: Vec<f32>) -> Ground {
    let Candidate { mut is_ground } = candidate;
    let mut ground = Ground::default();
    let mut residuals = Vec::with_capacity(is_ground.len());
    for _ in 0..ROUNDS {
        ground.surfaces = blocks.planes.iter().map(|plane| fit_surface(blocks, plane, &is_ground, None)).collect();
        ground.metric = metric(blocks, &ground.surfaces, &is_ground);
        let residual_of =
            |s: &Sample| ground.difference([s.column, s.row].map(f64::from), |c| blocks.planes[c][s.block]);
        residuals.clear();
        residuals.extend(blocks.samples.iter().map(residual_of));
        let of_ground = residuals.iter().zip(&is_ground).filter(|(_, g)| **g);
        let scatter: Vec<f32> = of_ground.step_by(SCATTER_STEP).map(|(r, _)| *r).collect();
        let sigma = median(scatter) / if ground.surfaces.len() == 1 { NORMAL_MAD } else { LARGEST_OF_THREE };
        let split = otsu(&residuals);
        let standing_out = split.mean_above;
        ground.scatter = sigma;
        ground.clarity = standing_out / sigma.max(f32::MIN_POSITIVE);
        let outlier = OUTLIER * sigma;
        let outlier = if ground.clarity >= CLASS_CLARITY { outlier.min(standing_out / 2.0) } else { outlier };
        ground.threshold = outlier.max(MIN_RESIDUAL).max(MIN_RELATIVE_RESIDUAL * standing_out);
        let half = (standing_out / 2.0).max(ground.threshold);
        // Whatever is nearer to the ground than to the shapes may be ground, shadows included; the next fit is robust.
        let mut changed = false;
        for (is_ground, residual) in is_ground.iter_mut().zip(&residuals) {
            let now = *residual < half;
            changed |= now != *is_ground;
            *is_ground = now;
        }
        if !changed {
            break;
        }
    }
    ground.residual = residual;
    ground.residual.resize(blocks.columns * blocks.rows, 0.0);
    fill_residuals(blocks, &mut ground);
    ground.clipping = clipping(frame, blocks, &is_ground);
    if let Some(clipping) = &ground.clipping {
        let fit = |plane: &Vec<f32>| fit_surface(blocks, plane, &is_ground, Some(clipping));
        ground.surfaces = blocks.planes.iter().map(fit).collect();
    }
    ground
}

/// The metric of the ground's blocks; none for a grey frame.
fn metric(blocks: &Blocks, surfaces: &[Surface], is_ground: &[bool]) -> Option<Metric> {
    let ([r, g, b], [red, green, blue]) = (&blocks.planes[..], surfaces) else { return None };
    let of_ground = blocks.samples.iter().zip(is_ground).filter(|(_, is_ground)| **is_ground);
    let difference = |(s, _): (&Sample, &bool)| {
        let (column, row) = (f64::from(s.column), f64::from(s.row));
        let channels = [(r, red), (g, green), (b, blue)];
        Vector3::from(channels.map(|(plane, surface)| plane[s.block] - surface.at(column, row)))
    };
    Metric::of(&of_ground.step_by(SCATTER_STEP).map(difference).collect::<Vec<_>>())
}

/// Finds by how much each block differs from the ground.
fn fill_residuals(blocks: &Blocks, ground: &mut Ground) {
    if let (Some(metric), [r, g, b], [red, green, blue]) = (&ground.metric, &blocks.planes[..], &ground.surfaces[..]) {
        for (row, residuals) in ground.residual.chunks_exact_mut(blocks.columns).enumerate() {
            let channels = [(r, red), (g, green), (b, blue)]
                .map(|(plane, surface)| (&plane[row * blocks.columns..], surface.along(row as f64, 0.0, 1.0)));
            for (column, residual) in residuals.iter_mut().enumerate() {
                *residual = metric.length(channels.map(|(values, levels)| values[column] - levels.at(column)));
            }
        }
        return;
    }
    for (channel, (plane, surface)) in blocks.planes.iter().zip(&ground.surfaces).enumerate() {
        let rows = plane.chunks_exact(blocks.columns).zip(ground.residual.chunks_exact_mut(blocks.columns));
        for (row, (values, residuals)) in rows.enumerate() {
            let levels = surface.along(row as f64, 0.0, 1.0);
            for (column, (residual, value)) in residuals.iter_mut().zip(values).enumerate() {
                let difference = (value - levels.at(column)).abs();
                *residual = if channel == 0 { difference } else { residual.max(difference) };
            }
        }
    }
}

/// What noise does to the levels of a frame, if it reaches beyond black or white anywhere.
fn clipping(frame: &Frame<'_>, blocks: &Blocks, is_ground: &[bool]) -> Option<Clipping> {
    let levels = blocks.samples.iter().flat_map(|s| blocks.planes.iter().map(|plane| plane[s.block]));
    let (low, high) = levels.fold((f32::MAX, f32::MIN), |(low, high), level| (low.min(level), high.max(level)));
    Clipping::of(noise(frame, blocks, is_ground), [low, high])
}

/// Standard deviation of the grey levels of a frame's ground, from differences of neighbouring pixels.
fn noise(frame: &Frame<'_>, blocks: &Blocks, is_ground: &[bool]) -> f32 {
    /// Median of the absolute difference of two normal numbers, in standard deviations.
    const MEDIAN: f32 = 0.953_9;
    let channels = frame.format.channels();
    let chosen = blocks.samples.iter().zip(is_ground).filter(|(_, is_ground)| **is_ground).map(|(s, _)| s);
    let chosen = chosen.step_by(SCATTER_STEP);
    let difference = |s: &Sample| {
        let row = frame.row((s.row as usize * blocks.size).min(frame.height - 1));
        let at = s.column as usize * blocks.size * channels;
        let next = row.get(at + channels).unwrap_or(&row[at]);
        f32::from(row[at].abs_diff(*next))
    };
    median(chosen.map(difference).collect()) / MEDIAN
}

/// Fits a surface to the ground's blocks.
fn fit_surface(blocks: &Blocks, plane: &[f32], is_ground: &[bool], clipping: Option<&Clipping>) -> Surface {
    let total = is_ground.iter().filter(|g| **g).count();
    let stride = (total / FIT_SAMPLES).max(1);
    let chosen = blocks.samples.iter().zip(is_ground).filter(|(_, is_ground)| **is_ground).step_by(stride);
    let level = |level| clipping.map_or(level, |clipping| clipping.level(level));
    let samples = chosen.map(|(s, _)| ([f64::from(s.column), f64::from(s.row)], level(plane[s.block])));
    Surface::fit([blocks.columns, blocks.rows], samples)
}

/// Two classes of values.
pub(super) struct Split {
    pub(super) threshold: f32,
    /// Between-class part of the variance, 0 to 1.
    separation: f64,
    /// Mean of the upper class.
    mean_above: f32,
}

/// The threshold that leaves the least variance within two classes (N. Otsu, *A threshold selection method from gray-level
/// histograms*, IEEE Trans. SMC 9, 1979).
pub(super) fn otsu(values: &[f32]) -> Split {
    let mut histogram = [0u32; 256];
    for v in values {
        histogram[*v as u8 as usize] += 1;
    }
    let total = values.len() as f64;
    let sum: f64 = histogram.iter().enumerate().map(|(v, n)| v as f64 * f64::from(*n)).sum();
    let squares: f64 = histogram.iter().enumerate().map(|(v, n)| (v * v) as f64 * f64::from(*n)).sum();
    let variance = squares / total - (sum / total).powi(2);
    let mut best = Split { threshold: 255.0, separation: 0.0, mean_above: 255.0 };
    let (mut below, mut below_sum, mut gain) = (0.0, 0.0, 0.0);
    for (v, n) in histogram.iter().enumerate() {
        below += f64::from(*n);
        below_sum += v as f64 * f64::from(*n);
        if below == 0.0 || below == total {
            continue;
        }
        let (low, high) = (below_sum / below, (sum - below_sum) / (total - below));
        let between = below * (total - below) * (high - low).powi(2);
        if between > gain {
            gain = between;
            // Half-way between the class means, rather than at the first of many equally good thresholds.
            let threshold = ((low + high) / 2.0) as f32;
            let separation = if variance > 0.0 { between / (total * total) / variance } else { 0.0 };
            best = Split { threshold, separation, mean_above: high as f32 };
        }
    }
    best
}

/// Median of a list; 0 of an empty one.
pub(super) fn median(mut values: Vec<f32>) -> f32 {
    quantile(&mut values, 0.5)
}

/// Quantile of a list (which gets reordered); 0 of an empty one.
pub(super) fn quantile(values: &mut [f32], q: f64) -> f32 {
    if values.is_empty() {
        return 0.0;
    }
    let k = ((values.len() - 1) as f64 * q) as usize;
    *values.select_nth_unstable_by(k, f32::total_cmp).1
}
