//! Synthetic jigsaw puzzles with truth.
//!
//! A puzzle is made in four steps, each reproducible from one seed:
//!
//! 1. **Cut** (`cut`): the sheet is divided into faces by joints. A joint is a smooth closed-form curve (a chain of
//!    cubic Béziers with a neck, drawn through a smooth warp of the whole sheet) sampled so densely that it stands for
//!    the true border.
//! 2. **Kerf**: each piece's outline is the loop of its joints, moved inward by half of each joint's clearance.
//! 3. **Heap**: pieces are taken away, doubled, turned face down, shuffled, turned and laid into frames.
//! 4. **Frames** (`render`): exact area coverage of each outline, Gaussian blur, vignette, sensor noise, 8 bit.
//!
//! The true critical points of a neck are the ends of the locally shortest chord between the two flanks of the curve.
//! That chord is normal to the curve at both ends, so that a kerf moves them along the chord: the neck of the tab
//! becomes narrower by the clearance and the mouth of the blank wider by it, exactly.
//!
//! Axes and units: pixels, x right, y **down**, pixel centres at whole numbers. Cost: linear in the number of pieces
//! and in the pixels of the frames; 10 000 outlines take seconds.
//!
//! ```
//! use jigsaw::generate::{Options, Puzzle};
//!
//! let puzzle = Puzzle::generate(&Options { rows: 2, columns: 3, seed: 7, ..Options::default() })?;
//! assert_eq!(puzzle.pieces().len(), 6);
//! let frame = puzzle.render(0);
//! assert_eq!((frame.width, frame.height), (1024, 1024));
//! # Ok::<(), jigsaw::generate::GenerateError>(())
//! ```

mod cut;
mod observe;
mod options;
mod render;
mod truth;

use std::f64::consts::TAU;

use isthmus::Point;
use nalgebra::{Isometry2, Vector2};
use rand::RngExt;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

use cut::Sheet;
pub use observe::ObserveError;
use options::tray;
pub use options::{Cut, GenerateError, Lighting, Options, Rim};
pub use render::Frame;
pub use truth::{FrameLabel, JointTruth, PieceTruth, PoseTruth, Score, SideTruth, Truth};

/// Ground that stays free around each piece beyond the reach of the blur, in pixels.
const MARGIN: f64 = 6.0;
/// Standard deviations after which a Gaussian is cut off: what is left is less than a quarter of a grey level.
const BLUR_REACH: f64 = 3.5;
/// Pixels by which the upper ends of two pieces of one frame differ, so that noise can't change their reading order.
const TOPS_APART: i64 = 3;
/// Tries to lay a piece so; a very full frame may lack the room.
const LAY_TRIES: usize = 50;
/// Random streams of one seed; frames use one each from `FRAMES` on.
mod stream {
    pub(super) const HEAP: u64 = 0;
    pub(super) const SHEETS: u64 = 1;
    pub(super) const FRAMES: u64 = 1 << 32;
}

fn rng(seed: u64, stream: u64) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(stream);
    rng
}

/// Kind of one side of a piece.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SideKind {
    /// Rim of the puzzle.
    Rim,
    /// The piece has the tab.
    Tab,
    /// The piece has the blank.
    Blank,
    /// A joint without a neck.
    Wave,
}

/// One side of a piece as it lies.
#[derive(Debug, Clone, PartialEq)]
pub struct Side {
    /// Number of the joint within its puzzle: the two sides of a joint share it.
    pub joint: usize,
    /// Kind of the side.
    pub kind: SideKind,
    /// Index of the piece on the other side (the original where there is a duplicate); none at the rim and beside a
    /// missing piece.
    pub neighbour: Option<usize>,
    /// Isthmus critical points in the frame, as the match segment runs; none without a neck.
    pub critical_points: Option<[Point; 2]>,
    /// Clearance of the joint, in pixels.
    pub clearance: f64,
}

/// One piece of the heap.
#[derive(Debug, Clone, PartialEq)]
pub struct TruePiece {
    /// `<file stem>` of its frame, or `<file stem>_<k>` in reading order where a frame holds more than one.
    pub id: String,
    /// Which puzzle of the heap it belongs to.
    pub puzzle: usize,
    /// Row in its puzzle.
    pub row: usize,
    /// Column in its puzzle.
    pub column: usize,
    /// Index of its frame.
    pub frame: usize,
    /// Whether it lies face down.
    pub flipped: bool,
    /// Index of the piece it is a copy of.
    pub duplicate_of: Option<usize>,
    face: usize,
    pose: Isometry2<f64>,
}

/// A heap of pieces with everything there is to know about them.
#[derive(Debug, Clone)]
pub struct Puzzle {
    options: Options,
    sheets: Vec<Sheet>,
    pieces: Vec<TruePiece>,
    frames: usize,
    /// For each sheet and face the piece that is its original, if it isn't missing.
    piece_of_face: Vec<Vec<Option<usize>>>,
}

impl Puzzle {
    /// Generates a puzzle. The same options give the same puzzle.
    ///
    /// # Errors
    /// An option out of its range, or a piece that doesn't fit into its frame.
    pub fn generate(options: &Options) -> Result<Self, GenerateError> {
        options.check()?;
        let sheets: Vec<Sheet> = (0..options.puzzles as u64)
            .map(|sheet| Sheet::cut(options, &mut rng(options.seed, stream::SHEETS + sheet)))
            .collect();
        let mut rng = rng(options.seed, stream::HEAP);

        let mut heap: Vec<(usize, usize)> =
            sheets.iter().enumerate().flat_map(|(s, sheet)| (0..sheet.faces.len()).map(move |f| (s, f))).collect();
        heap.shuffle(&mut rng);
        // A ragged rim leaves fewer faces than rows x columns: keep one piece at least.
        heap.truncate(heap.len().saturating_sub(options.missing).max(1));
        let flipped = options.flipped.min(heap.len());
        let mut lying: Vec<Lying> = heap
            .iter()
            .enumerate()
            .map(|(k, &(sheet, face))| Lying { sheet, face, flipped: k < flipped, copy: false })
            .collect();
        // Duplicate pieces that lie face up first: they are the ones that can be mistaken.
        let copies = heap.iter().cycle().skip(flipped).take(options.duplicate.min(heap.len()));
        lying.extend(copies.map(|&(sheet, face)| Lying { sheet, face, flipped: false, copy: true }));
        lying.shuffle(&mut rng);

        let mut piece_of_face: Vec<Vec<Option<usize>>> = sheets.iter().map(|s| vec![None; s.faces.len()]).collect();
        let per_frame = options.pieces_per_frame;
        let frames = lying.len().div_ceil(per_frame);
        let mut pieces = Vec::with_capacity(lying.len());
        let mut is_copy = Vec::with_capacity(lying.len());
        for (frame, chunk) in lying.chunks(per_frame).enumerate() {
            let mut laid = Vec::with_capacity(chunk.len());
            for (slot, &piece) in chunk.iter().enumerate() {
                let outline = oriented_outline(&sheets[piece.sheet], piece.face, piece.flipped);
                let mut pose = lay(options, &outline, slot, &mut rng)?;
                let mut top_left = corner(outline.iter().map(|p| pose * p));
                for _ in 0..LAY_TRIES {
                    if laid.iter().all(|((_, top), ..): &((i64, i64), _, _)| (top - top_left.1).abs() >= TOPS_APART) {
                        break;
                    }
                    pose = lay(options, &outline, slot, &mut rng)?;
                    top_left = corner(outline.iter().map(|p| pose * p));
                }
                laid.push((top_left, piece, pose));
            }
            // Reading order of the top left corners of the bounding boxes: by row of pixels, then by column.
            laid.sort_by_key(|((x, y), ..)| (*y, *x));
            for (k, (_, piece, pose)) in laid.into_iter().enumerate() {
                let stem = frame_stem(per_frame, frame);
                let face = &sheets[piece.sheet].faces[piece.face];
                let id = if chunk.len() == 1 { stem } else { format!("{stem}_{k}") };
                if !piece.copy {
                    piece_of_face[piece.sheet][piece.face] = Some(pieces.len());
                }
                is_copy.push(piece.copy);
                pieces.push(TruePiece {
                    id,
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
        for (piece, _) in pieces.iter_mut().zip(&is_copy).filter(|(_, copy)| **copy) {
            piece.duplicate_of = piece_of_face[piece.puzzle][piece.face];
        }
        Ok(Self { options: options.clone(), sheets, pieces, frames, piece_of_face })
    }

    /// What it was generated from.
    pub fn options(&self) -> &Options {
        &self.options
    }

    /// The pieces, in the order of their frames.
    pub fn pieces(&self) -> &[TruePiece] {
        &self.pieces
    }

    /// How many frames there are.
    pub fn frame_count(&self) -> usize {
        self.frames
    }

    /// File stem of a frame.
    pub fn frame_stem(&self, frame: usize) -> String {
        frame_stem(self.options.pieces_per_frame, frame)
    }

    /// True outline of a piece in its frame: clockwise as seen on a screen, points about half a pixel apart. The last
    /// point joins the first.
    pub fn outline(&self, piece: usize) -> Vec<Point> {
        let piece = &self.pieces[piece];
        let mut outline = oriented_outline(&self.sheets[piece.puzzle], piece.face, piece.flipped);
        outline.iter_mut().for_each(|p| *p = piece.pose * *p);
        outline
    }

    /// True border of a piece in its frame, resampled to equal steps of about `spacing` pixels: what a perfect
    /// segmentation would find.
    pub fn border(&self, piece: usize, spacing: f64) -> isthmus::contour::Border {
        let (points, spacing) = cut::resample_closed(&self.outline(piece), spacing);
        isthmus::contour::Border { points, spacing }
    }

    /// True pose: `p_puzzle = puzzle_from_image * p_image`. None for a piece that lies face down.
    pub fn puzzle_from_image(&self, piece: usize) -> Option<Isometry2<f64>> {
        let piece = &self.pieces[piece];
        (!piece.flipped).then(|| piece.pose.inverse())
    }

    /// The sides of a piece, as they follow one another along its outline.
    pub fn sides(&self, piece: usize) -> Vec<Side> {
        let piece = &self.pieces[piece];
        let sheet = &self.sheets[piece.puzzle];
        let place = |p: Point| piece.pose * if piece.flipped { mirror(p) } else { p };
        let mut sides: Vec<Side> = sheet.faces[piece.face]
            .sides
            .iter()
            .map(|&side| {
                let joint = &sheet.joints[side.joint];
                let kind = joint.kind_for(side);
                let critical_points = joint.critical_points_for(side).map(|[a, b]| {
                    let (a, b) = (place(a), place(b));
                    if piece.flipped { [b, a] } else { [a, b] }
                });
                let neighbour = joint.other_face(side).and_then(|face| self.piece_of_face[piece.puzzle][face]);
                Side { joint: side.joint, kind, neighbour, critical_points, clearance: joint.clearance }
            })
            .collect();
        if piece.flipped {
            sides.reverse();
        }
        sides
    }
}

#[derive(Clone, Copy)]
struct Lying {
    sheet: usize,
    face: usize,
    flipped: bool,
    copy: bool,
}

fn frame_stem(pieces_per_frame: usize, frame: usize) -> String {
    let what = if pieces_per_frame == 1 { "piece" } else { "frame" };
    format!("{what}_{frame:04}")
}

fn mirror(p: Point) -> Point {
    Point::new(-p.x, p.y)
}

/// The outline in the puzzle frame; mirrored (and run the other way, to stay clockwise) for a piece face down.
fn oriented_outline(sheet: &Sheet, face: usize, flipped: bool) -> Vec<Point> {
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

#[cfg(test)]
mod tests {
    use super::truth::area_and_centroid;
    use super::*;

    /// Error of a polygon's area against the curve it stands for, over its length: chords of half a pixel.
    const AREA_TOLERANCE: f64 = 1e-6;
    /// Distance between a border point and the polygon of its neighbour, in pixels: both are sampled every half pixel.
    const BORDER_TOLERANCE: f64 = 0.01;
    /// Centroid and area of a rendered piece against its outline: rounding to 8 bit.
    const RENDER_TOLERANCE: f64 = 0.02;

    fn generate(options: Options) -> Puzzle {
        Puzzle::generate(&options).unwrap()
    }

    fn kinds_of_cut() -> Vec<Options> {
        let mut all = vec![];
        for cut in [Cut::Grid, Cut::Brick, Cut::Honeycomb] {
            for rim in [Rim::Straight, Rim::Ragged, Rim::Patch] {
                for seed in 1..=4 {
                    let clearance = [0.0, 1.0];
                    all.push(Options {
                        rows: 5,
                        columns: 5,
                        wavy: 0.2,
                        cut,
                        rim,
                        seed,
                        clearance,
                        ..Options::default()
                    });
                }
            }
        }
        all
    }

    fn distance_to(outline: &[Point], p: Point) -> f64 {
        let n = outline.len();
        let to_segment = |k: usize| {
            let (a, b) = (outline[k], outline[(k + 1) % n]);
            let t = ((p - a).dot(&(b - a)) / (b - a).norm_squared()).clamp(0.0, 1.0);
            (a + (b - a) * t - p).norm()
        };
        (0..n).map(to_segment).fold(f64::MAX, f64::min)
    }

    /// Outline in the puzzle frame.
    fn in_place(puzzle: &Puzzle, piece: usize) -> Vec<Point> {
        let pose = puzzle.puzzle_from_image(piece).unwrap();
        puzzle.outline(piece).iter().map(|p| pose * p).collect()
    }

    #[test]
    fn same_seed_gives_the_same_puzzle_and_another_seed_another() {
        let options =
            Options { rows: 2, columns: 2, noise: 5.0, blur: 1.0, frame: Some([256, 256]), ..Options::default() };
        let (a, b) = (generate(options.clone()), generate(options.clone()));
        assert_eq!(a.truth("png"), b.truth("png"));
        // Frames don't depend on the order they are rendered in.
        let backward: Vec<Frame> = (0..4).rev().map(|k| b.render(k)).rev().collect();
        assert_eq!((0..4).map(|k| a.render(k)).collect::<Vec<_>>(), backward);
        let other = generate(Options { seed: 2, ..options.clone() });
        assert_ne!(a.truth("png").pieces, other.truth("png").pieces);
        // Noise doesn't change shapes.
        let clean = generate(Options { noise: 0.0, ..options });
        assert_eq!(a.truth("png").pieces, clean.truth("png").pieces);
    }

    #[test]
    fn areas_sum_up_to_the_sheet() {
        for (cut, clearance) in [(Cut::Grid, 0.0), (Cut::Brick, 0.0), (Cut::Honeycomb, 0.0)] {
            let options = Options { cut, clearance: [clearance; 2], ..Options::default() };
            let puzzle = generate(options.clone());
            let sum: f64 = (0..24).map(|k| area_and_centroid(&puzzle.outline(k)).0).sum();
            let sheet = 24.0 * options.pitch().powi(2);
            assert!((sum / sheet - 1.0).abs() < AREA_TOLERANCE, "{cut:?}: {sum} of {sheet}");
        }
    }

    #[test]
    fn neighbours_are_their_clearance_apart() {
        for clearance in [[0.0, 0.0], [2.0, 2.0], [0.5, 4.0]] {
            let puzzle = generate(Options { rows: 3, columns: 3, clearance, ..Options::default() });
            for piece in 0..9 {
                let own = in_place(&puzzle, piece);
                let pose = puzzle.puzzle_from_image(piece).unwrap();
                for side in puzzle.sides(piece) {
                    let (Some(other), Some([a, b])) = (side.neighbour, side.critical_points) else { continue };
                    assert!((clearance[0]..=clearance[1]).contains(&side.clearance));
                    let theirs = in_place(&puzzle, other);
                    // The critical points lie on the border, and all along the tab the other border is one kerf away.
                    let at = |end: Point| {
                        own.iter()
                            .enumerate()
                            .min_by(|p, q| (p.1 - pose * end).norm().total_cmp(&(q.1 - pose * end).norm()))
                    };
                    let (first, last) = (at(a).unwrap().0, at(b).unwrap().0);
                    assert!(distance_to(&own, pose * a) < BORDER_TOLERANCE);
                    let count = (last + own.len() - first) % own.len();
                    for k in (0..count).step_by(7) {
                        let gap = distance_to(&theirs, own[(first + k) % own.len()]);
                        assert!((gap - side.clearance).abs() < BORDER_TOLERANCE, "{gap} for {}", side.clearance);
                    }
                }
            }
        }
    }

    #[test]
    fn necks_are_locally_narrowest_and_narrower_than_their_tabs() {
        for options in kinds_of_cut() {
            let puzzle = generate(options.clone());
            for piece in 0..puzzle.pieces().len() {
                let outline = puzzle.outline(piece);
                let n = outline.len();
                for side in puzzle.sides(piece) {
                    let Some([a, b]) = side.critical_points else { continue };
                    let nearest =
                        |p: Point| (0..n).min_by(|&i, &j| (outline[i] - p).norm().total_cmp(&(outline[j] - p).norm()));
                    let (i, j) = (nearest(a).unwrap(), nearest(b).unwrap());
                    let width = (b - a).norm();
                    for (di, dj) in (0..40).flat_map(|i| (0..40).map(move |j| (i, j))) {
                        let chord = outline[(i + n + di - 20) % n] - outline[(j + n + dj - 20) % n];
                        assert!(chord.norm() > width - BORDER_TOLERANCE, "{options:?}: {} < {width}", chord.norm());
                    }
                    // Across the head, parallel to the neck.
                    let along = (b - a) / width;
                    let count = (j + n - i) % n;
                    let spread = (0..=count).map(|k| (outline[(i + k) % n] - a).dot(&along));
                    let (low, high) = spread.fold((f64::MAX, f64::MIN), |(l, h), v| (l.min(v), h.max(v)));
                    assert!(high - low > 1.3 * width, "{options:?}: head {} neck {width}", high - low);
                }
            }
        }
    }

    #[test]
    fn outlines_run_clockwise_and_never_cross_themselves() {
        for options in kinds_of_cut() {
            let puzzle = generate(options.clone());
            for piece in 0..puzzle.pieces().len() {
                let outline = puzzle.outline(piece);
                assert!(area_and_centroid(&outline).0 > 0.0);
                // Buckets of 4 px: only segments of the same bucket can cross.
                let mut buckets: std::collections::HashMap<(i64, i64), Vec<usize>> = Default::default();
                for (k, p) in outline.iter().enumerate() {
                    for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
                        let cell = ((p.x / 4.0).floor() as i64 + dx, (p.y / 4.0).floor() as i64 + dy);
                        buckets.entry(cell).or_default().push(k);
                    }
                }
                let n = outline.len();
                for members in buckets.values() {
                    for (m, &i) in members.iter().enumerate() {
                        for &j in &members[m + 1..] {
                            let apart = (j + n - i) % n;
                            if apart > 1 && apart < n - 1 {
                                let segment = |k: usize| [outline[k], outline[(k + 1) % n]];
                                let crossing = cut::crossing(segment(i), segment(j));
                                assert_eq!(crossing, None, "{options:?} piece {piece}");
                            }
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn rendering_keeps_area_and_centroid() {
        let options = Options { rows: 2, columns: 2, flipped: 1, ..Options::default() };
        let puzzle = generate(options);
        for piece in 0..4 {
            let frame = puzzle.render(puzzle.pieces()[piece].frame);
            let (ground, dark) = (f64::from(frame.pixels[0]), f64::from(*frame.pixels.iter().min().unwrap()));
            let (mut area, mut x, mut y) = (0.0, 0.0, 0.0);
            for (k, &level) in frame.pixels.iter().enumerate() {
                let cover = (ground - f64::from(level)) / (ground - dark);
                area += cover;
                x += cover * (k % 1024) as f64;
                y += cover * (k / 1024) as f64;
            }
            let (true_area, centroid) = area_and_centroid(&puzzle.outline(piece));
            assert!((area / true_area - 1.0).abs() < RENDER_TOLERANCE / 100.0, "{area} for {true_area}");
            assert!((Point::new(x / area, y / area) - centroid).norm() < RENDER_TOLERANCE);
        }
    }

    #[test]
    fn the_heap_is_what_was_asked_for() {
        let options = Options {
            rows: 4,
            columns: 5,
            puzzles: 2,
            missing: 3,
            duplicate: 2,
            flipped: 4,
            pieces_per_frame: 12,
            ..Options::default()
        };
        let puzzle = generate(options);
        let truth = puzzle.truth("png");
        assert_eq!(truth.pieces.len(), 40 - 3 + 2);
        assert_eq!(puzzle.frame_count(), 4);
        assert_eq!(truth.pieces.iter().filter(|p| p.flipped).count(), 4);
        assert!(truth.pieces.iter().all(|p| p.flipped == p.puzzle_from_image.is_none()));
        assert_eq!(truth.pieces.iter().filter(|p| p.duplicate_of.is_some()).count(), 2);
        for copy in truth.pieces.iter().filter(|p| p.duplicate_of.is_some()) {
            let original = truth.pieces.iter().find(|p| Some(&p.id) == copy.duplicate_of.as_ref()).unwrap();
            assert_eq!((copy.puzzle, copy.row, copy.column), (original.puzzle, original.row, original.column));
        }
        let ids: std::collections::BTreeSet<&String> = truth.pieces.iter().map(|p| &p.id).collect();
        assert_eq!(ids.len(), truth.pieces.len());
        let [width, height] = puzzle.options().frame_size().map(f64::from);
        for piece in 0..truth.pieces.len() {
            assert!(puzzle.outline(piece).iter().all(|p| p.x > 0.0 && p.y > 0.0 && p.x < width && p.y < height));
        }
        // Through JSON and back; numbers may differ in the last digit.
        let read: Truth = serde_json::from_str(&serde_json::to_string(&truth).unwrap()).unwrap();
        assert_eq!(read.options, truth.options);
        assert_eq!(read.joints, truth.joints);
        assert!(read.pieces.iter().zip(&truth.pieces).all(|(a, b)| a.id == b.id && a.sides.len() == b.sides.len()));
    }

    #[test]
    fn wavy_joints_have_no_neck_but_every_piece_keeps_one() {
        let puzzle = generate(Options { wavy: 0.3, ..Options::default() });
        let sides: Vec<Vec<Side>> = (0..24).map(|k| puzzle.sides(k)).collect();
        let waves = sides.iter().flatten().filter(|s| s.kind == SideKind::Wave).count();
        assert_eq!(waves, 2 * 11, "0.3 of 38 joints, seen from both sides");
        assert!(
            sides
                .iter()
                .flatten()
                .all(|s| (s.kind == SideKind::Wave) == (s.critical_points.is_none() && s.neighbour.is_some()))
        );
        assert!(sides.iter().all(|piece| piece.iter().any(|s| s.critical_points.is_some())));
    }

    #[test]
    fn at_full_similarity_all_tabs_are_alike() {
        let puzzle = generate(Options { similarity: 1.0, ..Options::default() });
        let widths: Vec<f64> = (0..24)
            .flat_map(|k| puzzle.sides(k))
            .filter_map(|s| s.critical_points.map(|[a, b]| (b - a).norm()))
            .collect();
        assert_eq!(widths.len(), 76);
        assert!(widths.iter().all(|w| (w - widths[0]).abs() < BORDER_TOLERANCE), "{widths:?}");
    }

    #[test]
    fn the_border_is_equally_spaced_and_true() {
        let puzzle = generate(Options::default());
        let border = puzzle.border(0, 1.0);
        let outline = puzzle.outline(0);
        assert!((border.spacing - 1.0).abs() < 1e-3);
        assert!(border.points.iter().all(|&p| distance_to(&outline, p) < 1e-9));
        let n = border.points.len();
        for k in 0..n {
            // The chord is shorter than the arc, most at the sharp corners of the piece.
            let chord = (border.points[(k + 1) % n] - border.points[k]).norm();
            assert!(chord <= border.spacing + 1e-9 && chord > 0.6 * border.spacing, "{chord}");
        }
    }

    #[test]
    fn the_truth_itself_has_a_perfect_score() {
        let options = Options { flipped: 1, duplicate: 1, missing: 1, clearance: [1.0, 2.0], ..Options::default() };
        let puzzle = generate(options);
        let pieces: Vec<crate::Piece> = (0..puzzle.pieces().len())
            .map(|k| {
                let isthmuses = puzzle.sides(k).into_iter().filter_map(|s| s.critical_points.map(|c| (s.kind, c)));
                let isthmuses = isthmuses
                    .map(|(kind, ends)| isthmus::isthmus::Isthmus {
                        polarity: match kind {
                            SideKind::Tab => isthmus::isthmus::Polarity::Positive,
                            _ => isthmus::isthmus::Polarity::Negative,
                        },
                        point: nalgebra::center(&ends[0], &ends[1]),
                        critical_points: ends,
                        arc: [0.0; 2],
                        width: 0.0,
                        path_length: 0.0,
                        persistence: 0.0,
                        salient: true,
                    })
                    .collect();
                let features = isthmus::Features {
                    border: puzzle.border(k, 1.0),
                    noise: 0.0,
                    isthmuses,
                    endoskeleton: Default::default(),
                    exoskeleton: Default::default(),
                };
                crate::Piece { id: puzzle.pieces()[k].id.clone(), features }
            })
            .collect();
        // The whole assembly may lie anywhere.
        let moved = Isometry2::new(Vector2::new(310.0, -40.0), 0.7);
        let mut assembly = crate::Assembly::default();
        for k in 0..pieces.len() {
            if let (Some(pose), None) = (puzzle.puzzle_from_image(k), puzzle.pieces()[k].duplicate_of) {
                let placement =
                    crate::Placement { piece: k, puzzle_from_image: moved * pose, component: 0, confidence: 1.0 };
                assembly.placements.push(placement);
            }
        }
        let truth = puzzle.truth("png");
        let index = |id: &String| pieces.iter().position(|p| p.id == *id).unwrap();
        for joint in &truth.joints {
            let (tab, blank) = (index(&joint.positive), index(&joint.negative));
            let of = |piece: usize| {
                let sides = puzzle.sides(piece).into_iter().filter(|s| s.critical_points.is_some());
                sides.enumerate().find(|(_, s)| s.joint == joint.joint).unwrap().0
            };
            assembly.matings.push(crate::Mating {
                positive_piece: tab,
                positive_isthmus: of(tab),
                negative_piece: blank,
                negative_isthmus: of(blank),
                correlation: 1.0,
                ave_gap: 0.0,
                clearance: joint.clearance_px,
                confidence: 1.0,
            });
        }
        let score = puzzle.score(&pieces, &assembly);
        assert!(score.is_perfect(), "{score:?}");
        assert_eq!((score.pieces, score.right_matings), (22, score.joints));
        assert!(score.worst_offset < 1e-9 && score.worst_rotation < 1e-9 && score.worst_clearance < 1e-12);

        // One piece moved by a pitch, one mating turned round: both are noticed.
        assembly.placements[3].puzzle_from_image.translation.x += puzzle.options().pitch();
        let mating = &mut assembly.matings[0];
        std::mem::swap(&mut mating.positive_piece, &mut mating.negative_piece);
        let score = puzzle.score(&pieces, &assembly);
        assert_eq!((score.placed, score.misplaced, score.wrong_matings), (21, 1, 1));
    }

    #[test]
    fn bad_options_are_refused_by_name() {
        let refused = |options: Options| Puzzle::generate(&options).err().map(|e| e.to_string()).unwrap_or_default();
        let base = Options::default;
        assert_eq!(refused(Options { rows: 0, ..base() }), "rows is 0: must be at least 1");
        assert_eq!(refused(Options { missing: 24, ..base() }), "missing is 24: must be less than the 24 pieces");
        assert_eq!(refused(Options { similarity: f64::NAN, ..base() }), "similarity is NaN: must be 0 to 1");
        assert!(refused(Options { clearance: [3.0, 2.0], ..base() }).starts_with("clearance is 3 to 2 px"));
        assert!(refused(Options { rows: usize::MAX, ..base() }).contains("at most 100000"));
        assert!(refused(Options { piece_size: Some(900.0), ..base() }).contains("doesn't fit"));
    }
}
