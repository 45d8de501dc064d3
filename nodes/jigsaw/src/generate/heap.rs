//! The heap: which pieces there are, which side is up, and where in which frame each lies.
//!
//! Pieces are taken away, turned face down and doubled, then shuffled, dealt out to the frames, and each turned and laid at random into a place
//! of its own. Within a frame they are numbered in the reading order of the top left corners of their bounding boxes.

use std::f64::consts::TAU;

use isthmus::Point;
use nalgebra::{Isometry2, Vector2};
use rand::RngExt;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;

use super::cut::Sheet;
use super::options::tray;
use super::{BLUR_REACH, GenerateError, Options, TruePiece};

/// Ground that stays free around each piece beyond the reach of the blur, in pixels.
const MARGIN: f64 = 6.0;
/// Pixels by which the upper ends of two pieces of one frame differ, so that noise can't change their reading order.
const TOPS_APART: i64 = 3;
/// Tries to lay a piece so; a very full frame may lack the room.
const LAY_TRIES: usize = 50;

/// A heap of pieces.
#[derive(Debug, Clone)]
pub(super) struct Heap {
    pub(super) pieces: Vec<TruePiece>,
    pub(super) frames: usize,
    /// For each sheet and face the piece that is its original, if it isn't missing.
    pub(super) piece_of_face: Vec<Vec<Option<usize>>>,
}

/// A piece that is in the heap.
#[derive(Clone, Copy)]
struct Lying {
    sheet: usize,
    face: usize,
    flipped: bool,
    copy: bool,
}

/// A piece that lies in a frame.
struct Laid {
    piece: Lying,
    pose: Isometry2<f64>,
    /// First pixel column and row that it covers by at least half, about.
    left: i64,
    top: i64,
}

impl Heap {
    /// Mixes the pieces of some sheets.
    ///
    /// # Errors
    /// A piece that doesn't fit into its frame.
    pub(super) fn mix(options: &Options, sheets: &[Sheet], rng: &mut ChaCha8Rng) -> Result<Self, GenerateError> {
        let lying = choose(options, sheets, rng);
        let per_frame = options.pieces_per_frame;
        let frames = lying.len().div_ceil(per_frame);
        let mut piece_of_face: Vec<Vec<Option<usize>>> = sheets.iter().map(|s| vec![None; s.faces.len()]).collect();
        let mut pieces = Vec::with_capacity(lying.len());
        let mut copies = Vec::new();
        for (frame, chunk) in lying.chunks(per_frame).enumerate() {
            for (k, Laid { piece, pose, .. }) in lay_all(options, sheets, chunk, rng)?.into_iter().enumerate() {
                let stem = frame_stem(per_frame, frame);
                let face = &sheets[piece.sheet].faces[piece.face];
                if piece.copy {
                    copies.push(pieces.len());
                } else {
                    piece_of_face[piece.sheet][piece.face] = Some(pieces.len());
                }
                pieces.push(TruePiece {
                    id: if chunk.len() == 1 { stem } else { format!("{stem}_{k}") },
                    puzzle: piece.sheet,
                    row: face.row,
                    column: face.column,
                    frame,
                    flipped: piece.flipped,
                    duplicate_of: None,
                    face: piece.face,
                    pose,
                });
            }
        }
        for copy in copies {
            let piece = &mut pieces[copy];
            piece.duplicate_of = piece_of_face[piece.puzzle][piece.face];
        }
        Ok(Self { pieces, frames, piece_of_face })
    }
}

/// Takes pieces away, turns some face down, doubles some, and shuffles them.
fn choose(options: &Options, sheets: &[Sheet], rng: &mut ChaCha8Rng) -> Vec<Lying> {
    let mut faces: Vec<(usize, usize)> =
        sheets.iter().enumerate().flat_map(|(s, sheet)| (0..sheet.faces.len()).map(move |f| (s, f))).collect();
    faces.shuffle(rng);
    // A ragged rim leaves fewer faces than rows x columns: keep one piece at least.
    faces.truncate(faces.len().saturating_sub(options.missing).max(1));
    let flipped = options.flipped.min(faces.len());
    let mut lying: Vec<Lying> = faces
        .iter()
        .enumerate()
        .map(|(k, &(sheet, face))| Lying { sheet, face, flipped: k < flipped, copy: false })
        .collect();
    // Duplicate pieces that lie face up first: they are the ones that can be mistaken.
    let copies = faces.iter().cycle().skip(flipped).take(options.duplicate.min(faces.len()));
    lying.extend(copies.map(|&(sheet, face)| Lying { sheet, face, flipped: false, copy: true }));
    lying.shuffle(rng);
    lying
}

/// Lays the pieces of a frame; in reading order of the top left corners of their bounding boxes: by row of pixels, then by column.
fn lay_all(
    options: &Options,
    sheets: &[Sheet],
    pieces: &[Lying],
    rng: &mut ChaCha8Rng,
) -> Result<Vec<Laid>, GenerateError> {
    let mut all: Vec<Laid> = Vec::with_capacity(pieces.len());
    for (slot, &piece) in pieces.iter().enumerate() {
        let outline = oriented_outline(&sheets[piece.sheet], piece.face, piece.flipped);
        let mut lay_once = || {
            let pose = lay(options, &outline, slot, rng)?;
            let (left, top) = corner(outline.iter().map(|p| pose * p));
            Ok(Laid { piece, pose, left, top })
        };
        let mut laid = lay_once()?;
        for _ in 0..LAY_TRIES {
            if all.iter().all(|other| (other.top - laid.top).abs() >= TOPS_APART) {
                break;
            }
            laid = lay_once()?;
        }
        all.push(laid);
    }
    all.sort_by_key(|laid| (laid.top, laid.left));
    Ok(all)
}

/// File stem of a frame.
pub(super) fn frame_stem(pieces_per_frame: usize, frame: usize) -> String {
    let what = if pieces_per_frame == 1 { "piece" } else { "frame" };
    format!("{what}_{frame:04}")
}

/// A place as it is seen from the other side of the sheet.
pub(super) fn mirror(p: Point) -> Point {
    Point::new(-p.x, p.y)
}

/// The outline in the puzzle frame; mirrored (and run the other way, to stay clockwise) for a piece face down.
pub(super) fn oriented_outline(sheet: &Sheet, face: usize, flipped: bool) -> Vec<Point> {
    let mut outline = sheet.outline(face);
    if flipped {
        outline.iter_mut().for_each(|p| *p = mirror(*p));
        outline.reverse();
    }
    outline
}

/// First pixel column and row that a shape covers by at least half, about.
fn corner(points: impl Iterator<Item = Point>) -> (i64, i64) {
    let (x, y) = points.fold((f64::MAX, f64::MAX), |(x, y), p| (x.min(p.x), y.min(p.y)));
    (x.round() as i64, y.round() as i64)
}

/// Turns a piece at random and lays it at random into its place of the frame.
fn lay(
    options: &Options,
    outline: &[Point],
    slot: usize,
    rng: &mut ChaCha8Rng,
) -> Result<Isometry2<f64>, GenerateError> {
    let [width, height] = options.frame_size().map(f64::from);
    let [columns, _] = tray(options.pieces_per_frame, width / height);
    let [room_width, room_height] = options.room();
    let turn = nalgebra::UnitComplex::new(rng.random_range(0.0..TAU));
    let (mut low, mut high) = (Vector2::repeat(f64::MAX), Vector2::repeat(f64::MIN));
    for p in outline {
        let p = (turn * p).coords;
        low = low.inf(&p);
        high = high.sup(&p);
    }
    let margin = MARGIN + BLUR_REACH * options.blur;
    let (extent, shift) = (high - low, Vector2::new(rng.random::<f64>(), rng.random::<f64>()));
    let free = Vector2::new(room_width, room_height) - extent - Vector2::repeat(2.0 * margin);
    if free.min() < 0.0 {
        return Err(GenerateError::DoesNotFit { width: extent.x, height: extent.y, room_width, room_height });
    }
    let room = Vector2::new((slot % columns) as f64 * room_width, (slot / columns) as f64 * room_height);
    // Pixel centres lie at whole numbers: the frame begins at -0.5.
    let target = room + Vector2::repeat(margin - 0.5) + free.component_mul(&shift);
    Ok(Isometry2::from_parts((target - low).into(), turn))
}
