//! See [`jigsaw_fuzz::piece_image`].
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| jigsaw_fuzz::piece_image(data));
