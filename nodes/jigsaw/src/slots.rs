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
    outlines: &'a [&'a Outline],
    /// Number of the first isthmus of each piece, and how many there are in all.
    first: Vec<usize>,
    /// By number: itself and its rivals.
    rivals: Vec<Vec<Slot>>,
}

impl<'a> Slots<'a> {
    pub(crate) fn new(outlines: &'a [&'a Outline]) -> Self {
        let mut first = vec![0];
        let mut rivals = Vec::new();
        for (piece, o) in outlines.iter().enumerate() {
            let begin = rivals.len();
            let segments: Vec<&Segment> = o.tabs.iter().chain(&o.mouths).collect();
            let slot = |k: usize| Slot { piece, number: begin + k };
            rivals.extend(segments.iter().enumerate().map(|(i, p)| {
                let near = segments.iter().enumerate().filter(|(j, q)| i == *j || share(o.length, p, q));
                near.map(|(j, _)| slot(j)).collect::<Vec<Slot>>()
            }));
            first.push(rivals.len());
        }
        Self { outlines, first, rivals }
    }

    /// How many there are.
    pub(crate) fn count(&self) -> usize {
        self.rivals.len()
    }

    /// The tab at some position of a piece's tabs.
    pub(crate) fn tab(&self, piece: usize, index: usize) -> Slot {
        Slot { piece, number: self.first[piece] + index }
    }

    /// The mouth at some position of a piece's mouths.
    pub(crate) fn mouth(&self, piece: usize, index: usize) -> Slot {
        Slot { piece, number: self.first[piece] + self.outlines[piece].tabs.len() + index }
    }

    /// All tabs, or all mouths, of a piece.
    pub(crate) fn of(&self, piece: usize, tabs: bool) -> impl Iterator<Item = Slot> {
        let middle = self.first[piece] + self.outlines[piece].tabs.len();
        let range = if tabs { self.first[piece]..middle } else { middle..self.first[piece + 1] };
        range.map(move |number| Slot { piece, number })
    }

    /// Whether it is a tab.
    pub(crate) fn is_tab(&self, slot: Slot) -> bool {
        slot.number - self.first[slot.piece] < self.outlines[slot.piece].tabs.len()
    }

    /// Its match segment.
    pub(crate) fn segment(&self, slot: Slot) -> &'a Segment {
        let outline = self.outlines[slot.piece];
        let index = slot.number - self.first[slot.piece];
        outline.tabs.get(index).unwrap_or_else(|| &outline.mouths[index - outline.tabs.len()])
    }

    /// The isthmuses that can't mate if this one does, itself among them.
    pub(crate) fn rivals(&self, slot: Slot) -> &[Slot] {
        &self.rivals[slot.number]
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
