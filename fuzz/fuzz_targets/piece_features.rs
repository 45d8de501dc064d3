//! See [`jigsaw_fuzz::piece_features`].
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| jigsaw_fuzz::piece_features(data));
