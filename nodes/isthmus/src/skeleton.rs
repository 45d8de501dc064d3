//! Euclidean skeleton.
//!
//! # Method
//! The skeleton of a region is the set of centres of its maximal discs. Of a border given by samples it is the Voronoi
//! diagram of the samples, less the Voronoi edges that cross the border (J. W. Brandt, V. R. Algazi, *Continuous
//! skeleton computation by Voronoi diagram*, CVGIP: Image Understanding 55, 1992). One Delaunay triangulation of the
//! border ([`Triangulation`]) carries both skeletons: triangles inside the shape the endoskeleton, those outside the
//! exoskeleton. A triangle's circumcentre is a skeleton point, its circumradius the distance value there.
//!
//! A triangle whose corners, taken in the order of the border, turn the way the border turns lies inside, else outside:
//! exact wherever the border's own steps are edges of the triangulation, and a matter of three indices.
//!
//! # Cost
//! `O(n log n)` in the number of border points, linear memory.
//!
//! # Failure
//! Where two parts of the border come closer to each other than their points are apart, the border's steps are not all
//! edges of the triangulation, and the passage between is lost. [`TriangulationError`] for a border that has no triangles.

use crate::Point;
use crate::contour::Border;
use crate::isthmus::Polarity;

/// A point of the skeleton with the radius of the largest empty disc around it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SkeletonPoint {
    /// Where.
    pub point: Point,
    /// Distance to the border, in pixels.
    pub distance: f64,
}

/// A skeleton: branches that run from a junction or an end to the next one.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Skeleton {
    /// The branches, each with at least two points.
    pub branches: Vec<Vec<SkeletonPoint>>,
}

/// Why a border cannot be triangulated.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum TriangulationError {
    /// Too few points, or all on one line.
    #[error("{points} border points span no triangle")]
    Degenerate {
        /// Number of points.
        points: usize,
    },
}

/// Delaunay triangulation of a border's points, each triangle known as inside or outside the shape.
#[derive(Debug, Clone, Default)]
pub struct Triangulation {
    /// Corners of the triangles, as indices into the border, three after three.
    pub(crate) corners: Vec<usize>,
    /// For each side of each triangle (from its corner to the next) the same side of its neighbour, or [`NO_NEIGHBOUR`].
    pub(crate) neighbours: Vec<usize>,
    /// Circumcentres and circumradii of the triangles.
    pub(crate) discs: Vec<SkeletonPoint>,
    /// Which side of the border each triangle is on.
    pub(crate) polarity: Vec<Polarity>,
    points: Vec<delaunator::Point>,
}

/// In place of a neighbouring side on the hull.
pub(crate) const NO_NEIGHBOUR: usize = delaunator::EMPTY;

impl Triangulation {
    /// Triangulates the points of a border.
    ///
    /// # Errors
    /// [`TriangulationError`] where the points lie on one line.
    pub fn new(border: &Border) -> Result<Self, TriangulationError> {
        let mut triangulation = Self::default();
        triangulation.rebuild(border)?;
        Ok(triangulation)
    }

    /// As [`Triangulation::new`], in the memory of an earlier one.
    ///
    /// # Errors
    /// [`TriangulationError`] where the points lie on one line.
    pub fn rebuild(&mut self, border: &Border) -> Result<(), TriangulationError> {
        let points = &border.points;
        self.points.clear();
        self.points.extend(points.iter().map(|p| delaunator::Point { x: p.x, y: p.y }));
        let delaunay = delaunator::triangulate(&self.points);
        self.corners = delaunay.triangles;
        self.neighbours = delaunay.halfedges;
        if self.corners.is_empty() {
            return Err(TriangulationError::Degenerate { points: points.len() });
        }
        self.discs.clear();
        self.polarity.clear();
        for t in self.corners.chunks_exact(3) {
            let [a, b, c] = [points[t[0]], points[t[1]], points[t[2]]];
            let (ab, ac) = (b - a, c - a);
            let twice_area = ab.perp(&ac);
            let (bb, cc) = (ab.norm_squared(), ac.norm_squared());
            let to_centre = nalgebra::Vector2::new(ac.y * bb - ab.y * cc, ab.x * cc - ac.x * bb) / (2.0 * twice_area);
            self.discs.push(SkeletonPoint { point: a + to_centre, distance: to_centre.norm() });
            // An even permutation of ascending indices keeps the sense of the triangle, an odd one turns it round.
            let ascending = u8::from(t[0] < t[1]) + u8::from(t[1] < t[2]) + u8::from(t[2] < t[0]) == 2;
            let inside = (twice_area > 0.0) == ascending;
            self.polarity.push(if inside { Polarity::Positive } else { Polarity::Negative });
        }
        Ok(())
    }

    /// The side that follows a side round its triangle.
    pub(crate) fn next_side(side: usize) -> usize {
        if side % 3 == 2 { side - 2 } else { side + 1 }
    }

    /// The border points that a side joins.
    pub(crate) fn ends(&self, side: usize) -> [usize; 2] {
        [self.corners[side], self.corners[Self::next_side(side)]]
    }
}
