//! The tightest passages of a floor map: on an occupancy grid, where is a robot of a given width stuck, and where does it just pass?
//!
//! `cargo run --release -p isthmus-shapes --example floor_map [WIDTH_IN_METRES [FILE.png]]`

use image::{Rgb, RgbImage};
use isthmus::isthmus::Polarity;
use isthmus::mask::{Frame, Parameters, segment};
use isthmus::{Extractor, Point};

/// Size of a cell of the grid, in metres.
const CELL: f64 = 0.05;
const COLUMNS: u32 = 300;
const ROWS: u32 = 200;
/// Free space: rooms and doors as [left, top, right, bottom] in cells.
const FREE: [[u32; 4]; 9] = [
    [20, 20, 110, 90],
    [130, 20, 280, 80],
    [20, 110, 280, 140],
    [20, 155, 90, 185],
    [110, 155, 280, 185],
    [60, 90, 78, 110],
    [200, 80, 209, 110],
    [50, 140, 72, 155],
    [240, 140, 254, 155],
];
/// Pixels for a cell in the picture.
const ZOOM: u32 = 4;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let robot: f64 = std::env::args().nth(1).map_or(Ok(0.6), |a| a.parse())?;
    let file = std::env::args().nth(2).unwrap_or_else(|| "floor_map.png".into());
    // As map servers have it: free space bright, walls dark.
    let is_free = |x: u32, y: u32| FREE.iter().any(|[l, t, r, b]| (*l..*r).contains(&x) && (*t..*b).contains(&y));
    let grid: Vec<u8> = (0..COLUMNS * ROWS).map(|k| if is_free(k % COLUMNS, k / COLUMNS) { 254 } else { 0 }).collect();
    let mut picture = RgbImage::from_fn(COLUMNS * ZOOM, ROWS * ZOOM, |x, y| {
        Rgb([if is_free(x / ZOOM, y / ZOOM) { 235 } else { 60 }; 3])
    });
    let mut extractor = Extractor::default();
    for cutout in segment(&Frame::grey(COLUMNS, ROWS, &grid)?, &Parameters::default()).cutouts {
        let features = extractor.extract(&cutout)?;
        for pair in features.endoskeleton.branches.iter().flat_map(|branch| branch.windows(2)) {
            line(&mut picture, [pair[0].point, pair[1].point], 0, Rgb([86, 140, 230]));
        }
        for passage in features.isthmuses.iter().filter(|i| i.polarity == Polarity::Positive) {
            let metres = passage.width * CELL;
            let passes = metres > robot;
            let (x, y) = (passage.point.x * CELL, passage.point.y * CELL);
            println!(
                "{metres:.2} m wide at ({x:.2} m, {y:.2} m): a robot of {robot} m {}",
                if passes { "passes" } else { "is stuck" }
            );
            let colour = if passes { Rgb([0, 114, 178]) } else { Rgb([213, 94, 0]) };
            line(&mut picture, passage.critical_points, 1, colour);
        }
    }
    picture.save(&file)?;
    println!("{file}");
    Ok(())
}

/// Draws a straight line.
fn line(picture: &mut RgbImage, [p, q]: [Point; 2], reach: i64, colour: Rgb<u8>) {
    let steps = (f64::from(ZOOM) * (q - p).norm()).ceil().max(1.0);
    for k in 0..=steps as u32 {
        mark(picture, p + (q - p) * (f64::from(k) / steps), reach, colour);
    }
}

/// Colours the square of picture pixels about a point of the grid.
fn mark(picture: &mut RgbImage, at: Point, reach: i64, colour: Rgb<u8>) {
    let zoomed = |v: f64| ((v + 0.5) * f64::from(ZOOM)) as i64;
    for dy in -reach..=reach {
        for dx in -reach..=reach {
            let (x, y) = (zoomed(at.x) + dx, zoomed(at.y) + dy);
            if (0..i64::from(picture.width())).contains(&x) && (0..i64::from(picture.height())).contains(&y) {
                picture.put_pixel(x as u32, y as u32, colour);
            }
        }
    }
}
