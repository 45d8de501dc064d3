//! Sub-pixel border of a shape.
//!
//! # Method
//! 1. *Iso-contour* of the grey picture half-way between the levels of shape and ground, by marching squares (W. E. Lorensen,
//!    H. E. Cline, *Marching cubes*, SIGGRAPH 1987, in the plane), the levels between pixels running as across a blurred edge. A
//!    diagonal cell joins the shape where its mean lies on the shape's side (G. M. Nielson, B. Hamann, *The asymptotic
//!    decider*, Visualization 1991). Of all closed contours the longest outer one is taken.
//! 2. A picture that is too noisy or too sharp (one-bit, without grey levels at the edge) for its contour to be trusted is
//!    blurred first, near the contour: just enough, as the measured noise and edge blur ask for. What the pixel grid has done to
//!    sharp edges along it by then is known, and taken off (`iso`).
//! 3. *Resampling* at equal steps of about one pixel of arc length.
//! 4. *Restoration*: blur rounds a border, its curves move towards their centres. One linear filter along the border undoes the
//!    measured blur as far as the measured noise allows (`restore`).
//!
//! The blur is measured across the edge, all along the border; the noise on the border itself: by the fourth difference of its
//! points across the border, a filter that curves of the shape do not pass (median absolute deviation, so that corners do not count).
//!
//! # Cost
//! One pass over the cutout to find the contours, then linear in the length of the border.
//!
//! # Failure
//! [`ContourError`]: no contrast, nothing at the level, a border too short or too long to be a shape.
//!
//! ```
//! use isthmus::{Point, contour::Border};
//! let square = [(0.0, 0.0), (40.0, 0.0), (40.0, 40.0), (0.0, 40.0)].map(|(x, y)| Point::new(x, y));
//! let border = Border::from_points(&square)?;
//! assert_eq!(border.points.len(), 160);
//! assert!((border.area() - 1600.0).abs() < 1e-9);
//! # Ok::<(), isthmus::contour::ContourError>(())
//! ```

mod band;
mod iso;
mod restore;

use crate::Point;
use crate::cutout::Cutout;
use band::{Band, Blurred, Raw};
use iso::{Contours, Raster, Start, aliasing};
use nalgebra::Vector2;
use restore::{Filter, History, edge_blur, noise_power};

/// A closed border: the last point joins the first. Points are equally spaced along it and run so that the shoelace
/// area in (x right, y down) is positive: clockwise as seen on a screen, the outward normal being `(dy, -dx)`.
#[derive(Debug, Clone, PartialEq)]
pub struct Border {
    /// Points in the source frame.
    pub points: Vec<Point>,
    /// Arc length between consecutive points, in pixels.
    pub spacing: f64,
}

/// Why there is no border.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ContourError {
    /// The cutout's pixel count is not that of its window.
    #[error("cutout holds {pixels} pixels: its window of {width} x {height} needs width * height of them")]
    PixelCount {
        /// Pixels there are.
        pixels: usize,
        /// Columns of the window.
        width: u32,
        /// Rows of the window.
        height: u32,
    },
    /// The levels of shape and ground are (nearly) the same, or not numbers.
    #[error("shape level {shape_level} and ground level {ground_level} must differ by at least {MIN_CONTRAST}")]
    Contrast {
        /// Grey level of the shape.
        shape_level: f32,
        /// Grey level of the ground.
        ground_level: f32,
    },
    /// No closed contour of the shape at the level between shape and ground.
    #[error("no closed contour at grey level {level}")]
    Nothing {
        /// The level.
        level: f32,
    },
    /// A coordinate is not a finite number of at most [`MAX_COORDINATE`].
    #[error("point {index} of the outline is ({x}, {y}): coordinates must be finite and at most {MAX_COORDINATE:e}")]
    Coordinate {
        /// Index of the point.
        index: usize,
        /// Its x.
        x: f64,
        /// Its y.
        y: f64,
    },
    /// The spacing is not positive and finite.
    #[error("spacing {spacing} must be positive and finite")]
    Spacing {
        /// The spacing.
        spacing: f64,
    },
    /// The border is too short for its spacing to be a shape.
    #[error("border of {length} px must be at least {MIN_POINTS} times its spacing of {spacing} px")]
    TooShort {
        /// Length of the border in pixels.
        length: f64,
        /// Spacing of its points in pixels.
        spacing: f64,
    },
    /// The border needs too many points.
    #[error("border of {length} px at a spacing of {spacing} px needs more than {MAX_POINTS} points")]
    TooLong {
        /// Length of the border in pixels.
        length: f64,
        /// Spacing of its points in pixels.
        spacing: f64,
    },
    /// The border encloses nothing.
    #[error("border encloses an area of {area} px²: it must be at least {minimum}")]
    NoArea {
        /// Enclosed area.
        area: f64,
        /// The least area a shape may have.
        minimum: f64,
    },
}

/// Least difference of shape and ground level: less is lost in the quantisation of 8-bit grey levels.
pub const MIN_CONTRAST: f32 = 4.0;
/// Least number of border points: a disc of 5 px across has 16, and nothing smaller has a measurable shape.
pub const MIN_POINTS: usize = 16;
/// Most border points: bounds memory (16 bytes each, and about 20 times that for the triangulation).
pub const MAX_POINTS: usize = 1 << 24;
/// Largest coordinate of an outline given directly, in pixels: beyond it the triangulation's predicates lose precision.
pub const MAX_COORDINATE: f64 = 1e8;

/// Spacing of the border's points in pixels: the resolution of the picture, no more, no less.
const SPACING: f64 = 1.0;
/// Least step of the fourth difference that measures the noise, in points: neighbours share grey levels, every other one
/// hardly does.
const NOISE_STEP: usize = 2;
/// Median absolute deviation of a normal distribution of standard deviation 1.
const NORMAL_MAD: f64 = 0.674_489_750_196_081_7;
/// Radius of the tightest curves worth keeping, as a part of the square root of the shape's area: the fillets of a
/// puzzle piece's tab are about 4 % of its size.
const TIGHTEST_CURVE: f64 = 0.04;
/// Most optical blur that is undone, as a part of the radius of the tightest curves: more has destroyed them.
const MAX_UNDONE: f64 = 0.6;
/// Edges narrower than this (standard deviation of the edge's blur, in pixels) alias: linear interpolation errs.
const MIN_EDGE_BLUR: f64 = 0.6;
/// What the edges of an aliased picture are widened to, in pixels.
const EDGE_BLUR: f64 = 1.0;
/// Most noise at which the contour is traced as it is, as a part of the contrast: at half the contrast being eight
/// standard deviations away, no pixel is on the wrong side by chance and few near the edge are.
const MAX_NOISE: f64 = 1.0 / 16.0;
/// Most that noise may move the contour's points, in pixels (standard deviation): beyond, the contour turns back on itself.
const MAX_WOBBLE: f64 = 0.12;
/// Most blur against noise, in pixels: more would join parts of the border.
const MAX_BLUR: f64 = 3.0;
/// From this much blur on, in pixels, a picture of half the resolution shows all there is.
const HALVING_BLUR: f64 = 2.0;

impl Border {
    /// Border from an outline given as the corners of a closed polygon (either sense), resampled at about 1 px.
    ///
    /// # Errors
    /// [`ContourError`] where a coordinate is not finite, or the outline too short, too long or without area.
    pub fn from_points(outline: &[Point]) -> Result<Self, ContourError> {
        Self::from_points_spaced(outline, SPACING)
    }

    /// As [`Border::from_points`], resampled at about `spacing` pixels (so that the border has a whole number of steps).
    ///
    /// # Errors
    /// [`ContourError`] where a coordinate or the spacing is not finite, or the outline too short, too long or
    /// without area.
    pub fn from_points_spaced(outline: &[Point], spacing: f64) -> Result<Self, ContourError> {
        if !(spacing.is_finite() && spacing > 0.0) {
            return Err(ContourError::Spacing { spacing });
        }
        if let Some((index, p)) =
            outline.iter().enumerate().find(|(_, p)| !(p.x.abs() <= MAX_COORDINATE && p.y.abs() <= MAX_COORDINATE))
        {
            return Err(ContourError::Coordinate { index, x: p.x, y: p.y });
        }
        let mut border = Self { points: Vec::new(), spacing };
        border.resample(outline)?;
        Ok(border)
    }

    /// Traces the border of a cutout; also gives the standard deviation of its points across the border, in pixels.
    /// [`crate::Extractor`] does the same and keeps the buffers.
    ///
    /// # Errors
    /// [`ContourError`] where the cutout is inconsistent, has no contrast or shows no shape.
    pub fn from_cutout(cutout: &Cutout) -> Result<(Self, f64), ContourError> {
        Tracer::default().trace(cutout)
    }

    /// Length of the border in pixels.
    #[must_use]
    pub fn length(&self) -> f64 {
        self.points.len() as f64 * self.spacing
    }

    /// The point at an arc length from the first point (any value, wrapped), on the polygon of the points.
    #[must_use]
    pub fn point_at(&self, arc: f64) -> Point {
        let (i, j, t) = self.locate(arc);
        self.points[i] + (self.points[j] - self.points[i]) * t
    }

    /// Arc length from `from` forward to `to`, in `0..length` (wraps round).
    #[must_use]
    pub fn forward(&self, from: f64, to: f64) -> f64 {
        (to - from).rem_euclid(self.length())
    }

    /// `count` equally spaced points from `arc[0] - extension` forward to `arc[1] + extension`, ends included.
    #[must_use]
    pub fn sample(&self, arc: [f64; 2], extension: f64, count: usize) -> Vec<Point> {
        let path = self.forward(arc[0], arc[1]) + 2.0 * extension;
        let step = if count > 1 { path / (count - 1) as f64 } else { 0.0 };
        (0..count).map(|i| self.point_at(arc[0] - extension + i as f64 * step)).collect()
    }

    /// Enclosed area in square pixels; positive, since the border runs clockwise as seen on a screen.
    #[must_use]
    pub fn area(&self) -> f64 {
        shoelace(&self.points)
    }

    /// Centroid of the enclosed area.
    #[must_use]
    pub fn centroid(&self) -> Point {
        let Some(&origin) = self.points.first() else { return Point::origin() };
        let (mut sum, mut twice_area) = (Vector2::zeros(), 0.0);
        for (p, q) in edges(&self.points) {
            let (a, b) = (p - origin, q - origin);
            let cross = a.perp(&b);
            sum += (a + b) * cross;
            twice_area += cross;
        }
        if twice_area == 0.0 { origin } else { origin + sum / (3.0 * twice_area) }
    }

    /// Smallest and largest coordinates of the points; `None` without points.
    #[must_use]
    pub fn bounds(&self) -> Option<[Point; 2]> {
        let first = *self.points.first()?;
        Some(self.points.iter().fold([first; 2], |[low, high], p| [low.inf(p), high.sup(p)]))
    }

    /// Whether a point lies inside (even-odd rule); linear in the number of points.
    #[must_use]
    pub fn contains(&self, point: Point) -> bool {
        let crossing = |p: &Point, q: &Point| {
            (p.y > point.y) != (q.y > point.y) && point.x < p.x + (point.y - p.y) / (q.y - p.y) * (q.x - p.x)
        };
        edges(&self.points).filter(|(p, q)| crossing(p, q)).count() % 2 == 1
    }

    /// Index of the point before an arc length, the one after, and how far between them.
    fn locate(&self, arc: f64) -> (usize, usize, f64) {
        let n = self.points.len();
        let position = arc / self.spacing;
        let within = (0.0..n as f64).contains(&position);
        let position = if within { position } else { position.rem_euclid(n as f64) };
        let i = (position as usize).min(n - 1);
        (i, if i + 1 == n { 0 } else { i + 1 }, position - i as f64)
    }

    /// Fills the border with equally spaced points of a closed polygon, about `self.spacing` apart.
    fn resample(&mut self, polygon: &[Point]) -> Result<(), ContourError> {
        self.resample_by(polygon, |i, t| {
            let next = if i + 1 == polygon.len() { polygon[0] } else { polygon[i + 1] };
            polygon[i] + (next - polygon[i]) * t
        })
    }

    /// Fills the border with equally spaced points, about `self.spacing` apart, of a curve through (almost) equally spaced
    /// points: between two of them lies the cubic of E. Catmull and R. Rom, 1974.
    fn resample_curve(&mut self, points: &[Point]) -> Result<(), ContourError> {
        let n = points.len();
        self.resample_by(points, |i, t| {
            let wrapped = |k: usize| points[if k < n { k } else { k - n }].coords;
            let [a, b, c, d] = [i + n - 1, i, i + 1, i + 2].map(wrapped);
            let (slope, next_slope) = ((c - a) * 0.5, (d - b) * 0.5);
            let (u, chord) = (1.0 - t, c - b);
            Point::from(b + chord * t + ((slope - chord) * u - (next_slope - chord) * t) * (t * u))
        })
    }

    /// Fills the border with equally spaced points, about `self.spacing` apart; `at` gives the point between two corners of a
    /// polygon, from the first one's index and how far between them.
    fn resample_by(&mut self, polygon: &[Point], at: impl Fn(usize, f64) -> Point) -> Result<(), ContourError> {
        let chords: Vec<f64> = edges(polygon).map(|(p, q)| (q - p).norm()).collect();
        let length: f64 = chords.iter().sum();
        let spacing = self.spacing;
        let count = (length / spacing).round();
        if count < MIN_POINTS as f64 {
            return Err(ContourError::TooShort { length, spacing });
        }
        if count > MAX_POINTS as f64 {
            return Err(ContourError::TooLong { length, spacing });
        }
        let count = count as usize;
        self.spacing = length / count as f64;
        self.points.clear();
        self.points.reserve(count);
        let mut start = 0.0;
        for (i, chord) in chords.iter().enumerate() {
            let end = start + chord;
            // The next sample's position is computed, not summed, so that long borders do not drift.
            let mut next = self.points.len() as f64 * self.spacing;
            while next < end && self.points.len() < count {
                self.points.push(at(i, (next - start) / (end - start)));
                next = self.points.len() as f64 * self.spacing;
            }
            start = end;
        }
        while self.points.len() < count {
            // Rounding can leave out the very last sample, which then is the end of the polygon.
            self.points.push(polygon[0]);
        }
        let area = shoelace(&self.points);
        if area < 0.0 {
            self.points.reverse();
        }
        let minimum = self.spacing * self.spacing;
        if area.abs() < minimum {
            return Err(ContourError::NoArea { area: area.abs(), minimum });
        }
        Ok(())
    }
}

/// The edges of a closed polygon.
fn edges(points: &[Point]) -> impl Iterator<Item = (&Point, &Point)> {
    points.windows(2).map(|pair| (&pair[0], &pair[1])).chain(points.last().zip(points.first()))
}

/// Signed area of a closed polygon: positive for one that runs clockwise as seen on a screen (y down).
fn shoelace(points: &[Point]) -> f64 {
    let Some(origin) = points.first() else { return 0.0 };
    edges(points).map(|(p, q)| (p - origin).perp(&(q - origin))).sum::<f64>() / 2.0
}

/// Blur of a contour's picture: standard deviations in pixels.
#[derive(Debug, Clone, Copy)]
struct Blur {
    /// That of the picture as it was taken.
    optical: f64,
    /// That which came after the noise, against it.
    late: f64,
}

/// Memory for pictures made from a cutout.
#[derive(Debug, Clone, Default)]
struct PixelBuffers {
    padded: Vec<u8>,
    halved: Vec<u8>,
}

/// Traces borders, keeping its buffers from one to the next.
#[derive(Debug, Clone, Default)]
pub struct Tracer {
    pixels: PixelBuffers,
    band: Band,
    starts: Vec<Start>,
    contours: Contours,
    filtered: Vec<Point>,
    filter: Filter,
    deviations: Vec<f64>,
}

impl Tracer {
    /// The border of a cutout, and the standard deviation of its points across the border, in pixels.
    ///
    /// # Errors
    /// [`ContourError`] where the cutout is inconsistent, has no contrast or shows no shape.
    pub fn trace(&mut self, cutout: &Cutout) -> Result<(Border, f64), ContourError> {
        let (width, height) = (cutout.window.width as usize, cutout.window.height as usize);
        let (shape_level, ground_level) = (cutout.shape_level, cutout.ground_level);
        if width.checked_mul(height) != Some(cutout.pixels.len()) {
            return Err(ContourError::PixelCount {
                pixels: cutout.pixels.len(),
                width: cutout.window.width,
                height: cutout.window.height,
            });
        }
        let contrast = (shape_level - ground_level).abs();
        if !(contrast >= MIN_CONTRAST && contrast.is_finite()) {
            return Err(ContourError::Contrast { shape_level, ground_level });
        }
        let level = (shape_level + ground_level) / 2.0;
        if cutout.pixels.is_empty() {
            return Err(ContourError::Nothing { level });
        }
        let mut buffers = std::mem::take(&mut self.pixels);
        let blur = self.trace_contour(cutout, level, &mut buffers);
        self.pixels = buffers;
        let Some(blur) = blur else { return Err(ContourError::Nothing { level }) };
        let mut border = Border { points: Vec::new(), spacing: SPACING };
        border.resample(&self.contours.longest)?;
        let noise = self.restore(&mut border, blur)?;
        Ok((border, noise))
    }

    /// Leaves the longest contour in `self.contours.longest`, in the source frame; gives the blur it has, `None` without a contour.
    fn trace_contour(&mut self, cutout: &Cutout, level: f32, buffers: &mut PixelBuffers) -> Option<Blur> {
        let contrast = (cutout.shape_level - cutout.ground_level).abs();
        let sense = if cutout.shape_level > cutout.ground_level { 1.0 } else { -1.0 };
        let margin = pad(cutout, level, &mut buffers.padded);
        let pixels = if margin == 0 { &cutout.pixels } else { &buffers.padded };
        let [width, height] = [cutout.window.width, cutout.window.height].map(|side| side as usize + 2 * margin);
        let full = Raw { pixels, width, height, step: 1.0 };
        let noise = f64::from(cutout.noise_level) / f64::from(contrast);
        // At half the resolution there is half the noise, and a quarter of the pixels.
        let is_noisy = noise > MAX_NOISE;
        let half = if is_noisy { Some(full.halved(&mut buffers.halved)) } else { None };

        let first = half.unwrap_or(full);
        first.starts(level, sense, &mut self.starts);
        if !self.contours.trace(&Raster { picture: first, level, contrast, sense, aliasing: 0.0 }, &self.starts) {
            return None;
        }
        let edge_blur_in = |raw: Raw<'_>, contour: &[Point], about: Option<f64>| {
            let own = edge_blur(contour, f64::from(contrast), about, |p| f64::from(sense) * raw.between(p)) * raw.step;
            (own * own - raw.variance()).max(0.0).sqrt()
        };
        let mut optical = edge_blur_in(first, &self.contours.longest, None);
        let late = needed_blur(optical, noise);
        if late > 0.0 {
            let second = half.filter(|_| late >= HALVING_BLUR).unwrap_or(full);
            let contour = self.contours.longest.iter().map(|p| second.own(first.in_full(*p)));
            self.band.mark(contour, [second.width, second.height]);
            let sigma = (late * late - second.variance()).sqrt() / second.step;
            self.band.blur(second, sigma, cutout.ground_level, (level, sense), &mut self.starts);
            let picture = Blurred { band: &self.band, raw: second };
            let aliasing = aliasing(optical / second.step, sigma);
            if !self.contours.trace(&Raster { picture, level, contrast, sense, aliasing }, &self.starts) {
                return None;
            }
            for p in &mut self.contours.longest {
                *p = second.in_full(*p);
            }
            optical = edge_blur_in(full, &self.contours.longest, Some(optical));
        }
        let offset =
            Vector2::new(f64::from(cutout.window.x) - margin as f64, f64::from(cutout.window.y) - margin as f64);
        for p in &mut self.contours.longest {
            *p += offset;
        }
        Some(Blur { optical, late })
    }

    /// Undoes blur and noise of a border; gives the standard deviation of its points that is left.
    fn restore(&mut self, border: &mut Border, Blur { optical, late }: Blur) -> Result<f64, ContourError> {
        let late_blur = late / border.spacing;
        let step = NOISE_STEP.max((2.0 * late_blur).round() as usize);
        let noise = noise_power(self.fourth_difference(border, step).powi(2), late_blur, step);
        let size = border.area().sqrt() / border.spacing;
        let radius = TIGHTEST_CURVE * size;
        let blur = (optical / border.spacing).min(MAX_UNDONE * radius).hypot(late_blur);
        let left = self.filter.design(History { blur, late_blur, radius }, noise);
        self.filter.apply(&border.points, &mut self.filtered);
        border.spacing = SPACING;
        border.resample_curve(&self.filtered)?;
        Ok(left.sqrt() * border.spacing)
    }

    /// Standard deviation of the fourth differences of a border's points, `step` apart, across the border, in its spacing.
    fn fourth_difference(&mut self, border: &Border, step: usize) -> f64 {
        let p = &border.points;
        let n = p.len();
        // A border has some more points than these reach.
        let at = |i: usize, steps: usize| {
            let k = i + steps * step;
            p[if k < n { k } else { k % n }].coords
        };
        self.deviations.clear();
        self.deviations.extend((0..n).step_by(2).map(|i| {
            let tangent = at(i, 4) - at(i, 0);
            let fourth = at(i, 0) + at(i, 4) - (at(i, 1) + at(i, 3)) * 4.0 + at(i, 2) * 6.0;
            let norm = tangent.norm();
            if norm > 0.0 { (fourth.perp(&tangent) / norm).abs() } else { fourth.norm() }
        }));
        let middle = self.deviations.len() / 2;
        let (_, median, _) = self.deviations.select_nth_unstable_by(middle, f64::total_cmp);
        *median / NORMAL_MAD / border.spacing
    }
}

/// Copies a cutout with a margin of ground where shape comes near its rim; gives the margin.
fn pad(cutout: &Cutout, level: f32, padded: &mut Vec<u8>) -> usize {
    /// Wide enough for the blur of an aliased picture.
    const MARGIN: usize = 4;
    /// Rows and columns along the rim that must be ground: those that make one at half the resolution.
    const RIM: usize = 2;
    let (width, height) = (cutout.window.width as usize, cutout.window.height as usize);
    let bright = cutout.shape_level > cutout.ground_level;
    let inside = |p: &u8| (f32::from(*p) > level) == bright;
    let rows = || cutout.pixels.chunks_exact(width.max(1));
    let touches = rows().take(RIM).chain(rows().rev().take(RIM)).any(|r| r.iter().any(inside))
        || rows().any(|r| r.iter().take(RIM).chain(r.iter().rev().take(RIM)).any(inside));
    if !touches {
        return 0;
    }
    let ground = cutout.ground_level.round() as u8;
    let padded_width = width + 2 * MARGIN;
    padded.clear();
    padded.resize(padded_width * (height + 2 * MARGIN), ground);
    for (row, to) in rows().zip(padded.chunks_exact_mut(padded_width).skip(MARGIN)) {
        to[MARGIN..MARGIN + width].copy_from_slice(row);
    }
    MARGIN
}

/// Blur in pixels that a picture needs before its contour can be trusted; `noise` is a part of the contrast.
fn needed_blur(edge_blur: f64, noise: f64) -> f64 {
    let edge = (2.0 * std::f64::consts::PI).sqrt();
    if noise > MAX_NOISE || noise * edge * edge_blur > MAX_WOBBLE {
        // A Gaussian of standard deviation s leaves 1 / (2 sqrt(pi) s) of the standard deviation of white noise, and an edge of
        // blur b the slope 1 / (sqrt(2 pi) sqrt(b^2 + s^2)): of their quotient, MAX_WOBBLE, follows s.
        let quotient = noise / (std::f64::consts::SQRT_2 * MAX_WOBBLE);
        let against_wobble = edge_blur * quotient / (1.0 - quotient * quotient).max(f64::MIN_POSITIVE).sqrt();
        let against_noise = noise / (MAX_NOISE * 2.0 * std::f64::consts::PI.sqrt());
        // Noise makes edges look sharper than they are; where it is blurred away, there is no aliasing left to fear.
        against_wobble.max(against_noise).clamp(MIN_EDGE_BLUR, MAX_BLUR)
    } else if edge_blur < MIN_EDGE_BLUR {
        (EDGE_BLUR * EDGE_BLUR - edge_blur * edge_blur).sqrt()
    } else {
        0.0
    }
}
