//! Isthmuses: locally shortest chords.
//!
//! # Method
//! After Webster, Ross, LaFollette and Stafford (MVA 1990) an isthmus is a local minimum of the distance value along the
//! Euclidean skeleton; the isthmus critical points (ICPs) are where its disc touches the border. Found without pixels:
//! 1. On the Delaunay triangulation of the border ([`Triangulation`]) the distance function of the region has its maxima
//!    at circumcentres, and its saddles at the middles of those edges that cross their own Voronoi edge (their diametral
//!    disc is empty: Gabriel edges). Where an edge does not, the way over it is as wide as the narrower of the two discs
//!    it separates.
//! 2. *Persistence* (H. Edelsbrunner, D. Letscher, A. Zomorodian, *Topological persistence and simplification*, 2002): going
//!    through the edges from the widest to the narrowest, each joins two parts of the region (union-find). The part with the
//!    smaller largest disc ends there; by how much that disc is wider than the edge is the persistence of the isthmus. The
//!    minima that noise and sampling make along a neck with parallel sides have next to none, and one of them
//!    stays, the deepest. What lies outside the convex hull counts as one infinitely wide disc.
//! 3. The chord slides along the border to its shortest, and Newton's method moves its ends on to where it meets the border,
//!    taken for a smooth curve, at right angles.
//!
//! # Cost
//! `O(n log n)` in the number of border points; the refinement is constant for each isthmus.
//!
//! # Failure
//! Passages narrower than about two steps of the border are not resolved. A bump without a neck has no isthmus.

use crate::Point;
use crate::contour::Border;
pub use crate::skeleton::Polarity;
use crate::skeleton::{NO_NEIGHBOUR, Triangulation};
use nalgebra::Vector2;

/// An isthmus line with its match segment.
#[derive(Debug, Clone, PartialEq)]
pub struct Isthmus {
    /// Neck or mouth.
    pub polarity: Polarity,
    /// Isthmus point `I_p`: midpoint of the isthmus line.
    pub point: Point,
    /// Isthmus critical points (ICPs): the ends of the isthmus line, first the one where the match segment begins
    /// when one walks forward along the border.
    pub critical_points: [Point; 2],
    /// Positions of the critical points on the border: arc length from `border.points[0]`, in pixels, each in
    /// `0..border length`; the match segment runs forward from the first to the second (it may wrap round).
    pub arc: [f64; 2],
    /// Length of the isthmus line, in pixels.
    pub width: f64,
    /// Length of the match segment, in pixels.
    pub path_length: f64,
    /// By how much the shape widens (in pixels of width) before the branch ends on the narrower of the two sides.
    pub persistence: f64,
    /// Whether this is taken for a real neck or mouth rather than a shallow waist of the body.
    pub salient: bool,
}

/// Least persistence in steps of the border: the saddles between the samples of parallel sides have less.
const MIN_PERSISTENCE_STEPS: f64 = 0.5;
/// Least persistence in standard deviations of a border point: chance minima of a noisy neck have less (both ends of
/// both chords vary, and there are many of them).
const MIN_PERSISTENCE_NOISE: f64 = 6.0;
/// Least persistence of a salient neck, as a part of its width: the tabs of real pieces widen by a fifth at least, the waists
/// between blanks and sides by less than a tenth as a rule.
const SALIENT_NECK_PERSISTENCE: f64 = 0.12;
/// Most area beyond a salient neck, as a part of the shape's: a lobe, not a limb of the body (tabs of real pieces have up to
/// a tenth, the corner between two blanks more).
const SALIENT_NECK_AREA: f64 = 0.13;
/// Least area beyond a salient neck or behind a salient mouth, as a part of the shape's: tabs have a hundredth and more, frayed edges and
/// dents less.
const SALIENT_AREA: f64 = 0.004;
/// Greatest width of a salient neck, as a part of the square root of the shape's area.
const SALIENT_NECK_WIDTH: f64 = 0.32;
/// Least persistence of a salient mouth, as a part of its width. There are few pockets that are no blanks.
const SALIENT_MOUTH_PERSISTENCE: f64 = 0.04;
/// Most area behind a salient mouth, as a part of the shape's.
const SALIENT_MOUTH_AREA: f64 = 0.2;
/// How far the chord's ends are tried, in steps, while it slides to its shortest.
const SLIDE: isize = 3;
/// Most slides of a chord: far more than a neck is long compared with [`SLIDE`]; guards against pathological borders.
const MAX_SLIDES: usize = 10_000;
/// Reach of the second differences that give a border's bend at a chord's ends, in steps.
const BEND: isize = 2;
/// Newton steps to the shortest chord: each gains digits as long as there is a minimum of its own.
const STEPS: usize = 8;
/// The shortest chord is found when its ends move by less than this, in steps.
const CONVERGED: f64 = 1e-3;
/// How far the shortest chord may be from the shortest between border points, in steps: beyond, the sides are parallel.
const MAX_SHIFT: f64 = 4.0;

/// An edge of the triangulation as a passage between two discs.
struct Passage {
    /// Half the width of the passage.
    radius: f64,
    /// A side of the triangulation.
    side: usize,
}

/// Finds the isthmuses of a border, salient ones first, then by falling persistence. `noise` is the standard deviation of
/// a border point across the border, in pixels.
#[must_use]
pub fn find(border: &Border, triangulation: &Triangulation, noise: f64) -> Vec<Isthmus> {
    let swept = Swept::new(border);
    let mut found: Vec<Isthmus> = persistent_saddles(border, triangulation, noise)
        .into_iter()
        .filter_map(|saddle| isthmus_at(border, &swept, triangulation, saddle))
        .collect();
    found.sort_by(|a, b| {
        b.salient.cmp(&a.salient).then(b.persistence.total_cmp(&a.persistence)).then(a.arc[0].total_cmp(&b.arc[0]))
    });
    found
}

/// The sides of the triangulation that are isthmuses, with their persistence.
fn persistent_saddles(border: &Border, triangulation: &Triangulation, noise: f64) -> Vec<(usize, f64)> {
    let outside = triangulation.discs.len();
    // Discs on (nearly) straight parts of the border have any radius, and rounding differs from one to the next: all that
    // are larger than the shape count as equally wide.
    let cap = triangulation.extent;
    let mut passages = Vec::with_capacity(triangulation.corners.len() / 2);
    for side in 0..triangulation.corners.len() {
        let neighbour = triangulation.neighbours[side];
        if neighbour != NO_NEIGHBOUR && neighbour < side {
            continue;
        }
        if triangulation.is_passage(side) {
            passages.push(Passage { radius: passage_radius(border, triangulation, side).min(cap), side });
        }
    }
    passages.sort_unstable_by(|a, b| b.radius.total_cmp(&a.radius).then(a.side.cmp(&b.side)));

    let threshold = (MIN_PERSISTENCE_STEPS * border.spacing).max(MIN_PERSISTENCE_NOISE * noise);
    let mut regions = Regions::new(triangulation.discs.iter().map(|d| d.distance.min(cap)).chain([f64::INFINITY]));
    let mut saddles = Vec::new();
    for Passage { radius, side } in passages {
        let neighbour = triangulation.neighbours[side];
        let there = if neighbour == NO_NEIGHBOUR { outside } else { neighbour / 3 };
        if let Some(largest) = regions.join(side / 3, there) {
            let persistence = 2.0 * (largest - radius);
            if persistence > threshold {
                saddles.push((side, persistence));
            }
        }
    }
    saddles
}

/// Half the width of the way over a side of the triangulation.
fn passage_radius(border: &Border, triangulation: &Triangulation, side: usize) -> f64 {
    let [i, j] = triangulation.ends(side);
    let (p, q) = (border.points[i], border.points[j]);
    let blocked = |side: usize| {
        // The third corner within the diametral disc: the edge does not cross its Voronoi edge.
        let third = border.points[triangulation.ends(Triangulation::next_side(side))[1]];
        (p - third).dot(&(q - third)) < 0.0
    };
    let neighbour = triangulation.neighbours[side];
    if blocked(side) || (neighbour != NO_NEIGHBOUR && blocked(neighbour)) {
        let disc = |side: usize| triangulation.discs[side / 3].distance;
        if neighbour == NO_NEIGHBOUR { disc(side) } else { disc(side).min(disc(neighbour)) }
    } else {
        (q - p).norm() / 2.0
    }
}

/// Union-find over discs; each region knows its largest.
struct Regions {
    parent: Vec<usize>,
    largest: Vec<f64>,
}

impl Regions {
    fn new(radii: impl Iterator<Item = f64>) -> Self {
        let largest: Vec<f64> = radii.collect();
        Self { parent: (0..largest.len()).collect(), largest }
    }

    fn root(&mut self, mut node: usize) -> usize {
        while self.parent[node] != node {
            self.parent[node] = self.parent[self.parent[node]];
            node = self.parent[node];
        }
        node
    }

    /// Joins the regions of two discs; gives the smaller of their largest radii, or `None` if they were one before.
    fn join(&mut self, a: usize, b: usize) -> Option<f64> {
        let (a, b) = (self.root(a), self.root(b));
        if a == b {
            return None;
        }
        let (small, large) = if self.largest[a] < self.largest[b] { (a, b) } else { (b, a) };
        self.parent[small] = large;
        Some(self.largest[small])
    }
}

/// The isthmus whose chord is near a side of the triangulation.
fn isthmus_at(
    border: &Border,
    swept: &Swept,
    triangulation: &Triangulation,
    (side, persistence): (usize, f64),
) -> Option<Isthmus> {
    let polarity = triangulation.polarity[side / 3];
    let [i, j] = triangulation.ends(side);
    let [s, t] = refine(border, slide(border, [i, j]));
    let length = border.length();
    let (s, t) = (s.rem_euclid(length), t.rem_euclid(length));
    let (p, q) = (border.point_at(s), border.point_at(t));
    let lobe = swept.lobe(border, [s, t]);
    let area = swept.total();
    let forward = match polarity {
        Polarity::Positive => border.forward(s, t) <= border.forward(t, s),
        // Border and chord run round a pocket the other way than round the shape.
        Polarity::Negative => lobe < 0.0,
    };
    let (arc, critical_points, lobe) = if forward { ([s, t], [p, q], lobe) } else { ([t, s], [q, p], area - lobe) };
    let width = (q - p).norm();
    let path_length = border.forward(arc[0], arc[1]);
    if !(width > 0.0 && path_length > width) {
        return None;
    }
    let is_large = lobe.abs() >= SALIENT_AREA * area;
    let salient = is_large
        && match polarity {
            Polarity::Positive => {
                persistence >= SALIENT_NECK_PERSISTENCE * width
                    && lobe.abs() <= SALIENT_NECK_AREA * area
                    && width <= SALIENT_NECK_WIDTH * area.sqrt()
            }
            Polarity::Negative => {
                persistence >= SALIENT_MOUTH_PERSISTENCE * width && lobe.abs() <= SALIENT_MOUTH_AREA * area
            }
        };
    Some(Isthmus {
        polarity,
        point: nalgebra::center(&p, &q),
        critical_points,
        arc,
        width,
        path_length,
        persistence,
        salient,
    })
}

/// Slides both ends of a chord along the border until no shorter one is near.
fn slide(border: &Border, ends: [usize; 2]) -> [usize; 2] {
    let n = border.points.len();
    let moved = |i: usize, by: isize| (i as isize + by).rem_euclid(n as isize) as usize;
    let squared = |i: usize, j: usize| (border.points[i] - border.points[j]).norm_squared();
    let mut best = (squared(ends[0], ends[1]), ends);
    for _ in 0..MAX_SLIDES {
        let [i, j] = best.1;
        for a in -SLIDE..=SLIDE {
            for b in -SLIDE..=SLIDE {
                let (i, j) = (moved(i, a), moved(j, b));
                let length = squared(i, j);
                if length < best.0 && i.abs_diff(j) > 1 {
                    best = (length, [i, j]);
                }
            }
        }
        if best.1 == [i, j] {
            break;
        }
    }
    best.1
}

/// Arc lengths of the ends of the shortest chord near a chord between border points: where it meets the border, taken for a
/// smooth curve through its points, at right angles on both ends.
fn refine(border: &Border, [i, j]: [usize; 2]) -> [f64; 2] {
    let n = border.points.len() as isize;
    let at = |i: isize| border.points[i.rem_euclid(n) as usize].coords;
    let bend = |i: usize| {
        let i = i as isize;
        (at(i - BEND) - at(i) * 2.0 + at(i + BEND)) / (BEND * BEND) as f64
    };
    let bends = [bend(i), bend(j)];
    // Point and tangent of a curve through the border points (E. Catmull, R. Rom, 1974), some steps from one of them.
    let curve = |i: usize, shift: f64| {
        let k = i as isize + shift.floor() as isize;
        let t = shift - shift.floor();
        let [a, b, c, d] = [at(k - 1), at(k), at(k + 1), at(k + 2)];
        let (linear, square, cube) = ((c - a) / 2.0, a - b * 2.5 + c * 2.0 - d * 0.5, (d - a + (b - c) * 3.0) / 2.0);
        (b + (linear + (square + cube * t) * t) * t, linear + (square * 2.0 + cube * (3.0 * t)) * t)
    };
    let start = [i as f64 * border.spacing, j as f64 * border.spacing];
    let (mut u, mut v) = (0.0, 0.0);
    for _ in 0..STEPS {
        let ((p, dp), (q, dq)) = (curve(i, u), curve(j, v));
        let chord = p - q;
        let gradient = [chord.dot(&dp), -chord.dot(&dq)];
        let (uu, uv, vv) = (dp.dot(&dp) + chord.dot(&bends[0]), -dp.dot(&dq), dq.dot(&dq) - chord.dot(&bends[1]));
        let determinant = uu * vv - uv * uv;
        if !(uu > 0.0 && determinant > 0.0) {
            return start;
        }
        let step =
            [(uv * gradient[1] - vv * gradient[0]) / determinant, (uv * gradient[0] - uu * gradient[1]) / determinant];
        let longest = step[0].abs().max(step[1].abs());
        // Far steps are cut short: the bend is known here, not there.
        let part = 1.0 / longest.max(1.0);
        (u, v) = (u + step[0] * part, v + step[1] * part);
        if u.abs().max(v.abs()) > MAX_SHIFT {
            return start;
        }
        if longest < CONVERGED {
            break;
        }
    }
    [start[0] + u * border.spacing, start[1] + v * border.spacing]
}

/// Area swept by the ray from the first border point to the others, up to each of them.
struct Swept {
    up_to: Vec<f64>,
}

impl Swept {
    fn new(border: &Border) -> Self {
        let Some(&origin) = border.points.first() else { return Self { up_to: vec![0.0] } };
        let mut sum = 0.0;
        let mut before = Vector2::zeros();
        let after = border.points.iter().skip(1).chain([&origin]).map(|p| {
            let ray = p - origin;
            sum += before.perp(&ray) / 2.0;
            before = ray;
            sum
        });
        Self { up_to: std::iter::once(0.0).chain(after).collect() }
    }

    /// Area of the shape.
    fn total(&self) -> f64 {
        self.up_to.last().copied().unwrap_or(0.0)
    }

    /// Signed area between the border from `arc[0]` forward to `arc[1]` (both in `0..length`) and the chord back.
    fn lobe(&self, border: &Border, arc: [f64; 2]) -> f64 {
        let origin = border.points[0];
        let rays = arc.map(|s| border.point_at(s) - origin);
        let [from, to] = [0, 1].map(|k| {
            let i = ((arc[k] / border.spacing) as usize).min(border.points.len() - 1);
            self.up_to[i] + (border.points[i] - origin).perp(&rays[k]) / 2.0
        });
        let whole = if arc[1] < arc[0] { self.total() } else { 0.0 };
        to - from + whole + rays[1].perp(&rays[0]) / 2.0
    }
}
