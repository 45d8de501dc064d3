//! See [`jigsaw_fuzz::parameter_file`].
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| jigsaw_fuzz::parameter_file(data));
