//! Analytic shapes with known necks, and their pictures.

#![allow(dead_code, unreachable_pub, reason = "a module of several test programs, each of which uses a part")]

use isthmus::Point;
use isthmus::isthmus::Polarity;
use isthmus::mask::{Aoi, Cutout};
use nalgebra::{Similarity2, Vector2};
use rand::{RngExt, SeedableRng, rngs::StdRng};

/// A tab: a disc of radius `head` on two banks, each an arc of radius `fillet` from the side of the body to the neck and one of radius
/// `flare` on from there to the disc. All in pixels.
#[derive(Debug, Clone, Copy)]
pub struct Tab {
    pub head: f64,
    pub fillet: f64,
    /// Where it differs from `fillet`, the banks' curvature jumps at the neck.
    pub flare: f64,
    /// Height of the head's centre over the side.
    pub height: f64,
    /// Shift along the side, from its middle.
    pub shift: f64,
}

impl Tab {
    /// Half the width of the neck.
    fn half_neck(self) -> f64 {
        ((self.head + self.flare).powi(2) - (self.height - self.fillet).powi(2)).sqrt() - self.flare
    }

    pub fn neck(self) -> f64 {
        2.0 * self.half_neck()
    }

    /// Outline from left to right over a side along x, outwards being -y; dense.
    fn outline(self) -> Vec<Vector2<f64>> {
        let centre = |radius: f64| Vector2::new(-self.half_neck() - radius, -self.fillet);
        let (below, above, head) = (centre(self.fillet), centre(self.flare), Vector2::new(0.0, -self.height));
        let joint = (head - above).y.atan2((head - above).x);
        let arc = |centre: Vector2<f64>, radius: f64, from: f64, to: f64| {
            let n = ((to - from).abs() * radius / STEP).ceil() as usize;
            (0..n).map(move |i| {
                let a = from + (to - from) * i as f64 / n as f64;
                centre + Vector2::new(a.cos(), a.sin()) * radius
            })
        };
        let quarter = std::f64::consts::FRAC_PI_2;
        let bank: Vec<_> = arc(below, self.fillet, quarter, 0.0).chain(arc(above, self.flare, 0.0, joint)).collect();
        let start = joint + std::f64::consts::PI;
        let mut points = bank.clone();
        points.extend(arc(head, self.head, start, 3.0 * std::f64::consts::PI - start));
        points.extend(bank.iter().rev().map(|p| Vector2::new(-p.x, p.y)));
        points.iter().map(|p| p + Vector2::new(self.shift, 0.0)).collect()
    }

    fn neck_ends(self) -> [Vector2<f64>; 2] {
        [-0.5, 0.5].map(|s| Vector2::new(self.shift + s * self.neck(), -self.fillet))
    }
}

/// Distance between points of an outline, in pixels: its polygon is 1e-4 px from the curve at most.
const STEP: f64 = 0.1;

/// A square body whose sides (top, right, bottom, left) are flat or carry a tab or a blank.
#[derive(Debug, Clone)]
pub struct Piece {
    pub size: f64,
    pub sides: [Option<(Polarity, Tab)>; 4],
}

/// A neck that is known.
#[derive(Debug, Clone, Copy)]
pub struct Neck {
    pub polarity: Polarity,
    pub ends: [Point; 2],
}

impl Neck {
    pub fn middle(&self) -> Point {
        nalgebra::center(&self.ends[0], &self.ends[1])
    }

    pub fn width(&self) -> f64 {
        (self.ends[1] - self.ends[0]).norm()
    }
}

impl Piece {
    /// A piece of usual proportions with tabs of different sizes.
    pub fn usual(size: f64) -> Self {
        let tab = |k: f64, shift: f64| Tab {
            head: 0.115 * size * k,
            fillet: 0.035 * size,
            flare: 0.035 * size,
            height: 0.15 * size * k,
            shift: shift * size,
        };
        Self {
            size,
            sides: [
                Some((Polarity::Positive, tab(1.0, 0.03))),
                Some((Polarity::Negative, tab(0.9, -0.05))),
                Some((Polarity::Positive, tab(1.05, 0.0))),
                Some((Polarity::Negative, tab(1.1, 0.02))),
            ],
        }
    }

    /// A piece with random tabs, blanks and flat sides.
    pub fn random(size: f64, seed: u64) -> Self {
        let mut rng = StdRng::seed_from_u64(seed);
        let sides = std::array::from_fn(|_| {
            let k = rng.random_range(0.85..1.1);
            let fillet = rng.random_range(0.025..0.05) * size;
            let tab = Tab {
                head: 0.115 * size * k,
                fillet,
                flare: fillet,
                height: 0.15 * size * k,
                shift: rng.random_range(-0.06..0.06) * size,
            };
            match rng.random_range(0..5) {
                0 => None,
                1 | 2 => Some((Polarity::Positive, tab)),
                _ => Some((Polarity::Negative, tab)),
            }
        });
        Self { size, sides }
    }

    /// The piece with banks that change their curvature at the neck: `ratio` is that of the radii above and below it.
    pub fn with_flare(mut self, ratio: f64) -> Self {
        for (_, tab) in self.sides.iter_mut().flatten() {
            tab.flare = ratio * tab.fillet;
        }
        self
    }

    fn frames(&self) -> impl Iterator<Item = (usize, impl Fn(Vector2<f64>) -> Point + use<>)> {
        let half = self.size / 2.0;
        (0..4).map(move |k| {
            let turn = nalgebra::Rotation2::new(std::f64::consts::FRAC_PI_2 * k as f64);
            (k, move |v: Vector2<f64>| Point::from(turn * (v - Vector2::new(0.0, half))))
        })
    }

    /// Outline, clockwise on a screen, about its centre.
    pub fn outline(&self, image_from_piece: &Similarity2<f64>) -> Vec<Point> {
        let half = self.size / 2.0;
        let mut points = Vec::new();
        for (k, place) in self.frames() {
            points.push(place(Vector2::new(-half, 0.0)));
            if let Some((polarity, tab)) = self.sides[k] {
                let sign = if polarity == Polarity::Positive { 1.0 } else { -1.0 };
                points.extend(tab.outline().into_iter().map(|v| place(Vector2::new(v.x, sign * v.y))));
            }
        }
        points.iter().map(|p| image_from_piece * p).collect()
    }

    pub fn necks(&self, image_from_piece: &Similarity2<f64>) -> Vec<Neck> {
        let mut necks = Vec::new();
        for (k, place) in self.frames() {
            if let Some((polarity, tab)) = self.sides[k] {
                let sign = if polarity == Polarity::Positive { 1.0 } else { -1.0 };
                let ends = tab.neck_ends().map(|v| image_from_piece * place(Vector2::new(v.x, sign * v.y)));
                necks.push(Neck { polarity, ends });
            }
        }
        necks
    }
}

/// How a picture is taken.
#[derive(Debug, Clone, Copy)]
pub struct Camera {
    pub width: usize,
    pub height: usize,
    pub shape_level: f64,
    pub ground_level: f64,
    /// Standard deviation of the blur, in pixels.
    pub blur: f64,
    /// Standard deviation of the grey levels.
    pub noise: f64,
    /// Part of the light that is lost in the corners.
    pub vignette: f64,
    pub seed: u64,
}

impl Default for Camera {
    fn default() -> Self {
        Self {
            width: 512,
            height: 512,
            shape_level: 40.0,
            ground_level: 215.0,
            blur: 0.8,
            noise: 0.0,
            vignette: 0.0,
            seed: 1,
        }
    }
}

impl Camera {
    /// Picture of outlines: exact pixel coverage along rows (8 lines a pixel), blur, light, noise, 8 bits.
    pub fn picture(&self, outlines: &[Vec<Point>]) -> Vec<u8> {
        let mut coverage = vec![0.0f64; self.width * self.height];
        for outline in outlines {
            self.cover(outline, &mut coverage);
        }
        blur(&mut coverage, self.width, self.height, self.blur);
        let mut rng = StdRng::seed_from_u64(self.seed);
        let (cx, cy) = (self.width as f64 / 2.0, self.height as f64 / 2.0);
        coverage
            .iter()
            .enumerate()
            .map(|(k, c)| {
                let (x, y) = ((k % self.width) as f64 - cx, (k / self.width) as f64 - cy);
                let light = 1.0 - self.vignette * (x * x + y * y) / (cx * cx + cy * cy);
                let level = (self.ground_level + (self.shape_level - self.ground_level) * c) * light;
                (level + self.noise * normal(&mut rng)).round().clamp(0.0, 255.0) as u8
            })
            .collect()
    }

    fn cover(&self, outline: &[Point], coverage: &mut [f64]) {
        const LINES: usize = 8;
        let mut crossings: Vec<Vec<f64>> = vec![Vec::new(); self.height * LINES];
        for (p, q) in outline.iter().zip(outline.iter().cycle().skip(1)) {
            // Line k lies at y = (k + 0.5) / LINES - 0.5.
            let line = |y: f64| (y + 0.5) * LINES as f64 - 0.5;
            let (low, high) = if p.y < q.y { (p, q) } else { (q, p) };
            let first = line(low.y).ceil().max(0.0) as usize;
            let end = line(high.y).ceil().clamp(0.0, (self.height * LINES) as f64) as usize;
            for (k, crossings) in crossings.iter_mut().enumerate().take(end).skip(first) {
                let y = (k as f64 + 0.5) / LINES as f64 - 0.5;
                crossings.push(p.x + (y - p.y) / (q.y - p.y) * (q.x - p.x));
            }
        }
        for (k, crossings) in crossings.iter_mut().enumerate() {
            crossings.sort_by(f64::total_cmp);
            let row = &mut coverage[k / LINES * self.width..][..self.width];
            for span in crossings.chunks_exact(2) {
                let (from, to) = ((span[0] + 0.5).max(0.0), (span[1] + 0.5).min(self.width as f64));
                let mut x = from;
                while x < to {
                    let end = (x.floor() + 1.0).min(to);
                    row[x as usize] += (end - x) / LINES as f64;
                    x = end;
                }
            }
        }
    }

    /// The picture as a cutout of one shape that fills it.
    pub fn cutout(&self, outline: &[Point]) -> Cutout {
        let window = Aoi { x: 0, y: 0, width: self.width as u32, height: self.height as u32 };
        Cutout {
            aoi: window,
            window,
            pixels: self.picture(std::slice::from_ref(&outline.to_vec())),
            shape_level: self.shape_level as f32,
            ground_level: self.ground_level as f32,
            noise_level: self.noise as f32,
        }
    }
}

/// Gaussian blur (clamped rim).
pub fn blur(values: &mut [f64], width: usize, height: usize, sigma: f64) {
    if sigma <= 0.0 {
        return;
    }
    let reach = (4.0 * sigma).ceil() as isize;
    let kernel: Vec<f64> = (-reach..=reach).map(|i| (-(i * i) as f64 / (2.0 * sigma * sigma)).exp()).collect();
    let total: f64 = kernel.iter().sum();
    let pass = |values: &mut [f64], count: usize, stride: usize, lines: usize, line_stride: usize| {
        let mut line = vec![0.0; count];
        for l in 0..lines {
            for (i, v) in line.iter_mut().enumerate() {
                *v = values[l * line_stride + i * stride];
            }
            for i in 0..count {
                let sum: f64 = kernel
                    .iter()
                    .zip(-reach..)
                    .map(|(k, j)| k * line[(i as isize + j).clamp(0, count as isize - 1) as usize])
                    .sum();
                values[l * line_stride + i * stride] = sum / total;
            }
        }
    };
    pass(values, width, 1, height, width);
    pass(values, height, width, width, 1);
}

/// A normally distributed number (Box and Muller).
pub fn normal(rng: &mut impl RngExt) -> f64 {
    let (u, v): (f64, f64) = (rng.random_range(f64::MIN_POSITIVE..1.0), rng.random_range(0.0..1.0));
    (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * v).cos()
}

/// A similarity: turn, scale, shift.
pub fn pose(angle: f64, scale: f64, x: f64, y: f64) -> Similarity2<f64> {
    Similarity2::new(Vector2::new(x, y), angle, scale)
}
