//! The metric in which colours are compared.
//!
//! P. C. Mahalanobis, *On the generalised distance in statistics*, 1936: grain of wood and folds of cloth differ in brightness, hardly in hue, so that
//! differences count the less the more the ground itself scatters in their direction.

use super::statistics::{NORMAL_MAD, median};
use nalgebra::{Matrix3, Vector3};

/// Differences in colour, shortened where the ground itself scatters.
#[derive(Debug, Clone)]
pub(super) struct Metric([[f32; 3]; 3]);

impl Metric {
    /// Metric of the ground's differences from its surface; none for scatter that is little or the same in all directions.
    pub(super) fn of(differences: &[Vector3<f32>]) -> Option<Self> {
        let mut sums = Matrix3::zeros();
        for d in differences {
            sums += d * d.transpose();
        }
        let eigen = sums.cast::<f64>().symmetric_eigen();
        let axes = eigen.eigenvectors.cast::<f32>();
        // What is no ground makes far outliers: medians rather than the sums themselves.
        let along =
            |axis: usize| median(&differences.iter().map(|d| axes.column(axis).dot(d).abs()).collect::<Vec<_>>());
        let scatter = [0, 1, 2].map(|axis| (along(axis) / NORMAL_MAD).max(MIN_SCATTER));
        let [least, most] = [f32::min, f32::max].map(|pick| scatter.into_iter().reduce(pick).unwrap_or(MIN_SCATTER));
        if most.is_nan() || most <= EVEN_SCATTER * least {
            return None;
        }
        let weights = Matrix3::from_diagonal(&Vector3::from(scatter.map(|s| least / s)));
        let metric = axes * weights * axes.transpose();
        Some(Self([0, 1, 2].map(|row| [0, 1, 2].map(|column| metric[(row, column)]))))
    }

    /// A difference in this metric.
    pub(super) fn whiten(&self, difference: [f32; 3]) -> [f32; 3] {
        self.0.map(|w| w.iter().zip(difference).map(|(w, d)| w * d).sum())
    }

    /// Length of a difference: the largest of the channels, as everywhere.
    #[inline(always)]
    pub(super) fn length(&self, [r, g, b]: [f32; 3]) -> f32 {
        let channel = |w: &[f32; 3]| (w[0] * r + w[1] * g + w[2] * b).abs();
        self.0.iter().map(channel).fold(0.0, |most, d| if d > most { d } else { most })
    }
}

/// Least scatter of the ground's blocks along an axis of colour, in grey levels: less is not told from rounding and compression.
const MIN_SCATTER: f32 = 2.0;
/// Scatter that differs by less than this factor between directions is taken for even: its measure is that of medians.
const EVEN_SCATTER: f32 = 1.5;
