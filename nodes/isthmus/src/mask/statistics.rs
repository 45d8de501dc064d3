//! Statistics of lists of levels.

use std::ops::Range;

/// Median absolute deviation of a normal distribution of standard deviation 1.
pub(super) const NORMAL_MAD: f32 = 0.674_5;

/// Two classes of values.
pub(super) struct Split {
    pub(super) threshold: f32,
    /// Between-class part of the variance, 0 to 1.
    pub(super) separation: f64,
    /// Mean of the lower class.
    pub(super) mean_below: f32,
    /// Mean of the upper class.
    pub(super) mean_above: f32,
}

/// How many values there are of each whole number up to 255.
pub(super) struct Histogram([u32; 256]);

impl Histogram {
    /// Counts values.
    pub(super) fn of(values: &[f32]) -> Self {
        let mut counts = [0u32; 256];
        for v in values {
            counts[*v as u8 as usize] += 1;
        }
        Self(counts)
    }

    /// The threshold that leaves the least variance within two classes of the values in a range (N. Otsu, *A threshold selection method
    /// from gray-level histograms*, IEEE Trans. SMC 9, 1979).
    pub(super) fn split(&self, range: Range<f32>) -> Split {
        let [from, to] = [range.start, range.end].map(|end| (end.ceil() as usize).min(self.0.len()));
        let histogram = || self.0.iter().enumerate().take(to).skip(from);
        let total: f64 = histogram().map(|(_, n)| f64::from(*n)).sum();
        let sum: f64 = histogram().map(|(v, n)| v as f64 * f64::from(*n)).sum();
        let squares: f64 = histogram().map(|(v, n)| (v * v) as f64 * f64::from(*n)).sum();
        let variance = squares / total - (sum / total).powi(2);
        let mut best = Split { threshold: 255.0, separation: 0.0, mean_below: 0.0, mean_above: 255.0 };
        let (mut below, mut below_sum, mut gain) = (0.0, 0.0, 0.0);
        for (v, n) in histogram() {
            below += f64::from(*n);
            below_sum += v as f64 * f64::from(*n);
            if *n == 0 || below == total {
                continue;
            }
            let (low, high) = (below_sum / below, (sum - below_sum) / (total - below));
            let between = below * (total - below) * (high - low).powi(2);
            if between > gain {
                gain = between;
                // Half-way between the class means, rather than at the first of many equally good thresholds.
                let threshold = ((low + high) / 2.0) as f32;
                let separation = if variance > 0.0 { between / (total * total) / variance } else { 0.0 };
                best = Split { threshold, separation, mean_below: low as f32, mean_above: high as f32 };
            }
        }
        best
    }

    /// How many values there are between two numbers, and how many whole numbers.
    pub(super) fn between(&self, ends: [f32; 2]) -> [f64; 2] {
        let [from, to] = [ends[0].min(ends[1]), ends[0].max(ends[1])].map(|end| (end as usize).min(self.0.len()));
        let count: u32 = self.0.iter().take(to).skip(from).sum();
        [f64::from(count), to.saturating_sub(from).max(1) as f64]
    }
}

/// Median of a list; 0 of an empty one.
pub(super) fn median(values: &[f32]) -> f32 {
    quantile(values, 0.5)
}

/// Quantile of a list; 0 of an empty one.
pub(super) fn quantile(values: &[f32], q: f64) -> f32 {
    let [quantile] = quantiles(values, [q]);
    quantile
}

/// Some quantiles of a list, from low to high.
pub(super) fn quantiles<const N: usize>(values: &[f32], parts: [f64; N]) -> [f32; N] {
    // The bits of floating point numbers, those but the sign of negative ones turned round, are whole numbers in the same order, and quicker to sort.
    let turned = |bits: i32| bits ^ ((bits >> 31) & i32::MAX);
    let mut keys: Vec<i32> = values.iter().map(|v| turned(v.to_bits() as i32)).collect();
    let mut from = 0;
    parts.map(|q| {
        if values.is_empty() {
            return 0.0;
        }
        let k = ((values.len() - 1) as f64 * q) as usize;
        let key = *keys[from..].select_nth_unstable(k - from).1;
        // What follows is no less.
        from = k;
        f32::from_bits(turned(key) as u32)
    })
}
