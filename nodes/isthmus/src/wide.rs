//! Loops over many equal elements, with the widest registers that this processor has.

pub use fearless_simd::Simd;

/// Evaluates an expression that is compiled twice: for any processor, and for those with AVX2, which take twice as many elements at a time; the
/// result is the same. Functions that it calls take part if they are always inlined.
#[macro_export]
macro_rules! widely {
    ($work:expr) => {
        match $crate::wide::processor() {
            Some(processor) => $crate::wide::Simd::vectorize(processor, || $work),
            None => $work,
        }
    };
}
pub use widely;

/// This processor, if it has AVX2.
#[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
pub fn processor() -> Option<fearless_simd::Avx2> {
    fearless_simd::Level::new().as_avx2()
}

/// Others have registers of one width.
#[cfg(not(any(target_arch = "x86", target_arch = "x86_64")))]
pub fn processor() -> Option<fearless_simd::Fallback> {
    None
}
