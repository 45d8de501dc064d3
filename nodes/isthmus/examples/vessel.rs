//! The narrowest places (stenoses) of a vessel silhouette: draws a branching vessel, finds its necks and writes a picture.
//!
//! `cargo run --release -p isthmus-shapes --example vessel [FILE.png]`

mod drawing;

use drawing::line;
use image::{Rgb, RgbImage};
use isthmus::isthmus::Polarity;
use isthmus::mask::{Frame, Parameters, segment};
use isthmus::{Extractor, Point};

const WIDTH: u32 = 700;
const HEIGHT: u32 = 420;
/// Vessels: points of their axes with the radius there, in pixels. Two of them narrow on the way.
const VESSELS: [&[[f64; 3]]; 3] = [
    &[[60.0, 210.0, 34.0], [180.0, 200.0, 32.0], [230.0, 195.0, 17.0], [290.0, 190.0, 31.0], [380.0, 200.0, 30.0]],
    &[[380.0, 200.0, 28.0], [460.0, 140.0, 23.0], [520.0, 110.0, 9.0], [570.0, 95.0, 20.0], [640.0, 80.0, 18.0]],
    &[[380.0, 200.0, 28.0], [470.0, 270.0, 22.0], [560.0, 310.0, 20.0], [640.0, 330.0, 18.0]],
];

fn inside(p: Point) -> bool {
    VESSELS.iter().flat_map(|v| v.windows(2)).any(|w| {
        let (a, b) = (Point::new(w[0][0], w[0][1]), Point::new(w[1][0], w[1][1]));
        let along = ((p - a).dot(&(b - a)) / (b - a).norm_squared()).clamp(0.0, 1.0);
        // Smooth between the radii, as vessels are.
        let eased = along * along * (3.0 - 2.0 * along);
        (p - (a + (b - a) * along)).norm() < w[0][2] + (w[1][2] - w[0][2]) * eased
    })
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let file = std::env::args().nth(1).unwrap_or_else(|| "vessel.png".into());
    let grey: Vec<u8> = (0..WIDTH * HEIGHT)
        .map(|k| {
            // Sixteen samples a pixel make the grey levels of the edge.
            let (x, y) = (f64::from(k % WIDTH), f64::from(k / WIDTH));
            let at = |s: u32| Point::new(x + f64::from(s % 4) / 4.0 - 0.375, y + f64::from(s / 4) / 4.0 - 0.375);
            let covered = (0..16).filter(|&s| inside(at(s))).count();
            (225 - 11 * covered) as u8
        })
        .collect();
    let mut picture = RgbImage::from_fn(WIDTH, HEIGHT, |x, y| Rgb([grey[(y * WIDTH + x) as usize]; 3]));
    let mut extractor = Extractor::default();
    for cutout in segment(&Frame::grey(WIDTH, HEIGHT, &grey)?, &Parameters::default()).cutouts {
        let features = extractor.extract(&cutout)?;
        for pair in features.endoskeleton.branches.iter().flat_map(|branch| branch.windows(2)) {
            line(&mut picture, [pair[0].point, pair[1].point], 0, Rgb([90, 160, 255]));
        }
        for neck in features.isthmuses.iter().filter(|i| i.polarity == Polarity::Positive) {
            println!(
                "{:5.1} px wide at ({:.1}, {:.1}), widens by {:.1} px",
                neck.width, neck.point.x, neck.point.y, neck.persistence
            );
            line(&mut picture, neck.critical_points, 1, Rgb([255, 140, 0]));
        }
    }
    picture.save(&file)?;
    println!("{file}");
    Ok(())
}
