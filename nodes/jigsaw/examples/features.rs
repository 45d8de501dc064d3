//! How exact the features of generated pieces are, measured against the generator's truth: one line for each kind of picture.
//!
//! `cargo run --release -p jigsaw --example features -- [--seeds FROM..TO] [--only NOISE,BLUR,VIGNETTE] [--verbose]`
//!
//! `missed` counts true isthmuses that have no found one of their polarity within [`SAME`] pixels, `superfluous` the found ones that
//! belong to no true one, for each piece (all / salient). `border` is the signed distance of the border from the true outline,
//! outwards positive: its mean over all points, and the root mean square about it.

use anyhow::{Context, bail};
use isthmus::isthmus::Polarity;
use isthmus::{Point, mask};
use jigsaw::generate::{Options, Puzzle, SideKind};
use rayon::prelude::*;

/// A found isthmus belongs to the true one whose middle is this near, in pixels: less than half the narrowest neck.
const SAME: f64 = 8.0;

/// Noise (grey levels), blur (pixels) and vignette of the pictures.
const CASES: [[f64; 3]; 9] = [
    [0.0, 0.0, 0.0],
    [3.0, 1.0, 0.0],
    [10.0, 2.0, 0.0],
    [0.0, 4.0, 0.0],
    [20.0, 1.0, 0.0],
    [20.0, 4.0, 0.0],
    [20.0, 4.0, 0.5],
    [40.0, 1.0, 0.0],
    [40.0, 4.0, 0.0],
];

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
}

impl Score {
    fn of(puzzle: &Puzzle, frame: usize, verbose: bool) -> anyhow::Result<Self> {
        let picture = puzzle.render(frame);
        let picture = mask::Frame::grey(picture.width, picture.height, &picture.pixels)?;
        let segmentation = mask::segment(&picture, &mask::Parameters::default());
        let [cutout] = &segmentation.cutouts[..] else {
            bail!("{} shapes in frame {frame}: {:?}", segmentation.cutouts.len(), segmentation.rejected)
        };
        let features = isthmus::Extractor::default().extract(cutout).with_context(|| format!("frame {frame}"))?;
        let piece = puzzle.pieces().iter().position(|p| p.frame == frame).context("a frame without a piece")?;
        let mut score = Self { pieces: 1, noise: vec![features.noise], ..Self::default() };
        let mut used = vec![false; features.isthmuses.len()];
        for side in puzzle.sides(piece) {
            let Some(ends) = side.critical_points else { continue };
            let polarity = if side.kind == SideKind::Tab { Polarity::Positive } else { Polarity::Negative };
            let middle = nalgebra::center(&ends[0], &ends[1]);
            let off = |k: &usize| (features.isthmuses[*k].point - middle).norm();
            let alike = (0..features.isthmuses.len()).filter(|&k| features.isthmuses[k].polarity == polarity);
            let nearest = alike.min_by(|a, b| off(a).total_cmp(&off(b))).filter(|k| off(k) < SAME);
            score.necks += 1;
            let Some(k) = nearest else {
                score.missed += 1;
                continue;
            };
            used[k] = true;
            let found = &features.isthmuses[k];
            score.not_salient += usize::from(!found.salient);
            score.middle.push(off(&k));
            score.ends.extend((0..2).map(|e| (found.critical_points[e] - ends[e]).norm()));
            score.widths.push(found.width - (ends[1] - ends[0]).norm());
            if verbose {
                let along = (ends[1] - ends[0]).normalize();
                let d = found.point - middle;
                println!(
                    "  {} {polarity:?}: along the chord {:.2}, across {:.2}, width {:.1} (true {:.1}), persistence {:.1}",
                    puzzle.pieces()[piece].id,
                    d.dot(&along),
                    d.perp(&along),
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
        let truth = puzzle.outline(piece);
        score.offsets = features.border.points.iter().map(|p| offset(&truth, *p)).collect();
        Ok(score)
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
        "| noise, blur, vignette | pieces | missed | not salient | superfluous + | - | middle (median, 95 %, most) | ends | width | border mean | rms | noise said |"
    );
    println!("|{}", " --- |".repeat(12));
    for [noise, blur, vignette] in cases {
        let mut total = Score::default();
        for seed in seeds.clone() {
            let puzzle = Puzzle::generate(&Options { seed, noise, blur, vignette, ..Options::default() })?;
            let scores: Vec<anyhow::Result<Score>> =
                (0..puzzle.frame_count()).into_par_iter().map(|k| Score::of(&puzzle, k, verbose)).collect();
            for score in scores {
                total.add(score.with_context(|| format!("seed {seed}"))?);
            }
        }
        let rate = |k: usize| total.superfluous[k] as f64 / total.pieces.max(1) as f64;
        let centre = mean(&total.offsets);
        let rms = mean(&total.offsets.iter().map(|o| (o - centre).powi(2)).collect::<Vec<_>>()).sqrt();
        println!(
            "| {noise}, {blur}, {vignette} | {} | {} of {} | {} | {:.2} / {:.2} | {:.2} / {:.2} | {} | {} | {:+.2} | {centre:+.3} | {rms:.3} | {:.3} |",
            total.pieces,
            total.missed,
            total.necks,
            total.not_salient,
            rate(0),
            rate(2),
            rate(1),
            rate(3),
            spread(&total.middle),
            spread(&total.ends),
            mean(&total.widths),
            mean(&total.noise),
        );
    }
    Ok(())
}
