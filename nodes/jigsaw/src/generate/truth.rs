//! What is true of a puzzle, as `truth.json` says it, and how an assembly compares with it.

use std::collections::{BTreeMap, BTreeSet};

use isthmus::Point;
use nalgebra::{Isometry2, Vector2};
use serde::{Deserialize, Serialize};

use super::{Options, Puzzle, SideKind};
use crate::{Assembly, Piece};

/// Content of `truth.json`. Pixels, x right, y down, pixel centres at whole numbers of the source image.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Truth {
    /// What the puzzle was generated from.
    pub options: Options,
    /// Every piece of the heap.
    pub pieces: Vec<PieceTruth>,
    /// Every joint with a neck between two pieces that are there and lie face up.
    pub joints: Vec<JointTruth>,
}

/// Truth of one piece.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PieceTruth {
    /// `<file stem>`, or `<file stem>_<k>` in reading order where a frame holds more than one.
    pub id: String,
    /// File name of its frame, or the topic of the frames of a bag.
    pub source: String,
    /// Number of its frame, from 0 in the order of the files or messages.
    pub frame: usize,
    /// Which puzzle of the heap it belongs to.
    pub puzzle: usize,
    /// Row in its puzzle.
    pub row: usize,
    /// Column in its puzzle.
    pub column: usize,
    /// Whether it lies face down: it then fits nowhere.
    pub flipped: bool,
    /// The piece it is a copy of: one of the two is left over.
    pub duplicate_of: Option<String>,
    /// `p_puzzle = R(theta) p_image + (x, y)`; null for a piece face down.
    pub puzzle_from_image: Option<PoseTruth>,
    /// Centroid of its area in the source image.
    pub centroid: [f64; 2],
    /// Its area.
    pub area_px: f64,
    /// Its sides, clockwise as seen in the image.
    pub sides: Vec<SideTruth>,
}

/// What a frame is called where it is written.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FrameLabel {
    /// Beginning of the ids of its pieces.
    pub stem: String,
    /// File name or topic.
    pub source: String,
}

/// A rigid motion, R = [[cos, -sin], [sin, cos]].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PoseTruth {
    /// Shift, in pixels.
    pub x: f64,
    /// Shift, in pixels.
    pub y: f64,
    /// Rotation, in radians.
    pub theta: f64,
}

/// Truth of one side of a piece.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SideTruth {
    /// Number of the joint within its puzzle.
    pub joint: usize,
    /// Rim, tab, blank or wave.
    pub kind: SideKind,
    /// The piece on the other side, if it is there.
    pub neighbour: Option<String>,
    /// Isthmus critical points in the source image, as the match segment runs; null without a neck.
    pub critical_points: Option<[[f64; 2]; 2]>,
    /// Width of the neck or mouth.
    pub width_px: Option<f64>,
    /// Clearance of the joint.
    pub clearance_px: f64,
}

/// Truth of one joint with a neck.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct JointTruth {
    /// Which puzzle of the heap it belongs to.
    pub puzzle: usize,
    /// Number of the joint within its puzzle.
    pub joint: usize,
    /// The piece with the tab.
    pub positive: String,
    /// The piece with the blank.
    pub negative: String,
    /// Clearance of the joint.
    pub clearance_px: f64,
}

/// How an assembly compares with the truth.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Score {
    /// Pieces that can be placed: present, face up, copies not counted, joined to the largest part of their puzzle that
    /// hangs together (missing pieces may leave others without a neighbour).
    pub pieces: usize,
    /// Of these, how many lie right, counted once each, in the largest component of their puzzle.
    pub placed: usize,
    /// Pieces placed wrong: against the others of their component, face down, or in a place already taken.
    pub misplaced: usize,
    /// Joints with a neck that can be found.
    pub joints: usize,
    /// Matings that are right.
    pub right_matings: usize,
    /// Matings that are wrong.
    pub wrong_matings: usize,
    /// Greatest distance of a rightly placed piece's centroid from where it belongs, after one rigid fit of its
    /// component, in pixels.
    pub worst_offset: f64,
    /// Greatest rotation of a rightly placed piece after that fit, in radians.
    pub worst_rotation: f64,
    /// Greatest error of a right mating's clearance, in pixels.
    pub worst_clearance: f64,
}

impl Score {
    /// Whether every piece is placed and nothing is wrong.
    pub fn is_perfect(&self) -> bool {
        self.placed == self.pieces && self.misplaced == 0 && self.wrong_matings == 0
    }
}

/// A piece is misplaced if it is off by more than this fraction of the pitch: any other place is a whole pitch away,
/// and the drift of a large puzzle stays far below.
const MISPLACED: f64 = 0.1;
/// The same for its rotation, in radians.
const MISTURNED: f64 = 0.1;
/// An isthmus belongs to a true neck if its midpoint is nearer than this fraction of the pitch.
const SAME_NECK: f64 = 0.05;
/// Pieces of a component tried as reference for the first, outlier-proof fit.
const REFERENCES: usize = 32;

impl Puzzle {
    /// What `truth.json` says; `extension` is that of the frames' files.
    pub fn truth(&self, extension: &str) -> Truth {
        self.truth_labelled(|frame| {
            let stem = self.frame_stem(frame);
            FrameLabel { source: format!("{stem}.{extension}"), stem }
        })
    }

    /// What `truth.json` says where frames, and with them pieces, are called otherwise.
    pub fn truth_labelled(&self, label: impl Fn(usize) -> FrameLabel) -> Truth {
        let labels: Vec<FrameLabel> = (0..self.frame_count()).map(label).collect();
        let id = |k: usize| {
            let piece = &self.pieces()[k];
            let number = piece.id.strip_prefix(&self.frame_stem(piece.frame)).unwrap_or_default();
            format!("{}{number}", labels[piece.frame].stem)
        };
        let pieces = (0..self.pieces().len())
            .map(|k| {
                let piece = &self.pieces()[k];
                let (area, centroid) = area_and_centroid(&self.outline(k));
                let pose = self.puzzle_from_image(k).map(|pose| PoseTruth {
                    x: pose.translation.x,
                    y: pose.translation.y,
                    theta: pose.rotation.angle(),
                });
                let sides = self
                    .sides(k)
                    .into_iter()
                    .map(|side| SideTruth {
                        joint: side.joint,
                        kind: side.kind,
                        neighbour: side.neighbour.map(id),
                        critical_points: side.critical_points.map(|ends| ends.map(|p| [p.x, p.y])),
                        width_px: side.critical_points.map(|[a, b]| (b - a).norm()),
                        clearance_px: side.clearance,
                    })
                    .collect();
                PieceTruth {
                    id: id(k),
                    source: labels[piece.frame].source.clone(),
                    frame: piece.frame,
                    puzzle: piece.puzzle,
                    row: piece.row,
                    column: piece.column,
                    flipped: piece.flipped,
                    duplicate_of: piece.duplicate_of.map(id),
                    puzzle_from_image: pose,
                    centroid: [centroid.x, centroid.y],
                    area_px: area,
                    sides,
                }
            })
            .collect();
        let joints = self
            .joints()
            .into_iter()
            .map(|(tab, blank, side)| JointTruth {
                puzzle: self.pieces()[tab].puzzle,
                joint: side.joint,
                positive: id(tab),
                negative: id(blank),
                clearance_px: side.clearance,
            })
            .collect();
        Truth { options: self.options().clone(), pieces, joints }
    }

    /// How many pieces can be placed: of each puzzle the largest part that hangs together.
    fn placeable(&self) -> usize {
        let lies = |k: usize| !self.pieces()[k].flipped && self.pieces()[k].duplicate_of.is_none();
        let mut seen = vec![false; self.pieces().len()];
        let mut largest: BTreeMap<usize, usize> = BTreeMap::new();
        for root in 0..seen.len() {
            if seen[root] || !lies(root) {
                continue;
            }
            seen[root] = true;
            let mut part = vec![root];
            let mut next = 0;
            while next < part.len() {
                for neighbour in self.sides(part[next]).into_iter().filter_map(|side| side.neighbour) {
                    if lies(neighbour) && !std::mem::replace(&mut seen[neighbour], true) {
                        part.push(neighbour);
                    }
                }
                next += 1;
            }
            let most = largest.entry(self.pieces()[root].puzzle).or_default();
            *most = part.len().max(*most);
        }
        largest.values().sum()
    }

    /// Joints with a neck between two pieces that lie face up, copies not counted: the piece with the tab, the one
    /// with the blank, the tab's side.
    fn joints(&self) -> Vec<(usize, usize, super::Side)> {
        let pieces = self.pieces();
        let mut joints = vec![];
        for tab in (0..pieces.len()).filter(|&k| !pieces[k].flipped && pieces[k].duplicate_of.is_none()) {
            for side in self.sides(tab).into_iter().filter(|side| side.kind == SideKind::Tab) {
                if let Some(blank) = side.neighbour.filter(|&other| !pieces[other].flipped) {
                    joints.push((tab, blank, side));
                }
            }
        }
        joints
    }

    /// Compares an assembly with the truth. `pieces` are those the solver was given; they are recognised by their ids,
    /// and unknown ones are ignored.
    pub fn score(&self, pieces: &[Piece], assembly: &Assembly) -> Score {
        let index: BTreeMap<&str, usize> = self.pieces().iter().enumerate().map(|(k, p)| (p.id.as_str(), k)).collect();
        let known: Vec<Option<usize>> = pieces.iter().map(|p| index.get(p.id.as_str()).copied()).collect();
        let known = |piece: usize| known.get(piece).copied().flatten();
        let joints = self.joints();
        let mut score = Score { pieces: self.placeable(), joints: joints.len(), ..Score::default() };

        // Placements, component by component.
        let mut components: BTreeMap<usize, Vec<(usize, Isometry2<f64>)>> = BTreeMap::new();
        for placement in &assembly.placements {
            if let Some(truth) = known(placement.piece) {
                components.entry(placement.component).or_default().push((truth, placement.puzzle_from_image));
            }
        }
        // Slots placed right, by puzzle: those of the component that holds most of them.
        let mut best: BTreeMap<usize, usize> = BTreeMap::new();
        for members in components.values() {
            let fit = self.fit(members);
            score.misplaced += members.len() - fit.right.len();
            score.worst_offset = score.worst_offset.max(fit.worst_offset);
            score.worst_rotation = score.worst_rotation.max(fit.worst_rotation);
            if let Some(&first) = fit.right.first() {
                let count = best.entry(self.pieces()[first].puzzle).or_default();
                *count = (*count).max(fit.right.len());
            }
        }
        score.placed = best.values().sum();

        // Matings.
        let original = |k: usize| self.pieces()[k].duplicate_of.unwrap_or(k);
        for mating in &assembly.matings {
            let (Some(tab), Some(blank)) = (known(mating.positive_piece), known(mating.negative_piece)) else {
                continue;
            };
            let isthmus = pieces[mating.positive_piece].features.isthmuses.get(mating.positive_isthmus);
            let face_up = !self.pieces()[tab].flipped && !self.pieces()[blank].flipped;
            let side = isthmus.and_then(|isthmus| {
                self.sides(tab).into_iter().find(|side| {
                    side.kind == SideKind::Tab
                        && side.neighbour == Some(original(blank))
                        && side.critical_points.is_some_and(|[a, b]| {
                            (nalgebra::center(&a, &b) - isthmus.point).norm() < SAME_NECK * self.options().pitch()
                        })
                })
            });
            match side.filter(|_| face_up) {
                Some(side) => {
                    score.right_matings += 1;
                    score.worst_clearance = score.worst_clearance.max((mating.clearance - side.clearance).abs());
                }
                None => score.wrong_matings += 1,
            }
        }
        score
    }

    /// Fits one component to the truth and tells which of its pieces lie right.
    fn fit(&self, members: &[(usize, Isometry2<f64>)]) -> Fit {
        let pitch = self.options().pitch();
        let motions: Vec<Motion> = members
            .iter()
            .filter_map(|&(piece, estimate)| {
                let truth = self.puzzle_from_image(piece)?;
                let centroid = area_and_centroid(&self.outline(piece)).1;
                Some(Motion { piece, estimate, truth, centroid })
            })
            .collect();
        let inliers = |fit: &Isometry2<f64>, puzzle: usize| -> Vec<usize> {
            (0..motions.len())
                .filter(|&m| {
                    let (offset, turn) = motions[m].residual(fit);
                    let same = self.pieces()[motions[m].piece].puzzle == puzzle;
                    same && offset < MISPLACED * pitch && turn < MISTURNED
                })
                .collect()
        };
        let least_squares = |chosen: &[usize]| least_squares(&motions, chosen, 0.5 * pitch);
        let step = motions.len().div_ceil(REFERENCES).max(1);
        let mut best: Vec<usize> = vec![];
        let mut puzzle = 0;
        for reference in motions.iter().step_by(step) {
            let theirs = self.pieces()[reference.piece].puzzle;
            // A reference's small rotation swings far pieces out of tolerance; one refit on the inliers mends it.
            let near = inliers(&(reference.truth * reference.estimate.inverse()), theirs);
            let found = inliers(&least_squares(&near), theirs);
            let found = if found.len() < near.len() { near } else { found };
            if found.len() > best.len() {
                (best, puzzle) = (found, theirs);
            }
        }
        for _ in 0..3 {
            let grown = inliers(&least_squares(&best), puzzle);
            if grown.len() <= best.len() {
                break;
            }
            best = grown;
        }
        let fit = least_squares(&best);
        let mut taken = BTreeSet::new();
        let mut out = Fit { right: vec![], worst_offset: 0.0, worst_rotation: 0.0 };
        for m in best {
            let piece = motions[m].piece;
            if taken.insert(self.pieces()[piece].face) {
                let (offset, turn) = motions[m].residual(&fit);
                out.worst_offset = out.worst_offset.max(offset);
                out.worst_rotation = out.worst_rotation.max(turn);
                out.right.push(piece);
            }
        }
        out
    }
}

/// A placed piece that has a true place.
struct Motion {
    piece: usize,
    /// Assembly from image.
    estimate: Isometry2<f64>,
    /// Puzzle from image.
    truth: Isometry2<f64>,
    /// Centroid of its area in the image.
    centroid: Point,
}

impl Motion {
    /// Distance of the centroid from where it belongs, and rotation.
    fn residual(&self, truth_from_assembly: &Isometry2<f64>) -> (f64, f64) {
        let offset = (truth_from_assembly * self.estimate * self.centroid - self.truth * self.centroid).norm();
        let turn = (truth_from_assembly.rotation * self.estimate.rotation).angle_to(&self.truth.rotation).abs();
        (offset, turn)
    }
}

/// Rigid motion that takes the assembly nearest to the truth, in the least squares of four points a piece, each `arm`
/// away from its centroid.
fn least_squares(motions: &[Motion], chosen: &[usize], arm: f64) -> Isometry2<f64> {
    let mut pairs = Vec::with_capacity(4 * chosen.len());
    for motion in chosen.iter().map(|&m| &motions[m]) {
        for (x, y) in [(arm, 0.0), (-arm, 0.0), (0.0, arm), (0.0, -arm)] {
            let p = motion.centroid + Vector2::new(x, y);
            pairs.push((motion.estimate * p, motion.truth * p));
        }
    }
    let count = pairs.len().max(1) as f64;
    let (a, b) = pairs
        .iter()
        .fold((Vector2::zeros(), Vector2::zeros()), |(a, b), (p, q)| (a + p.coords / count, b + q.coords / count));
    let (mut dot, mut cross) = (0.0, 0.0);
    for (p, q) in &pairs {
        let (p, q) = (p.coords - a, q.coords - b);
        dot += p.dot(&q);
        cross += p.perp(&q);
    }
    let turn = nalgebra::UnitComplex::new(cross.atan2(dot));
    Isometry2::from_parts((b - turn * a).into(), turn)
}

struct Fit {
    right: Vec<usize>,
    worst_offset: f64,
    worst_rotation: f64,
}

/// Signed area (positive if clockwise as seen on a screen) and centroid of a closed outline.
pub(super) fn area_and_centroid(outline: &[Point]) -> (f64, Point) {
    let Some(&origin) = outline.first() else { return (0.0, Point::origin()) };
    let (mut area, mut moment) = (0.0, Vector2::zeros());
    for (k, p) in outline.iter().enumerate() {
        let (p, q) = (p - origin, outline[(k + 1) % outline.len()] - origin);
        let cross = 0.5 * p.perp(&q);
        area += cross;
        moment += (p + q) * (cross / 3.0);
    }
    (area, origin + moment / area)
}
