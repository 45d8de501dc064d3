//! A component with its surroundings, cut out of the frame pixel by pixel, in a form in which half-way between two fixed levels is the border.

use super::frame::{Frame, PixelFormat};
use super::levels::{Levels, RowSource};
use super::runs::{Component, Components};
use super::segmentation::Parameters;
use super::standing::{NOBODY, Standing};
use super::statistics::{median, quantile};
use super::threads::Threads;
use crate::Point;
use crate::cutout::{Aoi, Cutout};

/// Pixels of ground round a shape in its cutout: room for the blur that the contour may need.
const MARGIN: usize = 8;
/// Greatest contrast of a cutout that had to be divided by the local contrast, in grey levels: shape and ground keep some room.
const MAX_DIVIDED_CONTRAST: f32 = 180.0;
/// Standard deviations of noise for which there is room beyond the levels of such a cutout: clipping is a bias.
const DIVIDED_ROOM: f32 = 4.0;
/// Neighbours of a shape smaller than this, in pixels, stay in its cutout: noise makes them of the outer half of a blurred edge, and
/// without them, as without the holes in its inner half, the edge would lie elsewhere.
const MIN_ERASED: usize = 16;
/// Most differences of neighbouring pixels looked at to measure the noise: beyond, the figure gets no better.
const NOISE_SAMPLES: usize = 2_000;
/// Half the width of the cut between two shapes, in pixels: pixels on either side of it are no neighbours.
const CUT: f64 = 1.0;

/// Most pixels on either side of a thread's middle: of a shape however large more is not thin.
const MAX_THREAD_REACH: usize = 3;
/// Blur of a thread's edge, in pixels.
const THREAD_BLUR: usize = 1;
/// Most noise at which threads are told, as a part of the contrast: at half the contrast being eight standard deviations away, no pixel is on
/// the wrong side by chance. More tears the edges of shapes to threads.
const MAX_THREAD_NOISE: f32 = 1.0 / 16.0;

/// The surroundings of a component.
#[derive(Debug, Clone, Default)]
pub(super) struct Crop {
    pub(super) x: i32,
    pub(super) y: i32,
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) pixels: Vec<u8>,
    pub(super) shape_level: f32,
    pub(super) ground_level: f32,
    pub(super) noise_level: f32,
    /// Contrast in the grey levels of the frame.
    pub(super) contrast: f32,
    /// Whether parts of it may come near the ground's level: it is print, or has weak blocks.
    pub(super) may_be_more: bool,
}

impl Crop {
    /// Cuts a component's surroundings out of the frame.
    pub(super) fn take(&mut self, frame: &Frame<'_>, standing: &Standing<'_>, k: usize) {
        let Standing { blocks, ground, components, owner } = *standing;
        let (block, columns) = (blocks.size, blocks.columns);
        let levels = Levels::of(standing, k);
        self.may_be_more = levels.is_print() || standing.has_weak_part(k, levels.contrast);
        let c = if self.may_be_more { standing.reach(k) } else { components.list[k] };
        let margin = MARGIN + block;
        let mut rows = RowSource { frame, ground, block, lines: Default::default() };
        (self.x, self.y) = ((c.left * block) as i32 - margin as i32, (c.top * block) as i32 - margin as i32);
        self.width = (c.right - c.left) * block + 2 * margin;
        self.height = (c.bottom - c.top) * block + 2 * margin;
        self.contrast = levels.contrast;
        let plain = levels.is_uniform() && frame.format == PixelFormat::Grey;
        if plain {
            (self.shape_level, self.ground_level) = (levels.ground + levels.sense * levels.contrast, levels.ground);
        } else if levels.is_uniform() && levels.hue.is_none() {
            (self.shape_level, self.ground_level) = (levels.contrast, 0.0);
        } else {
            // Half the contrast and the room above it fill half the scale.
            let noise = ground.scatter * block as f32 / levels.contrast.max(f32::MIN_POSITIVE);
            let contrast = (127.5 / (0.5 + DIVIDED_ROOM * noise)).min(MAX_DIVIDED_CONTRAST);
            (self.shape_level, self.ground_level) = (127.5 + contrast / 2.0, 127.5 - contrast / 2.0);
        }
        // Sums of rounded numbers, and surfaces through them, may lie beyond the 8-bit scale; no pixel does.
        for level in [&mut self.shape_level, &mut self.ground_level] {
            *level = level.clamp(0.0, 255.0);
        }
        let ground_pixel = self.ground_pixel();
        // Each pixel is written below.
        self.pixels.resize(self.width * self.height, ground_pixel);
        let x = self.x;
        let from = x.max(0) as usize;
        let to = frame.width.min((x + self.width as i32) as usize);
        let before = (from as i32 - x) as usize;
        let label = k as u32;
        for (row, line) in self.pixels.chunks_exact_mut(self.width).enumerate() {
            let y = self.y + row as i32;
            if y < 0 || y >= frame.height as i32 {
                line.fill(ground_pixel);
                continue;
            }
            let y = y as usize;
            let owners = &owner[y / block * columns..][..columns];
            let (left, rest) = line.split_at_mut(before);
            let (out, right) = rest.split_at_mut(to - from);
            left.fill(ground_pixel);
            right.fill(ground_pixel);
            if plain {
                out.copy_from_slice(&frame.row(y)[from..to]);
            } else {
                levels.fill_row(&mut rows, (y, from), out, [self.shape_level, self.ground_level]);
            }
            // What belongs to other components is made ground.
            let within = from / block..to.div_ceil(block);
            let is_foreign = |owner: u32| owner != label && owner != NOBODY;
            if owners[within.clone()].iter().fold(0, |count, owner| count + u32::from(is_foreign(*owner))) == 0 {
                continue;
            }
            for (column, owner) in within.clone().zip(&owners[within]) {
                if is_foreign(*owner) {
                    let (start, end) = ((column * block).max(from), ((column + 1) * block).min(to));
                    out[start - from..end - from].fill(ground_pixel);
                }
            }
        }
        self.noise_level = self.noise(standing, k);
    }

    /// Standard deviation of the grey levels, from differences of neighbouring pixels, in shape and ground; the larger.
    fn noise(&self, standing: &Standing<'_>, k: usize) -> f32 {
        /// Lower quartile and median of the absolute difference of two normal numbers, in standard deviations.
        const QUARTILE: f32 = 0.450_6;
        const MEDIAN: f32 = 0.953_9;
        let Standing { blocks, ground, owner, .. } = *standing;
        let (block, columns) = (blocks.size, blocks.columns);
        let (mut shape, mut clear) = (Vec::new(), Vec::new());
        let step = (self.width * self.height / NOISE_SAMPLES).max(1);
        let (mut across, mut down) = (0, 0);
        for at in (0..self.pixels.len() - 1).step_by(step) {
            let (x, y) = (self.x + across as i32, self.y + down);
            let is_last = across + 1 == self.width;
            across += step;
            while across >= self.width {
                (across, down) = (across - self.width, down + 1);
            }
            let (column, row) = (x.max(0) as usize / block, y.max(0) as usize / block);
            if x < 0 || y < 0 || column >= columns || row >= blocks.rows || is_last {
                continue;
            }
            let here = row * columns + column;
            let is_clear = owner[here] == NOBODY;
            if !is_clear && owner[here] != k as u32 {
                continue;
            }
            let (before, after) = (column.saturating_sub(1), (column + 1).min(columns - 1));
            let neighbours = [row * columns + before, row * columns + after, row.saturating_sub(1) * columns + column];
            let stands_out = |b: &usize| ground.residual[*b] > ground.threshold;
            let difference = f32::from(self.pixels[at].abs_diff(self.pixels[at + 1]));
            if is_clear {
                clear.push(difference);
            } else if stands_out(&here) && neighbours.iter().all(stands_out) {
                shape.push(difference);
            }
        }
        // Print and texture are not noise: half of a shape is free of them.
        (quantile(&shape, 0.25) / QUARTILE).max(median(&clear) / MEDIAN)
    }

    /// Connects the pixels that are beyond half-way from ground to shape.
    pub(super) fn label(&self, components: &mut Components) {
        let level = (self.shape_level + self.ground_level) / 2.0;
        components.clear();
        for (y, row) in self.pixels.chunks_exact(self.width).enumerate() {
            components.begin_row(y);
            if self.shape_level > self.ground_level {
                let least = level.floor() as u8;
                components.add_row(row, |p| p > least);
            } else {
                let most = level.ceil() as u8;
                components.add_row(row, |p| p < most);
            }
        }
        components.close();
    }

    /// Makes ground of the threads that hang on the shapes found: hairs, fluff; whether there are any. To be labelled again then.
    pub(super) fn erase_threads(
        &mut self,
        components: &Components,
        threads: &mut Threads,
        parameters: &Parameters,
    ) -> bool {
        if self.noise_level > MAX_THREAD_NOISE * (self.shape_level - self.ground_level).abs() {
            return false;
        }
        let ground = self.ground_pixel();
        let mut any = false;
        for (label, c) in components.list.iter().enumerate().filter(|(_, c)| c.area >= parameters.min_area) {
            let reach = ((parameters.max_thread / 2.0 * (c.area as f64).sqrt()).round() as usize).min(MAX_THREAD_REACH);
            if reach == 0 {
                continue;
            }
            for run in threads.find(components, label, reach) {
                any = true;
                let columns = run.start.saturating_sub(THREAD_BLUR)..self.width.min(run.end + THREAD_BLUR);
                for row in run.row.saturating_sub(THREAD_BLUR)..self.height.min(run.row + THREAD_BLUR + 1) {
                    self.pixels[row * self.width..][columns.clone()].fill(ground);
                }
            }
        }
        any
    }

    /// Bounding box of a component in the source frame.
    pub(super) fn aoi(&self, c: &Component) -> Aoi {
        Aoi {
            x: self.x + c.left as i32,
            y: self.y + c.top as i32,
            width: (c.right - c.left) as u32,
            height: (c.bottom - c.top) as u32,
        }
    }

    /// Grey level of ground.
    pub(super) fn ground_pixel(&self) -> u8 {
        self.ground_level.round().clamp(0.0, 255.0) as u8
    }

    /// The part round a component, all others made ground.
    pub(super) fn cutout(&self, components: &Components, index: usize) -> Cutout {
        let c = &components.list[index];
        let (left, top) = (c.left.saturating_sub(MARGIN), c.top.saturating_sub(MARGIN));
        let (right, bottom) =
            (self.width.min(c.right + MARGIN), (self.pixels.len() / self.width).min(c.bottom + MARGIN));
        let width = right - left;
        let mut pixels = Vec::with_capacity(width * (bottom - top));
        for y in top..bottom {
            pixels.extend_from_slice(&self.pixels[y * self.width + left..y * self.width + right]);
        }
        let ground = self.ground_pixel();
        let is_erased = |label: usize| label != index && components.list[label].area >= MIN_ERASED;
        for run in components.runs.iter().filter(|r| is_erased(r.label) && (top..bottom).contains(&r.row)) {
            let (start, end) = (run.start.clamp(left, right), run.end.clamp(left, right));
            pixels[(run.row - top) * width + start - left..(run.row - top) * width + end - left].fill(ground);
        }
        Cutout {
            aoi: self.aoi(c),
            window: Aoi {
                x: self.x + left as i32,
                y: self.y + top as i32,
                width: width as u32,
                height: (bottom - top) as u32,
            },
            pixels,
            shape_level: self.shape_level,
            ground_level: self.ground_level,
            noise_level: self.noise_level,
        }
    }

    /// Makes ground of the pixels along a line, so that what lies on either side comes apart.
    pub(super) fn cut(&mut self, [from, to]: [Point; 2]) {
        let local = |p: Point| Point::new(p.x - f64::from(self.x), p.y - f64::from(self.y));
        let (from, to) = (local(from), local(to));
        let ground = self.ground_pixel();
        let (low, high) = (from.inf(&to), from.sup(&to));
        let rows = self.pixels.len() / self.width;
        let range = |low: f64, high: f64, count: usize| {
            let first = (low - CUT).floor().clamp(0.0, count as f64) as usize;
            first..((high + CUT).ceil() + 1.0).clamp(0.0, count as f64) as usize
        };
        let along = to - from;
        for y in range(low.y, high.y, rows) {
            for x in range(low.x, high.x, self.width) {
                let to = Point::new(x as f64, y as f64) - from;
                let t = (to.dot(&along) / along.norm_squared().max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
                if (to - along * t).norm() <= CUT {
                    self.pixels[y * self.width + x] = ground;
                }
            }
        }
    }
}
