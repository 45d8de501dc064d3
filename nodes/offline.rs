//! The pipeline without nodes: image files or a bag in, `assembly.json`, `assembly.png`, `matches.csv` out.
//!
//! ```text
//! images ── segment ── cutouts ── features ── pieces ── solve ── assembly ── files
//! ```
//!
//! Images are worked on in parallel, a batch at a time, so that memory holds the pixels of one batch only. An image
//! that can't be used costs a warning, not the run. Files are written beside their place and renamed, so that a reader
//! never sees half a file.

use std::borrow::Cow;
use std::collections::BTreeSet;
use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::Instant;

use image::GrayImage;
use isthmus::isthmus::Polarity;
use isthmus::mask::{self, Cutout, Segmentation, Segmenter};
use isthmus::profile::distance_function;
use isthmus::{Extractor, Features};
use jigsaw::generate::{self, Puzzle};
use jigsaw::{Assembly, Candidate, Fate, Params, Piece, Solver, TableCounts};
use rayon::prelude::*;
use serde::Serialize;

use crate::bag::frames::{FrameBag, TOPIC};
use crate::bag::{BagError, BagReader, RawMessage, Selection, Storage, TopicCount, cdr};
use crate::capture::convert::{self, FrameError, Picture};
use crate::capture::cut::{self, Pixels};
use crate::capture::known::{FrameName, Known};
use crate::capture::params::SAME_PLACE_OVERLAP;
use crate::capture::source::{Frame, PICTURE_ENDINGS};
use crate::picture;

/// Images segmented at once: bounds the memory for pixels, and keeps all threads busy.
const BATCH: usize = 64;
/// Samples of an isthmus distance function in `features.json`.
const IDF_SAMPLES: usize = 64;
/// Ending of the pictures that [`inspect`] writes.
const OVERLAY_ENDING: &str = "_overlay.png";
/// Types of the messages that are pictures.
const RAW_IMAGE: &str = "sensor_msgs/msg/Image";
const COMPRESSED_IMAGE: &str = "sensor_msgs/msg/CompressedImage";
/// Stamp of the first frame of a generated bag, in ns since the epoch: fixed, so that the same seed gives the same bag.
const FIRST_STAMP_NS: i64 = 1_700_000_000_000_000_000;
/// Name of the picture that [`assemble`] writes.
const ASSEMBLY_PICTURE: &str = "assembly.png";

/// Input or output that can't be used at all.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum OfflineError {
    /// A path that can't be read.
    #[error("{}: {error}", path.display())]
    Read {
        /// The path.
        path: PathBuf,
        /// Why.
        error: io::Error,
    },
    /// A folder without an image.
    #[error("{}: no image in this folder; expected files ending in .{}", path.display(), PICTURE_ENDINGS.join(", ."))]
    EmptyFolder {
        /// The folder.
        path: PathBuf,
    },
    /// Nothing of the input can be used.
    #[error("no usable piece in {images} image{}: {reason}", if *images == 1 { "" } else { "s" })]
    NoPiece {
        /// How many images were looked at.
        images: usize,
        /// Why the first of them couldn't be used.
        reason: String,
    },
    /// A bag that can't be read, or written.
    #[error(transparent)]
    Bag(#[from] BagError),
    /// A bag without pictures.
    #[error("{}: no topic of type sensor_msgs/msg/Image or CompressedImage in this bag", path.display())]
    NoTopic {
        /// The bag.
        path: PathBuf,
    },
    /// A file that can't be written.
    #[error("{}: can't write: {error}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// Why.
        error: io::Error,
    },
    /// A parameter of the solver out of its range.
    #[error(transparent)]
    Solver(#[from] jigsaw::SolverError),
}

/// What a run tells while it goes on: the caller shows it or not.
pub trait Progress: Sync {
    /// A stage begins: its name and how many steps it takes (0 where that isn't known).
    fn stage(&self, name: &str, steps: usize);
    /// One step is done.
    fn step(&self);
    /// Something is wrong with a part of the input; the run goes on without it.
    fn warning(&self, text: &str);
}

/// Keeps silent.
#[derive(Debug, Clone, Copy, Default)]
pub struct Silent;

impl Progress for Silent {
    fn stage(&self, _name: &str, _steps: usize) {}
    fn step(&self) {}
    fn warning(&self, _text: &str) {}
}

/// Wall-clock seconds of each stage, as `assembly.json` gives them. Reading and decoding count as segmenting.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Seconds {
    /// Reading, decoding, segmenting.
    pub segment: f64,
    /// Borders, skeletons, isthmuses.
    pub features: f64,
    /// Candidates.
    pub r#match: f64,
    /// Assembling.
    pub assemble: f64,
}

/// What became of [`assemble`].
#[derive(Debug, Clone, PartialEq)]
pub struct Outcome {
    /// Pieces found.
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

/// A piece with where it came from.
struct Seen {
    source: String,
    aoi: mask::Aoi,
    piece: Piece,
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
    write_json(&out.join("assembly.json"), &AssemblyFile::new(pieces, &known, &assembly, seconds))?;
    progress.step();
    write_csv(&out.join("matches.csv"), pieces, &solver.candidates())?;
    progress.step();
    write_png(&out.join(ASSEMBLY_PICTURE), &picture::assembly(pieces, &assembly, picture::AssemblyStyle::default()))?;
    progress.step();
    Ok(Outcome {
        pieces: pieces.len(),
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
        let pictures: Vec<Result<(), OfflineError>> = image
            .shapes
            .par_iter()
            .map(|(cutout, seen)| {
                let Piece { id, features } = &seen.piece;
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
    write_json(&out.join("truth.json"), &puzzle.truth("png"))
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
    write_json(&out.join("truth.json"), &puzzle.truth_labelled(label))
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

/// One image, not yet read.
enum Input {
    File(PathBuf),
    /// A message of a bag.
    Message(RawMessage),
    /// A part of a bag that can't be read: why.
    Unreadable(String),
}

impl Input {
    fn read(self) -> Result<Picture, String> {
        let frame = match self {
            Input::File(path) => Frame::File(path),
            Input::Message(message) => {
                let topic = message.topic.name.clone();
                let undecodable = |error| format!("{topic}: {error}");
                if message.topic.type_name == COMPRESSED_IMAGE {
                    Frame::Compressed(topic.clone(), cdr::decode(&message.cdr).map_err(undecodable)?)
                } else {
                    Frame::Raw(topic.clone(), cdr::decode(&message.cdr).map_err(undecodable)?)
                }
            }
            Input::Unreadable(reason) => return Err(reason),
        };
        convert::picture(frame).map_err(|error| one_line(&error.to_string()))
    }
}

fn one_line(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// A path of the command line that can be read.
enum Origin {
    File(PathBuf),
    Bag(BagReader),
}

impl Origin {
    /// How many images it holds.
    fn count(&self) -> usize {
        match self {
            Origin::File(_) => 1,
            Origin::Bag(bag) => image_topics(bag).map(|topic| topic.messages as usize).sum(),
        }
    }

    fn images(&self) -> Result<Box<dyn Iterator<Item = Input> + '_>, OfflineError> {
        match self {
            Origin::File(path) => Ok(Box::new(std::iter::once(Input::File(path.clone())))),
            Origin::Bag(bag) => {
                let selection = Selection::topics(image_topics(bag).map(|topic| topic.topic.name.clone()));
                Ok(Box::new(bag.messages(selection)?.map(|message| match message {
                    Ok(message) => Input::Message(message),
                    Err(error) => Input::Unreadable(one_line(&error.to_string())),
                })))
            }
        }
    }
}

fn image_topics(bag: &BagReader) -> impl Iterator<Item = &TopicCount> {
    bag.topics().iter().filter(|topic| [RAW_IMAGE, COMPRESSED_IMAGE].contains(&topic.topic.type_name.as_str()))
}

/// File name extension in lower case.
fn extension(path: &Path) -> String {
    path.extension().map(|e| e.to_string_lossy().to_lowercase()).unwrap_or_default()
}

/// Whether a path is a bag: a file of one, or a folder with one.
fn is_bag(path: &Path) -> bool {
    if path.is_dir() {
        let holds_storage =
            |mut entries: fs::ReadDir| entries.any(|e| e.is_ok_and(|e| !e.path().is_dir() && is_bag(&e.path())));
        return path.join("metadata.yaml").is_file() || fs::read_dir(path).is_ok_and(holds_storage);
    }
    let storage = [Storage::Mcap, Storage::Sqlite3].map(Storage::extension);
    let name = if extension(path) == "zstd" { path.with_extension("") } else { path.to_path_buf() };
    storage.contains(&extension(&name).as_str())
}

/// What the paths name, the files of each folder in the order of their names. Pictures that a run wrote into `out` itself
/// are not taken for input.
fn find_inputs(paths: &[PathBuf], out: &Path, progress: &dyn Progress) -> Result<Vec<Origin>, OfflineError> {
    let mut origins = vec![];
    for path in paths {
        let read = |error| OfflineError::Read { path: path.clone(), error };
        let is_folder = fs::metadata(path).map_err(read)?.is_dir();
        if is_bag(path) {
            let bag = BagReader::open(path)?;
            bag.warnings().iter().for_each(|warning| progress.warning(&one_line(&warning.to_string())));
            if image_topics(&bag).next().is_none() {
                return Err(OfflineError::NoTopic { path: path.clone() });
            }
            origins.push(Origin::Bag(bag));
            continue;
        }
        if !is_folder {
            origins.push(Origin::File(path.clone()));
            continue;
        }
        let own = matches!((path.canonicalize(), out.canonicalize()), (Ok(a), Ok(b)) if a == b);
        let mut files = vec![];
        for entry in fs::read_dir(path).map_err(read)? {
            let file = entry.map_err(read)?.path();
            let name = file.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
            let written = own && (name == ASSEMBLY_PICTURE || name.ends_with(OVERLAY_ENDING));
            let wanted = PICTURE_ENDINGS.contains(&extension(&file).as_str());
            if wanted && !name.starts_with('.') && !written && file.is_file() {
                files.push(file);
            }
        }
        if files.is_empty() {
            return Err(OfflineError::EmptyFolder { path: path.clone() });
        }
        files.sort();
        origins.extend(files.into_iter().map(Origin::File));
    }
    Ok(origins)
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
struct Named {
    stem: String,
    frame: Pixels,
    shapes: Vec<(Cutout, Seen)>,
    unusable: usize,
}

/// Segments and analyses all images, a batch at a time, and hands each on in order.
fn look(
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
            let seen = Seen { source: source.clone(), aoi: cutout.aoi, piece: Piece { id, features } };
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

#[derive(Serialize)]
struct AoiRecord {
    x: i32,
    y: i32,
    width: u32,
    height: u32,
}

impl From<mask::Aoi> for AoiRecord {
    fn from(aoi: mask::Aoi) -> Self {
        Self { x: aoi.x, y: aoi.y, width: aoi.width, height: aoi.height }
    }
}

/// `assembly.json`.
#[derive(Serialize)]
struct AssemblyFile<'a> {
    pieces: Vec<PlacedRecord<'a>>,
    matings: Vec<MatingRecord<'a>>,
    unplaced: Vec<&'a str>,
    table: TableCounts,
    seconds: Seconds,
}

#[derive(Serialize)]
struct PlacedRecord<'a> {
    id: &'a str,
    source: &'a str,
    aoi: AoiRecord,
    puzzle_from_image: PoseRecord,
    component: usize,
    confidence: f64,
}

#[derive(Serialize)]
struct PoseRecord {
    x: f64,
    y: f64,
    theta: f64,
}

#[derive(Serialize)]
struct MatingRecord<'a> {
    positive: SideRecord<'a>,
    negative: SideRecord<'a>,
    correlation: f64,
    ave_gap_px: f64,
    clearance_px: f64,
    confidence: f64,
}

#[derive(Serialize)]
struct SideRecord<'a> {
    piece: &'a str,
    isthmus: usize,
}

impl<'a> AssemblyFile<'a> {
    fn new(pieces: &'a [Piece], known: &'a [(String, mask::Aoi)], assembly: &Assembly, seconds: Seconds) -> Self {
        let mut placed: Vec<PlacedRecord<'a>> = assembly
            .placements
            .iter()
            .map(|placement| PlacedRecord {
                id: &pieces[placement.piece].id,
                source: &known[placement.piece].0,
                aoi: known[placement.piece].1.into(),
                puzzle_from_image: PoseRecord {
                    x: placement.puzzle_from_image.translation.x,
                    y: placement.puzzle_from_image.translation.y,
                    theta: placement.puzzle_from_image.rotation.angle(),
                },
                component: placement.component,
                confidence: placement.confidence,
            })
            .collect();
        placed.sort_by_key(|record| (record.component, record.id));
        let side = |piece: usize, isthmus: usize| SideRecord { piece: &pieces[piece].id, isthmus };
        let matings = assembly.matings.iter().map(|mating| MatingRecord {
            positive: side(mating.positive_piece, mating.positive_isthmus),
            negative: side(mating.negative_piece, mating.negative_isthmus),
            correlation: mating.correlation,
            ave_gap_px: mating.ave_gap,
            clearance_px: mating.clearance,
            confidence: mating.confidence,
        });
        let mut unplaced: Vec<&str> = assembly.unplaced.iter().map(|&piece| pieces[piece].id.as_str()).collect();
        unplaced.sort_unstable();
        Self { pieces: placed, matings: matings.collect(), unplaced, table: assembly.table, seconds }
    }
}

/// One entry of `features.json`.
#[derive(Serialize)]
struct FeaturesRecord {
    id: String,
    source: String,
    aoi: AoiRecord,
    border_length_px: f64,
    noise_px: f64,
    isthmuses: Vec<IsthmusRecord>,
}

#[derive(Serialize)]
struct IsthmusRecord {
    polarity: &'static str,
    salient: bool,
    point: [f64; 2],
    critical_points: [[f64; 2]; 2],
    width_px: f64,
    path_length_px: f64,
    persistence_px: f64,
    idf: Vec<f64>,
}

impl FeaturesRecord {
    fn new(seen: &Seen) -> Self {
        let Features { border, noise, isthmuses, .. } = &seen.piece.features;
        let isthmuses = isthmuses
            .iter()
            .map(|isthmus| IsthmusRecord {
                polarity: match isthmus.polarity {
                    Polarity::Positive => "positive",
                    Polarity::Negative => "negative",
                },
                salient: isthmus.salient,
                point: [isthmus.point.x, isthmus.point.y],
                critical_points: isthmus.critical_points.map(|p| [p.x, p.y]),
                width_px: isthmus.width,
                path_length_px: isthmus.path_length,
                persistence_px: isthmus.persistence,
                idf: distance_function(border, isthmus, IDF_SAMPLES),
            })
            .collect();
        Self {
            id: seen.piece.id.clone(),
            source: seen.source.clone(),
            aoi: seen.aoi.into(),
            border_length_px: border.length(),
            noise_px: *noise,
            isthmuses,
        }
    }
}

/// One row of `matches.csv`; what was not computed, because a rule dropped the pair before, is empty.
#[derive(Serialize)]
struct MatchRow<'a> {
    positive_piece: &'a str,
    positive_isthmus: usize,
    negative_piece: &'a str,
    negative_isthmus: usize,
    opening_px: f64,
    path_difference_px: f64,
    shape_distance_px: f64,
    correlation: f64,
    pos_gap_px2: Option<f64>,
    neg_gap_px2: Option<f64>,
    ave_gap_px: Option<f64>,
    residual_px: Option<f64>,
    clearance_px: Option<f64>,
    support: usize,
    fate: String,
}

fn write_csv(path: &Path, pieces: &[Piece], candidates: &[Candidate]) -> Result<(), OfflineError> {
    write_file(path, |file| {
        let mut table = csv::Writer::from_writer(file);
        if candidates.is_empty() {
            // The writer takes the header from the first row: without one the file would be empty.
            table.write_record(MATCH_COLUMNS)?;
        }
        for candidate in candidates {
            table.serialize(MatchRow {
                positive_piece: &pieces[candidate.positive_piece].id,
                positive_isthmus: candidate.positive_isthmus,
                negative_piece: &pieces[candidate.negative_piece].id,
                negative_isthmus: candidate.negative_isthmus,
                opening_px: candidate.opening,
                path_difference_px: candidate.path_difference,
                shape_distance_px: candidate.shape_distance,
                correlation: candidate.correlation,
                pos_gap_px2: candidate.posed.map(|p| p.pos_gap),
                neg_gap_px2: candidate.posed.map(|p| p.neg_gap),
                ave_gap_px: candidate.posed.map(|p| p.ave_gap),
                residual_px: candidate.posed.map(|p| p.residual),
                clearance_px: candidate.posed.map(|p| p.clearance),
                support: candidate.support,
                fate: match candidate.fate {
                    Fate::Mated => "mated".into(),
                    Fate::Dropped(rule) => {
                        let name = serde_json::to_value(rule).unwrap_or_default();
                        format!("dropped: {}", name.as_str().unwrap_or("unknown rule"))
                    }
                },
            })?;
        }
        table.flush()
    })
}

/// Columns of `matches.csv`, as [`MatchRow`] names them.
const MATCH_COLUMNS: [&str; 15] = [
    "positive_piece",
    "positive_isthmus",
    "negative_piece",
    "negative_isthmus",
    "opening_px",
    "path_difference_px",
    "shape_distance_px",
    "correlation",
    "pos_gap_px2",
    "neg_gap_px2",
    "ave_gap_px",
    "residual_px",
    "clearance_px",
    "support",
    "fate",
];

/// Writes a JSON file.
///
/// # Errors
/// The file can't be written.
pub fn write_json(path: &Path, value: &impl Serialize) -> Result<(), OfflineError> {
    write_file(path, |file| {
        serde_json::to_writer_pretty(&mut *file, value)?;
        writeln!(file)
    })
}

/// Writes a PNG file.
///
/// # Errors
/// The file can't be written.
pub fn write_png<P>(path: &Path, picture: &image::ImageBuffer<P, Vec<u8>>) -> Result<(), OfflineError>
where
    P: image::Pixel<Subpixel = u8> + image::PixelWithColorType,
{
    write_file(path, |file| {
        picture.write_with_encoder(image::codecs::png::PngEncoder::new(file)).map_err(io::Error::other)
    })
}

/// Writes a file beside its place and renames it.
fn write_file(path: &Path, write: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> Result<(), OfflineError> {
    let name = path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let beside = path.with_file_name(format!(".{name}.{}.part", std::process::id()));
    let written = (|| {
        let mut file = io::BufWriter::new(fs::File::create(&beside)?);
        write(&mut file)?;
        file.into_inner().map_err(io::IntoInnerError::into_error)?.sync_all()?;
        fs::rename(&beside, path)
    })();
    written.map_err(|error| {
        // Nothing of a failed attempt stays behind; that it may be gone already is no news.
        let _ = fs::remove_file(&beside);
        OfflineError::Write { path: path.into(), error }
    })
}

/// Makes a folder and those above it.
///
/// # Errors
/// The folder can't be made.
pub fn make_folder(path: &Path) -> Result<(), OfflineError> {
    fs::create_dir_all(path).map_err(|error| OfflineError::Write { path: path.into(), error })
}
