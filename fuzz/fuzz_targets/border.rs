//! See [`jigsaw_fuzz::border`].
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| jigsaw_fuzz::border(data));
