//! Where a row of pixels goes over from one class to the other.

use crate::wide::widely;

/// Tells where in a row of pixels `set` begins to hold (`true`) and where it ceases to (`false`), from left to right; before the row
/// it does not hold.
pub(crate) fn changes<P: Copy>(row: &[P], set: impl Fn(P) -> bool, change: impl FnMut(usize, bool)) {
    widely!(tell_changes(row, set, change));
}

#[inline(always)]
fn tell_changes<P: Copy>(row: &[P], set: impl Fn(P) -> bool, mut change: impl FnMut(usize, bool)) {
    /// Pixels that are looked at together, as bits of a number; most chunks are uniform.
    const CHUNK: usize = 32;
    let mut holds = false;
    let (chunks, rest) = row.as_chunks::<CHUNK>();
    for (k, chunk) in chunks.iter().enumerate() {
        let count = chunk.iter().fold(0u8, |n, &p| n + u8::from(set(p)));
        if usize::from(count) == if holds { CHUNK } else { 0 } {
            continue;
        }
        let bits = chunk.iter().rev().fold(0u32, |bits, &p| bits << 1 | u32::from(set(p)));
        // A bit for each pixel that differs from the one before.
        let mut differ = bits ^ (bits << 1 | u32::from(holds));
        while differ != 0 {
            holds = !holds;
            change(k * CHUNK + differ.trailing_zeros() as usize, holds);
            differ &= differ - 1;
        }
    }
    for (k, &p) in rest.iter().enumerate() {
        if set(p) != holds {
            holds = !holds;
            change(chunks.len() * CHUNK + k, holds);
        }
    }
}
