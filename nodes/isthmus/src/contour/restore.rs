//! Restoration of a border: what blur and noise have done to it, undone as far as the noise allows.
//!
//! A contour of a picture blurred by a Gaussian of standard deviation `b` is the true border after a time `b^2 / 2` of flow by
//! curvature (B. Merriman, J. K. Bence, S. Osher, *Motion of multiple junctions: a level set approach*, J. Comp. Phys. 112, 1994): a curve of
//! radius `r` has moved by `b^2 / (2 r)` towards its centre. To first order that is a Gaussian low-pass `exp(-k^2 b^2 / 2)` on the
//! coordinates along the arc length, and one linear filter undoes it, N. Wiener's: with a signal of power `S(k)`, camera noise `N` that
//! the own blur `a` of the contour's picture has filtered, and errors `M` made after it,
//!
//! `R(k) = S exp(-k^2 b^2 / 2) / (S exp(-k^2 b^2) + N exp(-k^2 a^2) + M)`.
//!
//! Borders are arcs and lines: steps of the curvature give `S(k) = A / k^6`, where the tightest curves say how large `A` is. `R` is flat
//! at low frequencies, so that curves wider than the cut-off keep their size.

use crate::Point;
use crate::wide::widely;
use nalgebra::Vector2;

/// Samples of the filter's response between frequency 0 and the highest, half a turn a point.
const FREQUENCIES: usize = 96;
/// Greatest reach of the filter's kernel, in points.
const MAX_REACH: usize = 64;
/// Part of the kernel's weights that its tail may leave out: cut off earlier, the kernel bends curves.
const TAIL: f64 = 5e-4;
/// Power of the signal in units of the inverse cube of the tightest radius: curvature that comes and goes with that radius, about once
/// in two radii.
const SIGNAL: f64 = 0.5;
/// Standard deviation of a contour's points in a picture without noise, in pixels: interpolation, quantisation and what is left of the
/// pixel grid. 0.001 to 0.008 px on straight edges, more in tight curves.
const CONTOUR_ERROR: f64 = 0.012;

/// Points that are filtered together.
const BLOCK: usize = 16;

/// What happened to a border between the shape and its contour. Lengths in points of the border.
#[derive(Debug, Clone, Copy)]
pub(super) struct History {
    /// Standard deviation of all blur.
    pub(super) blur: f64,
    /// Standard deviation of the part of the blur that came after the noise.
    pub(super) late_blur: f64,
    /// Radius of the tightest curves worth keeping.
    pub(super) radius: f64,
}

/// A symmetric filter along a border.
#[derive(Debug, Clone, Default)]
pub(super) struct Filter {
    /// Weights of a point and of those to either side of it.
    weights: Vec<f64>,
    sums: Vec<f64>,
    unrolled: Vec<f64>,
}

impl Filter {
    /// Designs the filter for noise of a power `noise` (variance of a point, were it white). Gives the variance that it leaves.
    pub(super) fn design(&mut self, history: History, noise: f64) -> f64 {
        let History { blur, late_blur, radius } = history;
        let signal = SIGNAL / radius.powi(3);
        let error = CONTOUR_ERROR * CONTOUR_ERROR;
        let step = std::f64::consts::PI / FREQUENCIES as f64;
        self.sums.clear();
        self.sums.resize(MAX_REACH + 1, 0.0);
        let mut left = 0.0;
        for i in 0..FREQUENCIES {
            let k = (i as f64 + 0.5) * step;
            let square = k * k;
            let disturbance = noise * (-square * late_blur * late_blur).exp() + error;
            let passed = (-square * blur * blur / 2.0).exp();
            let response = passed / (passed * passed + disturbance * square.powi(3) / signal);
            left += disturbance * response * response;
            // cos(j k) by its recurrence.
            let twice = 2.0 * k.cos();
            let (mut before, mut cosine) = (k.cos(), 1.0);
            for sum in &mut self.sums {
                *sum += response * cosine;
                (before, cosine) = (cosine, twice * cosine - before);
            }
        }
        let total: f64 = self.sums.iter().map(|s| s.abs()).sum();
        let mut tail = 0.0;
        let reach = self.sums.iter().rposition(|s| {
            tail += s.abs();
            tail > TAIL * total
        });
        self.weights.clear();
        self.weights.extend_from_slice(&self.sums[..=reach.unwrap_or(0)]);
        left / FREQUENCIES as f64
    }

    /// Filters a closed border.
    pub(super) fn apply(&mut self, points: &[Point], filtered: &mut Vec<Point>) {
        widely!(self.filter(points, filtered));
    }

    #[inline(always)]
    fn filter(&mut self, points: &[Point], filtered: &mut Vec<Point>) {
        let n = points.len();
        let reach = (self.weights.len() - 1).min(n / 2);
        let weights = &self.weights[..=reach];
        let total = 2.0 * weights.iter().sum::<f64>() - weights[0];
        filtered.clear();
        filtered.resize(n, Point::origin());
        for axis in 0..2 {
            let unrolled = &mut self.unrolled;
            unrolled.clear();
            unrolled.extend(points[n - reach..].iter().chain(points).chain(&points[..reach]).map(|p| p[axis]));
            // The last block may be a part of one.
            unrolled.resize(n.next_multiple_of(BLOCK) + 2 * reach, 0.0);
            for (block, out) in filtered.chunks_mut(BLOCK).enumerate() {
                // Weight by weight, some points at a time: their sums stay in registers.
                let needed = &unrolled[block * BLOCK..][..2 * reach + BLOCK];
                let (before, after) = (&needed[..reach + BLOCK - 1], &needed[reach + 1..]);
                let mut sums = [0.0; BLOCK];
                for (sum, value) in sums.iter_mut().zip(&needed[reach..]) {
                    *sum = value * weights[0];
                }
                let pairs = before.windows(BLOCK).rev().zip(after.windows(BLOCK));
                for (weight, (before, after)) in weights[1..].iter().zip(pairs) {
                    for i in 0..BLOCK {
                        sums[i] += (before[i] + after[i]) * weight;
                    }
                }
                for (out, sum) in out.iter_mut().zip(sums) {
                    out[axis] = sum / total;
                }
            }
        }
    }
}

/// Power of the white noise before a blur that makes the fourth differences of contour points, `step` points apart, vary by `variance`.
pub(super) fn noise_power(variance: f64, late_blur: f64, step: usize) -> f64 {
    /// Sum of the squares of 1, -4, 6, -4, 1.
    const WHITE: f64 = 70.0;
    let k = |i: usize| (i as f64 + 0.5) * std::f64::consts::PI / FREQUENCIES as f64;
    let gain = |k: f64| (2.0 - 2.0 * (k * step as f64).cos()).powi(4) * (-k * k * late_blur * late_blur).exp();
    let passed = (0..FREQUENCIES).map(|i| gain(k(i))).sum::<f64>() / FREQUENCIES as f64;
    (variance - WHITE * CONTOUR_ERROR * CONTOUR_ERROR).max(0.0) / passed
}

/// Standard deviation of the blur of a picture's edge along a contour, in pixels, from the mean difference of the grey levels on either
/// side; `level` gives the grey level at a point, larger ones in the shape, and `contrast` is that of shape and ground. `about` is what the blur is
/// expected to be, if it is.
pub(super) fn edge_blur(contour: &[Point], contrast: f64, about: Option<f64>, level: impl Fn(Point) -> f64) -> f64 {
    /// Points of the contour that are looked at, about: the mean gets no better by more.
    const SAMPLES: usize = 256;
    /// Distance of the points that give a contour's direction: longer than the wiggles of noise.
    const CHORD: usize = 5;
    /// How far on either side of the contour the picture is looked at first, and at most, in pixels.
    const REACH: [f64; 2] = [1.0, 6.0];
    /// Variance that interpolation between pixels adds, averaged over all places.
    const INTERPOLATION: f64 = 1.0 / 6.0;
    let n = contour.len();
    let difference = |reach: f64| {
        let (mut sum, mut count) = (0.0, 0.0);
        for i in (0..n).step_by((n / SAMPLES).max(1)) {
            let chord = contour[(i + CHORD) % n] - contour[(i + n - CHORD % n) % n];
            let length = chord.norm();
            if length > 0.0 {
                // The shape lies on the right of its border as seen on a screen, which is (-dy, dx).
                let inwards = Vector2::new(-chord.y, chord.x) * (reach / length);
                sum += level(contour[i] + inwards) - level(contour[i] - inwards);
                count += 1.0;
            }
        }
        if count > 0.0 { sum / count / contrast } else { 1.0 }
    };
    let blur_at = |reach: f64| reach / (std::f64::consts::SQRT_2 * inverse_error_function(difference(reach)));
    let first = about.filter(|blur| *blur > REACH[0]).unwrap_or_else(|| blur_at(REACH[0]));
    let measured = if first > REACH[0] { blur_at(first.min(REACH[1])) } else { first };
    (measured * measured - INTERPOLATION).max(0.0).sqrt()
}

/// Inverse of the error function, to 0.2 % (S. Winitzki, 2008).
fn inverse_error_function(y: f64) -> f64 {
    const A: f64 = 0.147;
    // Nothing steeper than an edge within a pixel, nothing flatter than one of hundred pixels, is told apart.
    let y = y.clamp(0.01, 0.9999);
    let log = (1.0 - y * y).ln();
    let half = 2.0 / (std::f64::consts::PI * A) + log / 2.0;
    ((half * half - log / A).sqrt() - half).sqrt()
}
