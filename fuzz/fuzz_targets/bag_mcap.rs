//! See [`jigsaw_fuzz::bag_mcap`].
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| jigsaw_fuzz::bag_mcap(data));
