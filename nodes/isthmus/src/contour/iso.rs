//! Contours of a picture at a grey level: marching squares (W. E. Lorensen, H. E. Cline, *Marching cubes*, SIGGRAPH 1987, in the plane),
//! walked from the places where a row goes over from ground to shape.

use super::shoelace;
use crate::Point;

/// Grey levels by place.
pub(super) trait Picture {
    /// Columns and rows.
    fn size(&self) -> [usize; 2];

    /// Grey level of a pixel.
    fn at(&self, x: usize, y: usize) -> f32;
}

/// A picture whose outermost pixels are ground.
#[derive(Clone, Copy)]
pub(super) struct Raster<P> {
    pub(super) picture: P,
    pub(super) level: f32,
    /// Difference of the levels of shape and ground.
    pub(super) contrast: f32,
    /// 1 for a shape brighter than the ground, -1 for a darker one.
    pub(super) sense: f32,
    /// How far at most the pixel grid moves a crossing ([`aliasing`]), in pixels.
    pub(super) aliasing: f32,
}

/// How far the pixel grid moves an edge along a row or column at most, if a picture with edges of standard deviation `optical` was sampled
/// by square pixels and then blurred by `late`.
///
/// A pixel holds the mean over its square, so that the spectrum of an edge that runs along the grid is folded at the grid's frequency `m =
/// 1, -1` with `sinc(f - m)`. Of that the blur passes `exp(-2 pi^2 late^2 f^2)`: beside the edge's slope, a shift of
/// `sin(2 pi x) / (2 pi^3 late^2)` of an edge at `x`, of which inverse error functions between pixels take off a sixth.
pub(super) fn aliasing(optical: f64, late: f64) -> f32 {
    use std::f64::consts::PI;
    /// What is left of the shift between pixels.
    const LEFT: f64 = 5.0 / 6.0;
    /// Variance of the square of a pixel, which is a part of the edge's.
    const SQUARE: f64 = 1.0 / 12.0;
    if late > 0.0 {
        (LEFT / (2.0 * PI.powi(3) * late * late) * (-2.0 * PI * PI * (optical * optical - SQUARE).max(0.0)).exp())
            as f32
    } else {
        0.0
    }
}

/// `sin(pi s)` is `s (1 - s^2) (SINE[0] + SINE[1] s^2)` to one percent, for `s` from -1 to 1.
const SINE: [f32; 2] = [3.13, -1.8];
/// `exp(-2 pi^2 t^2)` is `(1 + EVENED t^2)^-4`, about.
const EVENED: f32 = 4.93;

/// A pixel of the shape whose left neighbour may be ground.
#[derive(Debug, Clone, Copy)]
pub(super) struct Start {
    pub(super) x: usize,
    pub(super) y: usize,
}

/// Traces contours, keeping its buffers from one picture to the next.
#[derive(Debug, Clone, Default)]
pub(super) struct Contours {
    /// Pixels to the right of an upward step so far, of which...
    visited: Vec<bool>,
    /// ... these are set: few, so that the others need not be cleared for the next picture.
    marked: Vec<usize>,
    current: Vec<Point>,
    /// The longest contour found.
    pub(super) longest: Vec<Point>,
}

impl Contours {
    /// Traces all contours that go up to the left of `starts` and keeps the longest outer one; whether there is any.
    pub(super) fn trace<P: Picture>(&mut self, raster: &Raster<P>, starts: &[Start]) -> bool {
        let [width, height] = raster.picture.size();
        for at in self.marked.drain(..) {
            self.visited[at] = false;
        }
        self.visited.resize(width * height, false);
        self.longest.clear();
        for &Start { x, y } in starts {
            let is_rim = x == 0 || y == 0 || y + 1 >= height;
            if !is_rim && !self.visited[y * width + x] && raster.value(x - 1, y) <= 0.0 {
                let before = self.marked.len();
                raster.follow(x, y, &mut self.marked, &mut self.current);
                for at in &self.marked[before..] {
                    self.visited[*at] = true;
                }
                if self.current.len() > self.longest.len() && shoelace(&self.current) > 0.0 {
                    std::mem::swap(&mut self.current, &mut self.longest);
                }
            }
        }
        !self.longest.is_empty()
    }
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

    /// How deep within the shape a pixel lies, from its difference from the level: in proportion to the inverse of the error function that a
    /// blurred edge is, by its series. Between pixels it is linear across an edge, as the grey level is not.
    fn depth(&self, value: f32) -> f32 {
        /// Coefficients of the third and fifth power, beside 1 of the first.
        const CUBIC: f32 = std::f32::consts::FRAC_PI_3;
        const QUINTIC: f32 = 7.0 * std::f32::consts::PI * std::f32::consts::PI / 30.0;
        let part = (value / self.contrast).clamp(-0.5, 0.5);
        let square = part * part;
        part * (1.0 + square * (CUBIC + square * QUINTIC))
    }

    /// Where between two neighbouring pixels the contour passes, from their values and twice the slope across.
    fn between(&self, p: f32, q: f32, across: f32) -> f64 {
        let (deep, high) = (self.depth(p), self.depth(q));
        let part = deep / (deep - high);
        if self.aliasing == 0.0 {
            return f64::from(part);
        }
        // An edge askew passes the pixels of neighbouring rows at other places, and the blur across the rows makes them even.
        let tangent = 0.5 * across / (q - p);
        let even = (1.0 + EVENED * tangent * tangent).powi(4);
        let s = 2.0 * part - 1.0;
        let sine = s * (1.0 - s * s) * (SINE[0] + SINE[1] * s * s);
        f64::from(part + self.aliasing * sine / even)
    }

    /// Follows the contour that runs up between the pixels `(x - 1, y)` (ground) and `(x, y)` (shape), the shape on its
    /// right-hand side. Lists the shape pixels to the right of its upward steps.
    fn follow(&self, x: usize, y: usize, marked: &mut Vec<usize>, contour: &mut Vec<Point>) {
        contour.clear();
        let [width, _] = self.picture.size();
        let value = |x: usize, y: usize| self.value(x, y);
        // Cells are named by their upper left pixel; a walk ends where it would enter its first cell as it did at first.
        let start = (x - 1, y - 1, Side::Bottom);
        let (mut x, mut y, mut entry) = start;
        loop {
            let (a, b, c, d) = (value(x, y), value(x + 1, y), value(x + 1, y + 1), value(x, y + 1));
            // Which corners are shape, clockwise from the upper left one. The contour leaves by the side that has, looking outwards, ground at
            // its left end and shape at its right one; where there are two, by one or the other.
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
            // Twice the slopes of the cell.
            let (right, down) = (b - a + c - d, d - a + c - b);
            contour.push(match exit {
                Side::Top => Point::new(fx + self.between(a, b, down), fy),
                Side::Right => Point::new(fx + 1.0, fy + self.between(b, c, right)),
                Side::Bottom => Point::new(fx + self.between(d, c, down), fy + 1.0),
                Side::Left => Point::new(fx, fy + self.between(a, d, right)),
            });
            (x, y, entry) = match exit {
                Side::Top => {
                    marked.push(y * width + x + 1);
                    (x, y - 1, Side::Bottom)
                }
                Side::Right => (x + 1, y, Side::Left),
                Side::Bottom => (x, y + 1, Side::Top),
                Side::Left => (x - 1, y, Side::Right),
            };
            if (x, y, entry) == start {
                return;
            }
        }
    }
}
