//! Generated puzzles as images or as a bag, with their truth.

use std::io;
use std::path::Path;

use jigsaw::generate::{self, Puzzle};
use rayon::prelude::*;

use super::look::BATCH;
use super::report::{OfflineError, Progress};
use crate::bag::frames::{FrameBag, TOPIC};
use crate::capture::known::FrameName;
use crate::results::{make_folder, write_file, write_json};

/// Stamp of the first frame of a generated bag, in ns since the epoch: fixed, so that the same seed gives the same bag.
const FIRST_STAMP_NS: i64 = 1_700_000_000_000_000_000;

/// Writes a generated puzzle as images and `truth.json` into the folder `out`.
///
/// # Errors
/// Files that can't be written.
pub fn write_images(puzzle: &Puzzle, out: &Path, progress: &dyn Progress) -> Result<(), OfflineError> {
    make_folder(out)?;
    progress.stage("rendering", puzzle.frame_count());
    (0..puzzle.frame_count()).into_par_iter().try_for_each(|k| {
        write_file(&out.join(format!("{}.png", puzzle.frame_stem(k))), |file| file.write_all(&rendered(puzzle, k)?))?;
        progress.step();
        Ok::<_, OfflineError>(())
    })?;
    Ok(write_json(&out.join("truth.json"), &puzzle.truth("png"))?)
}

/// Writes a generated puzzle as a bag with the new folder `out`, `rate` frames a second, and `truth.json` inside, in which
/// pieces are called as the nodes call them.
///
/// # Errors
/// A bag that can't be written.
pub fn write_bag(puzzle: &Puzzle, out: &Path, rate: f64, progress: &dyn Progress) -> Result<(), OfflineError> {
    let period = (1e9 / rate).round() as i64;
    let mut bag = FrameBag::create(out, FIRST_STAMP_NS, period)?;
    progress.stage("rendering", puzzle.frame_count());
    let frames: Vec<usize> = (0..puzzle.frame_count()).collect();
    for batch in frames.chunks(BATCH) {
        let rendered: Vec<generate::Frame> = batch.par_iter().map(|&k| puzzle.render(k)).collect();
        for frame in rendered {
            bag.push(frame.width, frame.height, &frame.pixels)?;
            progress.step();
        }
    }
    bag.finish()?;
    let label = |frame: usize| {
        let stamp = FIRST_STAMP_NS + frame as i64 * period;
        let second = 1_000_000_000;
        let sec = i32::try_from(stamp.div_euclid(second)).unwrap_or(i32::MAX);
        let name = FrameName::Stamp(TOPIC.into(), sec, stamp.rem_euclid(second) as u32);
        generate::FrameLabel { stem: name.base(), source: TOPIC.into() }
    };
    Ok(write_json(&out.join("truth.json"), &puzzle.truth_labelled(label))?)
}

/// A frame of a generated puzzle as PNG.
fn rendered(puzzle: &Puzzle, frame: usize) -> io::Result<Vec<u8>> {
    let frame = puzzle.render(frame);
    let mut png = vec![];
    let encoder = image::codecs::png::PngEncoder::new(&mut png);
    image::ImageEncoder::write_image(encoder, &frame.pixels, frame.width, frame.height, image::ExtendedColorType::L8)
        .map_err(io::Error::other)?;
    Ok(png)
}
