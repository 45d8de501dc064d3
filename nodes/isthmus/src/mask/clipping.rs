//! What clipping does to the mean of noisy grey levels, undone.
//!
//! A camera cannot tell a level below 0 or above 255. Where noise goes beyond, the mean of many pixels is not the level that
//! the pixels would have without noise: `mean(L) = E[clip(L + noise)]` lies further inside. Half-way between two levels, one of which is clipped, lies
//! elsewhere too, and with it the border. The noise is taken for normal; `mean` is tabulated and read backwards.

/// Levels of a byte.
const LEVELS: usize = 256;
/// Noise that reaches beyond the scale matters within this many standard deviations of its ends: further inside it moves a mean by less
/// than a thousandth of itself.
const REACH: f32 = 3.0;
/// Least noise that matters, in grey levels: what less of it does to a mean is lost in the rounding of levels.
const MIN_NOISE: f32 = 1.0;
/// Steps of the integral over the noise, from minus to plus [`EXTENT`] standard deviations.
const STEPS: usize = 64;
const EXTENT: f32 = 4.0;

/// Mean grey levels of clipped noise, and the levels they stand for.
#[derive(Debug, Clone)]
pub(super) struct Clipping {
    /// For each whole level the mean of the clipped pixels; ascending.
    means: [f32; LEVELS],
    /// For each whole level how many of the means are below it.
    below: [u16; LEVELS],
    /// Means from here on...
    low: f32,
    /// ... up to here are right as they are.
    high: f32,
}

impl Clipping {
    /// Table for a standard deviation of the noise; `None` where it is too little to matter to means from a least to a greatest.
    pub(super) fn of(noise: f32, [least, greatest]: [f32; 2]) -> Option<Self> {
        let top = (LEVELS - 1) as f32;
        let reach = REACH * noise;
        let is_clipped = least < reach || greatest > top - reach;
        if !(noise >= MIN_NOISE && noise.is_finite() && is_clipped) {
            return None;
        }
        let deviations: [f32; STEPS] = std::array::from_fn(|i| EXTENT * ((2 * i + 1) as f32 / STEPS as f32 - 1.0));
        let weights = deviations.map(|d| (-d * d / 2.0).exp());
        let total: f32 = weights.iter().sum();
        let mean = |level: usize| {
            let clipped = |(d, w): (&f32, &f32)| (level as f32 + d * noise).clamp(0.0, top) * w;
            deviations.iter().zip(&weights).map(clipped).sum::<f32>() / total
        };
        // Nothing is clipped in the middle, and the upper half is the lower one upside down.
        let mut means: [f32; LEVELS] = std::array::from_fn(|level| level as f32);
        for level in (0..LEVELS / 2).take_while(|level| (*level as f32) < reach) {
            means[level] = mean(level);
            means[LEVELS - 1 - level] = top - means[level];
        }
        let below = std::array::from_fn(|level| means.partition_point(|m| *m < level as f32) as u16);
        Some(Self { means, below, low: reach, high: top - reach })
    }

    /// The level that a mean of clipped pixels stands for: a number from 0 to 255.
    pub(super) fn level(&self, mean: f32) -> f32 {
        if mean >= self.low && mean <= self.high {
            return mean;
        }
        // Close above the whole level below.
        let mut after = usize::from(self.below[mean as u8 as usize]).clamp(1, LEVELS - 1);
        while after < LEVELS - 1 && self.means[after] < mean {
            after += 1;
        }
        let [below, above] = [self.means[after - 1], self.means[after]];
        let part = if above > below { (mean - below) / (above - below) } else { 0.0 };
        (after - 1) as f32 + part.clamp(0.0, 1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The table's steps and the integral's.
    const TOLERANCE: f32 = 0.05;

    #[test]
    fn a_clipped_mean_is_the_level_without_clipping() {
        let clipping = Clipping::of(20.0, [30.0, 225.0]).unwrap();
        // Of a normal distribution cut off a standard deviation below its mean: sigma (phi(1) - (1 - Phi(1))).
        let excess = 20.0 * (0.241_971 - 0.158_655);
        assert!((clipping.level(20.0 + excess) - 20.0).abs() < TOLERANCE);
        assert!((clipping.level(235.0 - excess) - 235.0).abs() < TOLERANCE);
        assert_eq!(clipping.level(128.0), 128.0);
        assert_eq!((clipping.level(0.0), clipping.level(255.0)), (0.0, 255.0));
    }

    #[test]
    fn little_noise_is_not_clipped() {
        assert!(Clipping::of(0.5, [0.0, 255.0]).is_none());
        assert!(Clipping::of(10.0, [40.0, 200.0]).is_none());
        assert!(Clipping::of(f32::NAN, [0.0, 255.0]).is_none());
    }
}
