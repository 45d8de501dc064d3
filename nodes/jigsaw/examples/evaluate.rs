//! How well the solver does on generated puzzles: one line for each case and seed.
//!
//! `cargo run --release -p jigsaw --example evaluate -- [CASE…] [--seeds FROM..TO] [--off SWITCH] [--paper] [--verbose]`
//! where a case is one of those listed by `--list`, and a switch is one of loops, pose_graph, fit_clearance,
//! recalibrate, merge_islands.

use anyhow::Context;
use isthmus::Point;
use jigsaw::generate::{Cut, Options, Puzzle, Rim};
use jigsaw::{Assembly, Fate, Params, Piece, Policy, Solver};
use nalgebra::Vector2;
use std::time::Instant;

/// A case: its name, how its puzzle is made, and whether its features come from rendered frames or from the outlines.
struct Case {
    name: &'static str,
    options: Options,
    frames: bool,
}

fn cases() -> Vec<Case> {
    let grid = |rows, columns| Options { rows, columns, ..Options::default() };
    let small = |rows, columns| Options { frame: Some([512, 512]), ..grid(rows, columns) };
    let case = |name, options| Case { name, options, frames: true };
    let exact = |name, options| Case { name, options, frames: false };
    let worn = Options { noise: 20.0, blur: 4.0, vignette: 0.5, ..grid(4, 6) };
    vec![
        exact("exact4x6", grid(4, 6)),
        case("4x6", grid(4, 6)),
        case("3x8", grid(3, 8)),
        case("8x12", grid(8, 12)),
        case("worn0", worn.clone()),
        case("worn2", Options { clearance: [2.0, 2.0], ..worn.clone() }),
        case("worn04", Options { clearance: [0.0, 4.0], ..worn }),
        case("alike95", Options { similarity: 0.95, noise: 10.0, blur: 2.0, ..grid(4, 6) }),
        case("alike98", Options { similarity: 0.98, ..grid(4, 6) }),
        case("alike98_8x12", Options { similarity: 0.98, ..small(8, 12) }),
        case("twins", Options { similarity: 0.99, noise: 20.0, blur: 4.0, ..small(4, 6) }),
        case("clones", Options { similarity: 0.995, noise: 20.0, blur: 4.0, ..small(4, 6) }),
        case("missing3", Options { missing: 3, ..grid(4, 6) }),
        case("missing5", Options { missing: 5, ..grid(4, 6) }),
        case("twice3", Options { duplicate: 3, ..grid(4, 6) }),
        case("flipped3", Options { flipped: 3, ..grid(4, 6) }),
        case("mixed", Options { puzzles: 2, ..grid(4, 6) }),
        case("wavy", Options { wavy: 0.1, ..grid(4, 6) }),
        case("wavy_8x12", Options { wavy: 0.1, ..small(8, 12) }),
        case("patch", Options { rim: Rim::Patch, ..grid(4, 6) }),
        case("ragged", Options { rim: Rim::Ragged, ..grid(6, 8) }),
        case("brick", Options { cut: Cut::Brick, ..grid(5, 6) }),
        case("honeycomb", Options { cut: Cut::Honeycomb, ..grid(5, 6) }),
        case("strip", Options { wavy: 0.0, ..grid(1, 6) }),
        case("15x20", small(15, 20)),
        case("25x40", small(25, 40)),
        case("worn_25x40", Options { noise: 10.0, blur: 2.0, vignette: 0.3, clearance: [0.0, 2.0], ..small(25, 40) }),
        exact("exact25x40", small(25, 40)),
        exact("exact100x100", small(100, 100)),
    ]
}

/// Lower bounds of the classes in which confidences are counted.
const BINS: [f64; 7] = [0.0, 0.5, 0.6, 0.8, 0.9, 0.95, 0.99];

/// Middle of a piece's border points.
fn centroid(piece: &Piece) -> Point {
    let points = &piece.features.border.points;
    Point::from(points.iter().fold(Vector2::zeros(), |s, p| s + p.coords) / points.len() as f64)
}

/// Prints the joints that were not found: their candidate and what became of it.
fn missed(puzzle: &Puzzle, pieces: &[Piece], solver: &Solver) {
    let truth = puzzle.truth("png");
    let candidates = solver.candidates();
    // The isthmus of a piece at the neck of a joint: its midpoint is nearest.
    let isthmus = |id: &str, joint: usize| {
        let side = truth.pieces.iter().find(|p| p.id == id)?.sides.iter().find(|s| s.joint == joint)?;
        let [a, b] = side.critical_points?;
        let middle = Point::new(0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1]));
        let piece = pieces.iter().position(|p| p.id == id)?;
        let distance = |k: &usize| (pieces[piece].features.isthmuses[*k].point - middle).norm();
        let all = 0..pieces[piece].features.isthmuses.len();
        Some((piece, all.min_by(|p, q| distance(p).total_cmp(&distance(q)))?))
    };
    for joint in &truth.joints {
        let (Some(tab), Some(mouth)) = (isthmus(&joint.positive, joint.joint), isthmus(&joint.negative, joint.joint))
        else {
            println!("  {} in {}: no isthmus", joint.positive, joint.negative);
            continue;
        };
        let known = candidates
            .iter()
            .find(|c| (c.positive_piece, c.positive_isthmus) == tab && (c.negative_piece, c.negative_isthmus) == mouth);
        match known {
            Some(c) if c.fate == Fate::Mated => {}
            Some(c) => println!(
                "  {} in {}: {:?}, {:.3?}, shape {:.3}, {} loops",
                joint.positive, joint.negative, c.fate, c.posed, c.shape_distance, c.support
            ),
            None => println!("  {} in {}: no candidate", joint.positive, joint.negative),
        }
    }
}

fn main() -> anyhow::Result<()> {
    let mut names = Vec::new();
    let mut seeds = 1..4u64;
    let mut verbose = false;
    let mut bins = [(0, 0); BINS.len()];
    let mut params = Params::default();
    let mut arguments = std::env::args().skip(1);
    let cases = cases();
    while let Some(argument) = arguments.next() {
        match argument.as_str() {
            "--list" => {
                cases.iter().for_each(|c| println!("{}", c.name));
                return Ok(());
            }
            "--seeds" => {
                let range = arguments.next().context("--seeds wants FROM..TO")?;
                let (from, to) = range.split_once("..").context("--seeds wants FROM..TO")?;
                seeds = from.parse()?..to.parse()?;
            }
            "--off" => params.switch_off(&arguments.next().context("--off SWITCH")?)?,
            "--verbose" => verbose = true,
            "--paper" => params.policy = Policy::Paper,
            name => names.push(name.to_owned()),
        }
    }
    println!(
        "{:14} {:>4} {:>9} {:>5} {:>11} {:>5} {:>8} {:>8} {:>8} {:>7} {:>7} {:>5}",
        "case",
        "seed",
        "placed",
        "misp",
        "matings",
        "wrong",
        "worst px",
        "rot mrad",
        "clear px",
        "match",
        "asm",
        "back"
    );
    for case in cases.iter().filter(|c| names.is_empty() || names.iter().any(|n| n == c.name)) {
        for seed in seeds.clone() {
            let puzzle = Puzzle::generate(&Options { seed, ..case.options.clone() })?;
            let begin = Instant::now();
            let pieces = if case.frames { puzzle.seen()? } else { puzzle.exact()? };
            let features = begin.elapsed().as_secs_f64();
            let mut solver = Solver::new(params)?;
            for piece in &pieces {
                solver.insert(piece.clone())?;
            }
            let assembly = solver.solve();
            let s = puzzle.score(&pieces, &assembly);
            println!(
                "{:14} {:4} {:4}/{:4} {:5} {:5}/{:5} {:5} {:8.3} {:8.3} {:8.3} {:7.3} {:7.3} {:5} {}{:.1}",
                case.name,
                seed,
                s.placed,
                s.pieces,
                s.misplaced,
                s.right_matings,
                s.joints,
                s.wrong_matings,
                s.worst_offset,
                1e3 * s.worst_rotation,
                s.worst_clearance,
                assembly.timings.matching,
                assembly.timings.assembly,
                assembly.table.backtracks,
                if s.is_perfect() { "" } else { "<<< " },
                features,
            );
            if params.policy == Policy::Paper {
                println!("{:?}", assembly.table);
            }
            for m in &assembly.matings {
                let alone = Assembly { matings: vec![m.clone()], ..Assembly::default() };
                let bin = BINS.iter().rposition(|b| m.confidence >= *b).unwrap_or(0);
                let right = puzzle.score(&pieces, &alone).right_matings;
                bins[bin].0 += right;
                bins[bin].1 += 1;
                if verbose && right == 0 {
                    println!("  wrong {} in {}: {m:?}", pieces[m.positive_piece].id, pieces[m.negative_piece].id);
                }
            }
            if verbose && !s.is_perfect() {
                let mut placements = assembly.placements.clone();
                placements.sort_by(|p, q| p.component.cmp(&q.component).then(p.piece.cmp(&q.piece)));
                for p in &placements {
                    let centre = p.puzzle_from_image * centroid(&pieces[p.piece]);
                    println!(
                        "  {} component {} at {:.0} {:.0} confidence {:.4}",
                        pieces[p.piece].id, p.component, centre.x, centre.y, p.confidence
                    );
                }
                for k in &assembly.unplaced {
                    println!("  {} left over", pieces[*k].id);
                }
                missed(&puzzle, &pieces, &solver);
            }
        }
    }
    println!("matings by confidence:");
    for (from, (right, all)) in BINS.iter().zip(bins) {
        println!("  from {from:.4}: {right} of {all} right");
    }
    Ok(())
}
