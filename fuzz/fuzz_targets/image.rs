//! See [`jigsaw_fuzz::image`].
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| jigsaw_fuzz::image(data));
