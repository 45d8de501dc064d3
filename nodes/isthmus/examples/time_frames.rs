//! Least time from a grey frame in memory to all its features, in milliseconds, one line a picture: for comparisons with other programs.
//!
//! `cargo run --release -p isthmus-shapes --example time_frames -- PICTURE…`

use isthmus::Extractor;
use isthmus::mask::{Frame, Parameters, Segmenter};
use std::time::{Duration, Instant};

/// Time spent on one picture.
const BUDGET: Duration = Duration::from_secs(2);

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let (mut segmenter, mut extractor) = (Segmenter::default(), Extractor::default());
    for path in std::env::args_os().skip(1) {
        let picture = image::open(&path)?.into_luma8();
        let frame = Frame::grey(picture.width(), picture.height(), picture.as_raw())?;
        let start = Instant::now();
        let mut least = Duration::MAX;
        while start.elapsed() < BUDGET {
            let before = Instant::now();
            for cutout in segmenter.segment(&frame, &Parameters::default()).cutouts {
                std::hint::black_box(extractor.extract(&cutout)?);
            }
            least = least.min(before.elapsed());
        }
        println!("{:.4}", least.as_secs_f64() * 1e3);
    }
    Ok(())
}
