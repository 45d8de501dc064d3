//! How the cost of a solution grows with the number of pieces.
//!
//! `cargo bench -p jigsaw --bench growth -- [COUNT…] [--plot FILE.svg]` (the file is taken from the folder of the crate)
//!
//! Features are made from true outlines, so that only matching and assembly are timed. Each row gives the best of a few
//! runs in milliseconds (matching, assembly), the processor time of both on all threads, the exponent with which it has
//! grown since the row before (1 is linear), what one more piece costs when all others are solved already (median of a
//! few; time and processor time), what each costs when all come one after another from all over the puzzle (mean and most,
//! processor time; of puzzles of some hundred pieces at most), the greatest memory that the process has held so far, and how many pieces were placed.
//! Processor time and memory are read from `/proc`, and are missing where there is none.

use anyhow::Context;
use jigsaw::generate::{Options, Puzzle};
use jigsaw::{Params, Piece, Solver};
use plotters::prelude::*;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Rows and columns of a puzzle of about so many pieces, two by three in proportion.
fn shape(count: usize) -> (usize, usize) {
    let rows = ((count as f64 / 1.5).sqrt().round() as usize).max(1);
    (rows, count.div_ceil(rows))
}

fn pieces(count: usize) -> anyhow::Result<Vec<Piece>> {
    let (rows, columns) = shape(count);
    let puzzle = Puzzle::generate(&Options { rows, columns, seed: 1, frame: Some([512, 512]), ..Options::default() })?;
    Ok(puzzle.exact()?)
}

/// Processor time that all threads of this process have taken, in seconds.
fn processor_time() -> f64 {
    let Ok(threads) = std::fs::read_dir("/proc/self/task") else { return f64::NAN };
    let of_thread = |path: PathBuf| -> Option<f64> {
        let text = std::fs::read_to_string(path.join("schedstat")).ok()?;
        Some(1e-9 * text.split_whitespace().next()?.parse::<f64>().ok()?)
    };
    threads.flatten().filter_map(|t| of_thread(t.path())).sum()
}

/// Greatest memory that this process has held so far, in MiB.
fn peak_memory() -> f64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"));
    line.and_then(|l| l.split_whitespace().next()?.parse::<f64>().ok()).map_or(f64::NAN, |kib| kib / 1024.0)
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}

/// What was measured of one puzzle; times in seconds.
struct Row {
    pieces: usize,
    matching: f64,
    assembly: f64,
    processor: f64,
    more: f64,
    more_processor: f64,
    /// Mean and most, one after another.
    each: [f64; 2],
    peak: f64,
    placed: usize,
}

/// Processor time of each solution when pieces come one after another from all over the puzzle, mean and most.
fn one_by_one(pieces: &[Piece]) -> anyhow::Result<[f64; 2]> {
    /// More take minutes.
    const MOST: usize = 320;
    /// Steps of the golden section visit all places evenly.
    const GOLDEN: f64 = 0.618_033_988_749_895;
    let n = pieces.len();
    if n > MOST {
        return Ok([f64::NAN; 2]);
    }
    let mut order: Vec<usize> = (0..n).collect();
    order.sort_by(|p, q| (*p as f64 * GOLDEN).fract().total_cmp(&(*q as f64 * GOLDEN).fract()));
    let mut solver = Solver::new(Params::default())?;
    let (mut sum, mut most) = (0.0, 0.0f64);
    for k in order {
        solver.insert(pieces[k].clone())?;
        let before = processor_time();
        solver.solve();
        let took = processor_time() - before;
        sum += took;
        most = most.max(took);
    }
    Ok([sum / n as f64, most])
}

fn measure(count: usize) -> anyhow::Result<Row> {
    let pieces = pieces(count)?;
    let n = pieces.len();
    let mut row = Row {
        pieces: n,
        matching: f64::INFINITY,
        assembly: f64::INFINITY,
        processor: f64::INFINITY,
        more: 0.0,
        more_processor: 0.0,
        each: one_by_one(&pieces)?,
        peak: 0.0,
        placed: 0,
    };
    let runs = if n > 500 { 1 } else { 5 };
    for _ in 0..runs {
        let mut solver = Solver::new(Params::default())?;
        for piece in &pieces {
            solver.insert(piece.clone())?;
        }
        let before = processor_time();
        let assembly = solver.solve();
        let t = assembly.timings;
        if t.matching + t.assembly < row.matching + row.assembly {
            (row.matching, row.assembly) = (t.matching, t.assembly);
        }
        row.processor = row.processor.min(processor_time() - before);
        row.placed = assembly.placements.len();
    }
    // Added are pieces from all over the puzzle.
    let added = if n > 2000 { 1 } else { 7.min(n - 1) };
    let is_added = |k: usize| (0..added).any(|a| k == (2 * a + 1) * n / (2 * added));
    let mut solver = Solver::new(Params::default())?;
    for (_, piece) in pieces.iter().enumerate().filter(|(k, _)| !is_added(*k)) {
        solver.insert(piece.clone())?;
    }
    solver.solve();
    let mut more = Vec::new();
    for (_, piece) in pieces.iter().enumerate().filter(|(k, _)| is_added(*k)) {
        let piece = piece.clone();
        let (begin, before) = (Instant::now(), processor_time());
        solver.insert(piece)?;
        solver.solve();
        more.push((begin.elapsed().as_secs_f64(), processor_time() - before));
    }
    row.more = median(more.iter().map(|m| m.0).collect());
    row.more_processor = median(more.iter().map(|m| m.1).collect());
    row.peak = peak_memory();
    Ok(row)
}

/// Draws processor time of a whole solution, and of one more piece, over the number of pieces, both logarithmic.
fn plot(path: &Path, rows: &[Row]) -> anyhow::Result<()> {
    let (first, last) = (rows.first().context("nothing measured")?, rows.last().context("nothing measured")?);
    let times = rows.iter().flat_map(|r| [r.processor, r.more_processor]);
    let (low, high) = times.fold((f64::INFINITY, 0.0f64), |(l, h), t| (l.min(t), h.max(t)));
    let root = SVGBackend::new(path, (800, 500)).into_drawing_area();
    let failed = |e: DrawingAreaErrorKind<std::io::Error>| anyhow::anyhow!("{}: {e}", path.display());
    root.fill(&WHITE).map_err(failed)?;
    let mut chart = ChartBuilder::on(&root)
        .margin(16)
        .x_label_area_size(44)
        .y_label_area_size(70)
        .build_cartesian_2d(
            (0.8 * first.pieces as f64..1.25 * last.pieces as f64).log_scale(),
            (0.5 * low..2.0 * high).log_scale(),
        )
        .map_err(failed)?;
    chart
        .configure_mesh()
        .x_desc("pieces")
        .y_desc("processor time, s")
        .x_label_formatter(&|v| format!("{v:.0}"))
        .y_label_formatter(&|v| format!("{v}"))
        .draw()
        .map_err(failed)?;
    let linear = |n: usize| first.processor * n as f64 / first.pieces as f64;
    let points =
        |value: &dyn Fn(&Row) -> f64| -> Vec<(f64, f64)> { rows.iter().map(|r| (r.pieces as f64, value(r))).collect() };
    let series = [
        ("match and assemble", BLUE, points(&|r| r.processor)),
        ("one more piece", RED, points(&|r| r.more_processor)),
        ("linear, for comparison", RGBColor(160, 160, 160), points(&|r| linear(r.pieces))),
    ];
    for (name, colour, points) in series {
        chart
            .draw_series(LineSeries::new(points.clone(), colour.stroke_width(2)))
            .map_err(failed)?
            .label(name)
            .legend(move |(x, y)| PathElement::new(vec![(x, y), (x + 20, y)], colour.stroke_width(2)));
        chart.draw_series(points.into_iter().map(|p| Circle::new(p, 3, colour.filled()))).map_err(failed)?;
    }
    chart
        .configure_series_labels()
        .position(SeriesLabelPosition::UpperLeft)
        .background_style(WHITE)
        .border_style(BLACK)
        .draw()
        .map_err(failed)?;
    root.present().map_err(failed)
}

fn main() -> anyhow::Result<()> {
    let mut counts: Vec<usize> = Vec::new();
    let mut picture = None;
    let mut arguments = std::env::args().skip(1);
    while let Some(argument) = arguments.next() {
        match argument.as_str() {
            "--plot" => picture = Some(PathBuf::from(arguments.next().context("--plot wants a file name")?)),
            // What cargo adds.
            "--bench" => {}
            count => counts.push(count.parse().with_context(|| format!("{count:?} is no number of pieces"))?),
        }
    }
    if counts.is_empty() {
        counts = vec![24, 300, 1000];
    }
    println!(
        "{:>6} {:>9} {:>9} {:>9} {:>8} {:>8} {:>9} {:>8} {:>8} {:>9} {:>7}",
        "pieces",
        "match ms",
        "asm ms",
        "cpu ms",
        "exponent",
        "+1 ms",
        "+1 cpu ms",
        "each ms",
        "most ms",
        "peak MiB",
        "placed"
    );
    let mut rows: Vec<Row> = Vec::new();
    for count in counts {
        let row = measure(count)?;
        let exponent = rows.last().map_or(f64::NAN, |before| {
            (row.processor / before.processor).ln() / (row.pieces as f64 / before.pieces as f64).ln()
        });
        println!(
            "{:6} {:9.1} {:9.1} {:9.1} {exponent:8.2} {:8.1} {:9.1} {:8.1} {:8.1} {:9.0} {:7}",
            row.pieces,
            1e3 * row.matching,
            1e3 * row.assembly,
            1e3 * row.processor,
            1e3 * row.more,
            1e3 * row.more_processor,
            1e3 * row.each[0],
            1e3 * row.each[1],
            row.peak,
            row.placed
        );
        rows.push(row);
    }
    match picture {
        Some(path) => plot(&path, &rows),
        None => Ok(()),
    }
}
