//! Pose of a tab in a mouth: point-to-line least squares with the clearance as a fourth unknown.
//!
//! Input: the prepared segments of a tab and a mouth. Output: the pose of the tab's piece relative to the mouth's, the
//! clearance (kerf) between the two borders, the residuals, and the information the contact carries about the pose.
//!
//! Method, a variant of ICP (Chen and Medioni 1992, *Object modelling by registration of multiple range images*):
//! 1. The samples of the two match segments, taken at equal parts of their path, give a first pose (Umeyama 1991).
//! 2. Each sample of the tab gets its foot on the mouth's border: a step along the tangent from the foot of the round
//!    before.
//! 3. Weighted normal equations for shift, turn and clearance: residual = signed distance - clearance; the weights
//!    (Geman-McClure) follow the median residual, so that a corner or a speck doesn't pull.
//! 4. From coarse to fine: a few samples of the match segment alone for all candidates; then some nodes of the segment
//!    extended to the shoulders up to the corners, for those that aren't hopeless; then all nodes, for the best.
//!
//! Complexity O(rounds · samples), 1 µs to 10 µs. Fails where the first pose is off by more than about half a neck,
//! and slides where the borders are near-circular or straight: the clearance is clamped and damped.

#![allow(clippy::needless_range_loop, reason = "a lane of many arrays side by side")]

use crate::outline::{LEAST_WIDTH, Node, ROUGH_SAMPLES, Segment};
use isthmus::wide::widely;
use nalgebra::{Isometry2, Matrix3, Matrix4, Point2, Vector2, Vector3, Vector4};

/// Limit of the fitted clearance in piece scales: no cut or segmentation takes more, and a free fit may diverge.
pub(crate) const MAX_CLEARANCE: f64 = 0.03;
/// Residuals count at most this, in piece scales: what doesn't follow at all shall not hide what follows exactly.
pub(crate) const RESIDUAL_CAP: f64 = 0.02;
/// Most that one iteration may turn, in radians.
const MAX_TURN: f64 = 0.1;
/// Weight of "no clearance" against that of all samples: enough where nothing else tells clearance from shift.
const CLEARANCE_DAMPING: f64 = 0.002;
/// Rounds from a rough pose to a coarse fit on the extended segment, and from there to a refined one: Gauss-Newton on
/// feet that hardly move converges in two or three.
const COARSE_ROUNDS: usize = 3;
const REFINEMENTS: usize = 2;
/// Rounds of a rough pose: the first without clearance, then two with.
const ROUGH_ROUNDS: usize = 3;
/// Most steps of the border that the foot of a point moves at once: half a turn of the tightest tab, beyond which the
/// tangent says nothing.
const STRIDE: f32 = 8.0;
/// Rounds after which guessed feet have come so near to where they belong that the first step can use them.
const SETTLING: usize = 1;
/// Every so many nodes of a tab take part in a coarse fit: five to each bend, enough to tell most candidates apart.
const COARSE_STRIDE: usize = 4;

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
    /// residuals of variance one at every node.
    pub(crate) information: Matrix3<f64>,
}

/// A candidate given to the assembly: tab `tab` of piece `a` in mouth `mouth` of piece `b`.
#[derive(Debug, Clone)]
pub(crate) struct Joint {
    pub(crate) a: usize,
    pub(crate) tab: usize,
    pub(crate) b: usize,
    pub(crate) mouth: usize,
    pub(crate) fit: Fit,
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
    /// Of a pose of the tab's piece in the image of the mouth's.
    fn between(tab: &Segment, mouth: &Segment, negative_from_positive: &Isometry2<f64>) -> Self {
        let shift = negative_from_positive * tab.origin - mouth.origin;
        let rotation = negative_from_positive.rotation;
        Self { cos: rotation.re, sin: rotation.im, x: shift.x, y: shift.y }
    }

    /// Pose of the tab's piece in the image of the mouth's.
    fn between_images(&self, tab: &Segment, mouth: &Segment) -> Isometry2<f64> {
        let rotation = nalgebra::UnitComplex::from_cos_sin_unchecked(self.cos, self.sin);
        let translation = mouth.origin.coords + Vector2::new(self.x, self.y) - rotation * tab.origin.coords;
        Isometry2::from_parts(translation.into(), rotation)
    }

    fn turned(&self, angle: f64, shift: Vector2<f64>) -> Self {
        let (sin, cos) = angle.sin_cos();
        let (c, s) = (cos * self.cos - sin * self.sin, sin * self.cos + cos * self.sin);
        let norm = c.hypot(s);
        Self {
            cos: c / norm,
            sin: s / norm,
            x: cos * self.x - sin * self.y + shift.x,
            y: sin * self.x + cos * self.y + shift.y,
        }
    }
}

/// Best rigid pose of the samples of the two match segments, pair by pair (Umeyama 1991 without scale).
fn first_pose(tab: &Segment, mouth: &Segment) -> Pose {
    let (cos, sin) = turn(tab, mouth);
    let [ax, ay] = tab.middle.map(f64::from);
    let [bx, by] = mouth.middle.map(f64::from);
    Pose { cos, sin, x: bx - cos * ax + sin * ay, y: by - sin * ax - cos * ay }
}

/// Cosine and sine of the angle by which that pose turns.
pub(crate) fn turn(tab: &Segment, mouth: &Segment) -> (f64, f64) {
    let (dot, cross) = widely!(products(&tab.samples, &mouth.samples));
    let norm = dot.hypot(cross).max(f64::EPSILON);
    (dot / norm, cross / norm)
}

/// Sums of dot and cross products of points.
#[inline(always)]
fn products(a: &[[f32; ROUGH_SAMPLES]; 2], b: &[[f32; ROUGH_SAMPLES]; 2]) -> (f64, f64) {
    let (mut dots, mut crosses) = ([0f32; LANES], [0f32; LANES]);
    let [[ax, ay], [bx, by]] = [a, b].map(|[x, y]| [x.as_chunks::<LANES>().0, y.as_chunks::<LANES>().0]);
    for k in 0..ROUGH_SAMPLES / LANES {
        for l in 0..LANES {
            dots[l] += ax[k][l] * bx[k][l] + ay[k][l] * by[k][l];
            crosses[l] += ax[k][l] * by[k][l] - ay[k][l] * bx[k][l];
        }
    }
    (f64::from(dots.iter().sum::<f32>()), f64::from(crosses.iter().sum::<f32>()))
}

/// Pose of the first segment's piece in the image of the second's in which their samples lie on one another best.
pub(crate) fn laid_on(a: &Segment, b: &Segment) -> Isometry2<f64> {
    first_pose(a, b).between_images(a, b)
}

/// Points worked on side by side, so that the arithmetic fills the vector registers of AVX2.
const LANES: usize = 8;

/// Some points of a tab with their feet on a mouth's border, in the mouth's frame but for `x` and `y`.
#[derive(Debug, Clone, Copy, Default)]
struct Group {
    /// The points in the tab's frame.
    x: [f32; LANES],
    y: [f32; LANES],
    /// Places of their feet on the mouth's run, in steps, and the nodes before them, with their places.
    at: [f32; LANES],
    place: [f32; LANES],
    before: Nodes,
    /// The points in the mouth's frame.
    px: [f32; LANES],
    py: [f32; LANES],
    /// Signed distance to the border, positive outside.
    distance: [f32; LANES],
    /// Outward normal at the foot.
    nx: [f32; LANES],
    ny: [f32; LANES],
    /// 1, or 0 where there is no point.
    present: [f32; LANES],
    /// 1, or 0 where there is no point or where it has no foot because it lies beyond an end of the run.
    mask: [f32; LANES],
}

impl Group {
    /// Finds the nodes before the feet, and gives those behind them.
    #[inline(always)]
    fn look_up(&mut self, run: &[Node]) -> Nodes {
        let most = (run.len() - 2) as f32;
        for l in 0..LANES {
            self.place[l] = self.at[l].floor().min(most);
        }
        let [before, behind] = Nodes::about(run, &self.place);
        self.before = before;
        behind
    }

    /// Moves the points and finds their feet near where they were: along the tangent, once. Rounds of refinement that
    /// follow one another take a foot to where it belongs (Newton's method, without a branch for each point).
    #[inline(always)]
    fn find(&mut self, run: &[Node], step: f32, (cos, sin, x, y): (f32, f32, f32, f32)) {
        // Numbers of 32 bits are rounded side by side.
        let last = (run.len() - 1) as f32;
        let half_spacing = 0.5 / step;
        let mut moved = [0.0; LANES];
        for l in 0..LANES {
            self.px[l] = cos * self.x[l] - sin * self.y[l] + x;
            self.py[l] = sin * self.x[l] + cos * self.y[l] + y;
            // Outward normals stand to the right of the running direction in an image, whose y points down.
            let a = &self.before;
            let along = (self.py[l] - a.y[l]) * a.nx[l] - (self.px[l] - a.x[l]) * a.ny[l];
            moved[l] = self.place[l] + (along * step).clamp(-STRIDE, STRIDE);
            self.at[l] = moved[l].clamp(0.0, last);
        }
        let b = self.look_up(run);
        let a = &self.before;
        for l in 0..LANES {
            let part = self.at[l] - self.place[l];
            let lerp = |p: f32, q: f32| p + (q - p) * part;
            self.nx[l] = lerp(a.nx[l], b.nx[l]);
            self.ny[l] = lerp(a.ny[l], b.ny[l]);
            // Between two nodes lies an arc, which rises over the chord where the normals diverge.
            let bulge = half_spacing * part * (1.0 - part) * (a.nx[l] * b.ny[l] - a.ny[l] * b.nx[l]);
            let (dx, dy) = (self.px[l] - lerp(a.x[l], b.x[l]), self.py[l] - lerp(a.y[l], b.y[l]));
            self.distance[l] = dx * self.nx[l] + dy * self.ny[l] - bulge;
            self.mask[l] = if moved[l] == self.at[l] { self.present[l] } else { 0.0 };
        }
    }
}

/// Some nodes of a run side by side.
#[derive(Debug, Clone, Copy, Default)]
struct Nodes {
    x: [f32; LANES],
    y: [f32; LANES],
    nx: [f32; LANES],
    ny: [f32; LANES],
}

impl Nodes {
    /// The nodes at some places, which are whole numbers, and those that follow them.
    #[inline(always)]
    fn about(run: &[Node], places: &[f32; LANES]) -> [Self; 2] {
        /// Added to a whole number that is less, it leaves that in the lowest bits of the sum: unlike a cast, which has to mind
        /// what is no such number, in one instruction for all lanes.
        const SHIFT: f32 = 8_388_608.0;
        let mut nodes = [Self::default(); 2];
        for l in 0..LANES {
            let place = ((places[l] + SHIFT).to_bits() - SHIFT.to_bits()) as usize;
            for (nodes, node) in nodes.iter_mut().zip(&run[place..place + 2]) {
                (nodes.x[l], nodes.y[l], nodes.nx[l], nodes.ny[l]) = (node.x, node.y, node.nx, node.ny);
            }
        }
        nodes
    }
}

/// Points of a tab with their feet on a mouth's border; kept between candidates, so that nothing is allocated for each
/// of them.
#[derive(Debug, Default)]
pub(crate) struct Feet {
    groups: Vec<Group>,
    /// Which points lie on the match segment proper.
    core: std::ops::Range<usize>,
    /// Bits of residuals.
    off: Vec<[i32; LANES]>,
}

impl Feet {
    /// Takes points and the places at which to look first for their feet.
    fn start(&mut self, points: impl Iterator<Item = (f32, f32, f64)>, mouth: &Segment) {
        let last = mouth.run.len().saturating_sub(1) as f64;
        self.groups.clear();
        for (k, (x, y, place)) in points.enumerate() {
            if k % LANES == 0 {
                self.groups.push(Group::default());
            }
            if let Some(group) = self.groups.last_mut() {
                let l = k % LANES;
                (group.x[l], group.y[l], group.at[l]) = (x, y, place.clamp(0.0, last) as f32);
                group.present[l] = 1.0;
            }
        }
        widely!(self.groups.iter_mut().for_each(|group| {
            group.look_up(&mouth.run);
        }));
    }

    /// Starts with the samples of the match segment: they lie at equal parts of both.
    fn start_with_samples(&mut self, tab: &Segment, mouth: &Segment) {
        let core = (mouth.core.len() - 1) as f64 / (ROUGH_SAMPLES - 1) as f64;
        let place = |k: usize| mouth.core.end as f64 - 1.0 - k as f64 * core;
        let [x, y] = tab.middle;
        let [xs, ys] = &tab.samples;
        let samples = xs.iter().zip(ys).enumerate();
        self.start(samples.map(|(k, (px, py))| (px + x, py + y, place(k))), mouth);
        self.core = 0..ROUGH_SAMPLES;
    }

    /// Starts with every `stride`-th node of the tab. The borders run opposite ways: equal parts of the two cores lie on
    /// one another.
    fn start_with_nodes(&mut self, tab: &Segment, mouth: &Segment, stride: usize) {
        let ratio = tab.step / mouth.step * mouth.path / tab.path;
        let place = |k: usize| mouth.core.end as f64 - 1.0 - (k as f64 - tab.core.start as f64) * ratio;
        let nodes = tab.run.iter().enumerate().step_by(stride);
        self.start(nodes.map(|(k, n)| (n.x, n.y, place(k))), mouth);
        self.core = tab.core.start.div_ceil(stride)..tab.core.end.div_ceil(stride);
    }

    fn find(&mut self, mouth: &Segment, pose: &Pose) {
        let pose = (pose.cos as f32, pose.sin as f32, pose.x as f32, pose.y as f32);
        let step = (1.0 / mouth.step) as f32;
        widely!(self.groups.iter_mut().for_each(|group| group.find(&mouth.run, step, pose)));
    }

    /// Brings feet that were only guessed to where they belong.
    fn settle(&mut self, mouth: &Segment, pose: &Pose) {
        for _ in 0..SETTLING {
            self.find(mouth, pose);
        }
    }

    fn points(&self) -> std::ops::Range<usize> {
        0..self.groups.len() * LANES
    }

    /// How many points have a foot.
    fn rows(&self) -> usize {
        self.groups.iter().map(|q| q.mask.iter().sum::<f32>() as usize).sum()
    }

    /// Over some of the points: the mean capped residual, and the sums of what overlaps and of what gapes.
    #[inline(always)]
    fn gaps(&self, points: &std::ops::Range<usize>, clearance: f64, cap: f64) -> [f64; 3] {
        let (clearance, cap) = (clearance as f32, cap as f32);
        let mut sums = [[0f32; LANES]; 4];
        let groups = self.groups.iter().enumerate().take(points.end.div_ceil(LANES)).skip(points.start / LANES);
        for (k, group) in groups {
            for l in 0..LANES {
                let here = if points.contains(&(k * LANES + l)) { group.mask[l] } else { 0.0 };
                let distance = group.distance[l];
                sums[0][l] += here * (distance - clearance).abs().min(cap);
                sums[1][l] += here * (-distance).max(0.0);
                sums[2][l] += here * distance.max(0.0);
                sums[3][l] += here;
            }
        }
        let [residual, overlap, gap, count] = sums.map(|lanes| f64::from(lanes.iter().sum::<f32>()));
        [residual / count.max(1.0), overlap, gap]
    }

    /// Width of the robust weights: thrice the median residual, but not less than suits the limit of the clearance. The median is
    /// found bit by bit: the greatest number than which no more than half of them are less. Numbers that aren't negative are ordered
    /// as their bits are.
    #[inline(always)]
    fn weight_width(&mut self, clearance: f64, limit: f64) -> f64 {
        /// Bits of the median that are left at nothing: it is known to 3 %.
        const ROUGH: u32 = 18;
        let least = LEAST_WIDTH / MAX_CLEARANCE * limit;
        let clearance = clearance as f32;
        self.off.clear();
        let mut present = [0f32; LANES];
        for group in &self.groups {
            let mut off = [i32::MAX; LANES];
            for l in 0..LANES {
                present[l] += group.mask[l];
                if group.mask[l] > 0.0 {
                    off[l] = (group.distance[l] - clearance).abs().to_bits() as i32;
                }
            }
            self.off.push(off);
        }
        let middle = (present.iter().sum::<f32>() as usize / 2) as i32;
        let reaches = |bound: i32| {
            let mut less = [0; LANES];
            for off in &self.off {
                for l in 0..LANES {
                    less[l] += i32::from(off[l] < bound);
                }
            }
            less.iter().sum::<i32>() <= middle
        };
        // Most of what fits needs no more than this look.
        if !reaches(((least / 3.0) as f32).to_bits() as i32) {
            return least;
        }
        let median = (ROUGH..31).rev().fold(0, |m, bit| if reaches(m | 1 << bit) { m | 1 << bit } else { m });
        least.max(3.0 * f64::from(f32::from_bits(median as u32)))
    }

    /// What the contact tells about the pose: the normal matrix without the clearance (Schur complement).
    fn information(&mut self, clearance: f64, limit: f64, free: bool) -> Matrix3<f64> {
        let width = widely!(self.weight_width(clearance, limit));
        let (h, ..) = widely!(self.normal_equations(clearance, width));
        let block = h.fixed_view::<3, 3>(0, 0).into_owned();
        let column: Vector3<f64> = h.fixed_view::<3, 1>(0, 3).into_owned();
        if free && h[(3, 3)] > f64::EPSILON { block - column * column.transpose() / h[(3, 3)] } else { block }
    }

    /// Weighted normal equations over (x, y, turn, clearance) about the local origin: matrix, right side, sum of
    /// weights.
    #[inline(always)]
    fn normal_equations(&self, clearance: f64, width: f64) -> (Matrix4<f64>, Vector4<f64>, f64) {
        /// Different products that are summed: ten of the symmetric matrix, the last of which is the sum of weights,
        /// and four of the right side.
        const SUMS: usize = 14;
        let (clearance, inverse) = (clearance as f32, 1.0 / width.max(f64::EPSILON) as f32);
        let mut sums = [[0f32; LANES]; SUMS];
        for q in &self.groups {
            for l in 0..LANES {
                let (nx, ny) = (q.nx[l], q.ny[l]);
                let r = q.distance[l] - clearance;
                let z = r * inverse;
                let w = 1.0 / (1.0 + z * z);
                let w = w * w * q.mask[l];
                let turn = q.px[l] * ny - q.py[l] * nx;
                let (wx, wy, wt, wr) = (w * nx, w * ny, w * turn, w * r);
                sums[0][l] += wx * nx;
                sums[1][l] += wx * ny;
                sums[2][l] += wx * turn;
                sums[3][l] += wx;
                sums[4][l] += wy * ny;
                sums[5][l] += wy * turn;
                sums[6][l] += wy;
                sums[7][l] += wt * turn;
                sums[8][l] += wt;
                sums[9][l] += w;
                sums[10][l] += wr * nx;
                sums[11][l] += wr * ny;
                sums[12][l] += wr * turn;
                sums[13][l] += wr;
            }
        }
        let s = sums.map(|lanes| f64::from(lanes.iter().sum::<f32>()));
        let h = Matrix4::new(
            s[0], s[1], s[2], -s[3], //
            s[1], s[4], s[5], -s[6], //
            s[2], s[5], s[7], -s[8], //
            -s[3], -s[6], -s[8], s[9],
        );
        (h, Vector4::new(s[10], s[11], s[12], -s[13]), s[9])
    }
}

/// One step of weighted least squares.
fn step(feet: &mut Feet, pose: &mut Pose, clearance: &mut f64, free: bool, limit: f64) {
    let width = widely!(feet.weight_width(*clearance, limit));
    let (mut h, mut g, total) = widely!(feet.normal_equations(*clearance, width));
    if total < 4.0 {
        return;
    }
    // A prior of a few samples' weight keeps the clearance from sliding where the normals don't tell it from a shift.
    if free {
        h[(3, 3)] += CLEARANCE_DAMPING * total;
        g[3] += CLEARANCE_DAMPING * total * *clearance;
    } else {
        h[(3, 3)] += 1e9 * total;
    }
    for k in 0..2 {
        h[(k, k)] += 1e-9 * total;
    }
    h[(2, 2)] += 1e-9 * total * limit * limit;
    if let Some(solution) = h.cholesky().map(|c| c.solve(&-g)) {
        let turn = solution[2].clamp(-MAX_TURN, MAX_TURN);
        *pose = pose.turned(turn, Vector2::new(solution[0], solution[1]));
        if free {
            *clearance = (*clearance + solution[3]).clamp(-limit, limit);
        }
    }
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
pub(crate) fn rough(tab: &Segment, mouth: &Segment, scale: f64, free: bool, feet: &mut Feet) -> Option<Rough> {
    if tab.core.len() < 4 || mouth.core.len() < 4 {
        return None;
    }
    let mut pose = first_pose(tab, mouth);
    let mut clearance = 0.0;
    let limit = MAX_CLEARANCE * scale;
    feet.start_with_samples(tab, mouth);
    for round in 0..ROUGH_ROUNDS {
        feet.find(mouth, &pose);
        step(feet, &mut pose, &mut clearance, free && round > 0, limit);
    }
    feet.find(mouth, &pose);
    if feet.rows() < ROUGH_SAMPLES / 2 {
        return None;
    }
    let [residual, ..] = widely!(feet.gaps(&feet.points(), clearance, RESIDUAL_CAP * scale));
    Some(Rough { pose, clearance, residual })
}

/// Refines a rough pose on a part of the nodes of the extended match segment: enough to tell which candidates are worth
/// all of them.
pub(crate) fn coarse(
    tab: &Segment,
    mouth: &Segment,
    from: &Rough,
    scale: f64,
    free: bool,
    feet: &mut Feet,
) -> Option<Fit> {
    fit(tab, mouth, (from.pose, from.clearance), scale, free, (COARSE_ROUNDS, COARSE_STRIDE), feet)
}

/// Refines a pose (of the tab's piece in the image of the mouth's) and its clearance on all nodes of the extended match
/// segment.
pub(crate) fn refine(
    tab: &Segment,
    mouth: &Segment,
    (negative_from_positive, clearance): (&Isometry2<f64>, f64),
    scale: f64,
    free: bool,
    feet: &mut Feet,
) -> Option<Fit> {
    let pose = Pose::between(tab, mouth, negative_from_positive);
    fit(tab, mouth, (pose, clearance), scale, free, (REFINEMENTS, 1), feet)
}

fn fit(
    tab: &Segment,
    mouth: &Segment,
    (mut pose, mut clearance): (Pose, f64),
    scale: f64,
    free: bool,
    (rounds, stride): (usize, usize),
    feet: &mut Feet,
) -> Option<Fit> {
    if mouth.run.len() < 2 {
        return None;
    }
    let limit = MAX_CLEARANCE * scale;
    feet.start_with_nodes(tab, mouth, stride);
    feet.settle(mouth, &pose);
    for _ in 0..rounds {
        feet.find(mouth, &pose);
        step(feet, &mut pose, &mut clearance, free, limit);
    }
    feet.find(mouth, &pose);
    if feet.rows() * stride < tab.core.len() / 2 {
        return None;
    }
    let cap = RESIDUAL_CAP * scale;
    let [residual, ..] = widely!(feet.gaps(&feet.points(), clearance, cap));
    let information = feet.information(clearance, limit, free) * stride as f64;
    let [ave_gap, overlap, gap] = widely!(feet.gaps(&feet.core, clearance, cap));
    let [pos_gap, neg_gap] = [overlap, gap].map(|sum| sum * tab.step * stride as f64);
    let negative_from_positive = pose.between_images(tab, mouth);
    Some(Fit { negative_from_positive, clearance, residual, ave_gap, pos_gap, neg_gap, information })
}

/// Best rigid pose that takes points `a` to points `b`, pair by pair as far as both go (Umeyama 1991 without scale).
pub fn rigid_fit(a: &[Point2<f64>], b: &[Point2<f64>]) -> Isometry2<f64> {
    let pairs = || a.iter().zip(b);
    let n = pairs().count().max(1) as f64;
    let ma = pairs().fold(Vector2::zeros(), |s, (p, _)| s + p.coords) / n;
    let mb = pairs().fold(Vector2::zeros(), |s, (_, q)| s + q.coords) / n;
    let (mut dot, mut cross) = (0.0, 0.0);
    for (p, q) in pairs() {
        let (p, q) = (p.coords - ma, q.coords - mb);
        dot += p.dot(&q);
        cross += p.x * q.y - p.y * q.x;
    }
    let rotation = nalgebra::UnitComplex::new(cross.atan2(dot));
    Isometry2::from_parts((mb - rotation * ma).into(), rotation)
}
