//! See [`jigsaw_fuzz::picture_file`].
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| jigsaw_fuzz::picture_file(data));
