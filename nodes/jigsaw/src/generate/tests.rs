//! The generator keeps what it promises: outlines, joints, frames and truth agree with one another.

use super::truth::area_and_centroid;
use super::*;
use nalgebra::Vector2;

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
                all.push(Options { rows: 5, columns: 5, wavy: 0.2, cut, rim, seed, clearance, ..Options::default() });
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
    let options = Options { rows: 2, columns: 2, noise: 5.0, blur: 1.0, frame: Some([256, 256]), ..Options::default() };
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
    let widths: Vec<f64> =
        (0..24).flat_map(|k| puzzle.sides(k)).filter_map(|s| s.critical_points.map(|[a, b]| (b - a).norm())).collect();
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
            crate::Piece { id: puzzle.pieces()[k].id.clone(), seen: 0, features }
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
