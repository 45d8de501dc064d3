//! Eq. 1 of Webster et al. 1990: normalised cross-correlation of two isthmus distance functions (IDFs).
//!
//! Given the IDF `f` of a tab and the IDF `g` of a mouth, walked in opposite directions so that mating borders run
//! alike, both sampled at equal steps of path length, the value at offset `m` is
//!
//! ```text
//!          Σ (f(x) - f̄) (g(x-m) - ḡ)
//! R(m) = ---------------------------------      over the x where both are defined
//!        √( Σ (f(x)-f̄)²  Σ (g(x-m)-ḡ)² )
//! ```
//!
//! The best offset says where along the match segment the two pieces meet. Complexity O(samples · offsets). It ignores
//! amplitude, so it hardly tells tabs of one make apart; and a flat IDF (a circular arc about its own isthmus point)
//! has no correlation at all, for which 0 is given.
//!
//! ```
//! let f: Vec<f64> = (0..60).map(|i| (i as f64 * 0.1).sin()).collect();
//! let best = jigsaw::correlation::correlate(&f[4..], &f, 0.75, 12);
//! assert!((best.value - 1.0).abs() < 1e-12);
//! assert_eq!(best.offset, -4); // f[4..] at x - 4... is g at x: g lags by 4 samples
//! ```

/// The best correlation over all offsets.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Correlation {
    /// Value of Eq. 1, in `-1..=1`.
    pub value: f64,
    /// Offset in samples: `f(x)` meets `g(x - offset)`.
    pub offset: i64,
}

/// Best value of Eq. 1 over the offsets at which at least `min_overlap` (a fraction) of the shorter function takes
/// part, not farther than `reach` samples from the offset that lays the middles on one another.
pub fn correlate(f: &[f64], g: &[f64], min_overlap: f64, reach: i64) -> Correlation {
    let (nf, ng) = (f.len() as i64, g.len() as i64);
    let least = ((min_overlap * nf.min(ng) as f64).ceil() as i64).max(2);
    let middle = (nf - ng) / 2;
    let low = (least - ng).max(middle - reach);
    let high = (nf - least).min(middle + reach);
    let mut best = Correlation { value: 0.0, offset: middle };
    let mut first = true;
    for offset in low..=high {
        let from = offset.max(0) as usize;
        let to = nf.min(offset + ng) as usize;
        let a = &f[from..to];
        let b = &g[(from as i64 - offset) as usize..(to as i64 - offset) as usize];
        let value = normalised(a, b);
        if first || value > best.value {
            best = Correlation { value, offset };
            first = false;
        }
    }
    best
}

fn normalised(a: &[f64], b: &[f64]) -> f64 {
    let n = a.len() as f64;
    let (mut sa, mut sb, mut saa, mut sbb, mut sab) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for (x, y) in a.iter().zip(b) {
        sa += x;
        sb += y;
        saa += x * x;
        sbb += y * y;
        sab += x * y;
    }
    let power = (saa - sa * sa / n) * (sbb - sb * sb / n);
    if power <= f64::EPSILON { 0.0 } else { ((sab - sa * sb / n) / power.sqrt()).clamp(-1.0, 1.0) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn correlation_ignores_amplitude_and_level() {
        let f: Vec<f64> = (0..50).map(|i| (f64::from(i) * 0.2).sin()).collect();
        let g: Vec<f64> = f.iter().map(|v| 3.0 * v + 7.0).collect();
        let best = correlate(&f, &g, 0.75, 10);
        assert!(best.value > 1.0 - 1e-9);
        assert_eq!(best.offset, 0);
    }

    #[test]
    fn a_flat_function_correlates_with_nothing() {
        assert_eq!(correlate(&[1.0; 20], &[1.0; 20], 0.75, 5).value, 0.0);
    }

    #[test]
    fn very_different_lengths_leave_no_offset() {
        assert_eq!(correlate(&[1.0, 2.0], &[1.0; 30], 1.0, 0).value, 0.0);
    }
}
