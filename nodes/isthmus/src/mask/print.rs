//! Print that comes near the ground's level, told from the ground.
//!
//! # Method
//! The border of print lies half-way between the ground and the shape's level close by, which blocks of pixels tell as long as it varies little from one to the next. A dark
//! tab on a dark ground is beyond half-way nowhere then, and lost.
//! 1. *Reach*: what stands out from the ground at all, however little, and hangs together with the shape; holes filled.
//! 2. *Weak parts* of it: what lies deeper in it than an edge is wide, and is not half-way to the shape's level.
//! 3. *Trial*: the border half-way to the level of the nearest place beyond the blur of the edge, weak parts being shape.
//! 4. *Verdict*: a weak part is print if its border is about as sharp as that of the rest, beside the level that the part has further in. Shadows and glow rise slowly.
//! 5. *Result*: the same border once more, without what is no print.
//!
//! # Cost
//! Linear in the pixels of the crop, and some tens of bytes for each; only for shapes whose level is that of print, some ten milliseconds for one of 200 px.

use super::crop::Crop;
use super::frame::Frame;
use super::levels::in_blocks;
use super::shadows::{box_mean, neighbours};
use super::standing::{NOBODY, Standing};
use super::statistics::{median, quantile};
use std::collections::VecDeque;

/// Larger crops are left as they are: pieces are smaller, and each pixel takes some tens of bytes.
const MOST_PIXELS: usize = 1 << 22;
/// A weak part has so many pixels: fewer are what noise leaves of an edge.
const LEAST_PART: usize = 12;
/// Print of less than one in so many of a shape's pixels changes the border only beside parts of so many pixels: elsewhere the blocks' is
/// smoother, and smaller parts are as often shade between pieces that touch.
const LEAST_SHARE: usize = 1_000;
const LEAST_ALONE: usize = 20;
/// Depths that are told apart, in pixels: no edge worth measuring is wider.
const MAX_DEPTH: u8 = 24;
/// An edge's blur is left behind where the median level is this part of the shape's: in the blocks' levels, which are those of deep within, and in levels by near places.
const SETTLED: f32 = 0.85;
const SETTLED_NEAR: f32 = 0.93;
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
/// Which of the steps along a part's border counts: at some places other print lies beside it.
const TYPICAL: f64 = 0.35;
/// Least step of print, as a part of the median step of the rest: of shadows in rendered scenes nine of ten have less than 0.56, of print three of four more than 0.6.
const CRISP: f32 = 0.6;
/// ... and of what may be print beside such.
const SOFT: f32 = 0.4;
/// How far beyond the levels of ground and shape noise may go, as a part of the contrast.
const OVERSHOOT: f32 = 0.2;
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

/// Parts of a picture.
struct Parts {
    /// Which one each pixel belongs to; 0 for the rest.
    of: Vec<usize>,
    /// Their pixels, from 1 on.
    lists: Vec<Vec<usize>>,
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
        let Some(levels) = print.find(&by_blocks, standing.ground.weak_threshold()) else { return false };
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
        let length = |k: usize| self.smooth.iter().map(|plane| plane[k] * plane[k]).sum::<f32>().sqrt();
        self.length.clear();
        self.length.extend((0..self.width * self.height).map(length));
    }

    /// The levels of the crop with its print, in parts of the contrast, if there is any that its levels by blocks leave out.
    fn find(&mut self, by_blocks: &[f32], threshold: f32) -> Option<Vec<f32>> {
        let stands_out = |k: usize| self.smooth.iter().any(|plane| plane[k].abs() > threshold);
        let stands_out: Vec<bool> = (0..self.length.len()).map(stands_out).collect();
        self.find_depth(|k| stands_out[k] && by_blocks[k] > 0.5, |k| stands_out[k]);
        let deep = self.settled(by_blocks, SETTLED)?;
        let strong = self.parts(|k| by_blocks[k] > 0.5);
        let body = (1..strong.lists.len()).max_by_key(|part| strong.lists[*part].len())?;
        let parts = self.parts(|k| self.depth[k] >= deep && strong.of[k] != body);
        // Those that do not come near the border are shape anyway.
        let matters = |part: &Vec<usize>| part.len() >= LEAST_PART && part.iter().any(|k| self.depth[*k] == deep);
        if !parts.lists.iter().any(matters) {
            return None;
        }
        let area = self.depth.iter().filter(|depth| **depth > 0).count();
        self.find_sources(deep);
        let nearest: Vec<usize> = self.source.iter().map(|s| parts.of.get(*s).map_or(NOWHERE, |part| *part)).collect();
        let trial: Vec<f32> = (0..self.length.len()).map(|k| self.relative(k, k)).collect();
        self.follow(&trial)?;
        let crispness = self.crispness(&parts, &nearest);
        let is_print = |part: usize| part > 0 && crispness.get(part).is_some_and(|crispness| *crispness >= CRISP);
        let lost: usize =
            (0..parts.lists.len()).filter(|part| is_print(*part)).map(|part| parts.lists[part].len()).sum();
        let is_beside = if lost * LEAST_SHARE < area {
            let counts = |part: &usize| is_print(*part) && parts.lists[*part].len() >= LEAST_ALONE;
            let is_nearest: Vec<bool> = nearest.iter().map(counts).collect();
            if !is_nearest.contains(&true) {
                return None;
            }
            self.dilated(&is_nearest, BEYOND)
        } else {
            vec![true; nearest.len()]
        };
        let level = |k: usize| match crispness.get(nearest[k]) {
            Some(crispness) if *crispness >= SOFT => self.relative(k, k),
            _ => by_blocks[k],
        };
        let second: Vec<f32> = (0..self.length.len()).map(level).collect();
        self.follow(&second)?;
        let is_nick = self.nicks(&second, &stands_out);
        let result = |k: usize| match self.source[k] {
            _ if is_nick[k] => 1.0,
            NOWHERE => by_blocks[k],
            _ => self.relative(k, k),
        };
        let near: Vec<f32> = (0..self.length.len()).map(result).collect();
        let is_elsewhere = self.is_elsewhere(by_blocks, &near, &is_beside);
        let chosen = near.iter().zip(by_blocks).zip(is_elsewhere);
        Some(chosen.map(|((near, by_blocks), is_elsewhere)| if is_elsewhere { *near } else { *by_blocks }).collect())
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
    fn settled(&self, levels: &[f32], part: f32) -> Option<u8> {
        let mut by_depth: [Vec<f32>; MAX_DEPTH as usize + 1] = Default::default();
        for (depth, level) in self.depth.iter().zip(levels).filter(|(depth, _)| (1..=MAX_DEPTH).contains(*depth)) {
            by_depth[usize::from(*depth)].push(*level);
        }
        (2..MAX_DEPTH).find(|depth| median(&by_depth[usize::from(*depth)]) >= part)
    }

    /// What is set, in parts that hang together.
    fn parts(&self, is_set: impl Fn(usize) -> bool) -> Parts {
        let mut parts = Parts { of: vec![0; self.depth.len()], lists: vec![Vec::new()] };
        for seed in 0..self.depth.len() {
            let is_open = |k: usize, of: &[usize]| of[k] == 0 && is_set(k);
            if !is_open(seed, &parts.of) {
                continue;
            }
            let (label, mut list) = (parts.lists.len(), vec![seed]);
            parts.of[seed] = label;
            let mut next = 0;
            while let Some(&k) = list.get(next) {
                next += 1;
                for j in neighbours(k, self.width, self.height) {
                    if is_open(j, &parts.of) {
                        parts.of[j] = label;
                        list.push(j);
                    }
                }
            }
            parts.lists.push(list);
        }
        parts
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
        let deep = self.settled(levels, SETTLED_NEAR)?;
        self.find_sources(deep + 1);
        Some(())
    }

    /// What stands out and lies in a nick of the border, where print changes: what a closing adds to the shape.
    fn nicks(&self, levels: &[f32], stands_out: &[bool]) -> Vec<bool> {
        let shape: Vec<bool> = levels.iter().map(|level| *level > 0.5).collect();
        let closed = self.eroded(&self.dilated(&shape, NICK), NICK);
        (0..shape.len()).map(|k| closed[k] && stands_out[k] && !shape[k]).collect()
    }

    /// Where two borders are apart by more than a pixel or two, and about there; only where that `matters`.
    fn is_elsewhere(&self, a: &[f32], b: &[f32], matters: &[bool]) -> Vec<bool> {
        let between: Vec<bool> = a.iter().zip(b).map(|(a, b)| (*a > 0.5) != (*b > 0.5)).collect();
        let shares = self.shares(&between, APART).zip(matters);
        let apart: Vec<bool> = shares.map(|(share, matters)| share > LEAST_APART && *matters).collect();
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

    /// How crisp the border is at each part, as a part of what it is at the rest of the shape; `nearest` tells which part a pixel is nearest to.
    fn crispness(&self, parts: &Parts, nearest: &[usize]) -> Vec<f32> {
        let plateau = |part: &Vec<usize>| median(&part.iter().map(|k| self.length[*k]).collect::<Vec<_>>());
        let plateaus: Vec<f32> = parts.lists.iter().map(plateau).collect();
        let mut steps = vec![Vec::new(); parts.lists.len()];
        let place = |k: usize| [(k % self.width) as f32, (k / self.width) as f32];
        for k in (0..self.depth.len()).filter(|k| self.depth[*k] == 1) {
            let (source, part) = (self.source[k], nearest[k]);
            if source == NOWHERE || part == NOWHERE {
                continue;
            }
            let ([x, y], [u, v]) = (place(k), place(source));
            let away = (x - u).hypot(y - v).max(1.0);
            let at = |steps: f32| {
                let along = |from: f32, to: f32, count: usize| {
                    (from + steps * (from - to) / away).round().clamp(0.0, (count - 1) as f32) as usize
                };
                self.relative(along(y, v, self.height) * self.width + along(x, u, self.width), k)
                    .clamp(-OVERSHOOT, 1.0 + OVERSHOOT)
            };
            let share = if part == 0 { 1.0 } else { (self.level[source] / plateaus[part]).min(1.0) };
            steps[part].push(share * (at(-INSIDE) - at(OUTSIDE)));
        }
        let usual = median(&steps[0]);
        let crispness = |steps: &Vec<f32>| {
            if steps.is_empty() || usual <= 0.0 { SOFT } else { quantile(steps, TYPICAL) / usual }
        };
        let list = parts.lists.iter().zip(&steps).enumerate();
        list.map(|(part, (list, steps))| if part > 0 && list.len() >= LEAST_PART { crispness(steps) } else { SOFT })
            .collect()
    }
}
