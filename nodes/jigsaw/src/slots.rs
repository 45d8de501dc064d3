//! The isthmuses of all pieces, numbered, and which of them claim the same stretch of border.
//!
//! Two isthmuses of a piece are rivals if their match segments share more than half of the shorter one: only one of
//! them can mate. Who rivals whom is a matter of the pieces alone, found once, O(isthmuses of a piece squared) each.

use crate::outline::{Outline, Segment};

/// One isthmus of one piece.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) struct Slot {
    pub(crate) piece: usize,
    /// Number among the isthmuses of all pieces.
    pub(crate) number: usize,
}

/// All isthmuses; those of a piece follow one another, tabs first.
#[derive(Debug, Clone)]
pub(crate) struct Slots<'a> {
    /// Number of the first tab and of the first mouth of each piece, and behind them how many isthmuses there are in all.
    first: Vec<[usize; 2]>,
    /// By number.
    segments: Vec<&'a Segment>,
    /// Of each number where its list begins: itself and its rivals.
    starts: Vec<usize>,
    rivals: Vec<Slot>,
}

impl<'a> Slots<'a> {
    pub(crate) fn new(outlines: &'a [&'a Outline]) -> Self {
        let count = outlines.iter().map(|o| o.tabs.len() + o.mouths.len()).sum();
        let (mut first, mut starts) = (Vec::with_capacity(outlines.len() + 1), Vec::with_capacity(count + 1));
        let (mut segments, mut rivals) = (Vec::with_capacity(count), Vec::with_capacity(count));
        for (piece, o) in outlines.iter().enumerate() {
            let begin = segments.len();
            first.push([begin, begin + o.tabs.len()]);
            segments.extend(o.tabs.iter().chain(&o.mouths));
            for (i, p) in segments[begin..].iter().enumerate() {
                starts.push(rivals.len());
                let near = segments[begin..].iter().enumerate().filter(|(j, q)| i == *j || share(o.length, p, q));
                rivals.extend(near.map(|(j, _)| Slot { piece, number: begin + j }));
            }
        }
        first.push([count; 2]);
        starts.push(rivals.len());
        Self { first, segments, starts, rivals }
    }

    /// How many there are.
    pub(crate) fn count(&self) -> usize {
        self.segments.len()
    }

    /// The tab at some position of a piece's tabs.
    pub(crate) fn tab(&self, piece: usize, index: usize) -> Slot {
        Slot { piece, number: self.first[piece][0] + index }
    }

    /// The mouth at some position of a piece's mouths.
    pub(crate) fn mouth(&self, piece: usize, index: usize) -> Slot {
        Slot { piece, number: self.first[piece][1] + index }
    }

    /// All tabs, or all mouths, of a piece.
    pub(crate) fn of(&self, piece: usize, tabs: bool) -> impl ExactSizeIterator<Item = Slot> + use<> {
        let [first, middle] = self.first[piece];
        let range = if tabs { first..middle } else { middle..self.first[piece + 1][0] };
        range.map(move |number| Slot { piece, number })
    }

    /// Whether it is a tab.
    pub(crate) fn is_tab(&self, slot: Slot) -> bool {
        slot.number < self.first[slot.piece][1]
    }

    /// Its match segment.
    pub(crate) fn segment(&self, slot: Slot) -> &'a Segment {
        self.segments[slot.number]
    }

    /// The isthmuses that can't mate if this one does, itself among them.
    pub(crate) fn rivals(&self, slot: Slot) -> &[Slot] {
        &self.rivals[self.starts[slot.number]..self.starts[slot.number + 1]]
    }

    /// Whether two isthmuses are the same one or rivals.
    pub(crate) fn conflict(&self, p: Slot, q: Slot) -> bool {
        p.piece == q.piece && self.rivals(p).contains(&q)
    }
}

/// Whether two segments of a border of some length share more than half of the shorter one.
fn share(length: f64, p: &Segment, q: &Segment) -> bool {
    // Overlap of two arcs of a circle: one begins inside the other.
    let ahead = (q.arc - p.arc).rem_euclid(length);
    let behind = (p.arc - q.arc).rem_euclid(length);
    let shared = if ahead < p.path {
        (p.path - ahead).min(q.path)
    } else if behind < q.path {
        (q.path - behind).min(p.path)
    } else {
        0.0
    };
    shared > 0.5 * p.path.min(q.path)
}
