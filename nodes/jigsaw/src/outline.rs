//! A piece made ready for matching: normals, prepared match segments, a coarse distance raster, straight edges.
//!
//! Everything here depends on the one piece alone, so it is computed once, in parallel, when the piece is inserted.
//! Coordinates are pixels of the piece's image (x right, y down) unless said otherwise.

use crate::Piece;
use isthmus::isthmus::{Isthmus, Polarity};
use isthmus::wide::widely;
use isthmus::{Point, hull};
use nalgebra::Vector2;
use std::sync::{LazyLock, OnceLock};

/// Samples of an IDF in the shape index: enough for a tab (its finest feature is about a tenth of its path).
pub(crate) const SHAPE_SAMPLES: usize = 64;
/// Points of a match segment by which it is posed roughly: three to each of the eight bends of a tab.
pub(crate) const ROUGH_SAMPLES: usize = 24;
/// Samples of the flanks on either side of a match segment, in the shape index: two to each of their bends.
pub(crate) const FLANK_SAMPLES: usize = 6;
/// How far they are apart, as a part of the path: together they reach as far as a segment is extended at most.
const FLANK_STEP: f64 = 0.08;
/// Cosine coefficients of the IDF by which the index narrows the choice; the rest of the energy is small.
pub(crate) const KEYS: usize = 8;
/// How far a match segment is extended beyond its critical points at most, in piece scales (the shoulders up to the
/// corners of a side one scale long with a tab of a third of it).
const MAX_EXTENSION: f64 = 0.35;
/// Cells of the raster along a piece scale: abutting borders then count for less than 0.1 % of overlap.
const RASTER_CELLS: f64 = 24.0;
/// Least width of the robust weights, in piece scales: where most of a contact fits exactly already, the rest must
/// still pull.
pub(crate) const LEAST_WIDTH: f64 = 0.004;
/// Length of a straight run, in piece scales, from which on it is taken for a straight edge.
const STRAIGHT_LENGTH: f64 = 0.4;
/// How far the border may leave its chord in such a run, in piece scales.
const STRAIGHT_TOLERANCE: f64 = 0.006;

/// Quantiles by which the distances of the border from the centroid are kept.
const REACHES: usize = 32;

/// A point with its outward normal, relative to the isthmus point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Node {
    pub(crate) x: f32,
    pub(crate) y: f32,
    pub(crate) nx: f32,
    pub(crate) ny: f32,
}

/// An isthmus made ready for matching.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Segment {
    /// Index of the isthmus in the piece's features.
    pub(crate) isthmus: usize,
    /// Isthmus point.
    pub(crate) origin: Point,
    /// Width and path length.
    pub(crate) width: f64,
    pub(crate) path: f64,
    /// Arc of the first critical point.
    pub(crate) arc: f64,
    /// IDF samples, mean removed, in the order in which a tab runs (mouths reversed).
    pub(crate) shape: [f32; SHAPE_SAMPLES],
    /// Leading cosine coefficients of `shape`: a root mean square distance between keys never exceeds that of shapes.
    pub(crate) keys: [f32; KEYS],
    /// Points at equal parts of the path, relative to their `middle`, in the order in which a tab runs: along x, and along y.
    pub(crate) samples: [[f32; ROUGH_SAMPLES]; 2],
    /// Middle of the samples, relative to the isthmus point.
    pub(crate) middle: [f32; 2],
    /// Points beyond either end of the segment, at equal parts of the path, relative to `middle`; in running order the first end, then the other.
    pub(crate) flanks: [[[f32; 2]; FLANK_SAMPLES]; 2],
    /// Outward normals there.
    pub(crate) leans: [[[f32; 2]; FLANK_SAMPLES]; 2],
    /// How many of them lie on the side that the segment is a part of.
    pub(crate) reach: [usize; 2],
    /// Scale of the piece.
    pub(crate) scale: f32,
    /// Border points of the extended segment in running order: every border point for a mouth, thinned for a tab.
    pub(crate) run: Vec<Node>,
    /// Border length between two nodes of `run`.
    pub(crate) step: f64,
    /// The nodes of `run` on the segment proper.
    pub(crate) core: std::ops::Range<usize>,
}

/// A straight part of the border.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Straight {
    pub(crate) from: Point,
    pub(crate) to: Point,
}

/// Coarse signed distance to the border on a square raster, with the nearest border point.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Raster {
    pub(crate) origin: Point,
    pub(crate) cell: f64,
    pub(crate) columns: usize,
    pub(crate) rows: usize,
    /// Distance to the border, negative inside, at the cell centres.
    pub(crate) distance: Vec<f32>,
    /// Index of the nearest border point.
    pub(crate) nearest: Vec<u32>,
    /// The cell centre farthest inside.
    pub(crate) pole: Point,
}

/// Where a point's nearest border point lies.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Foot {
    /// From there to the point.
    pub(crate) offset: Vector2<f64>,
    /// Outward normal of the border there, not quite of length one between two border points.
    pub(crate) normal: Vector2<f64>,
}

/// A piece made ready.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Outline {
    /// Tells it from all others that the solver has seen.
    pub(crate) serial: u64,
    /// When it was seen.
    pub(crate) seen: u64,
    pub(crate) points: Vec<Point>,
    pub(crate) normals: Vec<Vector2<f32>>,
    pub(crate) spacing: f64,
    pub(crate) length: f64,
    pub(crate) area: f64,
    /// Square root of the area: the unit of all relative tolerances.
    pub(crate) scale: f64,
    pub(crate) centroid: Point,
    /// Greatest distance of a border point from the centroid.
    pub(crate) radius: f64,
    /// See [`Outline::reaches`].
    reaches: OnceLock<[f32; REACHES]>,
    pub(crate) noise: f64,
    pub(crate) tabs: Vec<Segment>,
    pub(crate) mouths: Vec<Segment>,
    pub(crate) straights: Vec<Straight>,
    /// See [`Outline::hull`].
    hull: OnceLock<Vec<Point>>,
    pub(crate) raster: Raster,
}

impl Outline {
    pub(crate) fn new(piece: &Piece, serial: u64) -> Self {
        let border = &piece.features.border;
        let points = border.points.clone();
        let n = points.len();
        let spacing = border.spacing.max(f64::EPSILON);
        let mut twice_area = 0.0;
        let mut moment = Vector2::zeros();
        let origin = points[0];
        for (a, b) in points.iter().zip(points.iter().cycle().skip(1)) {
            let (a, b) = (a - origin, b - origin);
            let cross = a.x * b.y - a.y * b.x;
            twice_area += cross;
            moment += (a + b) * cross;
        }
        let area = (0.5 * twice_area).abs().max(f64::EPSILON);
        let centroid = if twice_area.abs() > f64::EPSILON { origin + moment / (3.0 * twice_area) } else { origin };
        let normals: Vec<Vector2<f32>> = (0..n)
            .map(|i| {
                let d = points[if i + 1 < n { i + 1 } else { 0 }] - points[if i > 0 { i - 1 } else { n - 1 }];
                let length = d.norm().max(f64::EPSILON);
                Vector2::new((d.y / length) as f32, (-d.x / length) as f32)
            })
            .collect();
        let radius = points.iter().map(|p| (p - centroid).norm_squared()).fold(0.0, f64::max).sqrt();
        let mut outline = Self {
            serial,
            seen: piece.seen,
            raster: Raster::new(&points, area.sqrt() / RASTER_CELLS),
            hull: OnceLock::new(),
            points,
            normals,
            spacing,
            length: n as f64 * spacing,
            area,
            scale: area.sqrt(),
            centroid,
            radius,
            reaches: OnceLock::new(),
            noise: piece.features.noise.max(0.0),
            tabs: Vec::new(),
            mouths: Vec::new(),
            straights: Vec::new(),
        };
        outline.straights = outline.find_straights();
        for (index, isthmus) in piece.features.isthmuses.iter().enumerate() {
            if !usable(isthmus, outline.length) {
                continue;
            }
            let segment = outline.prepare(index, isthmus);
            match isthmus.polarity {
                Polarity::Positive => outline.tabs.push(segment),
                Polarity::Negative => outline.mouths.push(segment),
            }
        }
        outline
    }

    /// Convex hull; few pieces are asked for theirs.
    pub(crate) fn hull(&self) -> &[Point] {
        self.hull.get_or_init(|| convex_hull(self.points.clone()))
    }

    /// Quantiles of the distances of border points from the centroid; few pieces are asked for theirs.
    pub(crate) fn reaches(&self) -> &[f32; REACHES] {
        self.reaches.get_or_init(|| {
            let n = self.points.len();
            let mut distances: Vec<f64> = self.points.iter().map(|p| (p - self.centroid).norm()).collect();
            distances.sort_unstable_by(f64::total_cmp);
            std::array::from_fn(|k| distances[(2 * k + 1) * n / (2 * REACHES)] as f32)
        })
    }

    /// Border point at an index that may lie outside `0..n`.
    fn at(&self, index: i64) -> Point {
        self.points[self.wrapped(index)]
    }

    /// The index of a border point, once round or more taken off.
    fn wrapped(&self, index: i64) -> usize {
        // To divide takes longer than to look whether it has to be done.
        let n = self.points.len() as i64;
        (if (0..n).contains(&index) { index } else { index.rem_euclid(n) }) as usize
    }

    /// Point at an arc length from the first border point.
    pub(crate) fn at_arc(&self, arc: f64) -> Point {
        let s = arc / self.spacing;
        let i = s.floor();
        let (a, b) = (self.at(i as i64), self.at(i as i64 + 1));
        a + (b - a) * (s - i)
    }

    /// The border next to a point that lies within `reach` of it.
    pub(crate) fn foot(&self, p: Point, reach: f64) -> Option<Foot> {
        let cell = self.raster.cell_of(p)?;
        if f64::from(self.raster.distance[cell]).abs() > reach + self.raster.cell {
            return None;
        }
        let (i, other, part) = self.walk(p, self.raster.nearest[cell] as usize);
        let (here, there) = (self.normals[i].cast::<f64>(), self.normals[other].cast::<f64>());
        let normal = here * (1.0 - part) + there * part;
        let edge = self.points[other] - self.points[i];
        // An arc between the two points, which rises over the chord where the normals diverge.
        let turn = here.perp(&there) * if other == (i + 1) % self.points.len() { 1.0 } else { -1.0 };
        let bulge = normal * (0.5 * self.spacing * part * (1.0 - part) * turn);
        Some(Foot { offset: p - (self.points[i] + edge * part + bulge), normal })
    }

    /// Foot of a point on the border, downhill from the border point `from`: a border point, the neighbour towards which
    /// the foot lies, and which part of the way.
    fn walk(&self, p: Point, from: usize) -> (usize, usize, f64) {
        let n = self.points.len();
        let mut i = from;
        let mut best = (p - self.points[i]).norm_squared();
        loop {
            let (next, previous) = ((i + 1) % n, (i + n - 1) % n);
            let (dn, dp) = ((p - self.points[next]).norm_squared(), (p - self.points[previous]).norm_squared());
            if dn < best && dn <= dp {
                (best, i) = (dn, next);
            } else if dp < best {
                (best, i) = (dp, previous);
            } else {
                break;
            }
        }
        let q = self.points[i];
        let along = (self.points[(i + 1) % n] - q).dot(&(p - q));
        let other = if along >= 0.0 { (i + 1) % n } else { (i + n - 1) % n };
        let edge = self.points[other] - q;
        (i, other, ((p - q).dot(&edge) / edge.norm_squared().max(f64::EPSILON)).clamp(0.0, 1.0))
    }

    /// Signed distance of a point from the border, positive outside, if it is less than `reach`, and the normal of the
    /// border there (outward).
    pub(crate) fn gap(&self, p: Point, reach: f64) -> Option<(f64, Vector2<f64>)> {
        let Foot { offset, normal } = self.foot(p, reach)?;
        let distance = offset.norm();
        (distance <= reach).then(|| (distance.copysign(offset.dot(&normal)), normal))
    }

    fn prepare(&self, index: usize, isthmus: &Isthmus) -> Segment {
        let tab = isthmus.polarity == Polarity::Positive;
        let mut shape = [0f32; SHAPE_SAMPLES];
        for (k, sample) in shape.iter_mut().enumerate() {
            let part = k as f64 / (SHAPE_SAMPLES - 1) as f64;
            let part = if tab { part } else { 1.0 - part };
            *sample = (self.at_arc(isthmus.arc[0] + part * isthmus.path_length) - isthmus.point).norm() as f32;
        }
        let mean = shape.iter().sum::<f32>() / SHAPE_SAMPLES as f32;
        shape.iter_mut().for_each(|v| *v -= mean);
        let points: [Vector2<f64>; ROUGH_SAMPLES] = std::array::from_fn(|k| {
            let part = k as f64 / (ROUGH_SAMPLES - 1) as f64;
            let part = if tab { part } else { 1.0 - part };
            self.at_arc(isthmus.arc[0] + part * isthmus.path_length) - isthmus.point
        });
        let middle = points.iter().sum::<Vector2<f64>>() / ROUGH_SAMPLES as f64;
        let first = (isthmus.arc[0] / self.spacing).ceil() as i64;
        let last = ((isthmus.arc[0] + isthmus.path_length) / self.spacing).floor() as i64;
        let (before, after) = (self.extension(isthmus, first, -1), self.extension(isthmus, last, 1));
        let flank_step = FLANK_STEP * isthmus.path_length;
        let ends = [(isthmus.arc[0], -1.0, before), (isthmus.arc[0] + isthmus.path_length, 1.0, after)];
        let ends = if tab { ends } else { [ends[1], ends[0]] };
        let flank = |(from, direction, _): (f64, f64, i64)| {
            std::array::from_fn(|k| from + direction * flank_step * (k + 1) as f64)
        };
        let arcs: [[f64; FLANK_SAMPLES]; 2] = ends.map(flank);
        // A tab is sampled as densely as its IDF; a mouth keeps every point, for its feet are looked for on it.
        let thin = if tab { ((last - first) as usize / SHAPE_SAMPLES).max(1) as i64 } else { 1 };
        let n = self.points.len() as i64;
        let begin = first - before / thin * thin;
        let run: Vec<Node> = (begin..=(last + after).min(begin + n - 1))
            .step_by(thin as usize)
            .map(|i| {
                let i = self.wrapped(i);
                let (p, normal) = (self.points[i] - isthmus.point, self.normals[i]);
                Node { x: p.x as f32, y: p.y as f32, nx: normal.x, ny: normal.y }
            })
            .collect();
        let core_from = ((first - begin) / thin) as usize;
        // A segment shorter than the sampling ends before it begins.
        let core_to = (((last - begin) / thin + 1).max(0) as usize).min(run.len());
        Segment {
            isthmus: index,
            origin: isthmus.point,
            width: isthmus.width,
            path: isthmus.path_length,
            arc: isthmus.arc[0],
            keys: keys(&shape),
            shape,
            samples: [points.map(|p| (p.x - middle.x) as f32), points.map(|p| (p.y - middle.y) as f32)],
            middle: [middle.x as f32, middle.y as f32],
            flanks: arcs.map(|arcs| {
                arcs.map(|arc| {
                    let p = self.at_arc(arc) - isthmus.point - middle;
                    [p.x as f32, p.y as f32]
                })
            }),
            leans: arcs.map(|arcs| {
                arcs.map(|arc| {
                    let normal = self.normals[self.wrapped((arc / self.spacing).round() as i64)];
                    [normal.x, normal.y]
                })
            }),
            reach: ends.map(|(_, _, points)| ((points as f64 * self.spacing / flank_step) as usize).min(FLANK_SAMPLES)),
            scale: self.scale as f32,
            run,
            step: thin as f64 * self.spacing,
            core: core_from.min(core_to)..core_to,
        }
    }

    /// How many border points beyond a critical point still belong to the side: up to the corner, where the border,
    /// having run along the chord, turns into the body (or up into the next tab).
    fn extension(&self, isthmus: &Isthmus, from: i64, direction: i64) -> i64 {
        const ALONG: f64 = 0.77; // cos 40°: has come round to the direction of the chord
        const DOWN: f64 = 0.77; // sin 50°: turned towards the body, a corner
        const UP: f64 = 0.87; // sin 60°: turned away from the body, another tab
        let critical = isthmus.critical_points[usize::from(direction > 0)];
        let Some(outward) = (critical - isthmus.point).try_normalize(f64::EPSILON) else { return 0 };
        let middle = self.at_arc(isthmus.arc[0] + 0.5 * isthmus.path_length) - isthmus.point;
        let mut body = Vector2::new(-outward.y, outward.x);
        let into_segment = body.dot(&middle) > 0.0;
        if into_segment == (isthmus.polarity == Polarity::Positive) {
            body = -body;
        }
        let most = ((MAX_EXTENSION * self.scale / self.spacing) as i64)
            .min((self.points.len() as i64 - (isthmus.path_length / self.spacing) as i64) / 2 - 1)
            .max(0);
        let window = ((0.02 * self.scale / self.spacing) as i64).max(2);
        let mut along = false;
        for k in 0..most {
            let i = from + direction * k;
            let d = self.at(i + direction * window) - self.at(i - direction * window);
            let d = d / d.norm().max(f64::EPSILON);
            if along {
                let down = d.dot(&body);
                if !(-UP..=DOWN).contains(&down) {
                    return (k - window).max(0);
                }
            } else {
                along = d.dot(&outward) > ALONG;
            }
        }
        most
    }

    fn find_straights(&self) -> Vec<Straight> {
        let n = self.points.len() as i64;
        let window = (STRAIGHT_LENGTH * self.scale / self.spacing) as i64;
        let stride = (window / 20).max(1);
        let tolerance = STRAIGHT_TOLERANCE * self.scale + 3.0 * self.noise;
        if window < 4 || window >= n {
            return Vec::new();
        }
        let is_straight = |from: i64, to: i64| {
            let (a, b) = (self.at(from), self.at(to));
            let Some(d) = (b - a).try_normalize(f64::EPSILON) else { return false };
            let is_near = |i: i64| {
                let p = self.at(i) - a;
                (p.x * d.y - p.y * d.x).abs() <= tolerance
            };
            // Most runs bend, and leave their chord in the middle.
            is_near(from + (to - from) / (2 * stride) * stride)
                && (0..=(to - from) / stride).all(|k| is_near(from + k * stride))
        };
        let mut found: Vec<(i64, i64)> = Vec::new();
        let mut i = 0;
        while i < n {
            if is_straight(i, i + window) {
                let mut to = i + window;
                while to < i + n && is_straight(i, to + stride) {
                    to += stride;
                }
                found.push((i, to));
                i = to;
            } else {
                i += stride;
            }
        }
        // The walk began somewhere: a run across the start was seen in two parts.
        if found.len() > 1 {
            let (first, last) = (found[0], found[found.len() - 1]);
            if last.1 + stride >= n + first.0 && is_straight(last.0, first.1 + n) {
                found[0] = (last.0, first.1 + n);
                found.pop();
            }
        }
        found.into_iter().map(|(a, b)| Straight { from: self.at(a), to: self.at(b) }).collect()
    }
}

/// Whether the figures of an isthmus can be worked with (messages may carry anything): its match segment is a part of
/// the border, longer than its chord.
fn usable(isthmus: &Isthmus, length: f64) -> bool {
    let numbers = [isthmus.width, isthmus.path_length, isthmus.arc[0], isthmus.point.x, isthmus.point.y];
    numbers.iter().all(|v| v.is_finite())
        && isthmus.width > 0.0
        && isthmus.path_length > isthmus.width
        && isthmus.path_length <= length
        && isthmus.arc[0].abs() <= 2.0 * length
}

/// Leading coefficients of the orthonormal cosine transform, scaled to root mean square.
fn keys(shape: &[f32; SHAPE_SAMPLES]) -> [f32; KEYS] {
    /// Cosines of the transform: 512 for each segment, were they computed each time.
    static WAVES: LazyLock<[[f32; SHAPE_SAMPLES]; KEYS]> = LazyLock::new(|| {
        let w = |k: usize| std::f32::consts::PI * (k + 1) as f32 / SHAPE_SAMPLES as f32;
        std::array::from_fn(|k| std::array::from_fn(|i| (w(k) * (i as f32 + 0.5)).cos()))
    });
    WAVES.each_ref().map(|wave| {
        let sum: f32 = shape.iter().zip(wave).map(|(v, cos)| v * cos).sum();
        sum * (2.0f32).sqrt() / SHAPE_SAMPLES as f32
    })
}

/// Drops points that can't be on the hull: those inside the octagon of the extreme points in eight directions (Akl and
/// Toussaint 1978), mostly nine in ten.
fn drop_inner(points: &mut Vec<Point>) {
    const DIRECTIONS: [(f64, f64); 8] =
        [(1.0, 0.0), (1.0, 1.0), (0.0, 1.0), (-1.0, 1.0), (-1.0, 0.0), (-1.0, -1.0), (0.0, -1.0), (1.0, -1.0)];
    /// Of points so many apart the extreme ones exclude hardly less.
    const STRIDE: usize = 8;
    let Some(first) = points.first() else { return };
    let mut extreme = DIRECTIONS.map(|_| (f64::NEG_INFINITY, *first));
    for p in points.iter().step_by(STRIDE) {
        for (best, (x, y)) in extreme.iter_mut().zip(DIRECTIONS) {
            let far = x * p.x + y * p.y;
            if far > best.0 {
                *best = (far, *p);
            }
        }
    }
    // Each side as a line `normal . p + offset`, positive inside; sides of no length exclude nothing.
    let sides = std::array::from_fn::<_, 8, _>(|k| {
        let (a, b) = (extreme[k].1, extreme[(k + 1) % 8].1);
        let (nx, ny) = (a.y - b.y, b.x - a.x);
        (nx, ny, if (nx, ny) == (0.0, 0.0) { f64::INFINITY } else { -(nx * a.x + ny * a.y) })
    });
    points.retain(|p| sides.iter().fold(false, |out, (nx, ny, offset)| out | (nx * p.x + ny * p.y + offset <= 0.0)));
}

/// Convex hull, running so that the turn is never negative.
pub(crate) fn convex_hull(mut points: Vec<Point>) -> Vec<Point> {
    drop_inner(&mut points);
    hull::convex_hull(&points).into_iter().map(|k| points[k]).collect()
}

/// Cells worked on side by side, so that the arithmetic fills the registers of AVX2.
const LANES: usize = 8;

/// What the cells of a raster know of the border: the point next to each, where that lies from the corner of the raster, and the square of
/// its distance. A rim of cells that know of none spares a look at where the raster ends.
struct Seen {
    /// Whole groups of cells.
    columns: usize,
    rows: usize,
    point: Vec<u32>,
    x: Vec<f32>,
    y: Vec<f32>,
    square: Vec<f32>,
}

impl Seen {
    fn new(columns: usize, rows: usize) -> Self {
        let [columns, rows] = [columns, rows].map(|n| n.next_multiple_of(LANES));
        let nowhere = vec![f32::INFINITY; (columns + 2) * (rows + 2)];
        let point = vec![0; nowhere.len()];
        Self { columns, rows, point, x: nowhere.clone(), y: nowhere.clone(), square: nowhere }
    }

    fn place(&self, column: usize, row: usize) -> usize {
        (row + 1) * (self.columns + 2) + column + 1
    }

    /// Columns for rows.
    fn transposed(&self) -> Self {
        let mut other = Self::new(self.rows, self.columns);
        for r in 0..self.rows {
            for c in 0..self.columns {
                let (from, to) = (self.place(c, r), other.place(r, c));
                (other.point[to], other.square[to]) = (self.point[from], self.square[from]);
                (other.x[to], other.y[to]) = (self.y[from], self.x[from]);
            }
        }
        other
    }

    /// Each row learns from the one before it, then from the one behind it: what lies rather that way than along the row.
    #[inline(always)]
    fn sweep(&mut self, cell: f32) {
        let width = self.columns + 2;
        let centres: Vec<f32> = (0..self.columns as u32).map(|c| (c as f32 + 0.5) * cell).collect();
        for (row, beside) in (0..self.rows).map(|r| (r, r)).chain((0..self.rows).rev().map(|r| (r, r + 2))) {
            self.learn((row + 1) * width + 1, beside * width + 1, &centres, (row as f32 + 0.5) * cell);
        }
    }

    /// The cells of a row look at the three next to them in another one.
    #[inline(always)]
    fn learn(&mut self, row: usize, beside: usize, xs: &[f32], y: f32) {
        for c in (0..self.columns).step_by(LANES) {
            let x = lanes(xs, c);
            let here = row + c;
            let (mut u, mut v) = (lanes(&self.x, here), lanes(&self.y, here));
            let (mut square, mut point) = (lanes(&self.square, here), lanes(&self.point, here));
            for there in [beside + c, beside + c - 1, beside + c + 1] {
                let (us, vs, points) = (lanes(&self.x, there), lanes(&self.y, there), lanes(&self.point, there));
                let mut other = [0f32; LANES];
                for l in 0..LANES {
                    other[l] = (x[l] - us[l]).powi(2) + (y - vs[l]).powi(2);
                }
                // One number after the other, for otherwise the compiler doesn't see that they lie side by side.
                (0..LANES).for_each(|l| u[l] = if other[l] < square[l] { us[l] } else { u[l] });
                (0..LANES).for_each(|l| v[l] = if other[l] < square[l] { vs[l] } else { v[l] });
                (0..LANES).for_each(|l| point[l] = if other[l] < square[l] { points[l] } else { point[l] });
                (0..LANES).for_each(|l| square[l] = if other[l] < square[l] { other[l] } else { square[l] });
            }
            self.x[here..here + LANES].copy_from_slice(&u);
            self.y[here..here + LANES].copy_from_slice(&v);
            self.square[here..here + LANES].copy_from_slice(&square);
            self.point[here..here + LANES].copy_from_slice(&point);
        }
    }
}

/// Some numbers from a place on.
#[inline(always)]
fn lanes<T: Copy + Default>(from: &[T], place: usize) -> [T; LANES] {
    let mut lanes = [T::default(); LANES];
    lanes.copy_from_slice(&from[place..place + LANES]);
    lanes
}

impl Raster {
    /// Nearest-point propagation (Danielsson), exact enough at this coarseness.
    fn new(points: &[Point], cell: f64) -> Self {
        let cell = cell.max(1e-6);
        let (mut low, mut high) = (points[0], points[0]);
        for p in points {
            low = Point::new(low.x.min(p.x), low.y.min(p.y));
            high = Point::new(high.x.max(p.x), high.y.max(p.y));
        }
        const MARGIN: f64 = 2.0; // cells: a neighbour's border in contact still finds its foot
        // A degenerate outline (all in a line) would have a vanishing cell.
        let cell = cell.max((high - low).norm() / 512.0);
        let origin = Point::new(low.x - MARGIN * cell, low.y - MARGIN * cell);
        let columns = ((high.x - low.x) / cell + 2.0 * MARGIN) as usize + 1;
        let rows = ((high.y - low.y) / cell + 2.0 * MARGIN) as usize + 1;
        let centre =
            |c: usize, r: usize| Point::new(origin.x + (c as f64 + 0.5) * cell, origin.y + (r as f64 + 0.5) * cell);
        let xs: Vec<f64> = (0..columns).map(|c| centre(c, 0).x).collect();
        let ys: Vec<f64> = (0..rows).map(|r| centre(0, r).y).collect();
        let mut seen = Seen::new(columns, rows);
        for (i, p) in points.iter().enumerate() {
            let (c, r) = (((p.x - origin.x) / cell) as usize, ((p.y - origin.y) / cell) as usize);
            let k = seen.place(c.min(columns - 1), r.min(rows - 1));
            let square = (centre(c, r) - p).norm_squared() as f32;
            if square < seen.square[k] {
                (seen.square[k], seen.point[k]) = (square, i as u32);
                (seen.x[k], seen.y[k]) = ((p.x - origin.x) as f32, (p.y - origin.y) as f32);
            }
        }
        widely!(seen.sweep(cell as f32));
        let mut seen = seen.transposed();
        widely!(seen.sweep(cell as f32));
        // Which side a cell lies on is counted, not told from the nearest normal: beyond a corner that is ambiguous.
        let mut crossings: Vec<Vec<f64>> = vec![Vec::new(); rows];
        // The first row whose centres lie at this height or below.
        let row = |y: f64| {
            let exact = (y - origin.y) / cell - 0.5;
            let whole = exact as usize;
            whole + usize::from(exact > whole as f64)
        };
        let mut from = row(points[0].y);
        for (a, b) in points.iter().zip(points.iter().cycle().skip(1)) {
            let to = row(b.y);
            for r in from.min(to)..from.max(to).min(rows) {
                crossings[r].push(a.x + (b.x - a.x) * ((ys[r] - a.y) / (b.y - a.y)));
            }
            from = to;
        }
        let mut distance = vec![0f32; columns * rows];
        let mut nearest = vec![0; columns * rows];
        for (r, list) in crossings.iter_mut().enumerate() {
            list.sort_by(f64::total_cmp);
            let mut passed = 0;
            for (c, x) in xs.iter().enumerate() {
                let k = r * columns + c;
                while list.get(passed).is_some_and(|crossing| crossing < x) {
                    passed += 1;
                }
                let from = seen.place(r, c);
                nearest[k] = seen.point[from];
                let d = seen.square[from].sqrt();
                distance[k] = if passed % 2 == 1 { -d } else { d };
            }
        }
        let deepest = (0..distance.len()).min_by(|i, j| distance[*i].total_cmp(&distance[*j])).unwrap_or(0);
        let pole = centre(deepest % columns, deepest / columns);
        Self { origin, cell, columns, rows, distance, nearest, pole }
    }

    /// Cell that holds a point.
    pub(crate) fn cell_of(&self, p: Point) -> Option<usize> {
        let c = (p.x - self.origin.x) / self.cell;
        let r = (p.y - self.origin.y) / self.cell;
        (c >= 0.0 && r >= 0.0 && c < self.columns as f64 && r < self.rows as f64)
            .then(|| r as usize * self.columns + c as usize)
    }
}
