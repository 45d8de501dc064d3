//! The ground of a frame: what colour it has where, and what stands out from it.
//!
//! The frame is averaged over small blocks. Otsu's threshold on the channel that separates best, and the classes' share of
//! the frame's outer rows and columns, tell the ground from the shapes. A quadratic surface through the ground's
//! blocks follows uneven light; what differs from it by more than its scatter is shape. Of a colour frame differences are taken
//! in the metric of the ground's own scatter (P. C. Mahalanobis, 1936): grain of wood and folds of cloth differ in
//! brightness, hardly in hue. Where the light varies by more than shapes and ground differ, no threshold tells the two apart; then the ground is
//! sought along the frame's rim.

use super::blocks::{Blocks, NOISE_STEP, Sample};
use super::clipping::Clipping;
use super::metric::Metric;
use super::statistics::{Histogram, NORMAL_MAD, Split, median};
use super::surface::{AlongRow, Surface};
use crate::wide::widely;
use nalgebra::Vector3;
use std::ops::Range;

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
    /// By how much a block differs from the ground, or how far in the direction of a hue, clipping put right.
    pub(super) fn contrast(&self, blocks: &Blocks, column: usize, row: usize, hue: Option<Hue>) -> f32 {
        let block = row * blocks.columns + column;
        let Some(clipping) = &self.clipping else {
            return match hue {
                None => self.residual[block],
                Some(_) => self.difference([column as f64, row as f64], hue, |c| blocks.planes[c][block]),
            };
        };
        self.difference([column as f64, row as f64], hue, |c| clipping.level(blocks.planes[c][block]))
    }

    /// What differs from the ground by more than this is no ground, whatever it is: shadows, glow, or print. Of faint shapes it is what shapes differ by.
    pub(super) fn weak_threshold(&self) -> f32 {
        (OUTLIER * self.scatter).max(MIN_RESIDUAL).min(self.threshold)
    }

    /// The direction in which blocks of a colour frame differ from the ground, on the middle: that in which what the ground scatters by counts least
    /// (R. A. Fisher, *The use of multiple measurements in taxonomic problems*, 1936).
    pub(super) fn hue(&self, blocks: &Blocks, list: &[(usize, usize)]) -> Option<Hue> {
        let [red, green, blue] = &self.surfaces[..] else { return None };
        let channel = |c: usize, surface: &Surface| {
            let difference = |&(column, row): &(usize, usize)| {
                let mean = blocks.planes[c][row * blocks.columns + column];
                let level = self.clipping.as_ref().map_or(mean, |clipping| clipping.level(mean));
                level - surface.at(column as f64, row as f64)
            };
            median(&list.iter().map(difference).collect::<Vec<_>>())
        };
        let middle = [channel(0, red), channel(1, green), channel(2, blue)];
        let whiten = |d| self.metric.as_ref().map_or(d, |metric| metric.whiten(d));
        let colour = list
            .get(list.len() / 2)
            .map_or([0.0; 3], |&(column, row)| [red, green, blue].map(|surface| surface.at(column as f64, row as f64)));
        let [white, light] = [middle, colour].map(|d| Vector3::from(whiten(d)));
        let light = light.try_normalize(f32::MIN_POSITIVE).unwrap_or_default();
        let across = white - light * (white.dot(&light) * SHADOWS / (1.0 + SHADOWS));
        let scale = white.amax() / across.dot(&white);
        let hue = Hue { weights: whiten(across.into()).map(|w| w * scale), gain: across.norm() * scale };
        scale.is_finite().then_some(hue)
    }

    /// The same of a tile of so many blocks a side, by its first one, and its middle.
    pub(super) fn tile_contrast(
        &self,
        blocks: &Blocks,
        (column, row): (usize, usize),
        side: usize,
        hue: Option<Hue>,
    ) -> ([f64; 2], f32) {
        let (columns, rows) = (column..blocks.columns.min(column + side), row..blocks.rows.min(row + side));
        let count = (columns.len() * rows.len()) as f32;
        let mean = |plane: &[f32]| {
            rows.clone().map(|row| plane[row * blocks.columns..][columns.clone()].iter().sum::<f32>()).sum::<f32>()
                / count
        };
        let level = |mean: f32| self.clipping.as_ref().map_or(mean, |clipping| clipping.level(mean));
        let middle = [&columns, &rows].map(|range| (range.start + range.end - 1) as f64 / 2.0);
        (middle, self.difference(middle, hue, |c| level(mean(&blocks.planes[c]))))
    }

    /// Whether a block may be ground in a shadow: darker, and of about the same hue.
    pub(super) fn may_be_shaded(&self, blocks: &Blocks, (column, row): (usize, usize)) -> bool {
        let block = row * blocks.columns + column;
        let mut parts = blocks
            .planes
            .iter()
            .zip(&self.surfaces)
            .map(|(plane, surface)| plane[block] / surface.at(column as f64, row as f64).max(1.0));
        let first = parts.next().map_or((0.0, 0.0), |part| (part, part));
        let (least, most) = parts.fold(first, |(least, most), part| (least.min(part), most.max(part)));
        most < 1.0 && most - least <= SHADED * (1.0 - most).max(1.0 - least)
    }

    /// The ground along a row, from a column in steps.
    pub(super) fn along(&self, row: f64, column: f64, step: f64) -> GroundRow<'_> {
        let mut levels = [AlongRow::default(); MAX_CHANNELS];
        let channels = self.surfaces.len().min(MAX_CHANNELS);
        for (levels, surface) in levels.iter_mut().zip(&self.surfaces) {
            *levels = surface.along(row, column, step);
        }
        GroundRow { levels, channels, metric: self.metric.as_ref() }
    }

    /// By how much the levels of a block differ from the ground: in the metric, by the largest of the channels, or in the direction of a hue.
    fn difference(&self, [column, row]: [f64; 2], hue: Option<Hue>, level: impl Fn(usize) -> f32) -> f32 {
        let differences = self.surfaces.iter().enumerate().map(|(c, surface)| level(c) - surface.at(column, row));
        if let Some(hue) = hue {
            return differences.zip(hue.weights).map(|(d, w)| w * d).sum();
        }
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

/// A direction of differences in colour.
#[derive(Debug, Clone, Copy)]
pub(super) struct Hue {
    /// Differences of the channels, weighted with these, add up to a signed difference.
    weights: [f32; 3],
    /// Scatter of that as a part of the scatter of a channel.
    pub(super) gain: f32,
}

/// How much the ground's brightness is taken to vary beside pieces, as a part of the variance by noise: shadows count less then, and noise a sixteenth more at most.
const SHADOWS: f32 = 1.0;

/// By how much the channels' parts of the light of a shaded ground differ at most, as a part of what is missing of it.
const SHADED: f32 = 0.4;

/// Channels of a colour frame.
const MAX_CHANNELS: usize = 3;

/// The ground along a row of pixels or blocks.
pub(super) struct GroundRow<'a> {
    levels: [AlongRow; MAX_CHANNELS],
    channels: usize,
    metric: Option<&'a Metric>,
}

impl GroundRow<'_> {
    /// The levels of a grey frame's ground.
    pub(super) fn grey(&self) -> Option<AlongRow> {
        (self.channels == 1).then_some(self.levels[0])
    }

    /// The difference of the pixel so many steps along the row from the ground, channel by channel, in the metric.
    pub(super) fn difference(&self, steps: usize, pixel: &[u8]) -> [f32; MAX_CHANNELS] {
        let mut difference = [0.0; MAX_CHANNELS];
        for (difference, (level, ground)) in difference.iter_mut().zip(pixel.iter().zip(&self.levels)) {
            *difference = f32::from(*level) - ground.at(steps);
        }
        self.metric.map_or(difference, |metric| metric.whiten(difference))
    }

    /// Fills a row with its signed differences from the ground in the direction of a hue, from its pixels.
    #[inline(always)]
    pub(super) fn fill_along(&self, hue: Hue, source: &[u8], differences: &mut [f32]) {
        let ([r, g, b], [red, green, blue]) = (self.levels, hue.weights);
        for (i, (difference, p)) in differences.iter_mut().zip(source.as_chunks::<3>().0).enumerate() {
            let [x, y, z] = p.map(f32::from);
            *difference = red * (x - r.at(i)) + green * (y - g.at(i)) + blue * (z - b.at(i));
        }
    }

    /// Fills a row with its differences from the ground; `values` gives the row's levels in a channel.
    #[inline(always)]
    pub(super) fn fill_differences<I: Iterator<Item = f32>>(
        &self,
        values: impl Fn(usize) -> I,
        differences: &mut [f32],
    ) {
        if let Some(metric) = self.metric {
            let [r, g, b] = self.levels;
            let colours = values(0).zip(values(1)).zip(values(2));
            for (i, (difference, ((red, green), blue))) in differences.iter_mut().zip(colours).enumerate() {
                *difference = metric.length([red - r.at(i), green - g.at(i), blue - b.at(i)]);
            }
            return;
        }
        for (i, (difference, value)) in differences.iter_mut().zip(values(0)).enumerate() {
            *difference = (value - self.levels[0].at(i)).abs();
        }
        for (channel, levels) in self.levels[..self.channels].iter().enumerate().skip(1) {
            for (i, (difference, value)) in differences.iter_mut().zip(values(channel)).enumerate() {
                *difference = difference.max((value - levels.at(i)).abs());
            }
        }
    }
}

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
/// Blocks used for a fit that tells what belongs to the ground.
const CLASS_SAMPLES: usize = 400;
/// ... and for the one that tells the ground's level: half-way between shape and ground is known half as well as the ground.
const LEVEL_SAMPLES: usize = 1_600;
/// One in so many of the ground's blocks tells its scatter: a median of a thousand is known to a thirtieth.
const SCATTER_STEP: usize = 4;
/// Median of the largest of three such deviations: of those in three channels.
const LARGEST_OF_THREE: f32 = 1.260_8;
/// Rounds of fitting the ground and asking again what belongs to it.
const ROUNDS: usize = 3;
/// Depths in the frame, as parts of its smaller side, at which rows and columns vote for the ground: beyond scanner edges, and
/// before most shapes.
const RIM_DEPTHS: [f64; 4] = [0.0, 0.01, 0.02, 0.04];
/// Blocks that vote along a side, at least: shares are known to a few percent.
const RIM_SAMPLES: usize = 64;
/// Share of the rim from which a class is the ground beyond doubt. In a tight crop of a shape with two straight sides along
/// the rim about half the rim is shape.
const SURE_SHARE: f64 = 0.62;

/// Share of the rim from which that what is not of it is no ground.
const CLEAN_SHARE: f64 = 0.95;
/// Share of a class that the part of it along the rim has at least, if it is ground: a surface through less does not tell the rest.
const LEAST_SHARE: f64 = 0.5;
/// One in so many blocks make no class of print: the edges of shapes are so many.
const FEW: f64 = 50.0;
/// How much denser levels are on the half way from such a class to the ground than in the class, from which on it is light that falls off: of what does so in inverse proportion to its
/// distance, or as a normal distribution, at least twice.
const FALLING: f64 = 2.0;
/// All levels.
const ALL: Range<f32> = 0.0..256.0;

/// A class of blocks taken for ground.
pub(super) struct Candidate {
    /// Whether each block of [`Blocks::samples`] is ground.
    is_ground: Vec<bool>,
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

/// Which blocks may be ground, the likelier class first, and whether the rim tells that it is.
pub(super) fn candidates(blocks: &Blocks) -> impl Iterator<Item = (Candidate, bool)> {
    let planes = &blocks.planes;
    let rim: Vec<usize> = rim_blocks(blocks).collect();
    let mut channels: Vec<Channel> = (0..planes.len()).map(Channel::Plane).collect();
    if let [r, g, b] = &planes[..] {
        let colour = [r, g, b].map(|plane| median(&rim.iter().map(|&k| plane[k]).collect::<Vec<_>>()));
        channels.extend([Channel::Brightest, Channel::Darkest, Channel::Difference(colour)]);
    }
    let best = channels
        .into_iter()
        .map(|channel| {
            let values: Vec<f32> = match &channel {
                Channel::Plane(c) => blocks.sampled[*c].clone(),
                _ => blocks.samples.iter().map(|s| channel.at(planes, s.block)).collect(),
            };
            let histogram = Histogram::of(&values);
            let split = histogram.split(ALL);
            (channel, values, histogram, split)
        })
        .max_by(|a, b| a.3.separation.total_cmp(&b.3.separation));
    best.into_iter().flat_map(move |(channel, values, histogram, split)| {
        let rim: Vec<f32> = rim.iter().map(|&k| channel.at(planes, k)).collect();
        let bright = rim.iter().filter(|v| **v > split.threshold).count();
        let share = bright as f64 / rim.len().max(1) as f64;
        let is_told = share.max(1.0 - share) >= SURE_SHARE;
        let class = move |bright: bool| {
            let whole = if bright { split.threshold..ALL.end } else { ALL.start..split.threshold };
            let class = rim_class(&values, &histogram, &rim, whole);
            values.iter().map(|v| class.contains(v)).collect()
        };
        let candidates =
            [share > 0.5, share <= 0.5].into_iter().map(move |bright| Candidate { is_ground: class(bright) });
        candidates.filter(|c| c.is_ground.contains(&true)).map(move |candidate| (candidate, is_told))
    })
}

/// The part of a class of levels that the rim is of, if it is most of it: what else is of that class is print.
fn rim_class(values: &[f32], histogram: &Histogram, rim: &[f32], class: Range<f32>) -> Range<f32> {
    let count = |values: &[f32], class: &Range<f32>| values.iter().filter(|v| class.contains(v)).count() as f64;
    let split = histogram.split(class.clone());
    let [all, along_rim] = [count(values, &class), count(rim, &class)];
    let is_ground = |part: &Range<f32>| {
        along_rim > 0.0
            && count(rim, part) >= CLEAN_SHARE * along_rim
            && (LEAST_SHARE * all..all).contains(&count(values, part))
            && is_apart(histogram, &class, &split, part)
    };
    let parts = [class.start..split.threshold, split.threshold..class.end];
    match parts.into_iter().find(is_ground) {
        Some(part) => rim_class(values, histogram, rim, part),
        None => class,
    }
}

/// Whether what is of a class and not of its part that is ground is one of its own, and not few: there are fewer levels on the way to it. Of light that falls off there are more the nearer to
/// the ground.
fn is_apart(histogram: &Histogram, class: &Range<f32>, split: &Split, ground: &Range<f32>) -> bool {
    let (mean, end) =
        if ground.start == class.start { (split.mean_below, class.end) } else { (split.mean_above, class.start) };
    let [all, _] = histogram.between([class.start, class.end]);
    let [on_the_way, distance] = histogram.between([split.threshold, (split.threshold + mean) / 2.0]);
    let [apart, width] = histogram.between([split.threshold, end]);
    apart * FEW >= all && on_the_way / distance < FALLING * apart / width
}

/// The blocks along the rim, at several depths.
fn rim_blocks(blocks: &Blocks) -> impl Iterator<Item = usize> {
    let (columns, rows) = (blocks.columns, blocks.rows);
    RIM_DEPTHS.into_iter().flat_map(move |depth| {
        let d = (depth * columns.min(rows) as f64) as usize;
        let along = |side: usize| (d..side - d).step_by((side / RIM_SAMPLES).max(1));
        let across = along(columns).flat_map(move |c| [d * columns + c, (rows - 1 - d) * columns + c]);
        let down = along(rows).flat_map(move |r| [r * columns + d, r * columns + columns - 1 - d]);
        across.chain(down)
    })
}

/// Finds the ground that a class of blocks belongs to, or, where nothing stands out from that clearly, the rim; `residual` is memory to be
/// used again.
pub(super) fn find(blocks: &Blocks, candidate: Candidate, residual: Vec<f32>) -> Ground {
    let ground = fit(blocks, candidate, residual);
    if ground.clarity >= CLEAR {
        return ground;
    }
    let rim = fit(blocks, along_rim(blocks), Vec::new());
    if rim.clarity > ground.clarity { rim } else { ground }
}

/// The rim taken for ground: a surface through it runs under all shapes, whatever the light.
fn along_rim(blocks: &Blocks) -> Candidate {
    Candidate { is_ground: blocks.samples.iter().map(|s| is_along_rim(blocks, s)).collect() }
}

/// Whether a block lies as near to the frame's edge as those that vote for the ground.
fn is_along_rim(blocks: &Blocks, sample: &Sample) -> bool {
    let (columns, rows) = (blocks.columns, blocks.rows);
    let depth = (RIM_DEPTHS[RIM_DEPTHS.len() - 1] * columns.min(rows) as f64) as usize;
    let is_near = |at: u32, count: usize| at as usize <= depth || at as usize + depth + 1 >= count;
    is_near(sample.column, columns) || is_near(sample.row, rows)
}

/// Where the ground ends among residuals below a limit, if a class of them stands out from it that hardly reaches the rim.
fn nearer_class<I: Iterator<Item = f32>>(
    histogram: &Histogram,
    limit: f32,
    sigma: f32,
    rim: impl Fn() -> I,
) -> Option<f32> {
    let split = histogram.split(0.0..limit);
    let nearer = split.threshold.max(OUTLIER * sigma).max(MIN_RESIDUAL);
    let stands_out = nearer < limit && split.mean_above >= CLEAR * sigma;
    if !stands_out || !is_apart(histogram, &(0.0..limit), &split, &(0.0..split.threshold)) {
        return None;
    }
    let [within, of_ground] = [limit, nearer].map(|limit| rim().filter(|r| *r < limit).count() as f64);
    (of_ground >= CLEAN_SHARE * within).then_some(nearer)
}

/// Fits the ground to a class of blocks, and finds what stands out from it; `residual` is memory to be used again.
fn fit(blocks: &Blocks, candidate: Candidate, residual: Vec<f32>) -> Ground {
    let Candidate { mut is_ground } = candidate;
    let mut ground = Ground::default();
    let as_is = |mean| mean;
    let mut residuals = vec![0.0; is_ground.len()];
    for _ in 0..ROUNDS {
        ground.surfaces = blocks
            .sampled
            .iter()
            .map(|levels| fit_surface(blocks, levels, &is_ground, CLASS_SAMPLES, &as_is))
            .collect();
        ground.metric = metric(blocks, &ground.surfaces, &is_ground);
        widely!(fill_sampled(blocks, &ground, &mut residuals));
        let of_ground = residuals.iter().zip(&is_ground).filter(|(_, g)| **g);
        let scatter: Vec<f32> = of_ground.step_by(SCATTER_STEP).map(|(r, _)| *r).collect();
        let sigma = median(&scatter) / if ground.surfaces.len() == 1 { NORMAL_MAD } else { LARGEST_OF_THREE };
        let histogram = Histogram::of(&residuals);
        let standing_out = histogram.split(ALL).mean_above;
        ground.scatter = sigma;
        ground.clarity = standing_out / sigma.max(f32::MIN_POSITIVE);
        let outlier = OUTLIER * sigma;
        let outlier = if ground.clarity >= CLASS_CLARITY { outlier.min(standing_out / 2.0) } else { outlier };
        ground.threshold = outlier.max(MIN_RESIDUAL).max(MIN_RELATIVE_RESIDUAL * standing_out);
        // Whatever is nearer to the ground than to the shapes may be ground, shadows included; the next fit is robust. What lies between the two as a class of its own and not along the rim is print.
        let mut half = (standing_out / 2.0).max(ground.threshold);
        let rim = || {
            let all = blocks.samples.iter().zip(&residuals);
            all.filter(|(sample, _)| is_along_rim(blocks, sample)).map(|(_, residual)| *residual)
        };
        while let Some(nearer) = nearer_class(&histogram, half, sigma, rim) {
            half = nearer;
        }
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
    ground.clipping = clipping(blocks, &is_ground);
    let fit = |level: &dyn Fn(f32) -> f32| {
        blocks.sampled.iter().map(|sampled| fit_surface(blocks, sampled, &is_ground, LEVEL_SAMPLES, level)).collect()
    };
    if ground.clipping.is_none() {
        ground.surfaces = fit(&as_is);
    }
    let mut residual = residual;
    residual.resize(blocks.columns * blocks.rows, 0.0);
    widely!(fill_residuals(blocks, &ground, &mut residual));
    ground.residual = residual;
    if let Some(clipping) = &ground.clipping {
        ground.surfaces = fit(&|mean| clipping.level(mean));
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
#[inline(always)]
fn fill_residuals(blocks: &Blocks, ground: &Ground, residual: &mut [f32]) {
    for (row, residuals) in residual.chunks_exact_mut(blocks.columns).enumerate() {
        let values = |c: usize| blocks.planes[c][row * blocks.columns..][..blocks.columns].iter().copied();
        ground.along(row as f64, 0.0, 1.0).fill_differences(values, residuals);
    }
}

/// The same of [`Blocks::samples`].
#[inline(always)]
fn fill_sampled(blocks: &Blocks, ground: &Ground, residuals: &mut [f32]) {
    let mut from = 0;
    for samples in blocks.samples.chunk_by(|a, b| a.row == b.row) {
        let (first, to) = (samples[0], from + samples.len());
        let values = |c: usize| blocks.sampled[c][from..to].iter().copied();
        let row = ground.along(f64::from(first.row), f64::from(first.column), blocks.sample_step as f64);
        row.fill_differences(values, &mut residuals[from..to]);
        from = to;
    }
}

/// What noise does to the levels of a frame, if it reaches beyond black or white anywhere.
fn clipping(blocks: &Blocks, is_ground: &[bool]) -> Option<Clipping> {
    let [low, high] = widely!(blocks.sampled.iter().fold([u32::MAX, 0], |range, levels| bits_range(levels, range)));
    let range = [low, high].map(f32::from_bits);
    Clipping::of(noise(blocks, is_ground), range)
}

/// The range of some bits, and of those of levels, which are whole numbers in the same order: none is negative.
#[inline(always)]
fn bits_range(levels: &[f32], range: [u32; 2]) -> [u32; 2] {
    levels.iter().map(|level| level.to_bits()).fold(range, |[low, high], bits| [low.min(bits), high.max(bits)])
}

/// Standard deviation of the grey levels of a frame's ground, from differences of neighbouring pixels.
fn noise(blocks: &Blocks, is_ground: &[bool]) -> f32 {
    /// Median of the absolute difference of two normal numbers, in standard deviations.
    const MEDIAN: f32 = 0.953_9;
    let of_ground = blocks.steps.iter().zip(is_ground.iter().step_by(NOISE_STEP)).filter(|(_, is_ground)| **is_ground);
    median(&of_ground.map(|(step, _)| f32::from(*step)).collect::<Vec<_>>()) / MEDIAN
}

/// Fits a surface to the ground's blocks, or to so many of them, about; `level` gives the level that a mean stands for.
fn fit_surface(
    blocks: &Blocks,
    sampled: &[f32],
    is_ground: &[bool],
    most: usize,
    level: &dyn Fn(f32) -> f32,
) -> Surface {
    let total = is_ground.iter().filter(|g| **g).count();
    let stride = (total / most).max(1);
    let all = blocks.samples.iter().zip(sampled).zip(is_ground);
    let chosen = all.filter(|(_, is_ground)| **is_ground).step_by(stride);
    let samples = chosen.map(|((s, mean), _)| ([f64::from(s.column), f64::from(s.row)], level(*mean)));
    Surface::fit([blocks.columns, blocks.rows], samples)
}
