//! What two outlines in a given pose say about each other: by how much they overlap, and how one should move along the
//! other. Both are remembered, for the same pairs lie side by side in the next solution; and so is Eq. 1 of those mated.
//!
//! *Contact*: the border of one piece is followed along that of the other (feet looked up on its distance raster);
//! point-to-line normal equations with robust weights, as in [`crate::placement`], over motion and clearance.
//! *Overlap*: depth times length of what intrudes.
//!
//! Both are evaluated where the pose, rounded to a grid, lies; a contact's right side is carried from there to the pose
//! itself by its own normal matrix, which at such distances is exact to the second order. So the figures depend on the
//! two pieces and the pose alone, whether they are computed or remembered, and a small change of the poses (another
//! piece far away) costs next to nothing. What the last solution did not ask for is forgotten.
//!
//! Complexity O(border) to compute, O(1) to remember; a remembered figure takes some 300 bytes, and a solution asks for
//! about ten of each pair of neighbours.

use crate::outline::{LEAST_WIDTH, Outline};
use isthmus::Point;
use nalgebra::{Isometry2, Matrix3, Matrix4, UnitComplex, Vector2, Vector3, Vector4};
use rustc_hash::FxHashMap;
use std::sync::{Mutex, PoisonError};

/// Meshes of the grid of poses along the sampling step of a contact: half a mesh off, the linearised distances err by
/// less than a thousandth of the step.
const MESHES: f64 = 10.0;
/// Mesh of the grid of poses for overlaps, in piece scales: along a side one scale long half a mesh makes a twentieth of the
/// overlap that is tolerated.
const OVERLAP_MESH: f64 = 0.002;
/// Parts of the memory that are locked apart, so that threads seldom wait for one another.
const SHARDS: usize = 16;

/// Two pieces, how finely they are looked at, and the pose on the grid.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
struct Key {
    pieces: [u64; 2],
    stride: usize,
    pose: [i64; 3],
}

/// A pose rounded to a grid.
struct Rounded {
    place: [i64; 3],
    pose: Isometry2<f64>,
}

impl Rounded {
    /// `mesh` in piece scales, which as an angle moves what is a scale away by as much.
    fn new(a: &Outline, b_from_a: &Isometry2<f64>, mesh: f64) -> Self {
        let centre = b_from_a * a.centroid;
        let length = mesh * a.scale;
        let place = [centre.x / length, centre.y / length, b_from_a.rotation.angle() / mesh].map(|v| v.round() as i64);
        let [x, y, angle] = place.map(|v| v as f64);
        let rotation = UnitComplex::new(angle * mesh);
        let translation = Vector2::new(x, y) * length - rotation * a.centroid.coords;
        Self { place, pose: Isometry2::from_parts(translation.into(), rotation) }
    }

    /// Small motion at a point (of `b`'s image) from the rounded pose to the pose itself.
    fn motion_to(&self, b_from_a: &Isometry2<f64>, at: &Point) -> Vector3<f64> {
        let motion = b_from_a * self.pose.inverse();
        let shift = motion * at - at;
        Vector3::new(shift.x, shift.y, motion.rotation.angle())
    }
}

#[derive(Debug, Default)]
struct Shard {
    /// Figures with the number of the solution that asked last.
    contacts: FxHashMap<Key, (u32, Option<Equations>)>,
    overlaps: FxHashMap<Key, (u32, f64)>,
    correlations: FxHashMap<[(u64, usize); 2], (u32, f64)>,
}

/// Contacts and overlaps that have been computed.
#[derive(Debug, Default)]
pub(crate) struct Memory {
    shards: [Mutex<Shard>; SHARDS],
    solution: u32,
}

/// A copy remembers nothing, so that the serial numbers of its pieces are its own.
impl Clone for Memory {
    fn clone(&self) -> Self {
        Self::default()
    }
}

impl Memory {
    fn shard(&self, pieces: [u64; 2]) -> std::sync::MutexGuard<'_, Shard> {
        let sum = pieces[0].wrapping_mul(31).wrapping_add(pieces[1]) as usize;
        // What a panicking thread left behind are whole entries.
        self.shards[sum % SHARDS].lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Forgets what the last solution didn't ask for.
    pub(crate) fn next_solution(&mut self) {
        let last = self.solution;
        for shard in &mut self.shards {
            let shard = shard.get_mut().unwrap_or_else(PoisonError::into_inner);
            shard.contacts.retain(|_, v| v.0 == last);
            shard.overlaps.retain(|_, v| v.0 == last);
            shard.correlations.retain(|_, v| v.0 == last);
        }
        self.solution = last.wrapping_add(1);
    }

    /// Area in which two pieces overlap, in square pixels: exact for shallow overlaps, large for deep ones.
    pub(crate) fn overlap(&self, a: &Outline, b: &Outline, b_from_a: &Isometry2<f64>) -> f64 {
        let centre = b_from_a * a.centroid;
        if (centre - b.centroid).norm() > a.radius + b.radius {
            return 0.0;
        }
        let rounded = Rounded::new(a, b_from_a, OVERLAP_MESH);
        let key = Key { pieces: [a.serial, b.serial], stride: 0, pose: rounded.place };
        if let Some(known) = self.shard(key.pieces).overlaps.get_mut(&key) {
            known.0 = self.solution;
            return known.1;
        }
        let area = overlap_area(a, b, &rounded.pose);
        self.shard(key.pieces).overlaps.insert(key, (self.solution, area));
        area
    }

    /// Eq. 1 of a tab and a mouth, each by the serial number of its piece and its place there.
    pub(crate) fn correlation(&self, tab: (u64, usize), mouth: (u64, usize), compute: impl FnOnce() -> f64) -> f64 {
        let pieces = [tab.0, mouth.0];
        if let Some(known) = self.shard(pieces).correlations.get_mut(&[tab, mouth]) {
            known.0 = self.solution;
            return known.1;
        }
        let value = compute();
        self.shard(pieces).correlations.insert([tab, mouth], (self.solution, value));
        value
    }

    /// What two pieces within `band` piece scales of each other say about their pose, from a point each `step` scales.
    pub(crate) fn contact(
        &self,
        a: &Outline,
        b: &Outline,
        b_from_a: &Isometry2<f64>,
        (band, step): (f64, f64),
        prior: &ClearancePrior,
    ) -> Option<Contact> {
        let stride = ((a.scale * step / a.spacing) as usize).max(1);
        let rounded = Rounded::new(a, b_from_a, step / MESHES);
        let key = Key { pieces: [a.serial, b.serial], stride, pose: rounded.place };
        let known = self.shard(key.pieces).contacts.get_mut(&key).map(|known| {
            known.0 = self.solution;
            known.1
        });
        let equations = known.unwrap_or_else(|| {
            let computed = follow(a, b, &rounded.pose, 0.5 * band * (a.scale + b.scale), stride);
            self.shard(key.pieces).contacts.insert(key, (self.solution, computed));
            computed
        })?;
        Some(equations.contact(&rounded.motion_to(b_from_a, &equations.centre), prior))
    }
}

/// Points of the thinned border along a piece scale, for overlap checks.
const SPARSE_STEP: f64 = 16.0;

/// How deep and over what length the border of `a` runs inside `b`: the sum of depth times length, in square pixels.
/// For a shallow overlap this is its area.
fn intrusion(a: &Outline, b: &Outline, b_from_a: &Isometry2<f64>) -> f64 {
    let stride = ((a.scale / SPARSE_STEP / a.spacing) as usize).max(1);
    let reach = b.radius * b.radius;
    let mut sum = 0.0;
    for p in a.points.iter().step_by(stride) {
        let p = b_from_a * p;
        if (p - b.centroid).norm_squared() > reach {
            continue;
        }
        let Some(k) = b.raster.cell_of(p) else { continue };
        if f64::from(b.raster.distance[k]) > b.raster.cell {
            continue;
        }
        let i = b.raster.nearest[k] as usize;
        let d = p - b.points[i];
        let depth = -(d.x * f64::from(b.normals[i].x) + d.y * f64::from(b.normals[i].y));
        if depth > 0.0 {
            sum += depth.min(-f64::from(b.raster.distance[k]) + b.raster.cell);
        }
    }
    sum * stride as f64 * a.spacing
}

/// Whether the innermost point of `a` lies deep inside `b`.
fn swallows(b: &Outline, a: &Outline, b_from_a: &Isometry2<f64>) -> bool {
    /// Depth in piece scales: abutting pieces keep their innermost points this far and farther outside.
    const DEEP: f64 = 0.1;
    let pole = b_from_a * a.raster.pole;
    b.raster.cell_of(pole).is_some_and(|cell| f64::from(b.raster.distance[cell]) < -DEEP * b.scale)
}

/// Area in which two pieces overlap, in square pixels: exact for shallow overlaps, large for deep ones.
fn overlap_area(a: &Outline, b: &Outline, b_from_a: &Isometry2<f64>) -> f64 {
    let centre = b_from_a * a.centroid;
    if (centre - b.centroid).norm() > a.radius + b.radius {
        return 0.0;
    }
    // Copies that lie on one another intrude nowhere: their borders coincide.
    if swallows(b, a, b_from_a) {
        return a.area.min(b.area);
    }
    intrusion(a, b, b_from_a).max(intrusion(b, a, &b_from_a.inverse()))
}

/// Contacts of fewer rows than this part of a scale are corners that meet, which say nothing about a pose.
const LEAST_CONTACT: f64 = 0.12;

/// What two outlines in a given pose say about each other.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Contact {
    /// Middle of the contact, in `b`'s image.
    pub(crate) centre: Point,
    /// Normal matrix and right side over the motion (x, y, turn) of `a` at `centre`, in `b`'s image, clearance
    /// eliminated.
    pub(crate) hessian: Matrix3<f64>,
    pub(crate) gradient: Vector3<f64>,
    /// How far apart the two borders run in this pose, in pixels, and the variance of that by how much it varies along
    /// the joint.
    pub(crate) clearance: f64,
    pub(crate) variance: f64,
}

/// Prior of a joint's clearance: mean and standard deviation, and the deviation of a border point, in pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct ClearancePrior {
    pub(crate) mean: f64,
    pub(crate) deviation: f64,
    pub(crate) noise: f64,
}

/// Normal equations of a contact before the clearance is eliminated: over the motion (x, y, turn) of `a` at `centre`,
/// and the clearance less `clearance`.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Equations {
    centre: Point,
    clearance: f64,
    variance: f64,
    spread: f64,
    h: Matrix4<f64>,
    g: Vector4<f64>,
}

impl Equations {
    /// The contact after a small motion of `a` at the centre.
    fn contact(&self, motion: &Vector3<f64>, prior: &ClearancePrior) -> Contact {
        let (mut h, mut g) = (self.h, self.g + self.h.fixed_columns::<3>(0) * motion);
        let clearance = self.clearance - g[3] / h[(3, 3)].max(f64::EPSILON);
        let pull = (prior.noise.max(self.spread) / prior.deviation.max(1e-3)).powi(2);
        h[(3, 3)] += pull;
        g[3] += pull * (self.clearance - prior.mean);
        let column: Vector3<f64> = h.fixed_view::<3, 1>(0, 3).into_owned();
        Contact {
            centre: self.centre,
            hessian: h.fixed_view::<3, 3>(0, 0).into_owned() - column * column.transpose() / h[(3, 3)],
            gradient: g.fixed_rows::<3>(0).into_owned() - column * (g[3] / h[(3, 3)]),
            clearance,
            variance: self.variance,
        }
    }
}

/// Follows the border of `a` along that of `b`, within `band` pixels of it, every `stride`-th point.
fn follow(a: &Outline, b: &Outline, b_from_a: &Isometry2<f64>, band: f64, stride: usize) -> Option<Equations> {
    /// Normals of borders in contact are opposite to within 45°.
    const OPPOSED: f64 = -0.7;
    let reach = (b.radius + band).powi(2);
    let rotation = b_from_a.rotation;
    let mut rows: Vec<(f64, Vector2<f64>, Point)> = Vec::new();
    for (k, p) in a.points.iter().enumerate().step_by(stride) {
        let p = b_from_a * p;
        if (p - b.centroid).norm_squared() > reach {
            continue;
        }
        let Some(foot) = b.foot(p, band) else { continue };
        if foot.normal.dot(&(rotation * a.normals[k].cast::<f64>())) > OPPOSED {
            continue;
        }
        let normal = foot.normal.normalize();
        let distance = foot.offset.dot(&normal);
        if distance.abs() <= band {
            rows.push((distance, normal, p));
        }
    }
    if rows.len() < 4 || rows.len() as f64 * stride as f64 * a.spacing < LEAST_CONTACT * a.scale {
        return None;
    }
    let mut distances: Vec<f64> = rows.iter().map(|r| r.0).collect();
    let middle = distances.len() / 2;
    let clearance = *distances.select_nth_unstable_by(middle, f64::total_cmp).1;
    let mut off: Vec<f64> = rows.iter().map(|r| (r.0 - clearance).abs()).collect();
    let spread = *off.select_nth_unstable_by(middle, f64::total_cmp).1;
    let width = (3.0 * spread).max(LEAST_WIDTH * b.scale);
    let centre = Point::from(rows.iter().fold(Vector2::zeros(), |s, r| s + r.2.coords) / rows.len() as f64);
    let mut h = Matrix4::zeros();
    let mut g = Vector4::zeros();
    for (distance, normal, p) in &rows {
        let r = distance - clearance;
        let w = 1.0 / (1.0 + (r / width).powi(2)).powi(2);
        let p = p - centre;
        let j = Vector4::new(normal.x, normal.y, p.x * normal.y - p.y * normal.x, -1.0);
        h += j * j.transpose() * w;
        g += j * (w * r);
    }
    let variance = variance(rows.iter().map(|r| r.0 - clearance), width);
    Some(Equations { centre, clearance, variance, spread, h, g })
}

/// Variance of the mean of some residuals that are alike where they are near: by the means of blocks (batch means,
/// Conway 1963). Those beyond `width` count as much as that.
fn variance(residuals: impl ExactSizeIterator<Item = f64>, width: f64) -> f64 {
    /// Blocks of a joint: each some ten points wide at the least, beyond which noise of the borders is independent.
    const BLOCKS: usize = 8;
    let size = residuals.len().div_ceil(BLOCKS);
    let capped: Vec<f64> = residuals.map(|r| r.clamp(-width, width)).collect();
    let means: Vec<f64> = capped.chunks(size).map(|c| c.iter().sum::<f64>() / c.len() as f64).collect();
    let n = means.len() as f64;
    let mean = means.iter().sum::<f64>() / n;
    means.iter().map(|m| (m - mean).powi(2)).sum::<f64>() / (n * (n - 1.0).max(1.0))
}
