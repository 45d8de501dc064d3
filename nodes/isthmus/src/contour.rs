//! Sub-pixel border of a shape.
//!
//! # Method
//! 1. *Iso-contour* of the grey picture half-way between the levels of shape and ground, by marching squares (W. E. Lorensen,
//!    H. E. Cline, *Marching cubes*, SIGGRAPH 1987, in the plane), the levels between pixels running as across a blurred edge. A
//!    diagonal cell joins the shape where its mean lies on the shape's side (G. M. Nielson, B. Hamann, *The asymptotic
//!    decider*, Visualization 1991). Of all closed contours the longest outer one is taken.
//! 2. A picture that is too noisy or too sharp (one-bit, without grey levels at the edge) for its contour to be trusted is
//!    blurred first, near the contour: just enough, as the measured noise and edge blur ask for.
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

mod restore;

use crate::Point;
use crate::mask::Cutout;
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
/// A Gaussian kernel ends here, in standard deviations.
const KERNEL_EXTENT: f64 = 3.0;
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

    /// Unit tangent at an arc length, in the direction of the border.
    #[must_use]
    pub fn tangent_at(&self, arc: f64) -> Vector2<f64> {
        let d = self.point_at(arc + self.spacing) - self.point_at(arc - self.spacing);
        let norm = d.norm();
        if norm > 0.0 { d / norm } else { Vector2::x() }
    }

    /// Unit normal at an arc length, out of the shape.
    #[must_use]
    pub fn normal_at(&self, arc: f64) -> Vector2<f64> {
        let t = self.tangent_at(arc);
        Vector2::new(t.y, -t.x)
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
        let length: f64 = edges(polygon).map(|(p, q)| (q - p).norm()).sum();
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
        for (p, q) in edges(polygon) {
            let d = q - p;
            let end = start + d.norm();
            // The next sample's position is computed, not summed, so that long borders do not drift.
            let mut next = self.points.len() as f64 * self.spacing;
            while next < end && self.points.len() < count {
                self.points.push(p + d * ((next - start) / (end - start)));
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
    points.iter().zip(points.iter().cycle().skip(1))
}

/// Signed area of a closed polygon: positive for one that runs clockwise as seen on a screen (y down).
fn shoelace(points: &[Point]) -> f64 {
    let Some(origin) = points.first() else { return 0.0 };
    edges(points).map(|(p, q)| (p - origin).perp(&(q - origin))).sum::<f64>() / 2.0
}

/// Traces borders, keeping its buffers from one to the next.
#[derive(Debug, Clone, Default)]
pub struct Tracer {
    padded: Vec<u8>,
    band: Band,
    spans: Vec<Span>,
    visited: Vec<bool>,
    contour: Vec<Point>,
    longest: Vec<Point>,
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
        let mut padded = std::mem::take(&mut self.padded);
        let margin = pad(cutout, level, &mut padded);
        let (width, height) = (width + 2 * margin, height + 2 * margin);
        let pixels = if margin == 0 { &cutout.pixels } else { &padded };
        let sense = if shape_level > ground_level { 1.0 } else { -1.0 };

        let raw = Raw { pixels, width };
        self.spans.clear();
        raw.spans(level, sense, &mut self.spans);
        let found = self.trace_longest(&Raster { picture: raw, width, height, level, contrast, sense });
        let side = if sense > 0.0 { 1.0 } else { -1.0 };
        let between = |p: Point| side * raw.between(p, height);
        let mut optical = if found { edge_blur(&self.longest, f64::from(contrast), between) } else { 0.0 };
        let late = needed_blur(f64::from(contrast), optical, f64::from(cutout.noise_level));
        let found = if late > 0.0 && found {
            let mut band = std::mem::take(&mut self.band);
            band.mark(&self.longest, width, height);
            band.blur(pixels, late, ground_level);
            self.spans.clear();
            band.spans(&mut self.spans);
            let picture = Blurred { band: &band, raw };
            let found = self.trace_longest(&Raster { picture, width, height, level, contrast, sense });
            self.band = band;
            if found {
                optical = edge_blur(&self.longest, f64::from(contrast), between);
            }
            found
        } else {
            found
        };
        self.padded = padded;
        if !found {
            return Err(ContourError::Nothing { level });
        }

        let offset =
            Vector2::new(f64::from(cutout.window.x) - margin as f64, f64::from(cutout.window.y) - margin as f64);
        for p in &mut self.longest {
            *p += offset;
        }
        let mut border = Border { points: Vec::new(), spacing: SPACING };
        border.resample(&self.longest)?;
        let noise = self.restore(&mut border, optical, late)?;
        Ok((border, noise))
    }

    /// Traces all contours that go up through `self.spans` and leaves the longest outer one in `self.longest`.
    fn trace_longest<P: Picture>(&mut self, raster: &Raster<P>) -> bool {
        let (width, height) = (raster.width, raster.height);
        self.visited.clear();
        self.visited.resize(width * height, false);
        self.longest.clear();
        for span in &self.spans {
            let y = span.y;
            if y == 0 || y + 1 >= height {
                continue;
            }
            let mut outside = span.start == 0 || raster.value(span.start - 1, y) <= 0.0;
            for x in span.start..span.end {
                let inside = raster.value(x, y) > 0.0;
                if inside && outside && !self.visited[y * width + x] && x > 0 {
                    raster.follow(x, y, &mut self.visited, &mut self.contour);
                    if self.contour.len() > self.longest.len() && shoelace(&self.contour) > 0.0 {
                        std::mem::swap(&mut self.contour, &mut self.longest);
                    }
                }
                outside = !inside;
            }
        }
        !self.longest.is_empty()
    }

    /// Undoes blur and noise of a border; gives the standard deviation of its points that is left.
    fn restore(&mut self, border: &mut Border, optical_blur: f64, late_blur: f64) -> Result<f64, ContourError> {
        let late_blur = late_blur / border.spacing;
        let step = NOISE_STEP.max((2.0 * late_blur).round() as usize);
        let noise = noise_power(self.fourth_difference(border, step).powi(2), late_blur, step);
        let size = border.area().sqrt() / border.spacing;
        let radius = TIGHTEST_CURVE * size;
        let blur = (optical_blur / border.spacing).min(MAX_UNDONE * radius).hypot(late_blur);
        let left = self.filter.design(History { blur, late_blur, radius }, noise);
        self.filter.apply(&border.points, &mut self.contour);
        border.spacing = SPACING;
        border.resample(&self.contour)?;
        Ok(left.sqrt() * border.spacing)
    }

    /// Standard deviation of the fourth differences of a border's points, `step` apart, across the border, in its spacing.
    fn fourth_difference(&mut self, border: &Border, step: usize) -> f64 {
        let p = &border.points;
        let n = p.len();
        let at = |i: usize, steps: usize| p[(i + steps * step) % n].coords;
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

/// Copies a cutout with a margin of ground where shape touches its rim; gives the margin.
fn pad(cutout: &Cutout, level: f32, padded: &mut Vec<u8>) -> usize {
    /// Wide enough for the blur of an aliased picture.
    const MARGIN: usize = 4;
    let (width, height) = (cutout.window.width as usize, cutout.window.height as usize);
    let bright = cutout.shape_level > cutout.ground_level;
    let inside = |p: &u8| (f32::from(*p) > level) == bright;
    let rows = || cutout.pixels.chunks_exact(width.max(1));
    let touches = rows().next().is_some_and(|r| r.iter().any(inside))
        || rows().next_back().is_some_and(|r| r.iter().any(inside))
        || rows().any(|r| r.first().is_some_and(inside) || r.last().is_some_and(inside));
    if !touches {
        return 0;
    }
    let ground = cutout.ground_level.round().clamp(0.0, 255.0) as u8;
    let padded_width = width + 2 * MARGIN;
    padded.clear();
    padded.resize(padded_width * (height + 2 * MARGIN), ground);
    for (row, to) in rows().zip(padded.chunks_exact_mut(padded_width).skip(MARGIN)) {
        to[MARGIN..MARGIN + width].copy_from_slice(row);
    }
    MARGIN
}

/// Blur in pixels that a picture needs before its contour can be trusted.
fn needed_blur(contrast: f64, edge_blur: f64, noise: f64) -> f64 {
    let noise = noise / contrast;
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

/// Pixels of one row.
#[derive(Debug, Clone, Copy)]
struct Span {
    y: usize,
    start: usize,
    /// One past the last pixel.
    end: usize,
}

/// Grey levels by place.
trait Picture {
    fn at(&self, x: usize, y: usize) -> f32;
}

/// The pixels as they are.
#[derive(Clone, Copy)]
struct Raw<'a> {
    pixels: &'a [u8],
    width: usize,
}

impl Picture for Raw<'_> {
    fn at(&self, x: usize, y: usize) -> f32 {
        f32::from(self.pixels[y * self.width + x])
    }
}

impl Raw<'_> {
    /// Grey level between the pixels of a picture of `height` rows, which is continued by its outermost pixels.
    fn between(&self, p: Point, height: usize) -> f64 {
        let (x, y) = (p.x.clamp(0.0, (self.width - 1) as f64), p.y.clamp(0.0, (height - 1) as f64));
        let (i, j) = (x as usize, y as usize);
        let (u, v) = (x - i as f64, y - j as f64);
        let (i1, j1) = ((i + 1).min(self.width - 1), (j + 1).min(height - 1));
        let at = |x: usize, y: usize| f64::from(self.pixels[y * self.width + x]);
        let (upper, lower) = (at(i, j) + (at(i1, j) - at(i, j)) * u, at(i, j1) + (at(i1, j1) - at(i, j1)) * u);
        upper + (lower - upper) * v
    }

    /// The stretches of rows in which ground is followed by shape, and a few more.
    fn spans(&self, level: f32, sense: f32, spans: &mut Vec<Span>) {
        /// Pixels that are looked at together: most of a row is uniform.
        const CHUNK: usize = 16;
        // Beyond the levels of a byte, one step further is as good as any.
        let bright = sense > 0.0;
        let bound = if bright { level.floor() } else { level.ceil() }.clamp(-1.0, 256.0) as i16;
        for (y, row) in self.pixels.chunks_exact(self.width).enumerate() {
            let mut before = false;
            for (k, chunk) in row.chunks(CHUNK).enumerate() {
                let inside: u8 = if bright {
                    chunk.iter().map(|&p| u8::from(i16::from(p) > bound)).sum()
                } else {
                    chunk.iter().map(|&p| u8::from(i16::from(p) < bound)).sum()
                };
                let all = usize::from(inside) == chunk.len();
                if inside > 0 && !(all && before) {
                    spans.push(Span { y, start: k * CHUNK, end: k * CHUNK + chunk.len() });
                }
                before =
                    all || chunk.last().is_some_and(|&p| (i16::from(p) > bound) == bright && i16::from(p) != bound);
            }
        }
    }
}

/// The cells of a picture round a contour, blurred.
#[derive(Debug, Clone, Default)]
struct Band {
    width: usize,
    height: usize,
    /// Cells in a row.
    columns: usize,
    /// For each cell where its levels begin, or [`OUTSIDE_BAND`].
    cells: Vec<usize>,
    levels: Vec<f32>,
    across: Vec<f32>,
    blurred: Vec<f32>,
}

/// Side of a cell in pixels: with its neighbours it covers what the greatest blur moves a contour by.
const CELL: usize = 8;
const OUTSIDE_BAND: usize = usize::MAX;

impl Band {
    /// Takes the cells that a contour goes through, and their neighbours.
    fn mark(&mut self, contour: &[Point], width: usize, height: usize) {
        (self.width, self.height) = (width, height);
        self.columns = width.div_ceil(CELL);
        let rows = height.div_ceil(CELL);
        self.cells.clear();
        self.cells.resize(self.columns * rows, OUTSIDE_BAND);
        let mut last = OUTSIDE_BAND;
        for p in contour {
            let (column, row) = (p.x as usize / CELL, p.y as usize / CELL);
            if std::mem::replace(&mut last, row * self.columns + column) == last {
                continue;
            }
            let columns = column.saturating_sub(1)..self.columns.min(column + 2);
            for row in row.saturating_sub(1)..rows.min(row + 2) {
                self.cells[row * self.columns + columns.start..row * self.columns + columns.end].fill(0);
            }
        }
        let mut count = 0;
        for cell in self.cells.iter_mut().filter(|c| **c != OUTSIDE_BAND) {
            *cell = count * CELL * CELL;
            count += 1;
        }
        self.levels.clear();
        self.levels.resize(count * CELL * CELL, 0.0);
    }

    /// Neighbouring cells of a row: the row, and the columns from the first to one past the last.
    fn stretches(&self) -> impl Iterator<Item = (usize, std::ops::Range<usize>)> {
        self.cells.chunks_exact(self.columns.max(1)).enumerate().flat_map(|(row, cells)| {
            let mut from = 0;
            std::iter::from_fn(move || {
                let start = from + cells[from..].iter().position(|c| *c != OUTSIDE_BAND)?;
                let count = cells[start..].iter().position(|c| *c == OUTSIDE_BAND);
                from = count.map_or(cells.len(), |count| start + count);
                Some((row, start..from))
            })
        })
    }

    fn spans(&self, spans: &mut Vec<Span>) {
        for (row, columns) in self.stretches() {
            let (start, end) = (columns.start * CELL, self.width.min(columns.end * CELL));
            spans.extend((row * CELL..self.height.min((row + 1) * CELL)).map(|y| Span { y, start, end }));
        }
    }

    /// Separable Gaussian blur of the cells; the picture is continued by its outermost pixels, which then become ground, so that
    /// contours close within.
    fn blur(&mut self, pixels: &[u8], sigma: f64, ground: f32) {
        let reach = (KERNEL_EXTENT * sigma).ceil() as usize;
        let mut kernel: Vec<f32> = (0..=2 * reach)
            .map(|i| (-(i as f64 - reach as f64).powi(2) / (2.0 * sigma * sigma)).exp() as f32)
            .collect();
        let total: f32 = kernel.iter().sum();
        kernel.iter_mut().for_each(|k| *k /= total);
        let (width, height) = (self.width, self.height);
        let (mut across, mut blurred) = (std::mem::take(&mut self.across), std::mem::take(&mut self.blurred));
        let mut levels = std::mem::take(&mut self.levels);
        for (row, columns) in self.stretches() {
            let (start, end) = (columns.start * CELL, width.min(columns.end * CELL));
            // Pixels that the kernel needs, and how many of them lie beyond the picture.
            let (from, to) = (start.saturating_sub(reach), width.min(end + reach));
            let before = (reach + from) - start;
            for y in row * CELL..height.min((row + 1) * CELL) {
                across.clear();
                across.resize(end - start + 2 * reach, 0.0);
                let within = before..before + to - from;
                for (i, k) in kernel.iter().enumerate() {
                    let source = (y + i).saturating_sub(reach).min(height - 1) * width;
                    for (sum, p) in across[within.clone()].iter_mut().zip(&pixels[source + from..source + to]) {
                        *sum += k * f32::from(*p);
                    }
                }
                let (first, last) = (across[within.start], across[within.end - 1]);
                across[..within.start].fill(first);
                across[within.end..].fill(last);
                blurred.clear();
                blurred.resize(end - start, 0.0);
                for (i, k) in kernel.iter().enumerate() {
                    for (sum, p) in blurred.iter_mut().zip(&across[i..]) {
                        *sum += k * p;
                    }
                }
                if start == 0 {
                    blurred[0] = ground;
                }
                if end == width {
                    blurred[end - start - 1] = ground;
                }
                if y == 0 || y == height - 1 {
                    blurred.fill(ground);
                }
                for (column, part) in columns.clone().zip(blurred.chunks(CELL)) {
                    let at = self.cells[row * self.columns + column] + y % CELL * CELL;
                    levels[at..at + part.len()].copy_from_slice(part);
                }
            }
        }
        (self.across, self.blurred, self.levels) = (across, blurred, levels);
    }
}

/// A picture that is blurred near a contour.
#[derive(Clone, Copy)]
struct Blurred<'a> {
    band: &'a Band,
    raw: Raw<'a>,
}

impl Picture for Blurred<'_> {
    fn at(&self, x: usize, y: usize) -> f32 {
        match self.band.cells[y / CELL * self.band.columns + x / CELL] {
            OUTSIDE_BAND => self.raw.at(x, y),
            cell => self.band.levels[cell + y % CELL * CELL + x % CELL],
        }
    }
}

/// A picture whose outermost pixels are ground.
struct Raster<P> {
    picture: P,
    width: usize,
    height: usize,
    level: f32,
    /// Difference of the levels of shape and ground.
    contrast: f32,
    /// 1 for a shape brighter than the ground, -1 for a darker one.
    sense: f32,
}

/// Sides of a marching squares cell.
#[derive(Clone, Copy, PartialEq)]
enum Side {
    Top,
    Right,
    Bottom,
    Left,
}

impl<P: Picture> Raster<P> {
    /// Difference from the level, positive in the shape.
    fn value(&self, x: usize, y: usize) -> f32 {
        self.sense * (self.picture.at(x, y) - self.level)
    }

    /// How deep within the shape a pixel lies, in units of the edge's blur, from its difference from the level: the inverse of the
    /// error function, by its series. Between pixels it is linear across an edge, as the grey level is not.
    fn depth(&self, value: f32) -> f32 {
        let part = (value / self.contrast).clamp(-0.5, 0.5);
        let square = part * part;
        part * (1.0 + square * (std::f32::consts::FRAC_PI_3 + square * 2.303))
    }

    /// Follows the contour that runs up between the pixels `(x - 1, y)` (ground) and `(x, y)` (shape), the shape on its
    /// right-hand side. Marks the shape pixels to the right of its upward steps.
    fn follow(&self, x: usize, y: usize, visited: &mut [bool], contour: &mut Vec<Point>) {
        contour.clear();
        let value = |x: usize, y: usize| self.value(x, y);
        let (start_x, start_y) = (x - 1, y - 1);
        let (mut x, mut y, mut entry) = (start_x, start_y, Side::Bottom);
        loop {
            let (a, b, c, d) = (value(x, y), value(x + 1, y), value(x + 1, y + 1), value(x, y + 1));
            let corners = u8::from(a > 0.0) | u8::from(b > 0.0) << 1 | u8::from(c > 0.0) << 2 | u8::from(d > 0.0) << 3;
            let joined = || a + b + c + d > 0.0;
            let exit = match corners {
                0b0010 | 0b0110 | 0b1110 => Side::Top,
                0b0100 | 0b1100 | 0b1101 => Side::Right,
                0b1000 | 0b1001 | 0b1011 => Side::Bottom,
                0b0001 | 0b0011 | 0b0111 => Side::Left,
                0b0101 if (entry == Side::Top) == joined() => Side::Right,
                0b0101 => Side::Left,
                _ if (entry == Side::Left) == joined() => Side::Top,
                _ => Side::Bottom,
            };
            let (fx, fy) = (x as f64, y as f64);
            let between = |p: f32, q: f32| {
                let (p, q) = (self.depth(p), self.depth(q));
                f64::from(p / (p - q))
            };
            contour.push(match exit {
                Side::Top => Point::new(fx + between(a, b), fy),
                Side::Right => Point::new(fx + 1.0, fy + between(b, c)),
                Side::Bottom => Point::new(fx + between(d, c), fy + 1.0),
                Side::Left => Point::new(fx, fy + between(a, d)),
            });
            (x, y, entry) = match exit {
                Side::Top => {
                    visited[y * self.width + x + 1] = true;
                    (x, y - 1, Side::Bottom)
                }
                Side::Right => (x + 1, y, Side::Left),
                Side::Bottom => (x, y + 1, Side::Top),
                Side::Left => (x - 1, y, Side::Right),
            };
            if (x, y) == (start_x, start_y) && entry == Side::Bottom {
                return;
            }
        }
    }
}
