//! What two outlines in a given pose say about each other: by how much they overlap, and how one should move along the
//! other.
//!
//! *Contact*: the border of one piece is followed along that of the other (feet looked up on its distance raster);
//! point-to-line normal equations with robust weights, as in [`crate::placement`], over motion and clearance.
//! *Overlap*: depth times length of what intrudes.
//!
//! Complexity O(border). The same pairs lie side by side in the next solution: [`crate::memory`].

use crate::outline::{LEAST_WIDTH, Outline};
use isthmus::Point;
use nalgebra::{Isometry2, Matrix3, Matrix4, Vector2, Vector3, Vector4};

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
pub(crate) fn overlap_area(a: &Outline, b: &Outline, b_from_a: &Isometry2<f64>) -> f64 {
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
pub(crate) struct Equations {
    pub(crate) centre: Point,
    clearance: f64,
    variance: f64,
    spread: f64,
    h: Matrix4<f64>,
    g: Vector4<f64>,
}

impl Equations {
    /// The contact after a small motion of `a` at the centre.
    pub(crate) fn contact(&self, motion: &Vector3<f64>, prior: &ClearancePrior) -> Contact {
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
pub(crate) fn follow(
    a: &Outline,
    b: &Outline,
    b_from_a: &Isometry2<f64>,
    band: f64,
    stride: usize,
) -> Option<Equations> {
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
