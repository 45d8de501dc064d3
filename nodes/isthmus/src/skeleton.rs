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
//! Discs are wide where the border's parts are far apart, so every border point is not needed there: the triangulation takes
//! one point in several, a step of about a hundredth of the shape's size, and halves the step as long as two parts of the border are
//! within a few steps of each other.
//!
//! Every bump of the border grows a branch. What a branch adds to the shape is how far its last disc reaches beyond
//! the disc where it leaves the others. Peeling the tree from its ends, branches that add less than the border's noise
//! and spacing account for are pruned ([`Triangulation::skeleton`]); the others stay whole, up to their ends.
//!
//! # Cost
//! `O(n log n)` in the number of border points, linear memory.
//!
//! # Failure
//! Where two parts of the border come closer to each other than their points are apart, the border's steps are not all
//! edges of the triangulation, and the passage between is lost. [`TriangulationError`] for a border that has no triangles.
//!
//! ```
//! use isthmus::{Features, Point, contour::Border};
//! let bar = [(0.0, 0.0), (100.0, 0.0), (100.0, 20.0), (0.0, 20.0)].map(|(x, y)| Point::new(x, y));
//! let features = Features::from_border(Border::from_points(&bar)?, 0.0)?;
//! // A bar has a spine, and a branch into each corner.
//! assert_eq!(features.endoskeleton.branches.len(), 5);
//! # Ok::<(), isthmus::Error>(())
//! ```

use crate::Point;
use crate::contour::Border;
use nalgebra::Vector2;

/// On which side of the border a skeleton or an isthmus line runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Polarity {
    /// Inside the shape (endoskeleton): the neck of a tab.
    Positive,
    /// Outside (exoskeleton): the mouth of a blank.
    Negative,
}

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
    /// The border points that are triangulated, in the order of the border.
    index: Vec<usize>,
    /// Corners of the triangles, as indices into `index`, three after three.
    pub(crate) corners: Vec<usize>,
    /// For each side of each triangle (from its corner to the next) the same side of its neighbour, or [`NO_NEIGHBOUR`].
    pub(crate) neighbours: Vec<usize>,
    /// Circumcentres and circumradii of the triangles.
    pub(crate) discs: Vec<SkeletonPoint>,
    /// Which side of the border each triangle is on.
    pub(crate) polarity: Vec<Polarity>,
    /// Whether each side is a way from one disc to the next, rather than a step of the border (or across it).
    passage: Vec<bool>,
    points: Vec<delaunator::Point>,
    /// Diagonal of the border's bounding box.
    pub(crate) extent: f64,
}

/// Radius beyond which a disc counts as a half-plane, in pixels: the square of a larger one has no digits left for a pixel.
const FAR: f64 = 1e9;
/// Least height of a branch over the rest of the skeleton, in steps of the border: a polygon's corners are that far from the curve.
const MIN_HEIGHT_STEPS: f64 = 1.0;
/// Least height of a branch in standard deviations of a border point: the chance bumps of a noisy border are lower.
const MIN_HEIGHT_NOISE: f64 = 8.0;
/// How far the exoskeleton goes on beyond the bounding box of the shape, as a part of the box's larger side: mouths at the edge
/// of the box lie on it as a whole.
pub const EXOSKELETON_MARGIN: f64 = 0.1;

/// Distance of the triangulated border points, as a part of the square root of the shape's area: half the radius of the
/// tightest curves that the border keeps.
const STEP: f64 = 0.02;
/// Greatest number of border steps from one triangulated point to the next.
const MAX_STRIDE: usize = 6;
/// Where two parts of the border are nearer to each other than this many steps, the step is halved: a passage is then found to
/// a twenty-fourth of a step.
const CLOSE: f64 = 3.0;
/// ... and the way between them along the border is this many times as long: nearer ones are the two sides of a corner.
const DETOUR: f64 = 3.0;

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
        self.extent = border.bounds().map_or(0.0, |[low, high]| (high - low).norm());
        let mut stride = ((STEP * border.area().sqrt() / border.spacing).round() as usize).clamp(1, MAX_STRIDE);
        self.triangulate(border, stride)?;
        while stride > 1 && !self.is_fine_enough(border, stride) {
            stride /= 2;
            self.triangulate(border, stride)?;
        }
        Ok(())
    }

    /// Triangulates one border point in `stride`.
    fn triangulate(&mut self, border: &Border, stride: usize) -> Result<(), TriangulationError> {
        let count = border.points.len() / stride;
        self.index.clear();
        self.index.extend((0..count).map(|k| k * border.points.len() / count));
        self.points.clear();
        self.points.extend(self.index.iter().map(|&k| border.points[k]).map(|p| delaunator::Point { x: p.x, y: p.y }));
        let delaunay = delaunator::triangulate(&self.points);
        self.corners = delaunay.triangles;
        self.neighbours = delaunay.halfedges;
        if self.corners.is_empty() {
            return Err(TriangulationError::Degenerate { points: border.points.len() });
        }
        self.discs.clear();
        self.polarity.clear();
        for t in self.corners.chunks_exact(3) {
            let [a, b, c] = [t[0], t[1], t[2]].map(|k| border.points[self.index[k]]);
            let (ab, ac) = (b - a, c - a);
            let twice_area = ab.perp(&ac);
            let (bb, cc) = (ab.norm_squared(), ac.norm_squared());
            let to_centre = Vector2::new(ac.y * bb - ab.y * cc, ab.x * cc - ac.x * bb) / (2.0 * twice_area);
            let radius = to_centre.norm();
            self.discs.push(if radius < FAR {
                SkeletonPoint { point: a + to_centre, distance: radius }
            } else {
                // Corners on one line: their disc is a half-plane, its centre out of sight.
                SkeletonPoint { point: a + Vector2::new(FAR, FAR), distance: FAR }
            });
            // An even permutation of ascending indices keeps the sense of the triangle, an odd one turns it round.
            let ascending = u8::from(t[0] < t[1]) + u8::from(t[1] < t[2]) + u8::from(t[2] < t[0]) == 2;
            let inside = (twice_area > 0.0) == ascending;
            self.polarity.push(if inside { Polarity::Positive } else { Polarity::Negative });
        }
        let mut flags = std::mem::take(&mut self.passage);
        flags.clear();
        let passage = |side: usize| {
            let [i, j] = self.corner_pair(side);
            let step = i.abs_diff(j);
            let there = match self.neighbours[side] {
                NO_NEIGHBOUR => Polarity::Negative,
                neighbour => self.polarity[neighbour / 3],
            };
            self.polarity[side / 3] == there && step != 1 && step != count - 1
        };
        flags.extend((0..self.corners.len()).map(passage));
        self.passage = flags;
        Ok(())
    }

    /// Whether all steps of the border are sides of the triangulation, and no two parts of the border are close for its step.
    fn is_fine_enough(&self, border: &Border, stride: usize) -> bool {
        let step = stride as f64 * border.spacing;
        let count = self.points.len();
        let mut steps = 0;
        for side in 0..self.corners.len() {
            if self.neighbours[side] != NO_NEIGHBOUR && self.neighbours[side] < side {
                continue;
            }
            let [i, j] = self.corner_pair(side);
            let apart = i.abs_diff(j).min(count - i.abs_diff(j));
            if apart == 1 {
                steps += 1;
                continue;
            }
            let chord = (border.points[self.index[i]] - border.points[self.index[j]]).norm();
            if chord < CLOSE * step && apart as f64 * step > DETOUR * chord {
                return false;
            }
        }
        steps == count
    }

    /// The skeleton on one side of the border, pruned by the standard deviation of its points across the border, `noise`. The
    /// exoskeleton is cut off [`EXOSKELETON_MARGIN`] beyond the bounding box.
    #[must_use]
    pub fn skeleton(&self, border: &Border, polarity: Polarity, noise: f64) -> Skeleton {
        let least = (MIN_HEIGHT_STEPS * border.spacing).max(MIN_HEIGHT_NOISE * noise);
        let mut skeleton = self.chains(&self.peel(polarity, least));
        if let (Polarity::Negative, Some([low, high])) = (polarity, border.bounds()) {
            let margin = Vector2::repeat(EXOSKELETON_MARGIN * (high - low).amax());
            skeleton = skeleton.clipped(low - margin, high + margin);
        }
        skeleton
    }

    /// Whether a side is a way from one disc to the next, or a step of the border itself (or crosses it).
    pub(crate) fn is_passage(&self, side: usize) -> bool {
        self.passage[side]
    }

    /// The triangle beyond a side; `None` where the outer world begins: over the hull, and at discs larger than the shape,
    /// which stand on (nearly) straight parts of the border and have their centres anywhere.
    fn beyond(&self, side: usize) -> Option<usize> {
        let neighbour = self.neighbours[side];
        (neighbour != NO_NEIGHBOUR && self.discs[neighbour / 3].distance <= self.extent).then_some(neighbour / 3)
    }

    /// Prunes the skeleton; gives the skeleton's graph: for each triangle that stays, its neighbours that stay.
    fn peel(&self, polarity: Polarity, least: f64) -> Graph {
        let count = self.discs.len();
        let is_open = |t: usize| self.polarity[t] == polarity && self.discs[t].distance <= self.extent;
        // Ways out of each triangle that are not yet peeled; the one over the hull, to infinity, never is.
        let ways = |t: usize| (3 * t..3 * t + 3).filter(|s| self.is_passage(*s));
        let mut degree: Vec<u8> = (0..count).map(|t| if is_open(t) { ways(t).count() as u8 } else { 0 }).collect();
        // The end of the skeleton that reaches furthest beyond a triangle's disc, and the neighbour it lies behind.
        let mut tip: Vec<(SkeletonPoint, usize)> = self.discs.iter().map(|d| (*d, NO_NEIGHBOUR)).collect();
        let mut peeled = vec![false; count];
        let mut stays = vec![false; count];
        let mut ends: Vec<usize> = (0..count).filter(|&t| degree[t] == 1).collect();
        while let Some(t) = ends.pop() {
            let next = ways(t).filter_map(|s| self.beyond(s)).find(|next| !peeled[*next]);
            let Some(next) = next else { continue };
            peeled[t] = true;
            let reach = |tip: &SkeletonPoint| (tip.point - self.discs[next].point).norm() + tip.distance;
            let height = reach(&tip[t].0) - self.discs[next].distance;
            if stays[t] || height >= least {
                stays[next] = true;
                // The whole branch stays, up to its end.
                let mut branch = t;
                while branch != NO_NEIGHBOUR && !stays[branch] {
                    stays[branch] = true;
                    branch = tip[branch].1;
                }
            }
            if tip[next].1 == NO_NEIGHBOUR || reach(&tip[t].0) > reach(&tip[next].0) {
                tip[next] = (tip[t].0, t);
            }
            degree[next] -= 1;
            if degree[next] == 1 {
                ends.push(next);
            }
        }
        Graph { kept: stays }
    }

    /// Walks the branches of a pruned skeleton.
    fn chains(&self, graph: &Graph) -> Skeleton {
        let ways = |t: usize| {
            (3 * t..3 * t + 3).filter_map(move |s| {
                let open = self.is_passage(s);
                let there = self.beyond(s);
                (open && there.is_none_or(|t| graph.kept[t])).then_some((s, there))
            })
        };
        let mut branches = Vec::new();
        let mut walked = vec![false; self.corners.len()];
        let mut walk = |start: usize, first: usize, walked: &mut Vec<bool>| {
            let mut branch = vec![self.discs[start]];
            let (mut side, mut at) = (first, start);
            loop {
                walked[side] = true;
                if self.beyond(side).is_none() {
                    branch.extend(self.way_out(side));
                    break;
                }
                let neighbour = self.neighbours[side];
                walked[neighbour] = true;
                at = if at == neighbour / 3 { side / 3 } else { neighbour / 3 };
                branch.push(self.discs[at]);
                let mut onward = ways(at).filter(|(s, _)| *s != neighbour);
                match (onward.next(), onward.next()) {
                    (Some((s, _)), None) if !walked[s] => side = s,
                    _ => break,
                }
            }
            branches.push(branch);
        };
        let kept = || (0..self.discs.len()).filter(|&t| graph.kept[t]);
        for t in kept().filter(|&t| ways(t).count() != 2) {
            for (side, _) in ways(t) {
                if !walked[side] {
                    walk(t, side, &mut walked);
                }
            }
        }
        // Rings have no junction to start from.
        for t in kept() {
            if let Some((side, _)) = ways(t).find(|(s, _)| !walked[*s]) {
                walk(t, side, &mut walked);
            }
        }
        Skeleton { branches }
    }

    /// The exoskeleton's way out over a side of the hull, to beyond any margin that is a part of the shape's size.
    fn way_out(&self, side: usize) -> impl Iterator<Item = SkeletonPoint> {
        /// Points of the way; their steps grow, since far out the distance grows evenly.
        const STEPS: usize = 24;
        let [i, j] = self.corner_pair(side);
        let end = |i: usize| nalgebra::Point2::new(self.points[i].x, self.points[i].y);
        let (p, q) = (end(i), end(j));
        let middle = nalgebra::center(&p, &q);
        let third = end(self.corners[Self::next_side(Self::next_side(side))]);
        let normal = Vector2::new((q - p).y, -(q - p).x).normalize();
        let outward = if normal.dot(&(third - p)) > 0.0 { -normal } else { normal };
        let start = (self.discs[side / 3].point - middle).dot(&outward);
        let reach = 2.0 * self.extent;
        (1..=STEPS).filter_map(move |k| {
            let way = reach * (k as f64 / STEPS as f64).powi(2);
            let point = middle + outward * way;
            (way > start).then(|| SkeletonPoint { point, distance: (point - p).norm() })
        })
    }

    /// The side that follows a side round its triangle.
    pub(crate) fn next_side(side: usize) -> usize {
        if side % 3 == 2 { side - 2 } else { side + 1 }
    }

    /// The border points that a side joins, as indices into the border.
    pub(crate) fn ends(&self, side: usize) -> [usize; 2] {
        self.corner_pair(side).map(|k| self.index[k])
    }

    /// The corners that a side joins.
    fn corner_pair(&self, side: usize) -> [usize; 2] {
        [self.corners[side], self.corners[Self::next_side(side)]]
    }
}

/// The triangles that stay in a pruned skeleton.
struct Graph {
    kept: Vec<bool>,
}

impl Skeleton {
    /// The parts of the branches within a rectangle.
    fn clipped(self, low: Point, high: Point) -> Self {
        let mut branches = Vec::with_capacity(self.branches.len());
        for branch in self.branches {
            let mut part: Vec<SkeletonPoint> = Vec::new();
            for pair in branch.windows(2) {
                let Some([from, to]) = clip(pair[0], pair[1], low, high) else {
                    flush(&mut part, &mut branches);
                    continue;
                };
                if part.last() != Some(&from) {
                    flush(&mut part, &mut branches);
                    part.push(from);
                }
                part.push(to);
            }
            flush(&mut part, &mut branches);
        }
        Self { branches }
    }
}

/// Ends a branch.
fn flush(part: &mut Vec<SkeletonPoint>, branches: &mut Vec<Vec<SkeletonPoint>>) {
    if part.len() > 1 {
        branches.push(std::mem::take(part));
    }
    part.clear();
}

/// The part of a segment within a rectangle (Y.-D. Liang, B. A. Barsky, *A new concept and method for line clipping*, 1984).
fn clip(from: SkeletonPoint, to: SkeletonPoint, low: Point, high: Point) -> Option<[SkeletonPoint; 2]> {
    let d = to.point - from.point;
    let (mut start, mut end) = (0.0f64, 1.0f64);
    for k in 0..2 {
        for (step, room) in [(-d[k], from.point[k] - low[k]), (d[k], high[k] - from.point[k])] {
            if step == 0.0 {
                if room < 0.0 {
                    return None;
                }
            } else if step < 0.0 {
                start = start.max(room / step);
            } else {
                end = end.min(room / step);
            }
        }
    }
    if start >= end {
        return None;
    }
    let at = |t: f64| match t {
        0.0 => from,
        1.0 => to,
        // Between close points of a branch the distance is as good as linear.
        _ => SkeletonPoint { point: from.point + d * t, distance: from.distance + (to.distance - from.distance) * t },
    };
    Some([at(start), at(end)])
}
