//! Pieces are found under bad light, on any ground and among dirt; what is left out is named.

#![allow(clippy::unwrap_used, reason = "test program: its functions beside the tests fail by panic too")]

mod shapes;

use isthmus::contour::Border;
use isthmus::mask::{Frame, Parameters, Reason, Segmentation, segment};
use isthmus::{Extractor, Point};
use rand::{SeedableRng, rngs::StdRng};
use shapes::{Camera, Neck, Piece, blur, normal, pose};

/// Side of the frames, in pixels.
const SIDE: usize = 900;
/// Size of the pieces' bodies, in pixels.
const SIZE: f64 = 220.0;
/// Centres of the pieces.
const CENTRES: [(f64, f64); 4] = [(230.0, 240.0), (650.0, 220.0), (240.0, 660.0), (640.0, 650.0)];
/// Most that the middle of a neck may be off, in pixels: uneven light and noise included.
const MIDDLE: f64 = 1.0;

/// A frame with four pieces, and their necks.
fn scene(camera: Camera) -> (Vec<u8>, Vec<Neck>) {
    let camera = Camera { width: SIDE, height: SIDE, ..camera };
    let (mut outlines, mut necks) = (Vec::new(), Vec::new());
    for (k, (x, y)) in CENTRES.into_iter().enumerate() {
        let piece = Piece::random(SIZE, 10 + k as u64);
        let pose = pose(0.2 + 0.1 * k as f64, 1.0, x, y);
        outlines.push(piece.outline(&pose));
        necks.extend(piece.necks(&pose));
    }
    (camera.picture(&outlines), necks)
}

fn grey(pixels: &[u8]) -> Segmentation {
    segment(&Frame::grey(SIDE as u32, SIDE as u32, pixels).unwrap(), &Parameters::default())
}

/// All four pieces are there, and all their necks where they belong.
fn check(found: &Segmentation, necks: &[Neck], what: &str) {
    assert_eq!(found.cutouts.len(), CENTRES.len(), "{what}: {:?}", found.rejected);
    check_levels(found, what);
    let mut extractor = Extractor::default();
    let isthmuses: Vec<_> = found.cutouts.iter().flat_map(|c| extractor.extract(c).unwrap().isthmuses).collect();
    for neck in necks {
        let same = isthmuses.iter().filter(|i| i.salient && i.polarity == neck.polarity);
        let off = same.map(|i| (i.point - neck.middle()).norm()).fold(f64::MAX, f64::min);
        assert!(off < MIDDLE, "{what}: {neck:?} is {off} px off");
    }
}

/// Levels are those of 8 bits, whatever surfaces run through them.
fn check_levels(found: &Segmentation, what: &str) {
    for c in &found.cutouts {
        for level in [c.shape_level, c.ground_level] {
            assert!((0.0..=255.0).contains(&level), "{what}: a level of {level:e}");
        }
    }
}

/// Puts a disc of a level on a frame.
fn disc(pixels: &mut [u8], (x, y): (f64, f64), radius: f64, mut level: impl FnMut(u8, f64) -> u8) {
    for (k, p) in pixels.iter_mut().enumerate() {
        let distance = ((k % SIDE) as f64 - x).hypot((k / SIDE) as f64 - y);
        if distance < radius {
            *p = level(*p, distance / radius);
        }
    }
}

#[test]
fn dark_on_light_and_light_on_dark() {
    for (shape_level, ground_level) in [(40.0, 215.0), (215.0, 40.0), (100.0, 140.0), (140.0, 100.0), (0.0, 255.0)] {
        let (pixels, necks) = scene(Camera { shape_level, ground_level, noise: 3.0, ..Camera::default() });
        check(&grey(&pixels), &necks, &format!("{shape_level} on {ground_level}"));
    }
}

/// Silhouettes without levels between, many to a frame and one each in tight frames without a margin.
#[test]
fn one_bit_silhouettes() {
    for (shape_level, ground_level) in [(0.0, 255.0), (255.0, 0.0)] {
        let what = format!("{shape_level} on {ground_level}");
        let (mut pixels, necks) = scene(Camera { shape_level, ground_level, ..Camera::default() });
        pixels.iter_mut().for_each(|p| *p = if *p < 128 { 0 } else { 255 });
        let found = grey(&pixels);
        check(&found, &necks, &what);
        for aoi in found.cutouts.iter().map(|c| c.aoi) {
            let rows = pixels.chunks_exact(SIDE).skip(aoi.y as usize).take(aoi.height as usize);
            let tight: Vec<u8> = rows.flat_map(|r| &r[aoi.x as usize..][..aoi.width as usize]).copied().collect();
            let found = segment(&Frame::grey(aoi.width, aoi.height, &tight).unwrap(), &Parameters::default());
            assert_eq!(found.cutouts.len(), 1, "{what}, tight: {:?}", found.rejected);
            check_levels(&found, &what);
        }
    }
}

#[test]
fn corners_of_half_the_light() {
    for (shape_level, ground_level) in [(40.0, 215.0), (215.0, 40.0)] {
        let camera = Camera { shape_level, ground_level, vignette: 0.5, noise: 3.0, ..Camera::default() };
        let (pixels, necks) = scene(camera);
        check(&grey(&pixels), &necks, &format!("{shape_level} on {ground_level}"));
    }
}

/// Uneven light with a blurred edge moves no border as a whole: the area enclosed stays.
#[test]
fn corners_of_half_the_light_out_of_focus() {
    /// Most that the border may lie outside or inside of where it lies under even light, on the mean, in pixels.
    const BORDER: f64 = 0.15;
    let areas = |vignette: f64| -> Vec<(f64, f64)> {
        let (pixels, _) = scene(Camera { vignette, noise: 10.0, blur: 4.0, ..Camera::default() });
        let found = grey(&pixels);
        assert_eq!(found.cutouts.len(), CENTRES.len(), "vignette {vignette}: {:?}", found.rejected);
        let border = |c| Border::from_cutout(c).unwrap().0;
        found.cutouts.iter().map(border).map(|b| (b.area(), b.length())).collect()
    };
    for ((even, length), (uneven, _)) in areas(0.0).into_iter().zip(areas(0.5)) {
        let offset = (uneven - even) / length;
        assert!(offset.abs() < BORDER, "the border lies {offset} px outside of where it was");
    }
}

#[test]
fn a_spot_of_glare_on_the_ground() {
    let (mut pixels, necks) = scene(Camera { ground_level: 190.0, noise: 3.0, ..Camera::default() });
    disc(&mut pixels, (445.0, 440.0), 60.0, |p, r| p.saturating_add((60.0 * (1.0 - r * r)) as u8));
    check(&grey(&pixels), &necks, "glare");
}

/// The reflection of a lamp in a dark, glossy ground: spots and a streak, faint and so strong that the camera clips them.
#[test]
fn a_lamp_in_a_dark_ground() {
    for strength in [60.0, 120.0, 225.0, 500.0] {
        for (width, height) in [(25.0, 25.0), (35.0, 35.0), (18.0, 60.0)] {
            let (mut pixels, necks) =
                scene(Camera { shape_level: 180.0, ground_level: 30.0, noise: 3.0, ..Camera::default() });
            for (k, p) in pixels.iter_mut().enumerate() {
                let (x, y) = ((k % SIDE) as f64 - 445.0, (k / SIDE) as f64 - 450.0);
                let glare = strength * (-0.5 * ((x / width).powi(2) + (y / height).powi(2))).exp();
                *p = if *p > 110 { *p } else { p.saturating_add(glare as u8) };
            }
            check(&grey(&pixels), &necks, &format!("glare of {strength}, {width} x {height} px"));
        }
    }
}

#[test]
fn a_ground_of_another_colour() {
    // Piece and ground are of the same brightness on the average of the channels.
    let (coverage, necks) = scene(Camera { shape_level: 255.0, ground_level: 0.0, noise: 0.0, ..Camera::default() });
    for (shape, ground) in
        [([180, 90, 60], [60, 90, 180]), ([200, 190, 120], [30, 120, 60]), ([90, 90, 90], [20, 160, 90])]
    {
        let mut pixels = Vec::with_capacity(3 * coverage.len());
        for c in &coverage {
            let mix = |k: usize| (ground[k] * (255 - i32::from(*c)) + shape[k] * i32::from(*c)) / 255;
            pixels.extend([0, 1, 2].map(|k| mix(k) as u8));
        }
        let frame = Frame::rgb(SIDE as u32, SIDE as u32, &pixels).unwrap();
        check(&segment(&frame, &Parameters::default()), &necks, &format!("{shape:?} on {ground:?}"));
    }
}

/// The scene's pieces by a part of each pixel, from 0 to 1.
fn coverage() -> (Vec<f64>, Vec<Neck>) {
    let (levels, necks) = scene(Camera { shape_level: 255.0, ground_level: 0.0, noise: 0.0, ..Camera::default() });
    (levels.into_iter().map(|c| f64::from(c) / 255.0).collect(), necks)
}

/// The grain is as strong as the difference in brightness between pieces and ground.
#[test]
fn a_table_of_wood() {
    const WOOD: [f64; 3] = [150.0, 105.0, 65.0];
    let (coverage, necks) = coverage();
    for piece in [[170.0, 165.0, 155.0], [90.0, 110.0, 150.0]] {
        let mut rng = StdRng::seed_from_u64(7);
        // Grain runs from top to bottom: lines of all widths.
        let mut grain = vec![0.0; SIDE];
        for width in [3.0, 12.0, 50.0] {
            let mut lines: Vec<f64> = (0..SIDE).map(|_| normal(&mut rng)).collect();
            blur(&mut lines, SIDE, 1, width);
            let power = (lines.iter().map(|l| l * l).sum::<f64>() / SIDE as f64).sqrt();
            grain.iter_mut().zip(&lines).for_each(|(grain, line)| *grain += 0.08 * line / power);
        }
        let mut pixels = Vec::with_capacity(3 * coverage.len());
        for (k, c) in coverage.iter().enumerate() {
            let light = 1.0 + grain[k % SIDE];
            for (wood, piece) in WOOD.into_iter().zip(piece) {
                let level = wood * light * (1.0 - c) + piece * c + 4.0 * normal(&mut rng);
                pixels.push(level.round().clamp(0.0, 255.0) as u8);
            }
        }
        let frame = Frame::rgb(SIDE as u32, SIDE as u32, &pixels).unwrap();
        check(&segment(&frame, &Parameters::default()), &necks, &format!("{piece:?} on wood"));
    }
}

/// Pieces with print in stripes, the ends of which (tabs, corners) have a seventh of the contrast: they belong to the pieces. What has as little contrast beside them, but rises slowly
/// from the ground, does not.
#[test]
fn print_near_the_level_of_the_ground() {
    const GROUND: [f64; 3] = [40.0, 45.0, 50.0];
    const STRIPES: [[f64; 3]; 3] = [[220.0, 200.0, 90.0], [150.0, 60.0, 70.0], [90.0, 170.0, 210.0]];
    const DARK: [f64; 3] = [58.0, 42.0, 68.0];
    let (coverage, necks) = coverage();
    let mut glow = vec![0.0; coverage.len()];
    for (k, (x, y)) in CENTRES.into_iter().enumerate().filter(|(k, _)| k % 2 == 1) {
        let (x, y) = (x - 0.45 * SIZE, y - 0.45 * SIZE);
        let about = |at: usize| ((at % SIDE) as f64 - x).hypot((at / SIDE) as f64 - y);
        glow.iter_mut()
            .enumerate()
            .for_each(|(at, g)| *g += (20.0 + k as f64) * (1.0 - (about(at) / 60.0).powi(2)).max(0.0));
    }
    for glow_part in [0.0, 1.0] {
        let mut rng = StdRng::seed_from_u64(12);
        let mut pixels = Vec::with_capacity(3 * coverage.len());
        for (k, c) in coverage.iter().enumerate() {
            let (x, y) = ((k % SIDE) as f64, (k / SIDE) as f64);
            let middle = CENTRES.into_iter().min_by(|a, b| {
                let far = |(u, v): (f64, f64)| (x - u).hypot(y - v);
                far(*a).total_cmp(&far(*b))
            });
            let (u, v) = middle.unwrap();
            let print = if x - u > 0.36 * SIZE {
                DARK
            } else {
                STRIPES[(((x + y - u - v) / 50.0).floor() as i64).rem_euclid(3) as usize]
            };
            for (ground, print) in GROUND.into_iter().zip(print) {
                let level = (ground + glow_part * glow[k]) * (1.0 - c) + print * c + 2.0 * normal(&mut rng);
                pixels.push(level.round().clamp(0.0, 255.0) as u8);
            }
        }
        let frame = Frame::rgb(SIDE as u32, SIDE as u32, &pixels).unwrap();
        check(&segment(&frame, &Parameters::default()), &necks, &format!("print, glow {glow_part}"));
    }
}

/// Dark print on black, as a scanner with an open lid sees it: on two pieces most of it is dark, so that as much of the frame is dark as is bright, and blocks of it lie nearer to the ground than to
/// bright print; on the others a tab or a corner, while the rest has one level.
#[test]
fn dark_print_on_black() {
    const DARK: [f64; 3] = [42.0, 40.0, 38.0];
    const BRIGHT: [[f64; 3]; 4] =
        [[215.0, 205.0, 190.0], [120.0, 160.0, 220.0], [225.0, 120.0, 105.0], [200.0, 200.0, 195.0]];
    /// Dark from here on, to the right of the piece's middle, as a part of its size.
    const FROM: [f64; 4] = [-0.3, -0.25, 0.36, 0.4];
    let (coverage, necks) = coverage();
    let mut rng = StdRng::seed_from_u64(31);
    let mut pixels = Vec::with_capacity(3 * coverage.len());
    for (k, c) in coverage.iter().enumerate() {
        let (x, y) = ((k % SIDE) as f64, (k / SIDE) as f64);
        let piece = 2 * usize::from(y > SIDE as f64 / 2.0) + usize::from(x > SIDE as f64 / 2.0);
        let print = if x - CENTRES[piece].0 > FROM[piece] * SIZE { DARK } else { BRIGHT[piece] };
        pixels.extend(print.map(|level| (level * c + 2.0 * normal(&mut rng)).round().clamp(0.0, 255.0) as u8));
    }
    let frame = Frame::rgb(SIDE as u32, SIDE as u32, &pixels).unwrap();
    check(&segment(&frame, &Parameters::default()), &necks, "dark print on black");
}

/// Light that falls off to the left and to all corners: the brightest ground has five times the level of the darkest, pieces three
/// quarters of that of the ground round them. No level tells the two apart.
#[test]
fn light_from_one_side() {
    let (coverage, necks) = coverage();
    let mut rng = StdRng::seed_from_u64(8);
    let level = |(k, c): (usize, &f64)| {
        let (x, y) = ((k % SIDE) as f64 / SIDE as f64, (k / SIDE) as f64 / SIDE as f64);
        let light = 200.0 * (0.3 + 0.9 * x + 0.5 * y) * (1.0 - 1.2 * ((x - 0.5).powi(2) + (y - 0.5).powi(2)));
        (light * (1.0 - 0.25 * c) + 3.0 * normal(&mut rng)).round().clamp(0.0, 255.0) as u8
    };
    let pixels: Vec<u8> = coverage.iter().enumerate().map(level).collect();
    check(&grey(&pixels), &necks, "light from one side");
}

/// A piece with dark print among bright ones, on black: an eighth of their contrast, and a crisp edge; beside it a glow of the same contrast that
/// falls off slowly.
#[test]
fn a_dark_piece_among_bright_ones_is_no_glare() {
    let outlines: Vec<_> = CENTRES
        .into_iter()
        .enumerate()
        .map(|(k, (x, y))| Piece::random(SIZE, 10 + k as u64).outline(&pose(0.3, 1.0, x, y)))
        .collect();
    let camera = Camera { width: SIDE, height: SIDE, shape_level: 1.0, ground_level: 0.0, ..Camera::default() };
    let camera = |level| Camera { shape_level: level, noise: 2.0, ..camera };
    let [bright, dark] = [(&outlines[..3], 180.0), (&outlines[3..], 24.0)].map(|(o, level)| camera(level).picture(o));
    let mut pixels: Vec<u8> = bright.iter().zip(&dark).map(|(b, d)| 10 + (*b).max(*d)).collect();
    let found = grey(&pixels);
    assert_eq!(found.cutouts.len(), 4, "{:?}", found.rejected);
    // The glow in place of the dark piece.
    pixels = bright.iter().map(|b| 10 + b).collect();
    disc(&mut pixels, CENTRES[3], 180.0, |p, r| p + (30.0 * (1.0 - r * r)) as u8);
    let found = grey(&pixels);
    assert_eq!(found.cutouts.len(), 3);
    assert!(found.rejected.iter().any(|r| r.reason == Reason::Faint), "{:?}", found.rejected);
}

/// Colours that differ by three to five times the noise of each channel: the largest of the channels' differences, whose mean noise alone makes a third of
/// that, would set the border pixels outside.
#[test]
fn faint_colours_in_noise() {
    /// Most that a border as a whole may lie beside the true one, in pixels.
    const BORDER: f64 = 0.15;
    let (coverage, necks) = coverage();
    let true_area: f64 = coverage.iter().sum();
    for (piece, ground, noise) in [
        ([34.0, 32.0, 31.0], [54.0, 52.0, 48.0], 5.0),
        ([205.0, 190.0, 180.0], [228.0, 215.0, 209.0], 7.0),
        ([120.0, 100.0, 90.0], [100.0, 103.0, 106.0], 4.0),
    ] {
        let what = format!("{piece:?} on {ground:?}");
        let mut rng = StdRng::seed_from_u64(11);
        let mut pixels = Vec::with_capacity(3 * coverage.len());
        for c in &coverage {
            for (piece, ground) in piece.into_iter().zip(ground) {
                let level: f64 = ground * (1.0 - c) + piece * c + noise * normal(&mut rng);
                pixels.push(level.round().clamp(0.0, 255.0) as u8);
            }
        }
        let found = segment(&Frame::rgb(SIDE as u32, SIDE as u32, &pixels).unwrap(), &Parameters::default());
        check(&found, &necks, &what);
        let borders: Vec<Border> = found.cutouts.iter().map(|c| Border::from_cutout(c).unwrap().0).collect();
        let sum = |of: fn(&Border) -> f64| borders.iter().map(of).sum::<f64>();
        let outside = (sum(Border::area) - true_area) / sum(Border::length);
        assert!(outside.abs() < BORDER, "{what}: the border lies {outside} px outside");
    }
}

/// Part of a lamp that pieces hide from the ground: their upper edges cast shadows of a length, the lower the shorter and the less soft.
fn shadow(coverage: &[f64], length: f64, softness: f64) -> Vec<f64> {
    const LAYERS: usize = 6;
    let mut shadow = vec![0.0f64; coverage.len()];
    for height in (1..=LAYERS).map(|layer| layer as f64 / LAYERS as f64) {
        let (x, y) = ((0.8 * length * height).round() as usize, (0.6 * length * height).round() as usize);
        let mut layer = vec![0.0; coverage.len()];
        layer[y * SIDE + x..].copy_from_slice(&coverage[..coverage.len() - y * SIDE - x]);
        blur(&mut layer, SIDE, SIDE, softness * height);
        shadow.iter_mut().zip(layer).for_each(|(shadow, layer)| *shadow = shadow.max(layer));
    }
    shadow
}

/// Shadows of half and more of what pieces and ground differ by, darker than the ground as well where pieces are brighter.
#[test]
fn a_deep_shadow() {
    /// Most that a border's points may lie beside the true outline, at corners (which blur rounds) and in shadow, and the border as a whole, in pixels.
    const POINTS: f64 = 1.6;
    const BORDER: f64 = 0.3;
    let (coverage, necks) = coverage();
    let outline = |(k, (x, y))| Piece::random(SIZE, 10 + k as u64).outline(&pose(0.2 + 0.1 * k as f64, 1.0, x, y));
    let truth: Vec<Border> = CENTRES
        .into_iter()
        .enumerate()
        .map(|place| Border::from_points_spaced(&outline(place), 0.25).unwrap())
        .collect();
    for (piece, ground, light, length, softness) in [
        ([60.0; 3], [225.0; 3], 0.5, 14.0, 3.0),
        ([120.0; 3], [225.0; 3], 0.72, 28.0, 6.0),
        ([220.0; 3], [130.0; 3], 0.6, 14.0, 3.0),
        ([50.0, 90.0, 190.0], [225.0, 222.0, 218.0], 0.5, 28.0, 6.0),
    ] {
        let what = format!("{piece:?} on {ground:?}, shadow of {length} px");
        let shadow = shadow(&coverage, length, softness);
        let mut rng = StdRng::seed_from_u64(9);
        let mut pixels = Vec::with_capacity(3 * coverage.len());
        for (c, shadow) in coverage.iter().zip(&shadow) {
            for (piece, ground) in piece.into_iter().zip(ground) {
                let level = ground * (1.0 - (1.0 - light) * shadow) * (1.0 - c) + piece * c + 3.0 * normal(&mut rng);
                pixels.push(level.round().clamp(0.0, 255.0) as u8);
            }
        }
        let found = if piece == [piece[0]; 3] {
            grey(&pixels.iter().copied().step_by(3).collect::<Vec<_>>())
        } else {
            segment(&Frame::rgb(SIDE as u32, SIDE as u32, &pixels).unwrap(), &Parameters::default())
        };
        check(&found, &necks, &what);
        assert_eq!(found.shaded.len(), CENTRES.len(), "{what}");
        for border in found.cutouts.iter().map(|c| Border::from_cutout(c).unwrap().0) {
            let off = |truth: &Border| (truth.centroid() - border.centroid()).norm();
            let truth = truth.iter().min_by(|a, b| off(a).total_cmp(&off(b))).unwrap();
            let mean = (border.area() - truth.area()) / truth.length();
            assert!(mean.abs() < BORDER, "{what}: the border lies {mean} px outside");
            let beside = |p: &Point| truth.points.iter().map(|q| (p - q).norm()).fold(f64::MAX, f64::min);
            let most = border.points.iter().map(beside).fold(0.0, f64::max);
            assert!(most < POINTS, "{what}: the border is {most} px off");
        }
    }
}

/// Pictures out of focus, uneven light and noise are no shadows.
#[test]
fn what_is_soft_all_round_is_no_shadow() {
    for (blur, vignette, noise) in
        [(0.0, 0.0, 0.0), (2.0, 0.0, 3.0), (4.0, 0.0, 3.0), (4.0, 0.5, 8.0), (1.0, 0.5, 20.0)]
    {
        let (pixels, necks) = scene(Camera { blur, vignette, noise, ..Camera::default() });
        let found = grey(&pixels);
        check(&found, &necks, &format!("blur {blur}"));
        assert_eq!((found.shaded, found.untold), (vec![], vec![]), "blur {blur}, vignette {vignette}, noise {noise}");
    }
}

/// A border that another line may be taken for is named, and no other.
#[test]
fn borders_that_are_not_told_all_the_way_are_named() {
    const SHAPE: f64 = 40.0;
    const GROUND: f64 = 215.0;
    let (clean, necks) =
        scene(Camera { shape_level: SHAPE, ground_level: GROUND, noise: 3.0, blur: 1.0, ..Camera::default() });
    let found = grey(&clean);
    check(&found, &necks, "clean");
    assert_eq!(found.untold, []);
    let (border, _) = Border::from_cutout(&found.cutouts[1]).unwrap();
    let middle = border.centroid();
    let is_shape = |p: u8| f64::from(p) < (SHAPE + GROUND) / 2.0;
    let faded = |p: u8, part: f64| {
        if is_shape(p) { (GROUND + (SHAPE - GROUND) * part + f64::from(p) - SHAPE) as u8 } else { p }
    };
    for (k, &edge) in border.points.iter().enumerate().step_by(border.points.len() / 7) {
        let spoils = [("print of 15 % of the contrast", edge, 24.0), ("gloss", edge, 80.0), ("a hole", middle, 14.0)];
        for (what, place, radius) in spoils {
            let mut pixels = clean.clone();
            let part = |distance: f64| match what {
                "gloss" => distance,
                "a hole" => 0.0,
                _ => 0.15,
            };
            disc(&mut pixels, (place.x, place.y), radius, |p, distance| faded(p, part(distance)));
            let found = grey(&pixels);
            assert_eq!(found.untold.len(), 1, "{what} at point {k}: {:?}", found.untold);
            let aoi = found.untold[0];
            assert!(
                (aoi.x - found.cutouts[1].aoi.x).abs() < 2 && found.cutouts.len() == CENTRES.len(),
                "{what}: {aoi:?}"
            );
        }
    }
}

#[test]
fn specks_and_hairs() {
    let (mut pixels, necks) = scene(Camera { noise: 3.0, ..Camera::default() });
    for (k, (x, y)) in
        [(440.0, 100.0), (60.0, 450.0), (445.0, 455.0), (850.0, 440.0), (430.0, 840.0)].into_iter().enumerate()
    {
        disc(&mut pixels, (x, y), 2.0 + 2.5 * k as f64, |_, _| 50);
    }
    // A hair of three pixels, bent, across the gap between the pieces.
    for i in 0..110 {
        let (x, y) = (i + 410, (380.0 + i as f64 + 6.0 * (i as f64 / 20.0).sin()) as usize);
        for v in y..y + 3 {
            pixels[v * SIDE + x..v * SIDE + x + 3].fill(60);
        }
    }
    let found = grey(&pixels);
    check(&found, &necks, "specks");
    assert!(found.rejected.iter().any(|r| r.reason == Reason::Small), "{:?}", found.rejected);
    assert!(found.rejected.iter().any(|r| r.reason == Reason::Thread), "{:?}", found.rejected);
}

/// Hairs of two pixels across the pieces, two of which one of them joins.
#[test]
fn hairs_on_the_pieces() {
    let (mut pixels, necks) = scene(Camera { noise: 3.0, ..Camera::default() });
    let [a, b, c, _] = CENTRES;
    for ([(x, y), (u, v)], bend) in [([a, b], 30.0), ([c, (c.0 + 150.0, c.1 + 230.0)], 12.0), ([b, (890.0, 40.0)], 8.0)]
    {
        let steps = 2 * SIDE;
        for t in (0..=steps).map(|i| i as f64 / steps as f64) {
            let across = bend * (7.0 * t).sin();
            let (p, q) = ((x + t * (u - x)) as usize, (y + t * (v - y) + across) as usize);
            for row in q..q + 2 {
                pixels[row * SIDE + p..row * SIDE + p + 2].fill(60);
            }
        }
    }
    check(&grey(&pixels), &necks, "hairs");
}

/// Coins, labels, strips, rulers: what has no bays, of the size of the pieces and of their level or half-way to it.
#[test]
fn what_has_no_bays_is_no_piece_beside_such_that_have() {
    let things: [fn(f64, f64) -> bool; 5] = [
        |x, y| x.hypot(y) < 60.0,
        |x, y| x.hypot(1.4 * y) < 85.0,
        |x, y| (0.9 * x + 0.44 * y).abs() < 80.0 && (0.9 * y - 0.44 * x).abs() < 50.0,
        |x, y| x.abs() < 25.0 && y.abs() < 440.0,
        |x, y| (x + y).abs() < 50.0 && (x - y).abs() < 160.0,
    ];
    for (k, thing) in things.into_iter().enumerate() {
        for (shape_level, ground_level) in [(40.0, 215.0), (180.0, 30.0)] {
            for level in [shape_level, 0.6 * shape_level + 0.4 * ground_level] {
                let (mut pixels, necks) = scene(Camera { shape_level, ground_level, noise: 3.0, ..Camera::default() });
                for (k, p) in pixels.iter_mut().enumerate() {
                    if thing((k % SIDE) as f64 - 445.0, (k / SIDE) as f64 - 450.0) {
                        *p = level as u8;
                    }
                }
                let found = grey(&pixels);
                check(&found, &necks, &format!("thing {k}"));
                let reasons: Vec<_> = found.rejected.iter().map(|r| r.reason).collect();
                assert_eq!(reasons, [Reason::Convex], "thing {k} of {level} on {ground_level}");
            }
        }
    }
    // Alone it may be a shape.
    let mut pixels = vec![200; SIDE * SIDE];
    disc(&mut pixels, (450.0, 450.0), 60.0, |_, _| 50);
    assert_eq!(grey(&pixels).cutouts.len(), 1);
}

/// Walls on two sides and on all of them, narrow and wide, of the level of the pieces, half-way to it, and beyond it.
#[test]
fn walls_and_trays() {
    for (shape_level, ground_level) in [(60.0, 215.0), (180.0, 30.0)] {
        for (wall, sides) in [20, 45, 60].into_iter().flat_map(|wall| [(wall, 2), (wall, 4)]) {
            for level in
                [shape_level, 0.5 * (shape_level + ground_level), if shape_level < 100.0 { 20.0 } else { 245.0 }]
            {
                let (mut pixels, necks) = scene(Camera { shape_level, ground_level, noise: 3.0, ..Camera::default() });
                for (k, p) in pixels.iter_mut().enumerate() {
                    let (x, y) = (k % SIDE, k / SIDE);
                    let depth = if sides == 2 { x.min(y) } else { x.min(y).min(SIDE - 1 - x).min(SIDE - 1 - y) };
                    if depth < wall {
                        *p = level as u8;
                    }
                }
                check(&grey(&pixels), &necks, &format!("{sides} walls of {wall} px and {level} on {ground_level}"));
            }
        }
    }
}

/// A solved puzzle that fills the frame up to a margin: joints show here and there.
#[test]
fn the_joints_of_a_sheet_are_no_shapes() {
    for margin in [30.0, 50.0] {
        let mut pixels = Camera { width: SIDE, height: SIDE, noise: 3.0, ..Camera::default() }.picture(&[]);
        let ground = pixels[0];
        let level = if ground > 128 { ground - 120 } else { ground + 120 };
        for (k, pixel) in pixels.iter_mut().enumerate() {
            let [x, y] = [k % SIDE, k / SIDE].map(|v| v as f64);
            let inside = |v: f64| (margin..SIDE as f64 - margin).contains(&v);
            let is_joint = |across: f64, along: f64| {
                let shift = 15.0 * (along / 25.0).sin();
                (across + shift).rem_euclid(200.0) < 3.0 && (along / 40.0 + (across / 200.0).floor()).sin() > 0.2
            };
            if inside(x) && inside(y) && !is_joint(x, y) && !is_joint(y, x) {
                *pixel = level;
            }
        }
        let found = grey(&pixels);
        let spans: Vec<u32> = found.cutouts.iter().map(|c| c.aoi.width).collect();
        assert!(spans.len() == 1 && spans[0] as usize > SIDE / 2, "margin {margin}: {spans:?}");
    }
}

#[test]
fn a_piece_that_the_frame_cuts_is_named() {
    let outlines: Vec<_> = [(230.0, 240.0), (650.0, 220.0), (240.0, 660.0), (880.0, 650.0)]
        .into_iter()
        .enumerate()
        .map(|(k, (x, y))| Piece::random(SIZE, 10 + k as u64).outline(&pose(0.3, 1.0, x, y)))
        .collect();
    let camera = Camera { width: SIDE, height: SIDE, noise: 3.0, ..Camera::default() };
    let found = grey(&camera.picture(&outlines));
    assert_eq!(found.cutouts.len(), 3);
    assert_eq!(found.rejected.iter().map(|r| r.reason).collect::<Vec<_>>(), [Reason::CutByFrame]);
}

/// A frame of four pieces two of which are `gap` pixels apart: the tab of the left one points at the flat side of the right one.
fn touching(gap: f64) -> (Segmentation, Vec<Neck>) {
    let usual = Piece::usual(SIZE);
    let mut left = Piece { sides: [None; 4], ..usual.clone() };
    left.sides[1] = usual.sides[0];
    let right = Piece { sides: [usual.sides[0], usual.sides[1], None, None], ..usual.clone() };
    let tab = left.sides[1].unwrap().1;
    let reach = SIZE + tab.height + tab.head + gap;
    let single = Piece::random(SIZE, 3);
    let lying = [
        (&left, pose(0.0, 1.0, 200.0, 250.0)),
        (&right, pose(0.0, 1.0, 200.0 + reach, 250.0)),
        (&single, pose(0.4, 1.0, 230.0, 680.0)),
        (&single, pose(1.4, 1.0, 640.0, 680.0)),
    ];
    let outlines: Vec<_> = lying.iter().map(|(piece, pose)| piece.outline(pose)).collect();
    let camera = Camera { width: SIDE, height: SIDE, noise: 3.0, ..Camera::default() };
    (grey(&camera.picture(&outlines)), lying.iter().flat_map(|(piece, pose)| piece.necks(pose)).collect())
}

#[test]
fn two_pieces_that_barely_touch_are_cut_apart() {
    for (gap, separated) in [(40.0, 0), (0.0, 1), (-0.5, 1)] {
        let (found, necks) = touching(gap);
        check(&found, &necks, &format!("gap {gap}"));
        assert_eq!((found.separated.len(), found.rejected.len()), (separated, 0), "gap {gap}: {:?}", found.rejected);
    }
}

#[test]
fn two_pieces_that_overlap_are_named() {
    for gap in [-3.0, -8.0] {
        let (found, _) = touching(gap);
        assert_eq!(found.cutouts.len(), 2, "gap {gap}");
        assert_eq!(found.rejected.iter().map(|r| r.reason).collect::<Vec<_>>(), [Reason::Touching], "gap {gap}");
        assert_eq!(found.separated, []);
    }
}

/// Pieces of many sizes, one with a waist between two lobes of the size of the smaller ones: it is whole, as the other large ones are. Beside smaller ones alone it
/// may be two that touch.
#[test]
fn a_waist_is_no_contact_where_pieces_are_of_many_sizes() {
    const SMALL: f64 = 110.0;
    const LARGE: f64 = 180.0;
    let usual = Piece::usual(SMALL);
    let lobe = |facing: usize| {
        let mut lobe = Piece { sides: [None; 4], ..usual.clone() };
        lobe.sides[facing] = usual.sides[0];
        lobe
    };
    let smaller = (0..4u64).map(|k| (Piece::random(SMALL, 20 + k), (110.0, 120.0 + 200.0 * k as f64)));
    let larger = [(Piece::random(LARGE, 30), (730.0, 220.0)), (Piece::random(LARGE, 31), (720.0, 660.0))];
    let waist = [(lobe(1), (330.0, 450.0)), (lobe(3), (330.0 + 1.18 * SMALL, 450.0))];
    for (has_larger, reasons) in [(true, vec![]), (false, vec![Reason::Touching])] {
        let pieces = smaller.clone().chain(waist.clone()).chain(larger.clone().into_iter().filter(|_| has_larger));
        let outlines: Vec<_> = pieces.map(|(piece, (x, y))| piece.outline(&pose(0.0, 1.0, x, y))).collect();
        let camera = Camera { width: SIDE, height: SIDE, noise: 3.0, ..Camera::default() };
        let found = grey(&camera.picture(&outlines));
        assert_eq!(found.rejected.iter().map(|r| r.reason).collect::<Vec<_>>(), reasons, "{has_larger}");
        assert_eq!(found.cutouts.len(), if has_larger { 7 } else { 4 });
    }
}

/// The edge of a sheet along the frame's edge, longer than any piece and thin: no piece is lost there.
#[test]
fn the_edge_of_a_sheet_is_no_piece_that_the_frame_cuts() {
    let (mut pixels, necks) = scene(Camera { noise: 3.0, ..Camera::default() });
    for row in pixels.chunks_exact_mut(SIDE) {
        row[SIDE - 14..].fill(50);
    }
    let found = grey(&pixels);
    check(&found, &necks, "sheet");
    assert_eq!(found.rejected.iter().map(|r| r.reason).collect::<Vec<_>>(), [Reason::Thread]);
}
