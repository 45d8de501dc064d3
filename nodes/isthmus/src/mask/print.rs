//! Print that comes near the ground's level, told from the ground.
//!
//! # Method
//! The border of print lies half-way between the ground and the shape's level close by, which blocks of pixels tell as long as it varies little from one to the next. A dark
//! tab on a dark ground is beyond half-way nowhere then, and lost.
//! 1. *Reach*: what stands out from the ground at all, however little, and hangs together with the shape; holes filled.
//! 2. *Trial*: the border half-way to the level of the nearest place within it beyond the blur of the edge.
//! 3. *Verdict*, where that is another border than half-way to the levels by blocks: what lies between the two is print if the trial's border is about as crisp there, over some pixels
//!    along it, as the rest of the border, and the level beside it is no glare's. Shadows and glow rise slowly. If most of it has the colour that the ground has in shadow, all stays as it was.
//! 4. *Result*: the same border once more, without what is no print.
//!
//! # Cost
//! Linear in the pixels of the crop, and some tens of bytes for each; only for shapes whose level is that of print, or with weak blocks deep within their reach: some ten milliseconds for one of 200 px.

use super::crop::Crop;
use super::frame::Frame;
use super::levels::in_blocks;
use super::shadows::{box_mean, neighbours};
use super::standing::{NOBODY, Standing};
use super::statistics::median;
use std::collections::VecDeque;

/// Larger crops are left as they are: pieces are smaller, and each pixel takes some tens of bytes.
const MOST_PIXELS: usize = 1 << 22;
/// Depths that are told apart, in pixels: no edge worth measuring is wider.
const MAX_DEPTH: u8 = 24;
/// An edge's blur is left behind where the median level is this part of the shape's: of that at places so many pixels further in, or of that at near places.
const SETTLED: f32 = 0.93;
const FURTHER: u8 = 3;
/// How far beyond the depth where levels are measured pixels are told by them: an edge's blur, and some more.
const BEYOND: usize = 8;
/// Half the side of the square over which the nearest level is measured.
const NEAR: usize = 3;
/// If the least level there is less than this part of the mean, print changes there, and a border half-way to the mean would leave out the weaker side of it.
const CHANGE: f32 = 0.85;
/// Half the width of nicks that are closed, in pixels.
const NICK: usize = 2;
/// Where less than this part of a square about it, so many pixels to either side, lies between two borders, the border stays as it is by blocks, which is smoother: half a pixel
/// between the two makes a tenth.
const APART: usize = 2;
const LEAST_APART: f32 = 0.25;
/// How far inside and outside of the border levels are compared, in pixels from the last one within.
const INSIDE: f32 = 1.5;
const OUTSIDE: f32 = 2.5;
/// Half the side of the square over which the border's crispness is measured, in pixels.
const ALONG: usize = 8;
/// Least step of print, as a part of the median step of the rest: of shadows in rendered scenes nine of ten have less than 0.56, of print three of four more.
const CRISP: f32 = 0.6;
/// How far beyond the levels of ground and shape noise may go, as a part of the contrast.
const OVERSHOOT: f32 = 0.2;
/// Cosine of the angle between a difference and that of black from which on it is one in brightness alone.
const SAME_HUE: f32 = 0.9;
/// What stands out by less than this part of the level of the rest may be glare: a scanner's lid and lens leave 0.04 to 0.17 beside bright pieces...
const FAINT: f32 = 0.2;
/// ... most of it less than this, ...
const FAINTEST: f32 = 0.1;
/// ... and what is more has seldom such steps.
const CRISP_IF_FAINT: f32 = 0.8;
/// Beside shadows more than this part of the doubtful border has their colour (0.8 to 1), beside print of many colours less (up to 0.4).
const SHADED: f32 = 0.6;
/// No place.
const NOWHERE: usize = usize::MAX;

/// Finds print, keeping its buffers from one component to the next.
#[derive(Debug, Clone, Default)]
pub(super) struct Print {
    width: usize,
    height: usize,
    /// Difference of each pixel from the ground, channel by channel, in the ground's metric.
    differences: Vec<Vec<f32>>,
    /// Their means over squares as large as a block.
    smooth: Vec<Vec<f32>>,
    /// Length of these.
    length: Vec<f32>,
    /// The ground's colour in the middle, in the metric: black is as far from it the other way.
    ground: [f32; 3],
    /// Depth within the reach or the border found last, in steps from pixel to pixel.
    depth: Vec<u8>,
    /// The place whose level tells how far a pixel is from ground to shape: itself if it lies that deep, or [`NOWHERE`].
    source: Vec<usize>,
    /// How far off that is, squared; more than any if it is nowhere.
    away: Vec<usize>,
    /// The level of the shape at a source.
    level: Vec<f32>,
    queue: VecDeque<usize>,
}

impl Crop {
    /// Makes shape of what belongs to a printed component though it is near the ground's level; whether there is any. To be labelled again then.
    pub(super) fn recover_print(
        &mut self,
        frame: &Frame<'_>,
        standing: &Standing<'_>,
        k: usize,
        print: &mut Print,
    ) -> bool {
        if self.pixels.len() > MOST_PIXELS {
            return false;
        }
        let range = self.shape_level - self.ground_level;
        let by_blocks: Vec<f32> = self.pixels.iter().map(|p| (f32::from(*p) - self.ground_level) / range).collect();
        print.measure(self, frame, standing, k);
        let Some(levels) = print.find(&by_blocks, standing.ground.weak_threshold(), self.is_print) else {
            return false;
        };
        for (pixel, level) in self.pixels.iter_mut().zip(levels) {
            let level = level.clamp(-OVERSHOOT, 1.0 + OVERSHOOT);
            *pixel = (self.ground_level + range * level).round().clamp(0.0, 255.0) as u8;
        }
        true
    }
}

impl Print {
    /// Takes the differences of the crop's pixels from the ground; what belongs to other components is ground.
    fn measure(&mut self, crop: &Crop, frame: &Frame<'_>, standing: &Standing<'_>, k: usize) {
        let Standing { blocks, ground, owner, .. } = *standing;
        (self.width, self.height) = (crop.width, crop.height);
        self.differences.resize_with(ground.surfaces.len(), Vec::new);
        for plane in &mut self.differences {
            plane.clear();
            plane.resize(self.width * self.height, 0.0);
        }
        let channels = frame.format.channels();
        let own = |x: usize, y: usize| {
            let owner = owner[y / blocks.size * blocks.columns + x / blocks.size];
            owner == NOBODY || owner == k as u32
        };
        let columns = crop.x.max(0) as usize..frame.width.min((crop.x + self.width as i32) as usize);
        let rows = crop.y.max(0) as usize..frame.height.min((crop.y + self.height as i32) as usize);
        for y in rows {
            let begin = (y as i32 - crop.y) as usize * self.width;
            let along = ground.along(
                in_blocks(y, blocks.size),
                in_blocks(columns.start, blocks.size),
                1.0 / blocks.size as f64,
            );
            let pixels = frame.row(y)[columns.start * channels..].chunks_exact(channels);
            for (i, (x, pixel)) in columns.clone().zip(pixels).enumerate().filter(|(_, (x, _))| own(*x, y)) {
                let at = begin + (x as i32 - crop.x) as usize;
                for (plane, d) in self.differences.iter_mut().zip(along.difference(i, pixel)) {
                    plane[at] = d;
                }
            }
        }
        let smooth = |plane: &Vec<f32>| box_mean(plane, [self.width, self.height], (blocks.size / 2).max(1));
        self.smooth = self.differences.iter().map(smooth).collect();
        self.ground = ground.colour(
            [(crop.x, self.width), (crop.y, self.height)]
                .map(|(from, side)| (f64::from(from) + side as f64 / 2.0) / blocks.size as f64),
        );
        let length = |k: usize| self.smooth.iter().map(|plane| plane[k] * plane[k]).sum::<f32>().sqrt();
        self.length.clear();
        self.length.extend((0..self.width * self.height).map(length));
    }

    /// The levels of the crop with its print, in parts of the contrast, if there is any that its levels by blocks leave out.
    fn find(&mut self, by_blocks: &[f32], threshold: f32, is_print: bool) -> Option<Vec<f32>> {
        let stands_out = |k: usize| self.smooth.iter().any(|plane| plane[k].abs() > threshold);
        let stands_out: Vec<bool> = (0..self.length.len()).map(stands_out).collect();
        self.find_depth(|k| stands_out[k] && by_blocks[k] > 0.5, |k| stands_out[k]);
        let deep = self.plateau()?;
        self.find_sources(deep);
        let trial: Vec<f32> = (0..self.length.len()).map(|k| self.relative(k, k)).collect();
        self.follow(&trial)?;
        let is_elsewhere = self.is_elsewhere(by_blocks, &trial);
        let is_crisp = self.crisp(by_blocks, &is_elsewhere)?;
        let near =
            |print: &Self, k: usize| if print.source[k] == NOWHERE { by_blocks[k] } else { print.relative(k, k) };
        let second = |k: usize| if is_crisp[k] { near(self, k) } else { by_blocks[k] };
        let second: Vec<f32> = (0..by_blocks.len()).map(second).collect();
        self.follow(&second)?;
        let is_nick = self.nicks(&second, &stands_out);
        let third = |k: usize| if is_nick[k] { 1.0 } else { near(self, k) };
        let third: Vec<f32> = (0..by_blocks.len()).map(third).collect();
        let is_elsewhere = self.is_elsewhere(by_blocks, &third);
        // The blocks' levels of a shape of one level are better than those of near places where they tell it.
        let result = |k: usize| if is_elsewhere[k] && (is_print || is_crisp[k]) { third[k] } else { by_blocks[k] };
        Some((0..by_blocks.len()).map(result).collect())
    }

    /// The depth within the reach from which on levels are the shape's own: on the middle they do not change further in.
    fn plateau(&self) -> Option<u8> {
        let mut steps: [Vec<f32>; MAX_DEPTH as usize] = Default::default();
        let inner = |k: usize| neighbours(k, self.width, self.height).find(|j| self.depth[*j] == self.depth[k] + 1);
        for k in (0..self.depth.len()).filter(|k| (1..MAX_DEPTH - FURTHER).contains(&self.depth[*k])) {
            if let Some(further) = (0..FURTHER).try_fold(k, |k, _| inner(k)) {
                steps[usize::from(self.depth[k])].push(self.length[k] / self.length[further].max(f32::MIN_POSITIVE));
            }
        }
        (2..MAX_DEPTH - FURTHER).find(|depth| median(&steps[usize::from(*depth)]) >= SETTLED)
    }

    /// Near which parts of the border what it takes in is print, if any.
    fn crisp(&self, by_blocks: &[f32], is_elsewhere: &[bool]) -> Option<Vec<bool>> {
        let count = self.depth.len();
        let [mut steps, mut levels, mut places] = [(); 3].map(|()| vec![0.0; count]);
        let (mut usual, mut shadows) = (Vec::new(), 0);
        for k in (0..count).filter(|k| self.depth[*k] == 1 && self.source[*k] != NOWHERE) {
            if !is_elsewhere[k] {
                usual.push(self.step(k));
            } else if by_blocks[k] <= 0.5 {
                let level = self.level[self.source[k]];
                shadows += usize::from(self.may_be_shadow(k));
                (steps[k], levels[k], places[k]) = (level * self.step(k), level, 1.0);
            }
        }
        if shadows as f32 >= SHADED * places.iter().sum::<f32>() {
            return None;
        }
        let usual = median(&usual);
        let body = (0..count).filter(|k| by_blocks[*k] > 0.5).map(|k| self.length[k]).collect::<Vec<_>>();
        let body = median(&body);
        let [steps, levels, places] = [steps, levels, places].map(|l| box_mean(&l, [self.width, self.height], ALONG));
        let is_print = |k: usize| {
            let crisp = if levels[k] < FAINT * body * places[k] { CRISP_IF_FAINT } else { CRISP };
            levels[k] > FAINTEST * body * places[k] && steps[k] >= crisp * usual * levels[k]
        };
        let is_print: Vec<bool> = (0..count).map(is_print).collect();
        (usual > 0.0 && is_print.contains(&true)).then_some(is_print)
    }

    /// Whether a pixel differs from the ground as if there were less light on it.
    fn may_be_shadow(&self, k: usize) -> bool {
        let along: f32 = self.smooth.iter().zip(self.ground).map(|(plane, g)| plane[k] * g).sum();
        let ground = self.ground.iter().map(|g| g * g).sum::<f32>().sqrt();
        along < -SAME_HUE * ground * self.length[k]
    }

    /// The step across the border at a pixel of it, as a part of the level further in.
    fn step(&self, k: usize) -> f32 {
        let source = self.source[k];
        let place = |k: usize| [(k % self.width) as f32, (k / self.width) as f32];
        let ([x, y], [u, v]) = (place(k), place(source));
        let away = (x - u).hypot(y - v).max(1.0);
        let at = |steps: f32| {
            let along = |from: f32, to: f32, count: usize| {
                (from + steps * (from - to) / away).round().clamp(0.0, (count - 1) as f32) as usize
            };
            self.relative(along(y, v, self.height) * self.width + along(x, u, self.width), k)
                .clamp(-OVERSHOOT, 1.0 + OVERSHOOT)
        };
        at(-INSIDE) - at(OUTSIDE)
    }

    /// Depth within what is set and hangs together with seeds, which are set; holes filled.
    fn find_depth(&mut self, is_seed: impl Fn(usize) -> bool, is_set: impl Fn(usize) -> bool) {
        let Self { width, height, depth, queue, .. } = self;
        let (width, height) = (*width, *height);
        let mut inside = vec![false; width * height];
        queue.extend((0..width * height).filter(|k| is_seed(*k)));
        queue.iter().for_each(|k| inside[*k] = true);
        while let Some(k) = queue.pop_front() {
            for j in neighbours(k, width, height) {
                if !inside[j] && is_set(j) {
                    inside[j] = true;
                    queue.push_back(j);
                }
            }
        }
        // What the ground along the rim does not reach is within, as holes are.
        depth.clear();
        depth.resize(width * height, u8::MAX);
        let across = (0..width).flat_map(|x| [x, (height - 1) * width + x]);
        let down = (0..height).flat_map(|y| [y * width, y * width + width - 1]);
        let mut front = VecDeque::new();
        for k in across.chain(down).filter(|k| !inside[*k]) {
            depth[k] = 0;
            queue.push_back(k);
        }
        while let Some(k) = queue.pop_front() {
            for j in neighbours(k, width, height) {
                if inside[j] {
                    front.push_back(k);
                } else if depth[j] > 0 {
                    depth[j] = 0;
                    queue.push_back(j);
                }
            }
        }
        while let Some(k) = front.pop_front() {
            for j in neighbours(k, width, height) {
                if depth[j] == u8::MAX && depth[k] < MAX_DEPTH {
                    depth[j] = depth[k] + 1;
                    front.push_back(j);
                }
            }
        }
    }

    /// The depth from which on levels are the shape's own, the edge's blur left behind.
    fn settled(&self, levels: &[f32]) -> Option<u8> {
        let mut by_depth: [Vec<f32>; MAX_DEPTH as usize + 1] = Default::default();
        for (depth, level) in self.depth.iter().zip(levels).filter(|(depth, _)| (1..=MAX_DEPTH).contains(*depth)) {
            by_depth[usize::from(*depth)].push(*level);
        }
        (2..MAX_DEPTH).find(|depth| median(&by_depth[usize::from(*depth)]) >= SETTLED)
    }

    /// Finds for each pixel about the border the nearest place of a depth, and the levels there.
    fn find_sources(&mut self, deep: u8) {
        let Self { width, height, depth, source, away, level, length, queue, .. } = self;
        let (width, height) = (*width, *height);
        let most = (usize::from(deep) + BEYOND).pow(2);
        let place = |k: usize| (k % width, k / width);
        let square = |(x, y): (usize, usize), radius: usize| {
            let columns = x.saturating_sub(radius)..width.min(x + radius + 1);
            (y.saturating_sub(radius)..height.min(y + radius + 1))
                .flat_map(move |v| columns.clone().map(move |u| (u, v, v * width + u)))
        };
        source.clear();
        source.extend((0..depth.len()).map(|k| if depth[k] >= deep { k } else { NOWHERE }));
        away.clear();
        away.resize(depth.len(), most + 1);
        level.clear();
        level.resize(depth.len(), 1.0);
        for k in (0..depth.len()).filter(|k| depth[*k] == deep) {
            let near = square(place(k), NEAR).filter(|(.., j)| depth[*j] == deep).map(|(.., j)| length[j]);
            let (least, sum, count) =
                near.fold((f32::MAX, 0.0, 0.0), |(least, sum, count), l| (l.min(least), sum + l, count + 1.0));
            let mean = sum / count;
            level[k] = if least < CHANGE * mean { least } else { mean };
            queue.push_back(k);
        }
        while let Some(k) = queue.pop_front() {
            let (x, y) = place(source[k]);
            for (u, v, j) in square(place(k), 1).filter(|(.., j)| depth[*j] < deep) {
                let distance = u.abs_diff(x).pow(2) + v.abs_diff(y).pow(2);
                if distance < away[j] {
                    (source[j], away[j]) = (source[k], distance);
                    queue.push_back(j);
                }
            }
        }
    }

    /// How far a pixel is from ground to shape by the level at the source of another.
    fn relative(&self, k: usize, of: usize) -> f32 {
        match self.source[of] {
            NOWHERE => 0.0,
            source if source == k => 1.0,
            source => {
                let along: f32 = self.smooth.iter().zip(&self.differences).map(|(s, d)| s[k] * d[k]).sum();
                along / (self.length[k] * self.level[source]).max(f32::MIN_POSITIVE)
            }
        }
    }

    /// Takes the border of a shape from levels, and the sources about it.
    fn follow(&mut self, levels: &[f32]) -> Option<()> {
        self.find_depth(|k| levels[k] > 0.5, |k| levels[k] > 0.5);
        let deep = self.settled(levels)?;
        self.find_sources(deep + 1);
        Some(())
    }

    /// What stands out and lies in a nick of the border, where print changes: what a closing adds to the shape.
    fn nicks(&self, levels: &[f32], stands_out: &[bool]) -> Vec<bool> {
        let shape: Vec<bool> = levels.iter().map(|level| *level > 0.5).collect();
        let closed = self.eroded(&self.dilated(&shape, NICK), NICK);
        (0..shape.len()).map(|k| closed[k] && stands_out[k] && !shape[k]).collect()
    }

    /// Where two borders are apart by more than a pixel or two, and about there.
    fn is_elsewhere(&self, a: &[f32], b: &[f32]) -> Vec<bool> {
        let between: Vec<bool> = a.iter().zip(b).map(|(a, b)| (*a > 0.5) != (*b > 0.5)).collect();
        let apart: Vec<bool> = self.shares(&between, APART).map(|share| share > LEAST_APART).collect();
        self.dilated(&apart, BEYOND)
    }

    /// Which part of the square about each pixel is set.
    fn shares(&self, set: &[bool], radius: usize) -> impl Iterator<Item = f32> + use<> {
        let levels: Vec<f32> = set.iter().map(|set| f32::from(u8::from(*set))).collect();
        box_mean(&levels, [self.width, self.height], radius).into_iter()
    }

    /// What is within so many rows and columns of what is set.
    fn dilated(&self, set: &[bool], radius: usize) -> Vec<bool> {
        // Half a pixel: means are no exact numbers.
        let least = 0.5 / (2 * radius + 1).pow(2) as f32;
        self.shares(set, radius).map(|share| share > least).collect()
    }

    /// What is farther than so many rows and columns from what is not set.
    fn eroded(&self, set: &[bool], radius: usize) -> Vec<bool> {
        let open: Vec<bool> = set.iter().map(|set| !set).collect();
        self.dilated(&open, radius).into_iter().map(|open| !open).collect()
    }
}
