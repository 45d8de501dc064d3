//! Whatever comes in: a result or an error, in linear time and memory, and nothing that is not a number.

#![allow(clippy::unwrap_used, reason = "test program: its functions beside the tests fail by panic too")]

mod shapes;

use isthmus::contour::{Border, ContourError};
use isthmus::mask::{Aoi, Cutout, Frame, MaskError, Parameters, PixelFormat, Segmentation, segment};
use isthmus::{Extractor, Features, Point, profile};
use proptest::prelude::*;
use rand::{RngExt, SeedableRng, rngs::StdRng};

fn run(width: u32, height: u32, pixels: &[u8]) -> Segmentation {
    let segmentation = segment(&Frame::grey(width, height, pixels).unwrap(), &Parameters::default());
    let mut extractor = Extractor::default();
    for cutout in &segmentation.cutouts {
        if let Ok(features) = extractor.extract(cutout) {
            finite(&features);
        }
    }
    segmentation
}

fn finite(features: &Features) {
    assert!(features.noise.is_finite() && features.border.spacing.is_finite());
    assert!(features.border.points.iter().all(|p| p.x.is_finite() && p.y.is_finite()));
    for i in &features.isthmuses {
        let numbers = [i.width, i.path_length, i.persistence, i.arc[0], i.arc[1], i.point.x, i.point.y];
        assert!(numbers.iter().all(|v| v.is_finite()), "{i:?}");
        let length = features.border.length();
        assert!(i.arc.iter().all(|a| (0.0..length).contains(a)), "{i:?} on a border of {length}");
        assert!(profile::distance_function(&features.border, i, 64).iter().all(|d| d.is_finite()), "{i:?}");
    }
    for s in features.endoskeleton.branches.iter().chain(&features.exoskeleton.branches).flatten() {
        assert!(s.point.x.is_finite() && s.point.y.is_finite() && s.distance.is_finite(), "{s:?}");
    }
}

#[test]
fn uniform_frames_hold_nothing() {
    for level in [0, 1, 127, 255] {
        for (width, height) in [(1, 1), (1, 500), (500, 1), (2, 2), (3, 7), (640, 480)] {
            let found = run(width, height, &vec![level; (width * height) as usize]);
            assert_eq!(found.cutouts.len(), 0, "{width} x {height} of {level}");
        }
    }
}

#[test]
fn single_pixels_are_no_shapes() {
    for size in [1u32, 2, 9, 130, 800] {
        let mut pixels = vec![200u8; (size * size) as usize];
        pixels[((size / 2) * size + size / 2) as usize] = 0;
        assert_eq!(run(size, size, &pixels).cutouts.len(), 0, "{size}");
    }
}

#[test]
fn noise_frames_hold_nothing_cut_out_of_proportion() {
    for seed in 0..6 {
        let mut rng = StdRng::seed_from_u64(seed);
        let (width, height) = (300 + 37 * seed as u32, 200 + 91 * seed as u32);
        let pixels: Vec<u8> = (0..width * height).map(|_| rng.random()).collect();
        let found = run(width, height, &pixels);
        let cut_out: usize = found.cutouts.iter().map(|c| c.pixels.len()).sum();
        assert!(cut_out <= 40 * pixels.len(), "{cut_out} pixels cut out of {}", pixels.len());
    }
}

#[test]
fn a_ring_has_its_outer_border() {
    let mut pixels = vec![20u8; 400 * 400];
    for y in 0..400i32 {
        for x in 0..400i32 {
            let r = f64::from((x - 200).pow(2) + (y - 200).pow(2)).sqrt();
            if (60.0..120.0).contains(&r) {
                pixels[(y * 400 + x) as usize] = 220;
            }
        }
    }
    let found = run(400, 400, &pixels);
    assert_eq!(found.cutouts.len(), 1);
    let (border, _) = Border::from_cutout(&found.cutouts[0]).unwrap();
    let radius = (border.area() / std::f64::consts::PI).sqrt();
    assert!((radius - 120.0).abs() < 0.5, "{radius}");
}

#[test]
fn very_wide_and_very_high() {
    for (width, height) in [(65_535u32, 12u32), (12, 65_535)] {
        let mut pixels = vec![210u8; (width * height) as usize];
        for y in 3..height - 3 {
            for x in 3..width - 3 {
                pixels[(y * width + x) as usize] = 30;
            }
        }
        run(width, height, &pixels);
    }
}

/// Side of the frames with the widest ratio of border to area.
const SIDE: usize = 1024;

#[test]
fn combs_spirals_and_chessboards() {
    let frame = |set: &dyn Fn(usize, usize) -> bool| -> Vec<u8> {
        (0..SIDE * SIDE).map(|k| if set(k % SIDE, k / SIDE) { 30 } else { 220 }).collect()
    };
    let within = |x: usize, y: usize| (20..SIDE - 20).contains(&x) && (20..SIDE - 20).contains(&y);
    let patterns: [&dyn Fn(usize, usize) -> bool; 4] = [
        &|x, y| within(x, y) && (y < 40 || x % 4 < 2),
        &|x, y| within(x, y) && (x / 7 + y / 7) % 2 == 0,
        &|x, y| within(x, y) && (x & y & 0x1f8) == 0,
        &|x, y| {
            let (u, v) = (x as f64 - 512.0, y as f64 - 512.0);
            let (r, a) = (u.hypot(v), v.atan2(u));
            r < 490.0 && (r / 12.0 - a / std::f64::consts::TAU).rem_euclid(1.0) < 0.5
        },
    ];
    for pattern in patterns {
        run(SIDE as u32, SIDE as u32, &frame(pattern));
    }
}

#[test]
fn a_fractal_border() {
    // Koch's snowflake: five generations, 3072 corners.
    let corner = |k: i32| nalgebra::Rotation2::new(std::f64::consts::TAU * f64::from(k) / 3.0) * Point::new(300.0, 0.0);
    let mut outline: Vec<Point> = (0..3).map(corner).collect();
    for _ in 0..5 {
        outline = (0..outline.len())
            .flat_map(|i| {
                let (p, q) = (outline[i], outline[(i + 1) % outline.len()]);
                let third = (q - p) / 3.0;
                let peak = p + third + nalgebra::Rotation2::new(-std::f64::consts::FRAC_PI_3) * third;
                [p, p + third, peak, p + third * 2.0]
            })
            .collect();
    }
    finite(&Features::from_border(Border::from_points(&outline).unwrap(), 0.0).unwrap());
}

#[test]
fn frames_that_do_not_fit_their_bytes() {
    assert_eq!(Frame::grey(0, 5, &[]).unwrap_err(), MaskError::Size { width: 0, height: 5 });
    assert_eq!(Frame::grey(4, 4, &[0; 15]).unwrap_err(), MaskError::Bytes { bytes: 15, needed: 16 });
    assert_eq!(
        Frame::new(PixelFormat::Rgb, 4, 4, 11, &[0; 99]).unwrap_err(),
        MaskError::Stride { stride: 11, row: 12 }
    );
    assert!(Frame::grey(u32::MAX, u32::MAX, &[]).is_err());
    // The last row need not be padded.
    assert!(Frame::new(PixelFormat::Grey, 3, 2, 8, &[0; 11]).is_ok());
}

#[test]
fn cutouts_that_make_no_sense() {
    let window = Aoi { x: 0, y: 0, width: 20, height: 20 };
    let good =
        Cutout { aoi: window, window, pixels: vec![0; 400], shape_level: 200.0, ground_level: 0.0, noise_level: 0.0 };
    let trace = |cutout: Cutout| Border::from_cutout(&cutout).unwrap_err();
    assert!(matches!(trace(good.clone()), ContourError::Nothing { .. }));
    assert!(matches!(trace(Cutout { pixels: vec![0; 399], ..good.clone() }), ContourError::PixelCount { .. }));
    assert!(matches!(trace(Cutout { shape_level: f32::NAN, ..good.clone() }), ContourError::Contrast { .. }));
    assert!(matches!(trace(Cutout { shape_level: 1.0, ..good.clone() }), ContourError::Contrast { .. }));
    let empty = Aoi { width: 0, height: 0, ..window };
    assert!(Border::from_cutout(&Cutout { window: empty, pixels: vec![], ..good.clone() }).is_err());
    // A shape that fills its window is padded; noise that is not a number does not blur.
    for noise_level in [0.0, 40.0, f32::NAN, f32::INFINITY, -3.0, 1e30] {
        let full = Cutout { pixels: vec![200; 400], noise_level, ..good.clone() };
        if let Ok((border, noise)) = Border::from_cutout(&full) {
            assert!(noise.is_finite() && (border.area() - 400.0).abs() < 60.0, "{noise_level}: {}", border.area());
        }
        // One that begins right behind the window's rim touches it at half the resolution.
        let is_shape = |k: usize| (4..16).contains(&(k % 20)) && (1..15).contains(&(k / 20));
        let pixels = (0..400).map(|k| if is_shape(k) { 255 } else { 0 }).collect();
        let (border, noise) = Border::from_cutout(&Cutout { pixels, noise_level, ..good.clone() }).unwrap();
        assert!(noise.is_finite() && (border.area() - 168.0).abs() < 60.0, "{noise_level}: {}", border.area());
    }
}

#[test]
fn outlines_that_make_no_sense() {
    let p = |x: f64, y: f64| Point::new(x, y);
    let error = |outline: &[Point]| Border::from_points(outline).unwrap_err();
    assert!(matches!(error(&[]), ContourError::TooShort { .. }));
    assert!(matches!(error(&[p(0.0, 0.0); 7]), ContourError::TooShort { .. }));
    assert!(matches!(error(&[p(0.0, 0.0), p(f64::NAN, 1.0)]), ContourError::Coordinate { index: 1, .. }));
    assert!(matches!(error(&[p(0.0, 0.0), p(1e300, 1.0)]), ContourError::Coordinate { index: 1, .. }));
    assert!(matches!(error(&[p(0.0, 0.0), p(1e8, 1.0), p(1e8, 1e8)]), ContourError::TooLong { .. }));
    assert!(matches!(error(&[p(0.0, 0.0), p(100.0, 0.0)]), ContourError::NoArea { .. }));
    assert!(matches!(Border::from_points_spaced(&[p(0.0, 0.0)], 0.0).unwrap_err(), ContourError::Spacing { .. }));
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, failure_persistence: None, rng_seed: prop::test_runner::RngSeed::Fixed(2), ..ProptestConfig::default() })]

    /// Random polygons cross themselves, turn back on themselves and repeat points.
    #[test]
    fn any_polygon(outline in prop::collection::vec((-60i32..60, -60i32..60), 0..40), noise in 0.0..3.0) {
        let outline: Vec<Point> = outline.iter().map(|(x, y)| Point::new(f64::from(*x), f64::from(*y))).collect();
        if let Ok(border) = Border::from_points(&outline) && let Ok(features) = Features::from_border(border, noise) {
            finite(&features);
        }
    }

    /// Rectangles drawn over each other at any levels.
    #[test]
    fn any_frame(
        width in 1u32..200,
        height in 1u32..200,
        boxes in prop::collection::vec((0u32..200, 0u32..200, 1u32..120, 1u32..120, any::<u8>()), 0..12),
        colour in any::<bool>(),
    ) {
        let channels = if colour { 3 } else { 1 };
        let mut pixels = vec![100u8; (width * height * channels) as usize];
        for (x, y, w, h, level) in boxes {
            for v in y.min(height)..(y + h).min(height) {
                let row = (v * width * channels) as usize;
                let (from, to) = ((x.min(width) * channels) as usize, ((x + w).min(width) * channels) as usize);
                pixels[row + from..row + to].fill(level);
            }
        }
        let format = if colour { PixelFormat::Rgb } else { PixelFormat::Grey };
        let frame = Frame::new(format, width, height, (width * channels) as usize, &pixels).unwrap();
        for cutout in segment(&frame, &Parameters::default()).cutouts {
            prop_assert_eq!(cutout.pixels.len(), (cutout.window.width * cutout.window.height) as usize);
            if let Ok(features) = Extractor::default().extract(&cutout) {
                finite(&features);
            }
        }
    }
}
