//! The tightest passages of a floor map: on an occupancy grid, where is a robot of a given width stuck, and where does it just pass?
//!
//! `cargo run --release -p isthmus-shapes --example floor_map [WIDTH_IN_METRES [FILE.png]]`

mod drawing;

use drawing::line;
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

/// The middle of a cell, or a place between cells, in the picture.
fn zoomed(p: Point) -> Point {
    Point::from(p.coords.map(|v| (v + 0.5) * f64::from(ZOOM) - 0.5))
}

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
            line(&mut picture, [pair[0].point, pair[1].point].map(zoomed), 0, Rgb([86, 140, 230]));
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
            line(&mut picture, passage.critical_points.map(zoomed), 1, colour);
        }
    }
    picture.save(&file)?;
    println!("{file}");
    Ok(())
}
