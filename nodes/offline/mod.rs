//! The pipeline without nodes: image files or a bag in, `assembly.json`, `assembly.png`, `matches.csv` out.
//!
//! ```text
//! images ── segment ── cutouts ── features ── pieces ── solve ── assembly ── files
//! ```
//!
//! Images are worked on in parallel, a batch at a time, so that memory holds the pixels of one batch only. An image
//! that can't be used costs a warning, not the run. Files are written beside their place and renamed, so that a reader
//! never sees half a file.

mod generated;
mod inputs;
mod look;
mod records;
mod report;

use std::borrow::Cow;
use std::path::{Path, PathBuf};
use std::time::Instant;

use image::GrayImage;
use isthmus::Features;
use isthmus::mask::{self, Cutout};
use jigsaw::{Params, Piece, Solver};
use rayon::prelude::*;

use crate::capture::cut::Pixels;
use crate::picture;
use crate::results::{
    ASSEMBLY_FILE, ASSEMBLY_PICTURE, AssemblyFile, OVERLAY_ENDING, make_folder, write_json, write_png,
};
pub use crate::results::{Seconds, WriteError};
pub use generated::{write_bag, write_images};
use inputs::find_inputs;
use look::{Seen, look};
use records::{FeaturesRecord, write_csv};
pub use report::{OfflineError, Progress};

/// What became of [`assemble`].
#[derive(Debug, Clone, PartialEq)]
pub struct Outcome {
    /// Pieces found, each once: not where one lay before it was seen elsewhere.
    pub pieces: usize,
    /// Pieces placed in the largest assembly.
    pub placed: usize,
    /// Connected assemblies.
    pub components: usize,
    /// Matings.
    pub matings: usize,
    /// Pieces that were seen but couldn't be used (cut by the frame's edge, touching another).
    pub unusable: usize,
    /// Where the time went.
    pub seconds: Seconds,
}

impl Outcome {
    /// Whether every piece was placed in one assembly.
    pub fn is_complete(&self) -> bool {
        self.unusable == 0 && self.placed == self.pieces
    }
}

/// Assembles the pieces of images, folders of images or bags, and writes the results into the folder `out`.
///
/// # Errors
/// Input of which nothing can be used, parameters out of range, or files that can't be written.
pub fn assemble(
    paths: &[PathBuf],
    out: &Path,
    params: &Params,
    progress: &dyn Progress,
) -> Result<Outcome, OfflineError> {
    let mut solver = Solver::new(*params)?;
    let inputs = find_inputs(paths, out, progress)?;
    make_folder(out)?;
    let mut seconds = Seconds::default();
    let mut unusable = 0;
    let mut seen: Vec<Seen> = vec![];
    look(&inputs, progress, &mut seconds, |image| {
        unusable += image.unusable;
        seen.extend(image.shapes.into_iter().map(|(_, seen)| seen));
        Ok(())
    })?;

    progress.stage("matching and assembling", 0);
    let start = Instant::now();
    let mut known: Vec<(String, mask::Aoi)> = vec![];
    for Seen { source, aoi, piece } in seen {
        match solver.insert(piece) {
            Ok(_) => known.push((source, aoi)),
            Err(error) => {
                unusable += 1;
                progress.warning(&format!("{source}: {error}; left out"));
            }
        }
    }
    let assembly = solver.solve();
    // What the solver's own stages don't cover belongs to matching.
    let whole = start.elapsed().as_secs_f64();
    seconds.assemble = assembly.timings.assembly.min(whole);
    seconds.r#match = whole - seconds.assemble;

    progress.stage("writing", 3);
    let pieces = solver.pieces();
    write_json(&out.join(ASSEMBLY_FILE), &AssemblyFile::new(pieces, &known, &assembly, seconds))?;
    progress.step();
    write_csv(&out.join("matches.csv"), pieces, &solver.candidates())?;
    progress.step();
    write_png(&out.join(ASSEMBLY_PICTURE), &picture::assembly(pieces, &assembly, picture::AssemblyStyle::default()))?;
    progress.step();
    Ok(Outcome {
        pieces: pieces.len() - assembly.earlier.len(),
        placed: assembly.placements.iter().filter(|p| p.component == 0).count(),
        components: assembly.placements.iter().map(|p| p.component + 1).max().unwrap_or(0),
        matings: assembly.matings.len(),
        unusable,
        seconds,
    })
}

/// Analyses the pieces of images and writes `features.json` and a picture of each piece into the folder `out`; gives
/// how many pieces there were.
///
/// # Errors
/// Input of which nothing can be used, or files that can't be written.
pub fn inspect(paths: &[PathBuf], out: &Path, progress: &dyn Progress) -> Result<usize, OfflineError> {
    let inputs = find_inputs(paths, out, progress)?;
    make_folder(out)?;
    let mut records = vec![];
    look(&inputs, progress, &mut Seconds::default(), |image| {
        let pictures: Vec<Result<(), WriteError>> = image
            .shapes
            .par_iter()
            .map(|(cutout, seen)| {
                let Piece { id, features, .. } = &seen.piece;
                let style = picture::InspectionStyle::default();
                let drawn = picture::inspection(id, &seen.source, cutout, features, style);
                write_png(&out.join(format!("{id}{OVERLAY_ENDING}")), &drawn)
            })
            .collect();
        pictures.into_iter().collect::<Result<(), _>>()?;
        if image.shapes.len() > 1 {
            let shapes: Vec<(&str, &Cutout, &Features)> =
                image.shapes.iter().map(|(c, seen)| (seen.piece.id.as_str(), c, &seen.piece.features)).collect();
            let overview = picture::frame_overview(&grey(&image.frame), &shapes, picture::OVERVIEW_SIDE);
            write_png(&out.join(format!("{}{OVERLAY_ENDING}", image.stem)), &overview)?;
        }
        records.extend(image.shapes.iter().map(|(_, seen)| FeaturesRecord::new(seen)));
        Ok(())
    })?;
    write_json(&out.join("features.json"), &records)?;
    Ok(records.len())
}

fn grey(frame: &Pixels) -> Cow<'_, GrayImage> {
    match frame {
        Pixels::Grey(grey) => Cow::Borrowed(grey),
        Pixels::Rgb(colour) => Cow::Owned(image::imageops::grayscale(colour)),
    }
}
