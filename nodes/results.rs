//! Files of results: their names, the form of `assembly.json`, and files written beside their place and renamed, so that a reader never sees
//! half a file.

use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use isthmus::mask;
use jigsaw::TableCounts;
use serde::Serialize;

/// Where the pieces of a puzzle belong.
pub(crate) const ASSEMBLY_FILE: &str = "assembly.json";
/// The picture of that.
pub(crate) const ASSEMBLY_PICTURE: &str = "assembly.png";
/// Ending of the pictures of pieces and frames.
pub(crate) const OVERLAY_ENDING: &str = "_overlay.png";

/// A file that can't be written.
#[derive(Debug, thiserror::Error)]
#[error("{}: can't write: {error}", path.display())]
pub struct WriteError {
    /// The file.
    pub path: PathBuf,
    /// Why.
    pub error: io::Error,
}

/// `assembly.json`.
#[derive(Serialize)]
pub(crate) struct AssemblyFile<'a> {
    pub(crate) pieces: Vec<PlacedRecord<'a>>,
    pub(crate) matings: Vec<MatingRecord<'a>>,
    pub(crate) unplaced: Vec<&'a str>,
    pub(crate) table: TableCounts,
    pub(crate) seconds: Seconds,
}

#[derive(Serialize)]
pub(crate) struct PlacedRecord<'a> {
    pub(crate) id: &'a str,
    pub(crate) source: &'a str,
    pub(crate) aoi: AoiRecord,
    pub(crate) puzzle_from_image: PoseRecord,
    pub(crate) component: usize,
    pub(crate) confidence: f64,
}

#[derive(Serialize)]
pub(crate) struct PoseRecord {
    pub(crate) x: f64,
    pub(crate) y: f64,
    pub(crate) theta: f64,
}

#[derive(Serialize)]
pub(crate) struct MatingRecord<'a> {
    pub(crate) positive: SideRecord<'a>,
    pub(crate) negative: SideRecord<'a>,
    pub(crate) correlation: f64,
    pub(crate) ave_gap_px: f64,
    pub(crate) clearance_px: f64,
    pub(crate) confidence: f64,
}

#[derive(Serialize)]
pub(crate) struct SideRecord<'a> {
    pub(crate) piece: &'a str,
    pub(crate) isthmus: usize,
}

#[derive(Serialize)]
pub(crate) struct AoiRecord {
    pub(crate) x: i32,
    pub(crate) y: i32,
    pub(crate) width: u32,
    pub(crate) height: u32,
}

impl From<mask::Aoi> for AoiRecord {
    fn from(aoi: mask::Aoi) -> Self {
        Self { x: aoi.x, y: aoi.y, width: aoi.width, height: aoi.height }
    }
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

/// Writes a JSON file.
///
/// # Errors
/// The file can't be written.
pub(crate) fn write_json(path: &Path, value: &impl Serialize) -> Result<(), WriteError> {
    write_file(path, |file| {
        serde_json::to_writer_pretty(&mut *file, value)?;
        writeln!(file)
    })
}

/// Writes a PNG file.
///
/// # Errors
/// The file can't be written.
pub(crate) fn write_png<P>(path: &Path, picture: &image::ImageBuffer<P, Vec<u8>>) -> Result<(), WriteError>
where
    P: image::Pixel<Subpixel = u8> + image::PixelWithColorType,
{
    write_file(path, |file| {
        picture.write_with_encoder(image::codecs::png::PngEncoder::new(file)).map_err(io::Error::other)
    })
}

/// Writes a file beside its place and renames it.
pub(crate) fn write_file(path: &Path, write: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> Result<(), WriteError> {
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
        WriteError { path: path.into(), error }
    })
}

/// Makes a folder and those above it.
///
/// # Errors
/// The folder can't be made.
pub(crate) fn make_folder(path: &Path) -> Result<(), WriteError> {
    fs::create_dir_all(path).map_err(|error| WriteError { path: path.into(), error })
}
