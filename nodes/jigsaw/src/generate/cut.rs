//! Dividing a sheet into pieces: vertices, joints between them, faces round which the joints run.

use std::collections::BTreeMap;
use std::f64::consts::TAU;

use isthmus::Point;
use nalgebra::{Rotation2, Vector2};
use rand::RngExt;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;

use super::{Cut, Options, Rim, SideKind};

/// Spacing of the points of a joint, in pixels: at the tightest bend (radius about 10 px) the chord is off by 0.003 px.
const STEP: f64 = 0.5;
/// Greatest displacement of an inner vertex, over the pitch.
const JITTER: f64 = 0.06;
/// Amplitude of each wave of the warp, over the pitch. Four of them bend the grid lines by up to a tenth.
const WARP: f64 = 0.025;
/// Displacement of a honeycomb's vertices, over the pitch: at 0.144 the hexagons are regular.
const HONEYCOMB: f64 = 0.13;
/// Least distance between two joints away from their common end, over the pitch: what cardboard needs to hold.
const BRIDGE: f64 = 0.05;
/// Radius about a common end within which two joints may come as close as they like, over the shorter chord.
const NEAR_END: f64 = 0.22;
/// Tries for a joint that keeps its distance at full size; after each lot the tab is made smaller.
const TRIES: usize = 12;
/// Sizes tried before a joint becomes a wave.
const TAB_SIZES: [f64; 3] = [1.0, 0.85, 0.7];
/// Fraction of the cells that a ragged rim leaves out.
const RAGGED: f64 = 0.1;

/// A joint with its direction: `forward` has the piece on the side of `(-dy, dx)`, on the right as seen on a screen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct DirectedJoint {
    pub(super) joint: usize,
    pub(super) forward: bool,
}

#[derive(Debug, Clone)]
pub(super) struct Joint {
    /// From vertex to vertex, about `STEP` apart, in the puzzle frame.
    points: Vec<Point>,
    /// The face that runs it forward, and the one that runs it backward.
    faces: [Option<usize>; 2],
    pub(super) clearance: f64,
    neck: Option<Neck>,
    rim: bool,
}

#[derive(Debug, Clone, Copy)]
struct Neck {
    /// Ends of the neck in the order of the joint's points.
    ends: [Point; 2],
    /// Whether the face that runs the joint backward has the tab, which then reaches into the other face.
    backward_has_tab: bool,
}

#[derive(Debug, Clone)]
pub(super) struct Face {
    pub(super) row: usize,
    pub(super) column: usize,
    /// Clockwise as seen on a screen.
    pub(super) sides: Vec<DirectedJoint>,
}

/// A divided sheet. Its upper left corner is the origin of the puzzle frame.
#[derive(Debug, Clone)]
pub(super) struct Sheet {
    pub(super) joints: Vec<Joint>,
    pub(super) faces: Vec<Face>,
}

impl Joint {
    pub(super) fn kind_for(&self, side: DirectedJoint) -> SideKind {
        match self.neck {
            _ if self.rim => SideKind::Rim,
            None => SideKind::Wave,
            Some(neck) if neck.backward_has_tab != side.forward => SideKind::Tab,
            Some(_) => SideKind::Blank,
        }
    }

    pub(super) fn other_face(&self, side: DirectedJoint) -> Option<usize> {
        self.faces[usize::from(side.forward)]
    }

    /// Ends of the neck or mouth on the border of one of the two pieces, as its outline runs.
    pub(super) fn critical_points_for(&self, side: DirectedJoint) -> Option<[Point; 2]> {
        let neck = self.neck?;
        let [mut a, mut b] = neck.ends;
        let chord = (b - a).normalize();
        // The kerf eats half its width from each side of the neck and adds as much to each side of the mouth.
        let inward = match self.kind_for(side) {
            SideKind::Tab => 0.5 * self.clearance,
            _ => -0.5 * self.clearance,
        };
        a += chord * inward;
        b -= chord * inward;
        Some(if side.forward { [a, b] } else { [b, a] })
    }

    /// The border of one of the two pieces along this joint: moved inward by half of the clearance.
    fn border_for(&self, side: DirectedJoint) -> Vec<Point> {
        let offset = 0.5 * self.clearance;
        let mut points = self.points.clone();
        if !side.forward {
            points.reverse();
        }
        if offset == 0.0 {
            return points;
        }
        let last = points.len() - 1;
        (0..=last)
            .map(|k| {
                let along = points[(k + 1).min(last)] - points[k.saturating_sub(1)];
                points[k] + Vector2::new(-along.y, along.x).normalize() * offset
            })
            .collect()
    }
}

impl Sheet {
    pub(super) fn cut(options: &Options, rng: &mut ChaCha8Rng) -> Self {
        let mut plan = Plan::lay_out(options, rng);
        if options.rim == Rim::Ragged {
            plan.drop_rim_faces(rng);
        }
        plan.draw(options, rng)
    }

    /// Outline of a face, clockwise as seen on a screen, with the kerf taken off.
    pub(super) fn outline(&self, face: usize) -> Vec<Point> {
        let sides = &self.faces[face].sides;
        let mut borders: Vec<Vec<Point>> = sides.iter().map(|&side| self.joints[side.joint].border_for(side)).collect();
        for k in 0..borders.len() {
            let next = (k + 1) % borders.len();
            let reach = sides[k].offset(self).max(sides[next].offset(self));
            if reach > 0.0 && next != k {
                let (tail, head) = (std::mem::take(&mut borders[k]), std::mem::take(&mut borders[next]));
                (borders[k], borders[next]) = mitre(tail, head, reach);
            }
        }
        let mut outline: Vec<Point> = Vec::with_capacity(borders.iter().map(Vec::len).sum());
        for p in borders.into_iter().flatten() {
            if outline.last().is_none_or(|q| (p - q).norm() > 1e-9) {
                outline.push(p);
            }
        }
        while outline.len() > 1 && (outline[0] - outline[outline.len() - 1]).norm() <= 1e-9 {
            outline.pop();
        }
        outline
    }
}

impl DirectedJoint {
    fn offset(self, sheet: &Sheet) -> f64 {
        0.5 * sheet.joints[self.joint].clearance
    }
}

/// Joins two borders that were moved inward: cuts them at their crossing, or draws them out until they cross.
fn mitre(mut tail: Vec<Point>, mut head: Vec<Point>, reach: f64) -> (Vec<Point>, Vec<Point>) {
    // At a corner of 30 degrees the crossing lies four offsets away.
    let reach = 4.0 * reach;
    let steps = (reach / STEP).ceil() as usize + 2;
    let (n, m) = (tail.len(), head.len());
    if n < 2 || m < 2 {
        return (tail, head);
    }
    let tail_from = n.saturating_sub(steps);
    let head_to = steps.min(m);
    let mut end: Vec<Point> = tail[tail_from..].to_vec();
    end.push(tail[n - 1] + (tail[n - 1] - tail[n - 2]).normalize() * reach);
    let mut begin = vec![head[0] + (head[0] - head[1]).normalize() * reach];
    begin.extend_from_slice(&head[..head_to]);
    for i in 0..end.len() - 1 {
        // From the corner outward along the second border, so that the crossing nearest to the corner wins.
        for j in 0..begin.len() - 1 {
            if let Some(crossing) = crossing([end[i], end[i + 1]], [begin[j], begin[j + 1]]) {
                tail.truncate(tail_from + i + 1);
                tail.push(crossing);
                let mut trimmed = vec![crossing];
                trimmed.extend_from_slice(&head[j.min(m)..]);
                head = trimmed;
                return (tail, head);
            }
        }
    }
    // Nearly in line and differently far inside: a small step joins them.
    (tail, head)
}

/// Where two line segments cross, if they do.
pub(super) fn crossing([a, b]: [Point; 2], [c, d]: [Point; 2]) -> Option<Point> {
    let (u, v, w) = (b - a, d - c, c - a);
    let det = u.perp(&v);
    if det.abs() <= 1e-12 * u.norm() * v.norm() {
        return None;
    }
    let (s, t) = (w.perp(&v) / det, w.perp(&u) / det);
    ((0.0..=1.0).contains(&s) && (0.0..=1.0).contains(&t)).then(|| a + u * s)
}

/// Resamples a closed line to equal steps of about `spacing`; gives the exact spacing as well.
pub(super) fn resample_closed(points: &[Point], spacing: f64) -> (Vec<Point>, f64) {
    let n = points.len();
    let length: f64 = (0..n).map(|k| (points[(k + 1) % n] - points[k]).norm()).sum();
    let count = (length / spacing).round().max(3.0);
    let spacing = length / count;
    let mut out = Vec::with_capacity(count as usize);
    let (mut k, mut walked) = (0, 0.0);
    for target in (0..count as usize).map(|i| i as f64 * spacing) {
        loop {
            let step = points[(k + 1) % n] - points[k % n];
            let size = step.norm();
            if k + 1 >= n || walked + size > target {
                out.push(points[k % n] + step * ((target - walked) / size.max(f64::MIN_POSITIVE)).clamp(0.0, 1.0));
                break;
            }
            walked += size;
            k += 1;
        }
    }
    (out, spacing)
}

/// The sheet before its joints are drawn: in units of the pitch, without the warp.
struct Plan {
    vertices: Vec<Point>,
    /// Ends and faces of each joint.
    joints: Vec<([usize; 2], [Option<usize>; 2])>,
    faces: Vec<Face>,
    rows: usize,
    columns: usize,
}

impl Plan {
    fn lay_out(options: &Options, rng: &mut ChaCha8Rng) -> Self {
        // A patch is cut out of a sheet that is larger by one piece all round.
        let margin = if options.rim == Rim::Patch { 1 } else { 0 };
        let (rows, columns) = (options.rows + 2 * margin, options.columns + 2 * margin);
        // Positions are kept in quarters of the pitch, so that they are exact as keys.
        let quarters_of_row = |row: usize| -> Vec<i64> {
            let shift = match (options.cut, row % 2) {
                (Cut::Grid, _) => 0,
                (_, 0) => -1,
                _ => 1,
            };
            let last = columns as i64;
            (0..=last).map(|x| if x == 0 || x == last { 4 * x } else { 4 * x + shift }).collect()
        };
        let mut plan = Self { vertices: vec![], joints: vec![], faces: vec![], rows, columns };
        let mut vertex_at: BTreeMap<(usize, i64), usize> = BTreeMap::new();
        let mut horizontal: BTreeMap<(usize, i64), usize> = BTreeMap::new();
        let mut line_of: Vec<Vec<i64>> = Vec::with_capacity(rows + 1);
        for line in 0..=rows {
            let above = if line > 0 { quarters_of_row(line - 1) } else { vec![] };
            let below = if line < rows { quarters_of_row(line) } else { vec![] };
            let mut all: Vec<i64> = above.iter().chain(&below).copied().collect();
            all.sort_unstable();
            all.dedup();
            for &x in &all {
                let at = Point::new(x as f64 / 4.0, line as f64);
                let mut p = at;
                let (side, end) = (x == 0 || x == 4 * columns as i64, line == 0 || line == rows);
                if options.cut == Cut::Honeycomb && !side && !end {
                    p.y += if above.contains(&x) { -HONEYCOMB } else { HONEYCOMB };
                }
                let loose = 1.0 - options.similarity;
                let jitter = Vector2::new(rng.random_range(-JITTER..JITTER), rng.random_range(-JITTER..JITTER)) * loose;
                let free_rim = options.rim != Rim::Straight;
                p.x += if side && !free_rim { 0.0 } else { jitter.x };
                p.y += if end && !free_rim { 0.0 } else { jitter.y };
                vertex_at.insert((line, x), plan.vertices.len());
                plan.vertices.push(p);
            }
            for pair in all.windows(2) {
                let ends = [vertex_at[&(line, pair[0])], vertex_at[&(line, pair[1])]];
                horizontal.insert((line, pair[0]), plan.joints.len());
                plan.joints.push((ends, [None; 2]));
            }
            line_of.push(all);
        }
        for row in 0..rows {
            let walls: Vec<(i64, usize)> = quarters_of_row(row)
                .into_iter()
                .map(|x| {
                    plan.joints.push(([vertex_at[&(row, x)], vertex_at[&(row + 1, x)]], [None; 2]));
                    (x, plan.joints.len() - 1)
                })
                .collect();
            for (column, pair) in walls.windows(2).enumerate() {
                let ((left, left_joint), (right, right_joint)) = (pair[0], pair[1]);
                let along = |line: usize| -> Vec<usize> {
                    line_of[line]
                        .iter()
                        .filter(|x| (left..right).contains(x))
                        .map(|&x| horizontal[&(line, x)])
                        .collect()
                };
                let outer = |k: usize, last: usize| k < margin || k + margin > last;
                if outer(row, rows - 1) || outer(column, columns - 1) {
                    continue;
                }
                let mut sides: Vec<DirectedJoint> = vec![];
                sides.extend(along(row).into_iter().map(|joint| DirectedJoint { joint, forward: true }));
                // A wall runs downward; its forward side, at (-dy, dx), is to the left.
                sides.push(DirectedJoint { joint: right_joint, forward: true });
                sides.extend(along(row + 1).into_iter().rev().map(|joint| DirectedJoint { joint, forward: false }));
                sides.push(DirectedJoint { joint: left_joint, forward: false });
                plan.faces.push(Face { row: row - margin, column: column - margin, sides });
            }
        }
        plan.join_faces();
        plan
    }

    fn join_faces(&mut self) {
        self.joints.iter_mut().for_each(|(_, faces)| *faces = [None; 2]);
        for (k, face) in self.faces.iter().enumerate() {
            for side in &face.sides {
                self.joints[side.joint].1[usize::from(!side.forward)] = Some(k);
            }
        }
    }

    /// Leaves out some faces along the rim, as long as the rest hangs together.
    fn drop_rim_faces(&mut self, rng: &mut ChaCha8Rng) {
        let count = (self.faces.len() as f64 * RAGGED) as usize;
        for _ in 0..count {
            let mut rim: Vec<usize> = (0..self.faces.len())
                .filter(|&k| self.faces[k].sides.iter().any(|s| self.joints[s.joint].1.contains(&None)))
                .collect();
            rim.shuffle(rng);
            let Some(face) = rim.into_iter().find(|&k| self.hangs_together_without(k)) else { return };
            self.faces.remove(face);
            self.join_faces();
        }
    }

    fn hangs_together_without(&self, dropped: usize) -> bool {
        let mut seen = vec![false; self.faces.len()];
        seen[dropped] = true;
        let Some(first) = (0..self.faces.len()).find(|&k| k != dropped) else { return false };
        let mut open = vec![first];
        seen[first] = true;
        while let Some(face) = open.pop() {
            for side in &self.faces[face].sides {
                for &next in self.joints[side.joint].1.iter().flatten() {
                    if !seen[next] {
                        seen[next] = true;
                        open.push(next);
                    }
                }
            }
        }
        seen.into_iter().all(|s| s)
    }

    /// Draws the joints, in pixels.
    fn draw(self, options: &Options, rng: &mut ChaCha8Rng) -> Sheet {
        let pitch = options.pitch();
        let wavy = self.choose_wavy(options, rng);
        let warp = Warp::new(options, self.columns as f64, self.rows as f64, rng);
        let common = TabShape::random(0.5, rng);
        // Coarse course of each joint, in units of the pitch: at first the chord.
        let mut courses: Vec<Vec<Point>> = self.joints.iter().map(|(ends, _)| self.chord(*ends)).collect();
        let mut joints = Vec::with_capacity(self.joints.len());
        for (k, (ends, faces)) in self.joints.iter().enumerate() {
            let neighbours = self.neighbours(k);
            let used = faces.iter().any(Option::is_some);
            let rim = match options.rim {
                Rim::Patch => !used,
                _ => faces.contains(&None),
            };
            let chord = Chord::new(self.vertices[ends[0]], self.vertices[ends[1]], rng.random());
            let mut neck = None;
            let mut curve = match options.rim {
                Rim::Straight if rim => chord.straight(),
                _ => chord.wave(rng),
            };
            if !rim && !wavy[k] {
                'sizes: for size in TAB_SIZES {
                    for _ in 0..TRIES {
                        let tab = TabShape::random(1.0, rng).towards(&common, options.similarity);
                        let (candidate, flanks) = chord.tab(&tab, size);
                        let course = sample(&candidate, 0.05).0;
                        if neighbours.iter().all(|&(other, end)| apart(&course, &courses[other], end)) {
                            courses[k] = course;
                            curve = candidate;
                            neck = Some(flanks);
                            break 'sizes;
                        }
                    }
                }
            }
            if neck.is_none() {
                courses[k] = sample(&curve, 0.05).0;
            }
            let clearance = match options.clearance {
                _ if rim => 0.0,
                [low, high] if low < high => rng.random_range(low..high),
                [low, _] => low,
            };
            let (mut points, knots) = sample(&curve, STEP / pitch);
            points.iter_mut().for_each(|p| *p = warp.apply(*p) * pitch);
            let neck = neck.map(|flanks| Neck {
                ends: narrowest(&points, flanks.map(|knot| knots[knot]), knots[flanks[0] + 2]),
                backward_has_tab: chord.to_forward_side,
            });
            joints.push(Joint { points, faces: *faces, clearance, neck, rim });
        }
        Sheet { joints, faces: self.faces }
    }

    fn chord(&self, ends: [usize; 2]) -> Vec<Point> {
        let [a, b] = ends.map(|v| self.vertices[v]);
        (0..=16).map(|k| a + (b - a) * (f64::from(k) / 16.0)).collect()
    }

    /// Joints that share a face with this one, and the end they share with it.
    fn neighbours(&self, joint: usize) -> Vec<(usize, Option<(Point, f64)>)> {
        let (ends, faces) = self.joints[joint];
        let length = |ends: [usize; 2]| (self.vertices[ends[1]] - self.vertices[ends[0]]).norm();
        let mut out: Vec<usize> =
            faces.iter().flatten().flat_map(|&face| self.faces[face].sides.iter().map(|s| s.joint)).collect();
        out.sort_unstable();
        out.dedup();
        out.retain(|&other| other != joint);
        out.into_iter()
            .map(|other| {
                let theirs = self.joints[other].0;
                let shared = ends.into_iter().find(|v| theirs.contains(v));
                let near = NEAR_END * length(ends).min(length(theirs));
                (other, shared.map(|v| (self.vertices[v], near)))
            })
            .collect()
    }

    /// Which joints are waves: the wanted fraction, but every face keeps a neck.
    fn choose_wavy(&self, options: &Options, rng: &mut ChaCha8Rng) -> Vec<bool> {
        let patch = options.rim == Rim::Patch;
        let has_neck =
            |faces: &[Option<usize>; 2]| faces.iter().flatten().count() == 2 || (patch && *faces != [None; 2]);
        let mut order: Vec<usize> = (0..self.joints.len()).filter(|&k| has_neck(&self.joints[k].1)).collect();
        let mut necks = vec![0_usize; self.faces.len()];
        for &k in &order {
            self.joints[k].1.iter().flatten().for_each(|&face| necks[face] += 1);
        }
        order.shuffle(rng);
        let mut left = (order.len() as f64 * options.wavy).round() as usize;
        let mut wavy = vec![false; self.joints.len()];
        for k in order {
            let faces = &self.joints[k].1;
            if left > 0 && faces.iter().flatten().all(|&face| necks[face] > 1) {
                faces.iter().flatten().for_each(|&face| necks[face] -= 1);
                wavy[k] = true;
                left -= 1;
            }
        }
        wavy
    }
}

/// A smooth displacement of the whole sheet that bends the grid lines and leaves a straight rim straight.
struct Warp {
    waves: Vec<(Vector2<f64>, f64, Vector2<f64>)>,
    size: Option<Vector2<f64>>,
}

impl Warp {
    fn new(options: &Options, width: f64, height: f64, rng: &mut ChaCha8Rng) -> Self {
        let amplitude = WARP * (1.0 - options.similarity);
        let waves = (0..4)
            .map(|_| {
                let direction = Rotation2::new(rng.random_range(0.0..TAU));
                let frequency = TAU / rng.random_range(2.5..6.0);
                let shift = Rotation2::new(rng.random_range(0.0..TAU)) * Vector2::new(amplitude, 0.0);
                (direction * Vector2::new(frequency, 0.0), rng.random_range(0.0..TAU), shift)
            })
            .collect();
        let size = (options.rim == Rim::Straight).then(|| Vector2::new(width, height));
        Self { waves, size }
    }

    fn apply(&self, p: Point) -> Point {
        let mut shift = Vector2::zeros();
        for (frequency, phase, amplitude) in &self.waves {
            shift += amplitude * (frequency.dot(&p.coords) + phase).sin();
        }
        if let Some(size) = self.size {
            // Fades within one pitch of the rim; a cubic step keeps the curves smooth.
            let fade = |v: f64, end: f64| {
                let t = v.min(end - v).clamp(0.0, 1.0);
                t * t * (3.0 - 2.0 * t)
            };
            shift.component_mul_assign(&Vector2::new(fade(p.x, size.x), fade(p.y, size.y)));
        }
        p + shift
    }
}

/// Shape of a tab, over the length of its chord: x along the chord, y into the other piece.
#[derive(Debug, Clone, Copy)]
struct TabShape([f64; 11]);

impl TabShape {
    /// Least and greatest value of each parameter, in the order of the bindings in `Chord::tab`.
    const RANGES: [[f64; 2]; 11] = [
        [0.43, 0.57],   // centre of the neck
        [0.23, 0.285],  // height
        [0.045, 0.068], // half width of the neck
        [0.095, 0.130], // half width of the head, left
        [0.095, 0.130], // half width of the head, right
        [0.060, 0.095], // height of the neck
        [0.50, 0.64],   // where the head is widest, between neck and top
        [-0.07, 0.03],  // level of the left shoulder
        [-0.07, 0.03],  // level of the right shoulder
        [-0.16, 0.16],  // tilt of the tab, in radians
        [-0.15, 0.15],  // skew: shift along the chord over height
    ];

    /// Draws each parameter from the middle `spread` of its range.
    fn random(spread: f64, rng: &mut ChaCha8Rng) -> Self {
        Self(Self::RANGES.map(|[low, high]| 0.5 * (low + high) + spread * (high - low) * (rng.random::<f64>() - 0.5)))
    }

    fn towards(&self, other: &Self, similarity: f64) -> Self {
        let mut out = *self;
        for (own, common) in out.0.iter_mut().zip(other.0) {
            *own += (common - *own) * similarity;
        }
        out
    }
}

/// Cubic Bézier, four control points.
type Bezier = [Point; 4];

struct Chord {
    from: Point,
    along: Vector2<f64>,
    /// A tab reaches to the side of `(-dy, dx)`, into the face that runs the joint forward.
    to_forward_side: bool,
}

impl Chord {
    fn new(from: Point, to: Point, to_forward_side: bool) -> Self {
        Self { from, along: to - from, to_forward_side }
    }

    fn place(&self, x: f64, y: f64) -> Point {
        let side = if self.to_forward_side { 1.0 } else { -1.0 };
        self.from + self.along * x + Vector2::new(-self.along.y, self.along.x) * (y * side)
    }

    fn straight(&self) -> Vec<Bezier> {
        vec![[0.0, 1.0 / 3.0, 2.0 / 3.0, 1.0].map(|x| self.place(x, 0.0))]
    }

    fn wave(&self, rng: &mut ChaCha8Rng) -> Vec<Bezier> {
        let (a, b, middle) =
            (rng.random_range(0.05..0.14), rng.random_range(-0.14..-0.05), rng.random_range(0.42..0.58));
        let level = 0.5 * (a + b);
        let slope = (b - a) * 0.18;
        let [p, q, r] = [(0.18, a), (middle - 0.18, level - slope), (middle, level)];
        let [s, t, end] = [(middle + 0.18, level + slope), (0.82, b), (1.0, 0.0)];
        let place = |(x, y): (f64, f64)| self.place(x, y);
        vec![[(0.0, 0.0), p, q, r].map(place), [r, s, t, end].map(place)]
    }

    /// The tab as six Béziers, and the numbers of the two knots at its neck.
    fn tab(&self, shape: &TabShape, size: f64) -> (Vec<Bezier>, [usize; 2]) {
        let [centre, height, neck, left, right, low, belly, dip_left, dip_right, tilt, skew] = shape.0;
        let [height, neck, left, right, low] = [height, neck, left, right, low].map(|v| v * size);
        let wide = low + (height - low) * belly;
        let tilt = Rotation2::new(tilt);
        // Handles of 0.55 draw about an ellipse between two points with crossed tangents.
        const ROUND: f64 = 0.55;
        // In the tab's own axes, before skew and tilt.
        let own = |x: f64, y: f64| {
            let p = tilt * Vector2::new(x + skew * y, y);
            (centre + p.x, p.y)
        };
        let rise = wide - low;
        let foot = low * 0.9 + 0.02;
        let knots = [
            (0.0, 0.0),
            ((centre - neck) * 0.7, dip_left),
            own(-neck, low - foot),
            own(-neck, low),
            own(-neck, low + 0.45 * rise),
            own(-left, wide - 0.5 * rise),
            own(-left, wide),
            own(-left, wide + ROUND * (height - wide)),
            own(-ROUND * left, height),
            own(0.0, height),
            own(ROUND * right, height),
            own(right, wide + ROUND * (height - wide)),
            own(right, wide),
            own(right, wide - 0.5 * rise),
            own(neck, low + 0.45 * rise),
            own(neck, low),
            own(neck, low - foot),
            (1.0 - (1.0 - centre - neck) * 0.7, dip_right),
            (1.0, 0.0),
        ];
        let points = knots.map(|(x, y)| self.place(x, y));
        let curve = (0..6).map(|k| [points[3 * k], points[3 * k + 1], points[3 * k + 2], points[3 * k + 3]]).collect();
        (curve, [1, 5])
    }
}

/// Points along a chain of Béziers, about `step` apart, and the index of each knot (end of a Bézier).
fn sample(curve: &[Bezier], step: f64) -> (Vec<Point>, Vec<usize>) {
    let mut points = vec![curve[0][0]];
    let mut knots = vec![0];
    for [a, b, c, d] in curve {
        let length = (b - a).norm() + (c - b).norm() + (d - c).norm();
        let count = (length / step).ceil().max(2.0) as usize;
        for k in 1..=count {
            let t = k as f64 / count as f64;
            let s = 1.0 - t;
            let p = a.coords * (s * s * s)
                + b.coords * (3.0 * s * s * t)
                + c.coords * (3.0 * s * t * t)
                + d.coords * (t * t * t);
            points.push(if k == count { *d } else { p.into() });
        }
        knots.push(points.len() - 1);
    }
    (points, knots)
}

/// Whether two joints keep their distance away from the end they share.
fn apart(a: &[Point], b: &[Point], end: Option<(Point, f64)>) -> bool {
    let near = |p: &Point| end.is_some_and(|(v, radius)| (p - v).norm() < radius);
    a.iter().all(|p| b.iter().all(|q| (p - q).norm() >= BRIDGE || (near(p) && near(q))))
}

/// Ends of the locally shortest chord between the two flanks of a tab: from the knots at its neck each end moves in
/// turn to the point of its flank nearest to the other, until neither moves.
fn narrowest(points: &[Point], [left, right]: [usize; 2], top: usize) -> [Point; 2] {
    // The flanks: from halfway between the vertex and the neck up to halfway between the neck and the top.
    let left_flank = &points[left / 2..(left + top) / 2];
    let right_flank = &points[(top + right) / 2..(right + points.len()) / 2];
    let (mut a, mut b) = (points[left], points[right]);
    // Each round shortens the distance to the limit by a factor of less than 0.7: 200 rounds reach machine precision.
    for _ in 0..200 {
        let (next_a, moved_from) = (nearest(left_flank, b), a);
        a = next_a;
        b = nearest(right_flank, a);
        if (a - moved_from).norm() < 1e-10 {
            break;
        }
    }
    [a, b]
}

/// Point of an open line nearest to `p`.
fn nearest(line: &[Point], p: Point) -> Point {
    let mut best = (f64::MAX, p);
    for pair in line.windows(2) {
        let along = pair[1] - pair[0];
        let t = ((p - pair[0]).dot(&along) / along.norm_squared()).clamp(0.0, 1.0);
        let q = pair[0] + along * t;
        let distance = (q - p).norm_squared();
        if distance < best.0 {
            best = (distance, q);
        }
    }
    best.1
}
