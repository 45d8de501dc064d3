//! Quadratic surfaces through levels: light as it falls off.
//!
//! Least squares on the polynomials of the second degree, from sums that samples can be added to and taken away from, so that a robust fit costs
//! one pass and what its outliers cost.

use super::statistics::{NORMAL_MAD, median};
use crate::wide::widely;
use nalgebra::{Matrix6, Vector6};

/// Residuals that tell how far samples scatter: a median of a thousand is known to a thirtieth.
const SPREAD_SAMPLES: usize = 1_000;

/// Rounds of leaving out what lies far from a fit, at most.
const ROUNDS: usize = 6;
/// One in so many samples that come or go change a fit by little.
const FEW: usize = 50;

/// A quadratic surface over a frame or a part of it, in block coordinates scaled to -1..1.
#[derive(Debug, Clone, Copy)]
pub(super) struct Surface {
    coefficients: Vector6<f64>,
    scale: [f64; 2],
}

impl Surface {
    /// Least squares fit to the levels of blocks (column, row, level) of a picture of so many columns and rows, repeated without what lies
    /// far from the fit before (specks, shadows, print): beyond three deviations.
    pub(super) fn fit(size: [usize; 2], levels: impl Iterator<Item = ([f64; 2], f32)>) -> Self {
        let scale = size.map(|n| 2.0 / (n.max(2) - 1) as f64);
        let samples: Vec<([f64; 2], f64)> =
            levels.map(|(place, level)| (scaled(scale, place), f64::from(level))).collect();
        let mut sums = NormalEquations::default();
        widely!(sums.add_all(&samples));
        let mut surface = Self { coefficients: sums.solve(), scale };
        let (mut residuals, mut is_kept) = (vec![0.0; samples.len()], vec![true; samples.len()]);
        for _ in 0..ROUNDS {
            widely!(surface.fill_residuals(&samples, &mut residuals));
            let few = residuals.iter().step_by((residuals.len() / SPREAD_SAMPLES).max(1));
            let limit = (3.0 / NORMAL_MAD * median(&few.copied().collect::<Vec<_>>())).max(1.0);
            let mut changed = 0;
            for (((place, level), residual), is_kept) in samples.iter().zip(&residuals).zip(&mut is_kept) {
                let keep = *residual <= limit;
                if keep != *is_kept {
                    sums.add(*place, *level, if keep { 1.0 } else { -1.0 });
                    *is_kept = keep;
                    changed += 1;
                }
            }
            surface.coefficients = sums.solve();
            if changed * FEW <= samples.len() {
                break;
            }
        }
        surface
    }

    /// Level at a block.
    pub(super) fn at(&self, column: f64, row: f64) -> f32 {
        self.at_scaled(scaled(self.scale, [column, row])) as f32
    }

    /// Level at a place in the surface's own coordinates.
    #[inline(always)]
    fn at_scaled(&self, [u, v]: [f64; 2]) -> f64 {
        let c = &self.coefficients;
        c[0] + v * (c[2] + v * c[5]) + u * (c[1] + v * c[4] + u * c[3])
    }

    /// By how much samples lie off the surface.
    #[inline(always)]
    fn fill_residuals(&self, samples: &[([f64; 2], f64)], residuals: &mut [f32]) {
        for (residual, (place, level)) in residuals.iter_mut().zip(samples) {
            *residual = (level - self.at_scaled(*place)).abs() as f32;
        }
    }

    /// The levels along a row, from a column in steps.
    pub(super) fn along(&self, row: f64, column: f64, step: f64) -> AlongRow {
        let c = self.coefficients;
        let [u, v] = scaled(self.scale, [column, row]);
        let step = step * self.scale[0];
        let slope = c[1] + v * c[4];
        let level = c[0] + v * (c[2] + v * c[5]) + u * (slope + u * c[3]);
        AlongRow([level, (slope + 2.0 * u * c[3]) * step, c[3] * step * step].map(|k| k as f32))
    }
}

/// Levels along a row: a quadratic polynomial of the number of the step.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct AlongRow([f32; 3]);

impl AlongRow {
    /// Level after so many steps.
    #[inline(always)]
    pub(super) fn at(&self, steps: usize) -> f32 {
        // A row is no longer than a number of four bytes, which the processor turns into a float several at a time.
        let i = steps as i32 as f32;
        self.0[0] + i * (self.0[1] + i * self.0[2])
    }
}

/// A place in the coordinates of a surface.
#[inline(always)]
fn scaled(scale: [f64; 2], [column, row]: [f64; 2]) -> [f64; 2] {
    [column * scale[0] - 1.0, row * scale[1] - 1.0]
}

/// Sums over samples that a least squares fit of a quadratic surface needs.
#[derive(Debug, Default)]
struct NormalEquations {
    count: f64,
    /// Sums of `u^a v^b` up to the fourth degree, degree by degree, rising in `b`.
    moments: [f64; 15],
    /// Sums of the level times those up to the second degree.
    right: [f64; 6],
}

impl NormalEquations {
    /// Adds samples.
    #[inline(always)]
    fn add_all(&mut self, samples: &[([f64; 2], f64)]) {
        for (place, level) in samples {
            self.add(*place, *level, 1.0);
        }
    }

    /// Adds a sample (of weight 1), or takes it away again (-1).
    #[inline(always)]
    fn add(&mut self, [u, v]: [f64; 2], level: f64, weight: f64) {
        let (uu, uv, vv) = (u * u, u * v, v * v);
        let powers =
            [1.0, u, v, uu, uv, vv, uu * u, uu * v, u * vv, v * vv, uu * uu, uu * uv, uu * vv, uv * vv, vv * vv];
        self.count += weight;
        for (sum, power) in self.moments.iter_mut().zip(powers) {
            *sum += weight * power;
        }
        for (sum, power) in self.right.iter_mut().zip(powers) {
            *sum += weight * level * power;
        }
    }

    /// Coefficients of 1, u, v, u^2, uv, v^2.
    fn solve(&self) -> Vector6<f64> {
        const EXPONENTS: [[usize; 2]; 6] = [[0, 0], [1, 0], [0, 1], [2, 0], [1, 1], [0, 2]];
        let normal = Matrix6::from_fn(|i, j| {
            let [a, b] = [0, 1].map(|k| EXPONENTS[i][k] + EXPONENTS[j][k]);
            let degree = a + b;
            self.moments[degree * (degree + 1) / 2 + b]
        });
        // A tiny ridge: the ground of a tight crop may not determine all coefficients.
        let normal = normal + Matrix6::identity() * (1e-6 * self.count.max(1.0));
        normal.cholesky().map_or_else(Vector6::zeros, |factor| factor.solve(&Vector6::from(self.right)))
    }
}
