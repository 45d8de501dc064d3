//! Grey levels near a contour: as they are, at half the resolution, or blurred against noise.
//!
//! What is far from the contour is never looked at: the picture is blurred in cells near the contour, in fixed point, eight pixels at a time.

use super::iso::{Picture, Start};
use crate::Point;
use crate::changes::changes;
use crate::wide::widely;
use std::ops::Range;

/// The pixels as they are, of the full picture or of one of less resolution.
#[derive(Clone, Copy)]
pub(super) struct Raw<'a> {
    /// Row by row, `width * height` of them; at least one.
    pub(super) pixels: &'a [u8],
    pub(super) width: usize,
    pub(super) height: usize,
    /// Distance of its pixels in pixels of the full picture.
    pub(super) step: f64,
}

impl Picture for Raw<'_> {
    fn size(&self) -> [usize; 2] {
        [self.width, self.height]
    }

    fn at(&self, x: usize, y: usize) -> f32 {
        f32::from(self.pixels[y * self.width + x])
    }
}

impl Raw<'_> {
    /// Grey level between the pixels of a picture, which is continued by its outermost pixels.
    pub(super) fn between(&self, p: Point) -> f64 {
        let (x, y) = (p.x.clamp(0.0, (self.width - 1) as f64), p.y.clamp(0.0, (self.height - 1) as f64));
        let (i, j) = (x as u32 as usize, y as u32 as usize);
        let (u, v) = (x - i as f64, y - j as f64);
        let first = j * self.width + i;
        let right = usize::from(i + 1 < self.width);
        let below = if j + 1 < self.height { self.width } else { 0 };
        let [a, b, c, d] = [0, right, below, below + right].map(|step| f64::from(self.pixels[first + step]));
        let (upper, lower) = (a + (b - a) * u, c + (d - c) * u);
        upper + (lower - upper) * v
    }

    /// Where rows go over from ground to shape, beyond `level`; `sense` is 1 for a shape brighter than the ground, -1 for a darker one.
    pub(super) fn starts(&self, level: f32, sense: f32, starts: &mut Vec<Start>) {
        starts.clear();
        // A whole number is beyond `level` if it is beyond the whole number next before it, seen from the ground. Outside the levels of a byte,
        // one step further is as good as any.
        let bound = if sense > 0.0 { level.floor() } else { level.ceil() }.clamp(-1.0, 256.0) as i16;
        for (y, row) in self.pixels.chunks_exact(self.width).enumerate() {
            let change = |x, begins| {
                if begins {
                    starts.push(Start { x, y });
                }
            };
            if sense > 0.0 {
                changes(row, |p| i16::from(p) > bound, change);
            } else {
                changes(row, |p| i16::from(p) < bound, change);
            }
        }
    }

    /// A place of the full picture in this one.
    pub(super) fn own(&self, p: Point) -> Point {
        Point::from(p.coords.map(|v| (v + 0.5) / self.step - 0.5))
    }

    /// A place of this picture in the full one.
    pub(super) fn in_full(&self, p: Point) -> Point {
        Point::from(p.coords.map(|v| (v + 0.5) * self.step - 0.5))
    }

    /// Variance of the blur that pixels of this size add to that of the full picture, in its square pixels.
    pub(super) fn variance(&self) -> f64 {
        (self.step * self.step - 1.0) / 12.0
    }

    /// The picture at half the resolution: means of 2 x 2 pixels; of an odd side the last pixel counts twice.
    pub(super) fn halved<'a>(&self, halved: &'a mut Vec<u8>) -> Raw<'a> {
        let (width, height) = (self.width.div_ceil(2), self.height.div_ceil(2));
        halved.resize(width * height, 0);
        for (y, out) in halved.chunks_exact_mut(width).enumerate() {
            let row = |y: usize| &self.pixels[y.min(self.height - 1) * self.width..][..self.width];
            widely!(halve_rows(row(2 * y), row(2 * y + 1), out));
        }
        Raw { pixels: halved, width, height, step: 2.0 * self.step }
    }
}

/// Means of 2 x 2 pixels of two rows.
#[inline(always)]
fn halve_rows(upper: &[u8], lower: &[u8], out: &mut [u8]) {
    let mean = |a: [u8; 2], b: [u8; 2]| {
        let [a, b] = [a, b].map(u16::from_le_bytes);
        (((a & 0xff) + (a >> 8) + (b & 0xff) + (b >> 8) + 2) >> 2) as u8
    };
    let ((upper, upper_rest), (lower, lower_rest)) = (upper.as_chunks(), lower.as_chunks());
    for (out, (a, b)) in out.iter_mut().zip(upper.iter().zip(lower)) {
        *out = mean(*a, *b);
    }
    if let (Some(out), [a], [b]) = (out.get_mut(upper.len()), upper_rest, lower_rest) {
        *out = mean([*a; 2], [*b; 2]);
    }
}

/// The cells of a picture round a contour, blurred.
#[derive(Debug, Clone, Default)]
pub(super) struct Band {
    /// Cells in a row.
    columns: usize,
    /// For each cell where its levels begin, or [`OUTSIDE_BAND`].
    cells: Vec<usize>,
    /// Levels of the cells' pixels, in parts of a grey level.
    levels: Vec<u16>,
    /// Memory for a line of neighbouring cells: blurred across the rows only, and both ways.
    half_blurred: Vec<u16>,
    blurred: Vec<u16>,
}

/// Side of a cell in pixels.
const CELL: usize = 8;
/// Distance of a contour in which pixels are blurred: twice the greatest blur, in pixels of the picture that is blurred.
const REACH: usize = 4;
/// Numbers of two bytes that are blurred together: what registers hold.
const LANES: usize = 16;
const OUTSIDE_BAND: usize = usize::MAX;
/// Parts of a grey level, as a power of two: the sum of two levels just fits in sixteen bits.
const LEVEL_BITS: u32 = 7;
const PARTS: f32 = (1 << LEVEL_BITS) as f32;
/// A Gaussian kernel ends here, in standard deviations.
const KERNEL_EXTENT: f64 = 3.0;

impl Band {
    /// Takes the cells within [`REACH`] of a contour.
    pub(super) fn mark(&mut self, contour: impl Iterator<Item = Point>, [width, height]: [usize; 2]) {
        self.columns = width.div_ceil(CELL);
        let rows = height.div_ceil(CELL);
        self.cells.clear();
        self.cells.resize(self.columns * rows, OUTSIDE_BAND);
        let mut marked = None;
        let cells = |at: f64, count: usize| {
            let at = at as u32 as usize;
            (at.saturating_sub(REACH) / CELL, ((at + REACH) / CELL).min(count - 1))
        };
        for p in contour {
            let (columns, across) = (cells(p.x, self.columns), cells(p.y, rows));
            if marked.replace((columns, across)) == Some((columns, across)) {
                continue;
            }
            for row in across.0..=across.1 {
                // Any number but that of cells outside; what it is follows when all are known.
                self.cells[row * self.columns..][columns.0..=columns.1].fill(0);
            }
        }
        let mut begin = 0;
        for cell in self.cells.iter_mut().filter(|c| **c != OUTSIDE_BAND) {
            *cell = begin;
            begin += CELL * CELL;
        }
        self.levels.resize(begin, 0);
    }

    /// Neighbouring cells of a row: the row, and the columns from the first to one past the last.
    fn stretches(&self) -> impl Iterator<Item = (usize, Range<usize>)> {
        self.cells.chunks_exact(self.columns.max(1)).enumerate().flat_map(|(row, cells)| {
            let mut from = 0;
            std::iter::from_fn(move || {
                let start = from + cells[from..].iter().position(|c| *c != OUTSIDE_BAND)?;
                let count = cells[start..].iter().position(|c| *c == OUTSIDE_BAND);
                from = count.map_or(cells.len(), |count| start + count);
                Some((row, start..from))
            })
        })
    }

    /// Separable Gaussian blur of the marked cells of a picture, which is continued by its outermost pixels; these become `ground` then, so
    /// that contours close within. `starts` becomes where rows of cells go over to what is beyond `level`, as [`Raw::starts`].
    pub(super) fn blur(
        &mut self,
        picture: Raw<'_>,
        sigma: f64,
        ground: f32,
        (level, sense): (f32, f32),
        starts: &mut Vec<Start>,
    ) {
        let weights = kernel(sigma);
        let (width, height) = (picture.width, picture.height);
        let ground = (ground.clamp(0.0, 255.0) * PARTS) as u16;
        // Whole parts; those of a byte's levels are positive numbers of two bytes.
        let bound = (if sense > 0.0 { (level * PARTS).floor() } else { (level * PARTS).ceil() }) as i16;
        let mut half_blurred = std::mem::take(&mut self.half_blurred);
        let mut blurred = std::mem::take(&mut self.blurred);
        let mut levels = std::mem::take(&mut self.levels);
        starts.clear();
        for (row, columns) in self.stretches() {
            let pixels = columns.start * CELL..columns.end * CELL;
            for y in row * CELL..height.min((row + 1) * CELL) {
                widely!(blur_row(picture, y, pixels.clone(), &weights, &mut half_blurred, &mut blurred));
                let line = &mut blurred[..pixels.len()];
                if pixels.start == 0 {
                    line[0] = ground;
                }
                // The picture's last pixel, and what cells have beyond it.
                line[(width - 1 - pixels.start).min(pixels.len())..].fill(ground);
                if y == 0 || y == height - 1 {
                    line.fill(ground);
                }
                let change = |x, begins| {
                    if begins {
                        starts.push(Start { x: pixels.start + x, y });
                    }
                };
                if sense > 0.0 {
                    changes(line, |p| p as i16 > bound, change);
                } else {
                    changes(line, |p| (p as i16) < bound, change);
                }
                for (column, part) in columns.clone().zip(line.as_chunks::<CELL>().0) {
                    levels[self.cells[row * self.columns + column] + y % CELL * CELL..][..CELL].copy_from_slice(part);
                }
            }
        }
        (self.half_blurred, self.blurred, self.levels) = (half_blurred, blurred, levels);
    }
}

/// Blurs pixels of row `y` across the rows (`line`) and then along the row.
#[inline(always)]
fn blur_row(
    picture: Raw<'_>,
    y: usize,
    pixels: Range<usize>,
    weights: &[u16],
    line: &mut Vec<u16>,
    blurred: &mut Vec<u16>,
) {
    blur_across_rows(picture, y, pixels, weights, line);
    blur_along_row(line, weights, blurred);
}

/// Blurs the pixels of row `y` against those above and below, with so many more on either side as blurring along the row needs.
#[inline(always)]
fn blur_across_rows(picture: Raw<'_>, y: usize, pixels: Range<usize>, weights: &[u16], line: &mut Vec<u16>) {
    let (width, height) = (picture.width, picture.height);
    let reach = weights.len() - 1;
    let from = pixels.start.saturating_sub(reach);
    // Some more, lest a few are left that go through the processor one by one.
    let to = width.min(from + (pixels.end + reach - from).next_multiple_of(LANES));
    let row_at = |y: usize| &picture.pixels[y.min(height - 1) * width..][from..to];
    line.clear();
    line.resize(pixels.len().next_multiple_of(LANES) + 2 * reach + LANES, 0);
    // Some may lie beyond the picture.
    let before = reach + from - pixels.start;
    let sums = &mut line[before..before + to - from];
    for (sum, p) in sums.iter_mut().zip(row_at(y)) {
        *sum = scaled(u16::from(*p) << LEVEL_BITS, weights[0]);
    }
    for (offset, &weight) in weights.iter().enumerate().skip(1) {
        let both = row_at(y.saturating_sub(offset)).iter().zip(row_at(y + offset));
        for (sum, (above, below)) in sums.iter_mut().zip(both) {
            *sum += scaled((u16::from(*above) + u16::from(*below)) << LEVEL_BITS, weight);
        }
    }
    let (first, last) = (sums[0], sums[sums.len() - 1]);
    line[..before].fill(first);
    line[before + to - from..].fill(last);
}

/// Blurs a line; what the kernel needs on either side is not of the result.
#[inline(always)]
fn blur_along_row(line: &[u16], weights: &[u16], blurred: &mut Vec<u16>) {
    let reach = weights.len() - 1;
    blurred.resize(line.len() - 2 * reach - LANES, 0);
    for (k, out) in blurred.as_chunks_mut::<LANES>().0.iter_mut().enumerate() {
        let needed = &line[k * LANES..][..LANES + 2 * reach];
        let (left, right) = (&needed[..reach + LANES - 1], &needed[reach + 1..]);
        let mut sums = [0u16; LANES];
        for (sum, level) in sums.iter_mut().zip(&needed[reach..]) {
            *sum = scaled(*level, weights[0]);
        }
        let pairs = left.windows(LANES).rev().zip(right.windows(LANES));
        for (&weight, (left, right)) in weights[1..].iter().zip(pairs) {
            for i in 0..LANES {
                sums[i] += scaled(left[i] + right[i], weight);
            }
        }
        *out = sums;
    }
}

/// Weights of a Gaussian kernel, the middle one and those to either side of it, in parts of 2^16.
fn kernel(sigma: f64) -> Vec<u16> {
    let reach = (KERNEL_EXTENT * sigma).ceil() as usize;
    let weights: Vec<f64> = (0..=reach).map(|i| (-(i as f64).powi(2) / (2.0 * sigma * sigma)).exp()).collect();
    let total = 2.0 * weights.iter().sum::<f64>() - weights[0];
    let mut parts: Vec<u16> = weights.iter().map(|w| (w / total * 65536.0).round().min(65535.0) as u16).collect();
    // Rounding must not change the sum, or a uniform picture would change its level.
    let others: u32 = parts.iter().skip(1).map(|p| 2 * u32::from(*p)).sum();
    parts[0] = 65536u32.saturating_sub(others).min(65535) as u16;
    parts
}

/// A level times a weight in parts of 2^16.
#[inline(always)]
fn scaled(level: u16, weight: u16) -> u16 {
    ((u32::from(level) * u32::from(weight)) >> 16) as u16
}

/// A picture that is blurred near a contour.
#[derive(Clone, Copy)]
pub(super) struct Blurred<'a> {
    pub(super) band: &'a Band,
    pub(super) raw: Raw<'a>,
}

impl Picture for Blurred<'_> {
    fn size(&self) -> [usize; 2] {
        self.raw.size()
    }

    fn at(&self, x: usize, y: usize) -> f32 {
        match self.band.cells[y / CELL * self.band.columns + x / CELL] {
            OUTSIDE_BAND => self.raw.at(x, y),
            cell => f32::from(self.band.levels[cell + y % CELL * CELL + x % CELL]) / PARTS,
        }
    }
}
