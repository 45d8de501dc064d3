//! The solver on folders of pictures of real pieces, one or many to a picture.
//!
//! `cargo run --release -p jigsaw --example scans -- FOLDER [--truth solution.csv] [--out FILE.svg] [--off SWITCH]`
//! The truth has the columns piece (file stem), column, row, rotation_rad.

use anyhow::Context;
use isthmus::mask::{Frame, Parameters, segment};
use jigsaw::{Assembly, Params, Piece, Solver};
use rayon::prelude::*;
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// All pieces of a picture, named as the command line names them.
fn load(path: &Path) -> anyhow::Result<Vec<Piece>> {
    let picture = image::open(path).with_context(|| path.display().to_string())?;
    let (width, height) = (picture.width(), picture.height());
    let stem = path.file_stem().and_then(|s| s.to_str()).context("file name")?.to_owned();
    let segmentation = if picture.color().has_color() {
        let pixels = picture.into_rgb8().into_raw();
        segment(&Frame::rgb(width, height, &pixels)?, &Parameters::default())
    } else {
        let pixels = picture.into_luma8().into_raw();
        segment(&Frame::grey(width, height, &pixels)?, &Parameters::default())
    };
    for rejected in &segmentation.rejected {
        println!("{stem}: {:?} at {:?}, {} px", rejected.reason, rejected.aoi, rejected.area);
    }
    let many = segmentation.cutouts.len() > 1;
    let mut extractor = isthmus::Extractor::default();
    let mut pieces = Vec::new();
    for (k, cutout) in segmentation.cutouts.iter().enumerate() {
        let features = extractor.extract(cutout).with_context(|| path.display().to_string())?;
        pieces.push(Piece { id: if many { format!("{stem}_{k}") } else { stem.clone() }, seen: 0, features });
    }
    Ok(pieces)
}

/// Outlines in place, as an SVG.
fn draw(path: &Path, pieces: &[Piece], assembly: &Assembly) -> anyhow::Result<()> {
    use std::fmt::Write;
    let mut body = String::new();
    let (mut width, mut height) = (0.0f64, 0.0f64);
    for p in &assembly.placements {
        let mut points = String::new();
        for q in pieces[p.piece].features.border.points.iter().step_by(3) {
            let q = p.puzzle_from_image * q;
            (width, height) = (width.max(q.x), height.max(q.y));
            write!(points, "{:.1},{:.1} ", q.x, q.y)?;
        }
        let hue = p.piece * 47 % 360;
        writeln!(body, "<polygon points='{points}' fill='hsl({hue},60%,70%)' fill-opacity='0.6'/>")?;
    }
    let head = format!("<svg xmlns='http://www.w3.org/2000/svg' width='1600' viewBox='0 0 {width:.0} {height:.0}'>");
    Ok(std::fs::write(path, format!("{head}\n{body}</svg>\n"))?)
}

fn main() -> anyhow::Result<()> {
    let mut folder = None;
    let mut truth = None;
    let mut out = None;
    let mut params = Params::default();
    let mut arguments = std::env::args().skip(1);
    while let Some(argument) = arguments.next() {
        match argument.as_str() {
            "--out" => out = arguments.next().map(PathBuf::from),
            "--truth" => truth = arguments.next().map(PathBuf::from),
            "--off" => params.switch_off(&arguments.next().context("--off SWITCH")?)?,
            "--candidates" => params.candidates = arguments.next().context("--candidates N")?.parse()?,
            path => folder = Some(PathBuf::from(path)),
        }
    }
    let folder = folder.context("no folder")?;
    let begin = Instant::now();
    let mut files: Vec<PathBuf> = std::fs::read_dir(&folder)?.map(|e| e.map(|e| e.path())).collect::<Result<_, _>>()?;
    files.retain(|f| {
        f.extension().is_some_and(|e| ["png", "jpg", "jpeg", "bmp", "tiff", "tif"].iter().any(|x| e == *x))
    });
    files.sort();
    let pieces: Vec<Vec<Piece>> = files.par_iter().map(|f| load(f)).collect::<Result<_, _>>()?;
    let pieces: Vec<Piece> = pieces.into_iter().flatten().collect();
    println!("{} pieces, features {:.2} s", pieces.len(), begin.elapsed().as_secs_f64());
    let mut solver = Solver::new(params)?;
    for piece in &pieces {
        solver.insert(piece.clone())?;
    }
    let assembly = solver.solve();
    let components = assembly.placements.iter().map(|p| p.component).max().map_or(0, |c| c + 1);
    let sizes: Vec<usize> =
        (0..components).map(|c| assembly.placements.iter().filter(|p| p.component == c).count()).collect();
    println!("components {sizes:?}, matings {}, unplaced {}", assembly.matings.len(), assembly.unplaced.len());
    println!("{:?}\n{:?}", assembly.table, assembly.timings);
    let residual = assembly.matings.iter().map(|m| m.ave_gap).sum::<f64>() / assembly.matings.len().max(1) as f64;
    let mut clearances: Vec<f64> = assembly.matings.iter().map(|m| m.clearance).collect();
    clearances.sort_by(f64::total_cmp);
    println!(
        "mean gap {residual:.2} px, clearance {:?}",
        [0.05, 0.5, 0.95].map(|q| clearances.get((q * clearances.len() as f64) as usize))
    );
    if let Some(out) = out {
        draw(&out, &pieces, &assembly)?;
    }
    if let Some(truth) = truth {
        let text = std::fs::read_to_string(truth)?;
        let mut cell = HashMap::new();
        for line in text.lines().skip(1) {
            let f: Vec<&str> = line.split(',').collect();
            cell.insert(f[0].to_owned(), (f[1].parse::<i64>()?, f[2].parse::<i64>()?, f[3].parse::<f64>()?));
        }
        let at = |k: usize| cell.get(&pieces[k].id).copied();
        let mut wrong = 0;
        for m in &assembly.matings {
            if let (Some(a), Some(b)) = (at(m.positive_piece), at(m.negative_piece))
                && (a.0 - b.0).abs() + (a.1 - b.1).abs() != 1
            {
                wrong += 1;
                println!("wrong mating {} {} {m:?}", pieces[m.positive_piece].id, pieces[m.negative_piece].id);
            }
        }
        let joints = cell.values().filter(|a| cell.values().any(|b| b.0 == a.0 + 1 && b.1 == a.1)).count()
            + cell.values().filter(|a| cell.values().any(|b| b.1 == a.1 + 1 && b.0 == a.0)).count();
        println!("wrong matings {wrong} of {}; joints in all {joints}", assembly.matings.len());
        // Rotation against truth in the main component: placement turns the piece by theta, truth says rotation.
        for sign in [1.0, -1.0] {
            let mut off: Vec<(f64, usize)> = assembly
                .placements
                .iter()
                .filter(|p| p.component == 0)
                .filter_map(|p| at(p.piece).map(|t| (p.puzzle_from_image.rotation.angle() - sign * t.2, p.piece)))
                .collect();
            let (s, c) = off.iter().fold((0.0, 0.0), |(s, c), a| (s + a.0.sin(), c + a.0.cos()));
            let mean = s.atan2(c);
            for a in &mut off {
                a.0 = ((a.0 - mean + std::f64::consts::PI).rem_euclid(std::f64::consts::TAU) - std::f64::consts::PI)
                    .abs();
            }
            off.sort_by(|p, q| q.0.total_cmp(&p.0));
            let bad = off.iter().filter(|a| a.0 > 0.14).count();
            println!("rotation against truth (sign {sign}): {bad} of {} off by over 8 degrees", off.len());
            if bad < 12 {
                off.iter().take(bad).for_each(|(a, k)| println!("  {} {a:.2}", pieces[*k].id));
            }
        }
    }
    Ok(())
}
