//! How the cost of a solution grows with the number of pieces: `cargo bench -p jigsaw`.
//!
//! Features are made from true outlines, so that only matching and assembly are timed. Each row gives the best of a few
//! runs in milliseconds, the exponent with which the time has grown since the row before (1 is linear), and what one
//! more piece costs when all others are solved already. Counts can be named: `cargo bench -p jigsaw -- 24 300 1000`.

use jigsaw::generate::{Options, Puzzle};
use jigsaw::{Params, Piece, Solver};
use rayon::prelude::*;
use std::time::Instant;

/// Rows and columns of a puzzle of about so many pieces, two by three in proportion.
fn shape(count: usize) -> (usize, usize) {
    let rows = ((count as f64 / 1.5).sqrt().round() as usize).max(1);
    (rows, count.div_ceil(rows))
}

fn pieces(count: usize) -> anyhow::Result<Vec<Piece>> {
    let (rows, columns) = shape(count);
    let puzzle = Puzzle::generate(&Options { rows, columns, seed: 1, frame: Some([512, 512]), ..Options::default() })?;
    (0..puzzle.pieces().len())
        .into_par_iter()
        .map(|k| {
            let features = isthmus::Features::from_border(puzzle.border(k, 1.0), 0.0)?;
            Ok(Piece { id: puzzle.pieces()[k].id.clone(), features })
        })
        .collect()
}

fn main() -> anyhow::Result<()> {
    let mut counts: Vec<usize> = std::env::args().skip(1).filter_map(|a| a.parse().ok()).collect();
    if counts.is_empty() {
        counts = vec![24, 96, 300];
    }
    println!("{:>6} {:>10} {:>10} {:>9} {:>10} {:>7}", "pieces", "match ms", "asm ms", "exponent", "+1 ms", "placed");
    let mut before: Option<(f64, f64)> = None;
    for count in counts {
        let pieces = pieces(count)?;
        let mut best = (f64::INFINITY, 0.0, 0.0);
        let mut placed = 0;
        let runs = if pieces.len() > 500 { 1 } else { 3 };
        for _ in 0..runs {
            let mut solver = Solver::new(Params::default())?;
            for piece in &pieces {
                solver.insert(piece.clone())?;
            }
            let assembly = solver.solve();
            let t = assembly.timings;
            if t.matching + t.assembly < best.0 {
                best = (t.matching + t.assembly, t.matching, t.assembly);
            }
            placed = assembly.placements.len();
        }
        let mut solver = Solver::new(Params::default())?;
        let (last, rest) = pieces.split_last().ok_or_else(|| anyhow::anyhow!("no pieces"))?;
        for piece in rest {
            solver.insert(piece.clone())?;
        }
        solver.solve();
        solver.insert(last.clone())?;
        let begin = Instant::now();
        solver.solve();
        let more = begin.elapsed().as_secs_f64();
        let n = pieces.len() as f64;
        let exponent = before.map_or(f64::NAN, |(m, t)| (best.0 / t).ln() / (n / m).ln());
        before = Some((n, best.0));
        println!(
            "{:6} {:10.1} {:10.1} {exponent:9.2} {:10.1} {placed:7}",
            pieces.len(),
            1e3 * best.1,
            1e3 * best.2,
            1e3 * more
        );
    }
    Ok(())
}
