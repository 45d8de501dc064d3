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
}

/// A pixel of the shape whose left neighbour may be ground.
#[derive(Debug, Clone, Copy)]
pub(super) struct Start {
    pub(super) x: usize,
    pub(super) y: usize,
}

/// Traces contours, keeping its buffers from one picture to the next.
#[derive(Debug, Clone, Default)]
pub(super) struct Contours {
    visited: Vec<bool>,
    current: Vec<Point>,
    /// The longest contour found.
    pub(super) longest: Vec<Point>,
}

impl Contours {
    /// Traces all contours that go up to the left of `starts` and keeps the longest outer one; whether there is any.
    pub(super) fn trace<P: Picture>(&mut self, raster: &Raster<P>, starts: &[Start]) -> bool {
        let [width, height] = raster.picture.size();
        self.visited.clear();
        self.visited.resize(width * height, false);
        self.longest.clear();
        for &Start { x, y } in starts {
            let is_rim = x == 0 || y == 0 || y + 1 >= height;
            if !is_rim && !self.visited[y * width + x] && raster.value(x - 1, y) <= 0.0 {
                raster.follow(x, y, &mut self.visited, &mut self.current);
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

    /// Follows the contour that runs up between the pixels `(x - 1, y)` (ground) and `(x, y)` (shape), the shape on its
    /// right-hand side. Marks the shape pixels to the right of its upward steps.
    fn follow(&self, x: usize, y: usize, visited: &mut [bool], contour: &mut Vec<Point>) {
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
                    visited[y * width + x + 1] = true;
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
