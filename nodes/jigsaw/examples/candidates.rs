//! How good the candidates are that matching gives the assembly, before it decides: for each case how many there are, how
//! many of the true joints are among them (recall), how many of these are the best of their mouth, and what gap is
//! left on them.
//!
//! `cargo run --release -p jigsaw --example candidates -- [--seeds FROM..TO]`

use anyhow::Context;
use jigsaw::generate::{Options, Puzzle, SideKind};
use jigsaw::{Params, Solver};
use std::collections::{HashMap, HashSet};

fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let mut seeds = 1..4u64;
    if let [flag, range] = &arguments[..] {
        let (from, to) = range.split_once("..").filter(|_| flag == "--seeds").context("--seeds FROM..TO")?;
        seeds = from.parse()?..to.parse()?;
    }
    let small = |rows, columns| Options { rows, columns, frame: Some([512, 512]), ..Options::default() };
    let cases = [
        ("clean 4 x 6", small(4, 6)),
        ("clean 12 x 16", small(12, 16)),
        ("noise 20, blur 4", Options { noise: 20.0, blur: 4.0, ..small(4, 6) }),
        ("clearance 0 to 4 px", Options { clearance: [0.0, 4.0], ..small(4, 6) }),
        ("similarity 0.98", Options { similarity: 0.98, ..small(8, 12) }),
    ];
    println!("{:20} {:>8} {:>7} {:>7} {:>7} {:>9}", "case", "refined", "joints", "found", "first", "gap px");
    for (name, options) in cases {
        let (mut listed, mut joints, mut found, mut first, mut gap) = (0, 0, 0, 0, 0.0);
        for seed in seeds.clone() {
            let puzzle = Puzzle::generate(&Options { seed, ..options.clone() })?;
            let mut sides: HashMap<usize, Vec<usize>> = HashMap::new();
            for piece in 0..puzzle.pieces().len() {
                for side in puzzle.sides(piece).iter().filter(|s| s.kind != SideKind::Rim) {
                    sides.entry(side.joint).or_default().push(piece);
                }
            }
            let truth: HashSet<(usize, usize)> =
                sides.values().filter(|s| s.len() == 2).map(|s| (s[0].min(s[1]), s[0].max(s[1]))).collect();
            let mut solver = Solver::new(Params::default())?;
            for piece in puzzle.seen()? {
                solver.insert(piece)?;
            }
            solver.solve();
            let table: Vec<_> =
                solver.candidates().into_iter().filter_map(|c| c.posed.map(|posed| (c, posed.residual))).collect();
            let mut best: HashMap<(usize, usize), f64> = HashMap::new();
            for (c, residual) in &table {
                let least = best.entry((c.negative_piece, c.negative_isthmus)).or_insert(f64::INFINITY);
                *least = least.min(*residual);
            }
            let mut seen: HashMap<(usize, usize), (bool, f64)> = HashMap::new();
            for (c, residual) in &table {
                let pair = (c.positive_piece.min(c.negative_piece), c.positive_piece.max(c.negative_piece));
                let is_best = *residual <= best[&(c.negative_piece, c.negative_isthmus)];
                if truth.contains(&pair) {
                    let entry = seen.entry(pair).or_insert((false, f64::INFINITY));
                    if *residual < entry.1 {
                        *entry = (is_best, *residual);
                    }
                }
            }
            listed += table.len();
            joints += truth.len();
            found += seen.len();
            first += seen.values().filter(|s| s.0).count();
            gap += seen.values().map(|s| s.1).sum::<f64>();
        }
        println!("{name:20} {listed:8} {joints:7} {found:7} {first:7} {:9.4}", gap / found.max(1) as f64);
    }
    Ok(())
}
