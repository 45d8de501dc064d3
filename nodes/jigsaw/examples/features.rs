//! How exact the features of generated pieces are, measured against the generator's truth: one line for each kind of picture.
//!
//! `cargo run --release -p jigsaw --example features -- [--seeds FROM..TO] [--only NOISE,BLUR,VIGNETTE] [--verbose]`
//!
//! Each piece is taken [`PICTURES`] times with new noise. `missed` counts true isthmuses that have no found one of their polarity within
//! [`SAME`] pixels, `superfluous` the found ones that belong to no true one, for each picture (all / salient). The *bias* of a middle is its mean
//! distance from the true one over the pictures, along the tab; its *deviation* is what noise adds. `border` is the signed distance of the border from
//! the true outline, outwards positive: means of whole borders, and the root mean square of all points about their mean. *Both sides of a joint* is the
//! sum of the mean distances of its two borders along it, which the clearance of the two pieces is wrong by (mean, deviation, most).

use anyhow::{Context, bail};
use isthmus::isthmus::Polarity;
use isthmus::{Point, mask};
use jigsaw::generate::{Options, Puzzle, SideKind};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal};
use rayon::prelude::*;

/// A found isthmus belongs to the true one whose middle is this near, in pixels: less than half the narrowest neck.
const SAME: f64 = 8.0;

/// Noise (grey levels), blur (pixels) and vignette of the pictures.
const CASES: [[f64; 3]; 13] = [
    [0.0, 0.0, 0.0],
    [0.0, 1.5, 0.0],
    [0.0, 4.0, 0.0],
    [8.0, 0.0, 0.0],
    [8.0, 1.5, 0.0],
    [8.0, 4.0, 0.0],
    [20.0, 0.0, 0.0],
    [20.0, 1.5, 0.0],
    [20.0, 4.0, 0.0],
    [8.0, 1.5, 0.5],
    [20.0, 4.0, 0.5],
    [40.0, 1.0, 0.0],
    [40.0, 4.0, 0.0],
];
/// How many times each piece is taken, by pictures that differ in their noise.
const PICTURES: u64 = 3;
/// How far beyond a match segment a joint is taken to reach, in pixels: about to the corners of the pieces.
const BEYOND: f64 = 60.0;
/// Points of a joint at which its distance from the true outline is taken.
const JOINT_POINTS: usize = 100;
/// One in so many points of a border is compared with the true outline.
const BORDER_STEP: usize = 3;

/// What is measured on pieces.
#[derive(Debug, Default)]
struct Score {
    pieces: usize,
    necks: usize,
    missed: usize,
    not_salient: usize,
    /// Superfluous isthmuses: positive, negative, salient positive, salient negative.
    superfluous: [usize; 4],
    middle: Vec<f64>,
    ends: Vec<f64>,
    widths: Vec<f64>,
    offsets: Vec<f64>,
    noise: Vec<f64>,
    /// Mean and standard deviation over the pictures of a piece of a neck's place along its tab.
    biases: Vec<f64>,
    deviations: Vec<f64>,
    /// Mean offset of each whole border.
    borders: Vec<f64>,
    /// Joint, picture, and mean offset of the border along it.
    joints: Vec<((usize, u64), f64)>,
}

impl Score {
    /// The score of a piece; `puzzle` is rendered without noise, which is added here, each time anew.
    fn of(puzzle: &Puzzle, frame: usize, noise: f64, verbose: bool) -> anyhow::Result<Self> {
        let clean = puzzle.render(frame);
        let piece = puzzle.pieces().iter().position(|p| p.frame == frame).context("a frame without a piece")?;
        let truth = puzzle.outline(piece);
        let necks: Vec<(Polarity, [Point; 2], usize)> = puzzle
            .sides(piece)
            .into_iter()
            .filter_map(|side| {
                let polarity = if side.kind == SideKind::Tab { Polarity::Positive } else { Polarity::Negative };
                side.critical_points.map(|ends| (polarity, ends, side.joint))
            })
            .collect();
        let mut score = Self::default();
        let mut along_tab = vec![Vec::new(); necks.len()];
        let normal = Normal::new(0.0, noise as f32)?;
        for picture in 0..PICTURES {
            let mut rng = ChaCha8Rng::seed_from_u64(frame as u64 * PICTURES + picture);
            let noisy = |p: &u8| (f32::from(*p) + normal.sample(&mut rng)).round().clamp(0.0, 255.0) as u8;
            let pixels: Vec<u8> = clean.pixels.iter().map(noisy).collect();
            let segmentation =
                mask::segment(&mask::Frame::grey(clean.width, clean.height, &pixels)?, &mask::Parameters::default());
            let [cutout] = &segmentation.cutouts[..] else {
                bail!("{} shapes in frame {frame}: {:?}", segmentation.cutouts.len(), segmentation.rejected)
            };
            let features = isthmus::Extractor::default().extract(cutout).with_context(|| format!("frame {frame}"))?;
            score.pieces += 1;
            score.noise.push(features.noise);
            let mut used = vec![false; features.isthmuses.len()];
            for ((polarity, ends, joint), along_tab) in necks.iter().zip(&mut along_tab) {
                let middle = nalgebra::center(&ends[0], &ends[1]);
                let off = |k: &usize| (features.isthmuses[*k].point - middle).norm();
                let alike = (0..used.len()).filter(|&k| features.isthmuses[k].polarity == *polarity);
                let nearest = alike.min_by(|a, b| off(a).total_cmp(&off(b))).filter(|k| off(k) < SAME);
                score.necks += 1;
                let Some(k) = nearest else {
                    score.missed += 1;
                    continue;
                };
                used[k] = true;
                let found = &features.isthmuses[k];
                let across = (ends[1] - ends[0]).normalize();
                let d = found.point - middle;
                along_tab.push(d.perp(&across));
                score.not_salient += usize::from(!found.salient);
                score.middle.push(d.norm());
                score.ends.extend((0..2).map(|e| (found.critical_points[e] - ends[e]).norm()));
                score.widths.push(found.width - (ends[1] - ends[0]).norm());
                let points = features.border.sample(found.arc, BEYOND, JOINT_POINTS);
                let offsets: Vec<f64> = points.iter().map(|p| offset(&truth, *p)).collect();
                score.joints.push(((*joint, picture), mean(&offsets)));
                if verbose {
                    println!(
                        "  {} {polarity:?}: along the chord {:.2}, along the tab {:.2}, width {:.1} (true {:.1}), persistence {:.1}",
                        puzzle.pieces()[piece].id,
                        d.dot(&across),
                        d.perp(&across),
                        found.width,
                        (ends[1] - ends[0]).norm(),
                        found.persistence,
                    );
                }
            }
            for (found, _) in features.isthmuses.iter().zip(&used).filter(|(_, used)| !**used) {
                score.superfluous[found.polarity as usize] += 1;
                score.superfluous[2 + found.polarity as usize] += usize::from(found.salient);
            }
            let points = features.border.points.iter().step_by(BORDER_STEP);
            let offsets: Vec<f64> = points.map(|p| offset(&truth, *p)).collect();
            score.borders.push(mean(&offsets));
            score.offsets.extend(offsets);
        }
        for along_tab in along_tab.iter().filter(|a| a.len() == PICTURES as usize) {
            score.biases.push(mean(along_tab).abs());
            // Of as many pictures, the mean already follows the noise.
            score.deviations.push(deviation(along_tab) * (PICTURES as f64 / (PICTURES as f64 - 1.0)).sqrt());
        }
        Ok(score)
    }

    /// What the two sides of each joint are off by together.
    fn close_joints(&mut self) -> Vec<f64> {
        self.joints.sort_by_key(|(key, _)| *key);
        self.joints.chunk_by(|a, b| a.0 == b.0).filter(|c| c.len() == 2).map(|c| c[0].1 + c[1].1).collect()
    }

    fn add(&mut self, other: Self) {
        self.pieces += other.pieces;
        self.necks += other.necks;
        self.missed += other.missed;
        self.not_salient += other.not_salient;
        for (sum, n) in self.superfluous.iter_mut().zip(other.superfluous) {
            *sum += n;
        }
        self.middle.extend(other.middle);
        self.ends.extend(other.ends);
        self.widths.extend(other.widths);
        self.offsets.extend(other.offsets);
        self.noise.extend(other.noise);
        self.biases.extend(other.biases);
        self.deviations.extend(other.deviations);
        self.borders.extend(other.borders);
        self.joints.extend(other.joints);
    }
}

/// Signed distance of a point from a closed outline that runs clockwise on the screen, outwards positive.
fn offset(outline: &[Point], p: Point) -> f64 {
    let segments = outline.iter().zip(outline.iter().cycle().skip(1));
    let nearest = segments.map(|(a, b)| {
        let (along, to) = (b - a, p - a);
        let t = (to.dot(&along) / along.norm_squared().max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
        let away = to - along * t;
        (away.norm(), to.perp(&along).signum())
    });
    nearest.min_by(|a, b| a.0.total_cmp(&b.0)).map_or(f64::NAN, |(distance, side)| distance * side)
}

/// Median, 95 % quantile and largest.
fn spread(values: &[f64]) -> String {
    let mut values = values.to_vec();
    values.sort_by(f64::total_cmp);
    let at = |q: f64| values.get(((values.len().max(1) - 1) as f64 * q) as usize).copied().unwrap_or(f64::NAN);
    format!("{:.2} {:.2} {:.2}", at(0.5), at(0.95), at(1.0))
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len().max(1) as f64
}

fn deviation(values: &[f64]) -> f64 {
    let centre = mean(values);
    mean(&values.iter().map(|v| (v - centre).powi(2)).collect::<Vec<_>>()).sqrt()
}

/// Mean, standard deviation and most.
fn scatter(values: &[f64]) -> String {
    let most = values.iter().fold(0.0, |most: f64, v| most.max(v.abs()));
    format!("{:+.3} {:.3} {most:.2}", mean(values), deviation(values))
}

fn main() -> anyhow::Result<()> {
    let mut seeds = 1..4u64;
    let mut cases = CASES.to_vec();
    let mut verbose = false;
    let mut arguments = std::env::args().skip(1);
    while let Some(argument) = arguments.next() {
        match argument.as_str() {
            "--seeds" => {
                let range = arguments.next().context("--seeds wants FROM..TO")?;
                let (from, to) = range.split_once("..").context("--seeds wants FROM..TO")?;
                seeds = from.parse()?..to.parse()?;
            }
            "--only" => {
                let case = arguments.next().context("--only wants NOISE,BLUR,VIGNETTE")?;
                let numbers: Vec<f64> = case.split(',').map(str::parse).collect::<Result<_, _>>()?;
                cases = vec![numbers.try_into().ok().context("--only wants three numbers")?];
            }
            "--verbose" => verbose = true,
            other => bail!("unknown argument {other}"),
        }
    }
    println!(
        "| noise, blur, vignette | pictures | missed | not salient | superfluous + | - | middle (median, 95 %, most) | its bias | its deviation | ends | width | border (mean, deviation, most) | rms | said | both sides of a joint |"
    );
    println!("|{}", " --- |".repeat(15));
    for [noise, blur, vignette] in cases {
        let mut total = Score::default();
        let mut joints = Vec::new();
        for seed in seeds.clone() {
            let puzzle = Puzzle::generate(&Options { seed, blur, vignette, ..Options::default() })?;
            let scores: Vec<anyhow::Result<Score>> =
                (0..puzzle.frame_count()).into_par_iter().map(|k| Score::of(&puzzle, k, noise, verbose)).collect();
            for score in scores {
                total.add(score.with_context(|| format!("seed {seed}"))?);
            }
            // Joints are numbered in each puzzle.
            joints.extend(total.close_joints());
            total.joints.clear();
        }
        let rate = |k: usize| total.superfluous[k] as f64 / total.pieces.max(1) as f64;
        println!(
            "| {noise}, {blur}, {vignette} | {} | {} of {} | {} | {:.2} / {:.2} | {:.2} / {:.2} | {} | {} | {} | {} | {:+.2} | {} | {:.3} | {:.3} | {} |",
            total.pieces,
            total.missed,
            total.necks,
            total.not_salient,
            rate(0),
            rate(2),
            rate(1),
            rate(3),
            spread(&total.middle),
            spread(&total.biases),
            spread(&total.deviations),
            spread(&total.ends),
            mean(&total.widths),
            scatter(&total.borders),
            deviation(&total.offsets),
            mean(&total.noise),
            scatter(&joints),
        );
    }
    Ok(())
}
