//! Images to named pieces: read, cut out, analysed, a batch at a time, in parallel.

use std::collections::BTreeSet;
use std::path::Path;
use std::time::Instant;

use isthmus::mask::{self, Cutout, Segmentation, Segmenter};
use isthmus::{Extractor, Features};
use jigsaw::Piece;
use jigsaw_msgs::builtin_interfaces::msg::Time;
use rayon::prelude::*;

use super::inputs::{Input, Origin};
use super::report::{OfflineError, Progress};
use crate::capture::convert::{FrameError, Picture};
use crate::capture::cut::{self, Pixels};
use crate::capture::known::{FrameName, Known};
use crate::capture::params::SAME_PLACE_OVERLAP;
use crate::fields;
use crate::results::Seconds;

/// Images segmented at once: bounds the memory for pixels, and keeps all threads busy.
pub(super) const BATCH: usize = 64;

/// A piece with where it came from.
pub(super) struct Seen {
    pub(super) source: String,
    pub(super) aoi: mask::Aoi,
    pub(super) piece: Piece,
}

/// What was found in one image.
struct Looked {
    name: FrameName,
    content: u64,
    frame: Pixels,
    shapes: Vec<(Cutout, Features)>,
    /// Shapes that were seen but can't be used.
    unusable: usize,
    warnings: Vec<String>,
}

/// The pieces of one image, named.
pub(super) struct Named {
    pub(super) stem: String,
    pub(super) frame: Pixels,
    pub(super) shapes: Vec<(Cutout, Seen)>,
    pub(super) unusable: usize,
}

/// Segments and analyses all images, a batch at a time, and hands each on in order.
pub(super) fn look(
    origins: &[Origin],
    progress: &dyn Progress,
    seconds: &mut Seconds,
    mut take: impl FnMut(Named) -> Result<(), OfflineError>,
) -> Result<(), OfflineError> {
    let count = origins.iter().map(Origin::count).sum();
    progress.stage("looking at images", count);
    let mut names = Names::default();
    let mut found = 0;
    // Kept back until the first usable piece: without one the first of them becomes the error.
    let mut held = vec![];
    for origin in origins.chunk_by(|a, b| matches!((a, b), (Origin::File(_), Origin::File(_)))) {
        let mut images: Box<dyn Iterator<Item = Input>> = Box::new(std::iter::empty());
        for part in origin {
            images = Box::new(images.chain(part.images()?));
        }
        loop {
            let start = Instant::now();
            let batch: Vec<Input> = images.by_ref().take(BATCH).collect();
            if batch.is_empty() {
                break;
            }
            let segmented: Vec<Result<Segmented, String>> = batch
                .into_par_iter()
                .map_init(Segmenter::default, |segmenter, input| segment(segmenter, input.read()?))
                .collect();
            seconds.segment += start.elapsed().as_secs_f64();

            let start = Instant::now();
            let analysed: Vec<Result<Looked, String>> = segmented
                .into_par_iter()
                .map_init(Extractor::default, |extractor, segmented| {
                    let looked = segmented.map(|segmented| analyse(extractor, segmented));
                    progress.step();
                    looked
                })
                .collect();
            seconds.features += start.elapsed().as_secs_f64();

            for looked in analysed {
                match looked {
                    Ok(looked) => {
                        let named = names.name(looked, &mut held);
                        found += named.shapes.len();
                        take(named)?;
                    }
                    Err(error) => held.push(error),
                }
                if found > 0 {
                    held.drain(..).for_each(|text| progress.warning(&text));
                }
            }
        }
    }
    if found == 0 {
        let reason = held.into_iter().next().unwrap_or_else(|| "nothing found".into());
        return Err(OfflineError::NoPiece { images: count, reason });
    }
    Ok(())
}

/// Names pieces, each name once.
#[derive(Default)]
struct Names {
    taken: BTreeSet<String>,
    known: Known,
}

impl Names {
    /// A file's pieces are named after the file; those of a message as the capture node names them, and those it
    /// would take for known ones are left out.
    fn name(&mut self, looked: Looked, warnings: &mut Vec<String>) -> Named {
        warnings.extend(looked.warnings);
        let source = looked.name.source().to_owned();
        let count = looked.shapes.len();
        let (cutouts, features): (Vec<Cutout>, Vec<Features>) = looked.shapes.into_iter().unzip();
        let stem = match &looked.name {
            FrameName::File(name) => {
                Path::new(name).file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default()
            }
            name => name.base(),
        };
        let ids: Vec<Option<String>> = match &looked.name {
            FrameName::File(_) if count == 1 => vec![Some(stem.clone())],
            FrameName::File(_) => (0..count).map(|k| Some(format!("{stem}_{k}"))).collect(),
            name => {
                let admitted = self.known.admit(name, looked.content, &cutouts, same_place_overlap());
                admitted.into_iter().map(|a| (a.publish && !self.taken.contains(&a.id)).then_some(a.id)).collect()
            }
        };
        let seen = match &looked.name {
            FrameName::File(_) => 0,
            FrameName::Stamp(topic, sec, nanosec) => fields::seen(topic, &Time { sec: *sec, nanosec: *nanosec }),
        };
        let mut shapes = vec![];
        for ((cutout, features), id) in cutouts.into_iter().zip(features).zip(ids) {
            let Some(wanted) = id else { continue };
            // Files of the same stem in different folders: the later one gets another id.
            let mut id = wanted.clone();
            for copy in 2.. {
                if self.taken.insert(id.clone()) {
                    break;
                }
                id = format!("{wanted}~{copy}");
            }
            if id != wanted {
                warnings.push(format!("{source}: id {wanted} is taken, called {id} instead"));
            }
            let seen = Seen { source: source.clone(), aoi: cutout.aoi, piece: Piece { id, seen, features } };
            shapes.push((cutout, seen));
        }
        Named { stem, frame: looked.frame, shapes, unusable: looked.unusable }
    }
}

/// The capture node's default: from which overlap on a piece counts as seen before.
fn same_place_overlap() -> f64 {
    match SAME_PLACE_OVERLAP.default {
        crate::ros::params::Default::Double(overlap) => overlap,
        // No other type fits an overlap; exact coincidence is the strictest of all.
        _ => 1.0,
    }
}

/// The shapes of one image.
struct Segmented {
    name: FrameName,
    content: u64,
    frame: Pixels,
    segmentation: Segmentation,
}

fn segment(segmenter: &mut Segmenter, picture: Picture) -> Result<Segmented, String> {
    let source = picture.name.source().to_owned();
    let frame = Pixels::from(picture.pixels);
    let no_piece = |reason| FrameError::NoPiece { source_name: source, reason }.to_string();
    let segmentation = frame.cut(segmenter).map_err(no_piece)?;
    Ok(Segmented { name: picture.name, content: picture.content, frame, segmentation })
}

/// Features of the shapes of one image, and what is wrong with it.
fn analyse(extractor: &mut Extractor, segmented: Segmented) -> Looked {
    let Segmented { name, content, frame, segmentation } = segmented;
    let source = name.source();
    let mut shapes = vec![];
    let mut warnings: Vec<String> =
        cut::left_out(&segmentation).iter().map(|what| format!("{source}: {what}")).collect();
    let is_piece = |r: &&mask::Rejected| matches!(r.reason, mask::Reason::CutByFrame | mask::Reason::Touching);
    let mut unusable = segmentation.rejected.iter().filter(is_piece).count();
    for cutout in segmentation.cutouts {
        match extractor.extract(&cutout) {
            Ok(features) => shapes.push((cutout, features)),
            Err(error) => {
                unusable += 1;
                warnings.push(format!("{source}: the shape at ({}, {}): {error}", cutout.aoi.x, cutout.aoi.y));
            }
        }
    }
    Looked { name, content, frame, shapes, unusable, warnings }
}
