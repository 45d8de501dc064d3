//! Growth of the cost with the frame's size: one piece of 300 px for each megapixel, least time of several runs, one thread.
//!
//! `cargo bench -p isthmus-shapes --bench growth` for all sizes, `cargo bench -p isthmus-shapes --bench growth -- 1024` for one.

#![allow(missing_docs, clippy::unwrap_used, reason = "bench program")]

#[path = "../tests/shapes/mod.rs"]
mod shapes;

use isthmus::contour::Tracer;
use isthmus::isthmus::{Polarity, find};
use isthmus::mask::{Frame, Parameters, Segmenter};
use isthmus::profile;
use isthmus::skeleton::Triangulation;
use shapes::{Camera, Piece, pose};
use std::hint::black_box;
use std::time::{Duration, Instant};

/// Sides of the frames in pixels: 0.25 to 16 megapixels.
const SIDES: [usize; 4] = [512, 1024, 2048, 4096];
/// Side of the cell in which a piece lies.
const CELL: usize = 1024;
/// Samples of an isthmus distance function.
const IDF: usize = 64;
/// Time spent on one frame.
const BUDGET: Duration = Duration::from_secs(2);
/// Least number of runs.
const RUNS: usize = 3;

const STAGES: [&str; 7] = ["segment", "border", "triangulate", "isthmuses", "IDF", "whole", "skeletons"];

fn main() {
    println!("| megapixels | pieces | border points | {} |", STAGES.join(" ms | ") + " ms");
    println!("|{}", " ---: |".repeat(3 + STAGES.len()));
    let asked: Vec<usize> = std::env::args().filter_map(|a| a.parse().ok()).collect();
    for side in if asked.is_empty() { SIDES.to_vec() } else { asked } {
        let (cells, cell) = (side.div_ceil(CELL), side.min(CELL));
        let outlines: Vec<_> = (0..cells * cells)
            .map(|k| {
                let centre = |i: usize| (i * cell + cell / 2) as f64;
                Piece::random(300.0, k as u64).outline(&pose(k as f64, 1.0, centre(k % cells), centre(k / cells)))
            })
            .collect();
        let camera = Camera { width: side, height: side, noise: 3.0, ..Camera::default() };
        let pixels = camera.picture(&outlines);
        let frame = Frame::grey(side as u32, side as u32, &pixels).unwrap();
        let mut least = [Duration::MAX; STAGES.len()];
        let mut points = 0;
        let (mut segmenter, mut tracer) = (Segmenter::default(), Tracer::default());
        let mut triangulation = Triangulation::default();
        let start = Instant::now();
        let mut runs = 0;
        while runs < RUNS || start.elapsed() < BUDGET {
            runs += 1;
            let mut spent = [Duration::ZERO; STAGES.len()];
            let mut clock = Instant::now();
            let mut stop = |stage: usize| {
                spent[stage] += clock.elapsed();
                clock = Instant::now();
            };
            let found = segmenter.segment(black_box(&frame), &Parameters::default());
            stop(0);
            assert_eq!(found.cutouts.len(), outlines.len());
            points = 0;
            for cutout in &found.cutouts {
                let (border, noise) = tracer.trace(cutout).unwrap();
                stop(1);
                triangulation.rebuild(&border).unwrap();
                stop(2);
                let isthmuses = find(&border, &triangulation, noise);
                stop(3);
                for i in &isthmuses {
                    black_box(profile::distance_function(&border, i, IDF));
                }
                stop(4);
                black_box([Polarity::Positive, Polarity::Negative].map(|p| triangulation.skeleton(&border, p, noise)));
                stop(6);
                points += border.points.len();
            }
            spent[5] = spent[..5].iter().sum();
            for (least, spent) in least.iter_mut().zip(spent) {
                *least = (*least).min(spent);
            }
        }
        let megapixels = (side * side) as f64 / (1 << 20) as f64;
        let cells: Vec<String> = least.iter().map(|t| format!("{:.2}", t.as_secs_f64() * 1e3)).collect();
        println!("| {megapixels} | {} | {points} | {} |", outlines.len(), cells.join(" | "));
    }
}
