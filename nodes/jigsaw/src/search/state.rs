//! What a search changes and takes back: islands of pieces, their poses, and the matings on which these rest.
//!
//! Islands are disjoint sets whose members form a ring, so that two are united by exchanging two links, whatever their
//! sizes, and a whole state is a few flat vectors: to save one before a step that may be undone is one copy of each. Steps
//! that change little write down what was there before instead.

use crate::loops::Edge;
use crate::slots::{Slot, Slots};
use nalgebra::Isometry2;
use std::collections::BTreeMap;

/// Islands, poses and matings.
#[derive(Debug, Clone)]
pub(super) struct State {
    /// Island of each piece: one of its members.
    island: Vec<usize>,
    /// The next member of its island, in a ring.
    next: Vec<usize>,
    /// Members of the island of that number.
    size: Vec<usize>,
    /// Pose of each piece in its island (island from image).
    pose: Vec<Isometry2<f64>>,
    /// Size of each island when its poses were adjusted last.
    adjusted: Vec<usize>,
    /// Candidates that are matings, in the order in which they were taken.
    joined: Vec<usize>,
    /// The mating at each isthmus, by its number.
    used: Vec<Option<usize>>,
    /// Evidence for pieces that were placed because their whole border fits.
    pub(super) fitted: BTreeMap<usize, f64>,
    /// What the changes of a step that may be undone have replaced; none where there is no such step.
    replaced: Option<Vec<Replaced>>,
}

/// What was there before a change.
#[derive(Debug, Clone)]
enum Replaced {
    Pose(usize, Isometry2<f64>),
    Adjusted(usize, usize),
    Mating(Slot, Option<usize>),
    /// One more among those joined.
    Joined,
    /// Two islands, the first of which has become part of the second, and the size of the first.
    Islands(usize, usize, usize),
}

impl State {
    /// So many pieces, each by itself, with their isthmuses.
    pub(super) fn new(n: usize, slots: &Slots) -> Self {
        Self {
            island: (0..n).collect(),
            next: (0..n).collect(),
            size: vec![1; n],
            pose: vec![Isometry2::identity(); n],
            adjusted: vec![1; n],
            joined: Vec::new(),
            used: vec![None; slots.count()],
            fitted: BTreeMap::new(),
            replaced: None,
        }
    }

    /// Takes a step that is undone unless it succeeds; it changes poses, islands and matings one by one.
    pub(super) fn begin(&mut self) {
        self.replaced = Some(Vec::new());
    }

    /// Ends such a step.
    pub(super) fn end(&mut self, succeeded: bool) {
        let replaced = self.replaced.take().filter(|_| !succeeded);
        for before in replaced.into_iter().flatten().rev() {
            match before {
                Replaced::Pose(piece, pose) => self.pose[piece] = pose,
                Replaced::Adjusted(island, size) => self.adjusted[island] = size,
                Replaced::Mating(slot, mating) => self.used[slot.number] = mating,
                Replaced::Joined => drop(self.joined.pop()),
                Replaced::Islands(from, to, size) => {
                    // Exchanged once more, the two links part the rings again.
                    self.next.swap(from, to);
                    self.belong(from, from);
                    (self.size[from], self.size[to]) = (size, self.size[to] - size);
                }
            }
        }
    }

    fn replace(&mut self, before: Replaced) {
        if let Some(replaced) = &mut self.replaced {
            replaced.push(before);
        }
    }

    /// Pose of a piece in its island (island from image).
    pub(super) fn pose(&self, piece: usize) -> &Isometry2<f64> {
        &self.pose[piece]
    }

    /// Lays a piece down anew in its island.
    pub(super) fn lay(&mut self, piece: usize, pose: Isometry2<f64>) {
        self.replace(Replaced::Pose(piece, self.pose[piece]));
        self.pose[piece] = pose;
    }

    /// Size of an island when its poses were adjusted last.
    pub(super) fn adjusted(&self, island: usize) -> usize {
        self.adjusted[island]
    }

    /// Notes that the poses of an island are being adjusted.
    pub(super) fn note_adjusted(&mut self, island: usize) {
        self.replace(Replaced::Adjusted(island, self.adjusted[island]));
        self.adjusted[island] = self.size[island];
    }

    /// Island of a piece.
    pub(super) fn island(&self, piece: usize) -> usize {
        self.island[piece]
    }

    /// How many pieces the island of a piece has.
    pub(super) fn size(&self, piece: usize) -> usize {
        self.size[self.island[piece]]
    }

    /// Whether a piece is an island by itself.
    pub(super) fn alone(&self, piece: usize) -> bool {
        self.size(piece) == 1
    }

    /// All islands.
    pub(super) fn islands(&self) -> impl Iterator<Item = usize> {
        (0..self.island.len()).filter(|k| self.island[*k] == *k)
    }

    /// Pieces of an island, itself first.
    pub(super) fn members(&self, island: usize) -> impl ExactSizeIterator<Item = usize> {
        let mut next = island;
        (0..self.size[island]).map(move |_| {
            let piece = next;
            next = self.next[piece];
            piece
        })
    }

    /// Size of the largest island.
    pub(super) fn largest(&self) -> usize {
        self.islands().map(|k| self.size[k]).max().unwrap_or(0)
    }

    /// Makes the members of one island members of another; their poses are the caller's.
    pub(super) fn unite(&mut self, from: usize, to: usize) {
        self.replace(Replaced::Islands(from, to, self.size[from]));
        self.belong(from, to);
        self.next.swap(from, to);
        self.size[to] += std::mem::take(&mut self.size[from]);
    }

    /// Numbers all pieces in the ring of one as those of an island.
    fn belong(&mut self, piece: usize, island: usize) {
        let mut k = piece;
        loop {
            self.island[k] = island;
            k = self.next[k];
            if k == piece {
                break;
            }
        }
    }

    /// Candidates that are matings, in the order in which they were taken.
    pub(super) fn joined(&self) -> &[usize] {
        &self.joined
    }

    /// The mating at an isthmus.
    pub(super) fn mating_at(&self, slot: Slot) -> Option<usize> {
        self.used[slot.number]
    }

    /// Takes a candidate as a mating of two isthmuses.
    pub(super) fn take(&mut self, candidate: usize, slots: [Slot; 2]) {
        if slots.iter().any(|s| self.used[s.number] != Some(candidate)) {
            self.replace(Replaced::Joined);
            self.joined.push(candidate);
        }
        for slot in slots {
            self.replace(Replaced::Mating(slot, self.used[slot.number]));
            self.used[slot.number] = Some(candidate);
        }
    }

    /// Keeps some of the matings only; what no longer hangs together becomes islands apart.
    pub(super) fn keep(&mut self, edges: &[Edge], stays: impl Fn(usize) -> bool) {
        self.joined.retain(|k| stays(*k));
        for used in &mut self.used {
            *used = used.filter(|k| stays(*k));
        }
        for k in 0..self.island.len() {
            (self.island[k], self.next[k], self.size[k]) = (k, k, 1);
        }
        for k in std::mem::take(&mut self.joined) {
            let (a, b) = (self.island[edges[k].a], self.island[edges[k].b]);
            if a != b {
                let (from, to) = if self.size[a] <= self.size[b] { (a, b) } else { (b, a) };
                self.unite(from, to);
            }
            self.joined.push(k);
        }
        self.adjusted.copy_from_slice(&self.size);
    }
}
