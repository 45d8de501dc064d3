//! Pose of a tab in a mouth: point-to-line least squares with the clearance as a fourth unknown.
//!
//! Input: the prepared segments of a tab and a mouth. Output: the pose of the tab's piece relative to the mouth's, the
//! clearance (kerf) between the two borders, the residuals, and the information the contact carries about the pose.
//!
//! Method, a variant of ICP (Chen and Medioni 1992, *Object modelling by registration of multiple range images*):
//! 1. The samples of the two match segments, taken at equal parts of their path, give a first pose (Umeyama 1991).
//! 2. Each sample of the tab gets its foot on the mouth's border: a walk from the foot of the last iteration.
//! 3. Weighted normal equations for shift, turn and clearance: residual = signed distance - clearance; the weights
//!    (Geman-McClure) follow the median residual, so that a corner or a speck doesn't pull.
//! 4. First the match segment alone, then extended to the shoulders up to the corners.
//!
//! Complexity O(iterations · samples), some 10 µs. Fails where the first pose is off by more than about half a neck,
//! and slides where the borders are near-circular or straight: the clearance is clamped and damped.

use crate::outline::{LEAST_WIDTH, Node, SHAPE_SAMPLES, Segment};
use nalgebra::{Isometry2, Matrix3, Matrix4, Point2, Vector2, Vector3, Vector4};

/// Limit of the fitted clearance in piece scales: no cut or segmentation takes more, and a free fit may diverge.
pub(crate) const MAX_CLEARANCE: f64 = 0.03;
/// Residuals count at most this, in piece scales: what doesn't follow at all shall not hide what follows exactly.
pub(crate) const RESIDUAL_CAP: f64 = 0.02;
/// Most that one iteration may turn, in radians.
const MAX_TURN: f64 = 0.1;
/// Weight of "no clearance" against that of all samples: enough where nothing else tells clearance from shift.
const CLEARANCE_DAMPING: f64 = 0.002;
/// Steps from a rough pose to a refined one; Gauss-Newton on feet that hardly move converges in two or three.
const REFINEMENTS: usize = 3;
/// Samples of the match segment for a rough pose.
const ROUGH_SAMPLES: usize = 20;

/// A refined contact of a tab and a mouth.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Fit {
    /// `p_negative_image = negative_from_positive * p_positive_image`.
    pub(crate) negative_from_positive: Isometry2<f64>,
    pub(crate) clearance: f64,
    /// Mean capped residual over the extended segment.
    pub(crate) residual: f64,
    /// Mean capped residual over the match segment alone (AVE-GAP with the clearance taken off).
    pub(crate) ave_gap: f64,
    /// Areas of overlap and underlap along the match segment, as posed, clearance included.
    pub(crate) pos_gap: f64,
    pub(crate) neg_gap: f64,
    /// Information about (x, y, turn) of the tab's piece about the mouth's isthmus point, clearance eliminated, for
    /// residuals of variance one.
    pub(crate) information: Matrix3<f64>,
}

/// A pose during refinement: tab's local frame to mouth's local frame.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Pose {
    cos: f64,
    sin: f64,
    x: f64,
    y: f64,
}

impl Pose {
    fn apply(&self, n: &Node) -> Vector2<f64> {
        let (x, y) = (f64::from(n.x), f64::from(n.y));
        Vector2::new(self.cos * x - self.sin * y + self.x, self.sin * x + self.cos * y + self.y)
    }

    fn turned(&self, angle: f64, about: Vector2<f64>, shift: Vector2<f64>) -> Self {
        let (sin, cos) = angle.sin_cos();
        let (x, y) = (self.x - about.x, self.y - about.y);
        let (c, s) = (cos * self.cos - sin * self.sin, sin * self.cos + cos * self.sin);
        let norm = c.hypot(s);
        Self {
            cos: c / norm,
            sin: s / norm,
            x: cos * x - sin * y + about.x + shift.x,
            y: sin * x + cos * y + about.y + shift.y,
        }
    }
}

/// Point of a run at a part of its core, in `0..=1`.
fn core_point(segment: &Segment, part: f64) -> Vector2<f64> {
    let s = segment.core.start as f64 + part * (segment.core.len().max(1) - 1) as f64;
    let i = (s as usize).min(segment.run.len() - 1);
    let j = (i + 1).min(segment.run.len() - 1);
    let t = s - i as f64;
    let (a, b) = (&segment.run[i], &segment.run[j]);
    let lerp = |p: f32, q: f32| f64::from(p) * (1.0 - t) + f64::from(q) * t;
    Vector2::new(lerp(a.x, b.x), lerp(a.y, b.y))
}

/// Best rigid pose of paired points (Umeyama 1991 without scale).
fn first_pose(tab: &Segment, mouth: &Segment) -> Pose {
    const PAIRS: usize = SHAPE_SAMPLES / 2;
    let (mut ma, mut mb) = (Vector2::zeros(), Vector2::zeros());
    let (mut dot, mut cross) = (0.0, 0.0);
    let pair = |k: usize| {
        let part = k as f64 / (PAIRS - 1) as f64;
        (core_point(tab, part), core_point(mouth, 1.0 - part))
    };
    for k in 0..PAIRS {
        let (a, b) = pair(k);
        ma += a;
        mb += b;
        dot += a.dot(&b);
        cross += a.x * b.y - a.y * b.x;
    }
    let n = PAIRS as f64;
    ma /= n;
    mb /= n;
    dot -= n * ma.dot(&mb);
    cross -= n * (ma.x * mb.y - ma.y * mb.x);
    let norm = dot.hypot(cross).max(f64::EPSILON);
    let (cos, sin) = (dot / norm, cross / norm);
    Pose { cos, sin, x: mb.x - cos * ma.x + sin * ma.y, y: mb.y - sin * ma.x - cos * ma.y }
}

/// Foot of a point on a run, walking from `at`: signed distance (positive outside), unit normal; `None` beyond an end.
fn foot(run: &[Node], at: &mut usize, p: Vector2<f64>) -> Option<(f64, Vector2<f64>)> {
    let square = |i: usize| {
        let (dx, dy) = (p.x - f64::from(run[i].x), p.y - f64::from(run[i].y));
        dx * dx + dy * dy
    };
    let mut i = (*at).min(run.len() - 1);
    let mut best = square(i);
    // Downhill in one direction, looking two points ahead so that a speck of noise doesn't stop the walk.
    let from = i;
    for direction in [1isize, -1] {
        let mut k = from;
        let mut misses = 0;
        while misses < 2 {
            k = k.wrapping_add_signed(direction);
            if k >= run.len() {
                break;
            }
            let d = square(k);
            if d < best {
                (best, i, misses) = (d, k, 0);
            } else {
                misses += 1;
            }
        }
        if i != from {
            break;
        }
    }
    *at = i;
    if i == 0 || i + 1 == run.len() {
        return None;
    }
    let q = Vector2::new(f64::from(run[i].x), f64::from(run[i].y));
    let next = &run[i + 1];
    let prev = &run[i - 1];
    let forward = Vector2::new(f64::from(next.x), f64::from(next.y)) - q;
    let along = (p - q).dot(&forward);
    let (other, edge, part) = if along >= 0.0 {
        (next, forward, along / forward.norm_squared().max(f64::EPSILON))
    } else {
        let back = Vector2::new(f64::from(prev.x), f64::from(prev.y)) - q;
        (prev, back, ((p - q).dot(&back) / back.norm_squared().max(f64::EPSILON)).max(0.0))
    };
    let part = part.min(1.0);
    let base = q + edge * part;
    let normal = Vector2::new(
        f64::from(run[i].nx) * (1.0 - part) + f64::from(other.nx) * part,
        f64::from(run[i].ny) * (1.0 - part) + f64::from(other.ny) * part,
    );
    let normal = normal / normal.norm().max(f64::EPSILON);
    Some(((p - base).dot(&normal), normal))
}

/// Feet of the samples of a range of the tab's run.
struct Feet {
    at: Vec<usize>,
    rows: Vec<(f64, Vector2<f64>, Vector2<f64>)>,
    /// The rows on the match segment proper.
    core: std::ops::Range<usize>,
    off: Vec<f64>,
}

impl Feet {
    fn new(tab: &Segment, mouth: &Segment) -> Self {
        // The borders run opposite ways: equal parts of the two cores lie on one another.
        let ratio = tab.step / mouth.step * mouth.path / tab.path;
        let at = (0..tab.run.len())
            .map(|k| {
                let s = mouth.core.end as f64 - 1.0 - (k as f64 - tab.core.start as f64) * ratio;
                s.clamp(0.0, (mouth.run.len() - 1) as f64) as usize
            })
            .collect();
        Self { at, rows: Vec::with_capacity(tab.run.len()), core: 0..0, off: Vec::with_capacity(tab.run.len()) }
    }

    fn find(&mut self, tab: &Segment, mouth: &Segment, range: impl Iterator<Item = usize>, pose: &Pose) {
        self.rows.clear();
        self.core = 0..0;
        for k in range {
            let p = pose.apply(&tab.run[k]);
            if let Some((distance, normal)) = foot(&mouth.run, &mut self.at[k], p) {
                self.rows.push((distance, normal, p));
            }
            if k < tab.core.start {
                self.core.start = self.rows.len();
            }
            if k < tab.core.end {
                self.core.end = self.rows.len();
            }
        }
    }

    /// Mean capped residual of some rows.
    fn residual(&self, rows: std::ops::Range<usize>, clearance: f64, cap: f64) -> f64 {
        let count = rows.len().max(1) as f64;
        self.rows[rows].iter().map(|r| (r.0 - clearance).abs().min(cap)).sum::<f64>() / count
    }

    fn spread(&mut self, clearance: f64) -> f64 {
        self.off.clear();
        self.off.extend(self.rows.iter().map(|r| (r.0 - clearance).abs()));
        if self.off.is_empty() {
            return 0.0;
        }
        let middle = self.off.len() / 2;
        *self.off.select_nth_unstable_by(middle, f64::total_cmp).1
    }
}

/// One step of weighted least squares; returns the normal matrix over (x, y, turn, clearance) about the local origin.
fn step(feet: &mut Feet, pose: &mut Pose, clearance: &mut f64, free: bool, limit: f64) -> Matrix4<f64> {
    let width = (3.0 * feet.spread(*clearance)).max(LEAST_WIDTH / MAX_CLEARANCE * limit);
    let mut h = Matrix4::zeros();
    let mut g = Vector4::zeros();
    let mut total = 0.0;
    for (distance, normal, p) in &feet.rows {
        let r = distance - *clearance;
        let z = r / width;
        let w = 1.0 / (1.0 + z * z);
        let w = w * w;
        let j = Vector4::new(normal.x, normal.y, p.x * normal.y - p.y * normal.x, -1.0);
        h += j * j.transpose() * w;
        g += j * (w * r);
        total += w;
    }
    if total < 4.0 {
        return h;
    }
    let mut damped = h;
    // A prior of a few samples' weight keeps the clearance from sliding where the normals don't tell it from a shift.
    if free {
        damped[(3, 3)] += CLEARANCE_DAMPING * total;
        g[3] += CLEARANCE_DAMPING * total * *clearance;
    } else {
        damped[(3, 3)] += 1e9 * total;
    }
    for k in 0..2 {
        damped[(k, k)] += 1e-9 * total;
    }
    damped[(2, 2)] += 1e-9 * total * limit * limit;
    if let Some(solution) = damped.cholesky().map(|c| c.solve(&-g)) {
        let turn = solution[2].clamp(-MAX_TURN, MAX_TURN);
        *pose = pose.turned(turn, Vector2::zeros(), Vector2::new(solution[0], solution[1]));
        if free {
            *clearance = (*clearance + solution[3]).clamp(-limit, limit);
        }
    }
    h
}

/// A rough pose, from a few samples of the match segment alone.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Rough {
    pose: Pose,
    clearance: f64,
    /// Mean capped residual of the few samples.
    pub(crate) residual: f64,
}

/// Poses a tab in a mouth roughly: what is far off after this can't be a mating. `scale` is the piece scale, `free`
/// whether the clearance is fitted.
pub(crate) fn rough(tab: &Segment, mouth: &Segment, scale: f64, free: bool) -> Option<Rough> {
    if tab.core.len() < 4 || mouth.core.len() < 4 {
        return None;
    }
    let mut pose = first_pose(tab, mouth);
    let mut clearance = 0.0;
    let limit = MAX_CLEARANCE * scale;
    let stride = (tab.core.len() / ROUGH_SAMPLES).max(1);
    let mut feet = Feet::new(tab, mouth);
    for round in 0..3 {
        feet.find(tab, mouth, tab.core.clone().step_by(stride), &pose);
        step(&mut feet, &mut pose, &mut clearance, free && round > 0, limit);
    }
    feet.find(tab, mouth, tab.core.clone().step_by(stride), &pose);
    if feet.rows.len() * stride < tab.core.len() / 2 {
        return None;
    }
    Some(Rough { pose, clearance, residual: feet.residual(0..feet.rows.len(), clearance, RESIDUAL_CAP * scale) })
}

/// Refines a rough pose on the extended match segment.
pub(crate) fn refine(tab: &Segment, mouth: &Segment, from: &Rough, scale: f64, free: bool) -> Option<Fit> {
    let Rough { mut pose, mut clearance, .. } = *from;
    let limit = MAX_CLEARANCE * scale;
    let cap = RESIDUAL_CAP * scale;
    let mut feet = Feet::new(tab, mouth);
    let mut h = Matrix4::zeros();
    for _ in 0..REFINEMENTS {
        feet.find(tab, mouth, 0..tab.run.len(), &pose);
        h = step(&mut feet, &mut pose, &mut clearance, free, limit);
    }
    feet.find(tab, mouth, 0..tab.run.len(), &pose);
    if feet.rows.len() < tab.core.len() / 2 {
        return None;
    }
    let residual = feet.residual(0..feet.rows.len(), clearance, cap);
    Some(fit_of(tab, mouth, &feet, &pose, clearance, residual, cap, reduced(&h, free)))
}

#[allow(clippy::too_many_arguments, reason = "the figures of one finished refinement")]
fn fit_of(
    tab: &Segment,
    mouth: &Segment,
    feet: &Feet,
    pose: &Pose,
    clearance: f64,
    residual: f64,
    cap: f64,
    information: Matrix3<f64>,
) -> Fit {
    let (mut pos_gap, mut neg_gap) = (0.0, 0.0);
    for (distance, ..) in &feet.rows[feet.core.clone()] {
        if *distance < 0.0 { pos_gap -= distance * tab.step } else { neg_gap += distance * tab.step }
    }
    let rotation = nalgebra::UnitComplex::from_cos_sin_unchecked(pose.cos, pose.sin);
    let translation = mouth.origin.coords + Vector2::new(pose.x, pose.y) - rotation * tab.origin.coords;
    Fit {
        negative_from_positive: Isometry2::from_parts(translation.into(), rotation),
        clearance,
        residual,
        ave_gap: feet.residual(feet.core.clone(), clearance, cap),
        pos_gap,
        neg_gap,
        information,
    }
}

/// The figures of a given pose, unrefined, with no clearance: for the rules of the paper.
pub(crate) fn as_posed(tab: &Segment, mouth: &Segment, pose: &Isometry2<f64>, scale: f64) -> Option<Fit> {
    let shift = pose * tab.origin - mouth.origin;
    let pose = Pose { cos: pose.rotation.re, sin: pose.rotation.im, x: shift.x, y: shift.y };
    let mut feet = Feet::new(tab, mouth);
    feet.find(tab, mouth, tab.core.clone(), &pose);
    if feet.rows.len() < tab.core.len() / 2 {
        return None;
    }
    let residual = feet.residual(feet.core.clone(), 0.0, f64::INFINITY);
    Some(fit_of(tab, mouth, &feet, &pose, 0.0, residual, RESIDUAL_CAP * scale, Matrix3::identity()))
}

/// Takes the clearance out of the normal matrix (Schur complement).
fn reduced(h: &Matrix4<f64>, free: bool) -> Matrix3<f64> {
    let block = h.fixed_view::<3, 3>(0, 0).into_owned();
    let column: Vector3<f64> = h.fixed_view::<3, 1>(0, 3).into_owned();
    if free && h[(3, 3)] > f64::EPSILON { block - column * column.transpose() / h[(3, 3)] } else { block }
}

/// Best rigid pose that takes points `a` to points `b` (Umeyama 1991 without scale).
pub fn rigid_fit(a: &[Point2<f64>], b: &[Point2<f64>]) -> Isometry2<f64> {
    let n = a.len().min(b.len()).max(1) as f64;
    let ma = a.iter().fold(Vector2::zeros(), |s, p| s + p.coords) / n;
    let mb = b.iter().fold(Vector2::zeros(), |s, p| s + p.coords) / n;
    let (mut dot, mut cross) = (0.0, 0.0);
    for (p, q) in a.iter().zip(b) {
        let (p, q) = (p.coords - ma, q.coords - mb);
        dot += p.dot(&q);
        cross += p.x * q.y - p.y * q.x;
    }
    let rotation = nalgebra::UnitComplex::new(cross.atan2(dot));
    Isometry2::from_parts((mb - rotation * ma).into(), rotation)
}
