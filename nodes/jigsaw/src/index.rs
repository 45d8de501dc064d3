//! Shape index: the tabs whose isthmus distance function (IDF), and the flanks beside it, are nearest to those of a mouth.
//!
//! A k-d tree over the leading cosine coefficients of the mean-removed IDF. The distance between two sets of
//! coefficients never exceeds the root mean square difference of the whole functions, so the k nearest under the
//! whole difference are exact. Where all tabs are cut after one template and differ in little but where they sit on their sides, hundreds have
//! nearly the same IDF, and the flanks tell them apart: they are compared where the samples of the two segments lie on each other best
//! (W. Kabsch, *A solution for the best rotation to relate two sets of vectors*, 1976), which adds to the difference. Neck width and path length are windows that each candidate must pass. Building is
//! O(n log n), a query O(k log n) on the clustered shapes of tabs (measured growth: see the benches).

use crate::outline::{FLANK_SAMPLES, KEYS, Outline, SHAPE_SAMPLES, Segment};
use crate::placement::turn;

/// Entries a leaf of the tree holds: below this a linear scan is faster than descending.
const LEAF: usize = 16;
/// For fewer queries all entries are one leaf: a tree costs as much as so many scans.
const FEW: usize = 16;

/// One tab in the index.
#[derive(Debug, Clone)]
pub(crate) struct Entry<'a> {
    /// Piece and position of the tab in the piece's list.
    pub(crate) piece: u32,
    pub(crate) tab: u32,
    /// Rank of the piece by id, so that ties don't depend on the order of insertion.
    pub(crate) rank: u32,
    pub(crate) segment: &'a Segment,
}

/// Window on the difference of mouth and neck width, in piece scales: clearance on both sides (3 % each) and the
/// uncertainty of a flat minimum on both.
const OPENING_WINDOW: f64 = 0.15;
/// Window on the difference of path lengths, in piece scales: the critical points of a neck with near-parallel sides
/// may slide along it.
const PATH_WINDOW: f64 = 0.4;

/// Most that a flank's distance from the other's counts for, in piece scales: a corner that was not told, on one of the two, must not outweigh the
/// likeness of the tabs, and the tree is searched as far as that (10 000 pieces are matched in twice the time that it takes without flanks, at 0.015 in
/// more than three times).
const MOST_ASIDE: f32 = 0.005;
/// Most distance that the flanks have in common, in piece scales: clearance on both sides.
const MOST_IN_COMMON: f32 = 0.03;

/// Which differences of width and path length (mouth less neck), in pixels, a candidate may have.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Windows {
    pub(crate) opening: (f64, f64),
    pub(crate) path: (f64, f64),
}

impl Windows {
    /// What the mouths of a piece allow.
    pub(crate) fn of(outline: &Outline) -> Self {
        let (w, p) = (OPENING_WINDOW * outline.scale, PATH_WINDOW * outline.scale);
        Self { opening: (-w, w), path: (-p, p) }
    }

    pub(crate) fn let_opening_pass(&self, mouth: &Segment, tab: &Segment) -> bool {
        let opening = mouth.width - tab.width;
        opening >= self.opening.0 && opening <= self.opening.1
    }

    pub(crate) fn let_path_pass(&self, mouth: &Segment, tab: &Segment) -> bool {
        let path = mouth.path - tab.path;
        path >= self.path.0 && path <= self.path.1
    }
}

/// The tree, implicit: entries ordered so that the median of each range splits it.
pub(crate) struct Index<'a> {
    entries: Vec<Entry<'a>>,
    axes: Vec<u8>,
    /// Entries a leaf holds.
    leaf: usize,
}

/// A tab found: distance, then piece and tab.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Hit {
    pub(crate) distance: f32,
    pub(crate) rank: u32,
    pub(crate) piece: u32,
    pub(crate) tab: u32,
}

impl Hit {
    fn key(&self) -> (f32, u32, u32) {
        (self.distance, self.rank, self.tab)
    }

    /// Order by distance, ties by id.
    pub(crate) fn order(&self, other: &Self) -> std::cmp::Ordering {
        let (a, b) = (self.key(), other.key());
        a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)).then(a.2.cmp(&b.2))
    }
}

impl<'a> Index<'a> {
    /// For about so many queries.
    pub(crate) fn new(mut entries: Vec<Entry<'a>>, queries: usize) -> Self {
        let mut axes = vec![0u8; entries.len()];
        let leaf = if queries < FEW { entries.len() } else { LEAF };
        build(&mut entries, &mut axes, leaf);
        Self { entries, axes, leaf }
    }

    /// The `k` nearest tabs of other pieces within the windows, nearest first.
    pub(crate) fn nearest(&self, mouth: &Segment, piece: u32, windows: &Windows, k: usize) -> Vec<Hit> {
        let mut query = Query { mouth, piece, windows, k, hits: Vec::with_capacity(k + 1) };
        self.search(0, self.entries.len(), [0.0; KEYS], &mut query);
        query.hits
    }

    fn search(&self, from: usize, to: usize, offsets: [f32; KEYS], query: &mut Query) {
        if to - from <= self.leaf {
            for entry in &self.entries[from..to] {
                query.offer(entry);
            }
            return;
        }
        let middle = (from + to) / 2;
        let axis = self.axes[middle] as usize;
        let difference = query.mouth.keys[axis] - self.entries[middle].segment.keys[axis];
        let mut far = offsets;
        far[axis] = difference.abs().max(far[axis]);
        let bound: f32 = far.iter().map(|v| v * v).sum();
        query.offer(&self.entries[middle]);
        let (near, other) =
            if difference < 0.0 { ((from, middle), (middle + 1, to)) } else { ((middle + 1, to), (from, middle)) };
        self.search(near.0, near.1, offsets, query);
        if bound.sqrt() <= query.limit() {
            self.search(other.0, other.1, far, query);
        }
    }
}

fn build(entries: &mut [Entry], axes: &mut [u8], leaf: usize) {
    if entries.len() <= leaf {
        return;
    }
    // The axis of the greatest spread halves the range best.
    let mut spread = [0f32; KEYS];
    for (axis, s) in spread.iter_mut().enumerate() {
        let (mut low, mut high) = (f32::INFINITY, f32::NEG_INFINITY);
        for e in entries.iter() {
            low = low.min(e.segment.keys[axis]);
            high = high.max(e.segment.keys[axis]);
        }
        *s = high - low;
    }
    let axis = (0..KEYS).max_by(|a, b| spread[*a].total_cmp(&spread[*b])).unwrap_or(0);
    let middle = entries.len() / 2;
    entries.select_nth_unstable_by(middle, |a, b| a.segment.keys[axis].total_cmp(&b.segment.keys[axis]));
    axes[middle] = axis as u8;
    let (left, right) = entries.split_at_mut(middle);
    let (left_axes, right_axes) = axes.split_at_mut(middle);
    build(left, left_axes, leaf);
    build(&mut right[1..], &mut right_axes[1..], leaf);
}

struct Query<'q> {
    mouth: &'q Segment,
    piece: u32,
    windows: &'q Windows,
    k: usize,
    hits: Vec<Hit>,
}

impl Query<'_> {
    fn limit(&self) -> f32 {
        if self.hits.len() < self.k { f32::INFINITY } else { self.hits[self.k - 1].distance }
    }

    fn offer(&mut self, entry: &Entry) {
        if entry.piece == self.piece {
            return;
        }
        let (mouth, tab) = (self.mouth, entry.segment);
        if !self.windows.let_opening_pass(mouth, tab) || !self.windows.let_path_pass(mouth, tab) {
            return;
        }
        let limit = self.limit();
        if squares(&self.mouth.keys, &entry.segment.keys).sqrt() > limit {
            return;
        }
        let shape = shape_distance(self.mouth, entry.segment);
        if shape > limit {
            return;
        }
        let distance = shape.hypot(flank_distance(self.mouth, entry.segment));
        let hit = Hit { distance, rank: entry.rank, piece: entry.piece, tab: entry.tab };
        if distance > limit {
            return;
        }
        let place = self.hits.partition_point(|h| h.order(&hit).is_lt());
        self.hits.insert(place, hit);
        self.hits.truncate(self.k);
    }
}

fn squares<const N: usize>(a: &[f32; N], b: &[f32; N]) -> f32 {
    a.iter().zip(b).map(|(x, y)| (x - y) * (x - y)).sum()
}

/// Root mean square difference of two mean-removed IDFs, in pixels.
pub(crate) fn shape_distance(a: &Segment, b: &Segment) -> f32 {
    let mut lanes = [0f32; 8];
    for (x, y) in a.shape.chunks_exact(8).zip(b.shape.chunks_exact(8)) {
        for k in 0..8 {
            let d = x[k] - y[k];
            lanes[k] += d * d;
        }
    }
    (lanes.iter().sum::<f32>() / SHAPE_SAMPLES as f32).sqrt()
}

/// Root mean square distance of the flanks of a tab from those of a mouth, in pixels, where the two are put on each other by the samples of
/// their segments; what they have in common, and flanks that end at a corner of the piece, don't count.
fn flank_distance(mouth: &Segment, tab: &Segment) -> f32 {
    let (cos, sin) = turn(tab, mouth);
    let (cos, sin) = (cos as f32, sin as f32);
    let mut asides = [0f32; 2 * FLANK_SAMPLES];
    let mut count = 0;
    for end in 0..2 {
        let reach = tab.reach[end].min(mouth.reach[end]);
        let pairs = tab.flanks[end].iter().zip(&mouth.flanks[end]).zip(&mouth.leans[end]);
        for (([x, y], [u, v]), [nx, ny]) in pairs.take(reach) {
            asides[count] = nx * (u - (cos * x - sin * y)) + ny * (v - (sin * x + cos * y));
            count += 1;
        }
    }
    let asides = &asides[..count];
    let [most, in_common] = [MOST_ASIDE, MOST_IN_COMMON].map(|part| part * mouth.scale);
    let mean = (asides.iter().sum::<f32>() / count.max(1) as f32).clamp(-in_common, in_common);
    let squares: f32 = asides.iter().map(|d| (d - mean).abs().min(most).powi(2)).sum();
    (squares / (2 * FLANK_SAMPLES) as f32).sqrt()
}
