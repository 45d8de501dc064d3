//! Connected components of a binary picture as runs of pixels (A. Rosenfeld, J. L. Pfaltz, *Sequential operations in digital
//! picture processing*, J. ACM 13, 1966; on runs, with union-find): one pass, memory linear in the number of runs.

use crate::changes::changes;

/// Widest gap at which a hole that ends is no more than a speck, in pixels.
const SPECK: usize = 2;

/// Neighbouring pixels of one row.
#[derive(Debug, Clone, Copy)]
pub(super) struct Run {
    pub(super) row: usize,
    pub(super) start: usize,
    /// One past the last pixel.
    pub(super) end: usize,
    /// Index of the component (after [`Components::close`]).
    pub(super) label: usize,
}

/// A connected component.
#[derive(Debug, Clone, Copy)]
pub(super) struct Component {
    pub(super) area: usize,
    pub(super) left: usize,
    pub(super) top: usize,
    /// One past the right-most column.
    pub(super) right: usize,
    /// One past the lowest row.
    pub(super) bottom: usize,
    /// Whether it has a hole that is wider than specks are.
    pub(super) is_hollow: bool,
}

/// Runs and components, filled row by row.
#[derive(Debug, Clone, Default)]
pub(super) struct Components {
    pub(super) runs: Vec<Run>,
    pub(super) list: Vec<Component>,
    parent: Vec<usize>,
    /// Runs that close a hole above them.
    closing: Vec<usize>,
    previous: std::ops::Range<usize>,
    current: usize,
    row: usize,
}

impl Components {
    pub(super) fn clear(&mut self) {
        self.runs.clear();
        self.list.clear();
        self.parent.clear();
        self.closing.clear();
        self.previous = 0..0;
        self.current = 0;
        self.row = 0;
    }

    /// The runs of a component (after [`Components::close`]), found among those of its rows.
    pub(super) fn runs_of(&self, label: usize) -> impl Iterator<Item = &Run> {
        let [from, to] = self
            .list
            .get(label)
            .map_or([0, 0], |c| [c.top, c.bottom].map(|row| self.runs.partition_point(|run| run.row < row)));
        self.runs[from..to].iter().filter(move |run| run.label == label)
    }

    /// Begins a row; rows come in order, each once.
    pub(super) fn begin_row(&mut self, row: usize) {
        self.previous = self.current..self.runs.len();
        self.current = self.runs.len();
        self.row = row;
    }

    /// Adds the runs of the current row where `set` holds.
    pub(super) fn add_row<P: Copy>(&mut self, row: &[P], set: impl Fn(P) -> bool) {
        let mut start = None;
        changes(row, set, |x, begins| match start.take() {
            None if begins => start = Some(x),
            Some(from) => self.push(from, x),
            None => {}
        });
        if let Some(from) = start {
            self.push(from, row.len());
        }
    }

    /// Adds a run of the current row; runs of a row come in order, apart from each other.
    pub(super) fn push(&mut self, start: usize, end: usize) {
        let label = self.parent.len();
        self.parent.push(label);
        // Runs of the row above that end before this one begins cannot touch a later one either.
        while self.previous.start < self.previous.end && self.runs[self.previous.start].end <= start {
            self.previous.start += 1;
        }
        for k in self.previous.clone() {
            if self.runs[k].start >= end {
                break;
            }
            let (a, b) = (self.root(self.runs[k].label), self.root(label));
            // Both sides of the gap before it belong to one component already.
            if a == b && self.runs[k].start - self.runs[k - 1].end > SPECK {
                self.closing.push(label);
            }
            self.parent[a.max(b)] = a.min(b);
        }
        self.runs.push(Run { row: self.row, start, end, label });
    }

    fn root(&mut self, mut node: usize) -> usize {
        while self.parent[node] != node {
            self.parent[node] = self.parent[self.parent[node]];
            node = self.parent[node];
        }
        node
    }

    /// Labels the runs and lists the components, in the order of their first pixel.
    pub(super) fn close(&mut self) {
        for k in 0..self.runs.len() {
            // A component's root is its first run: met before the others.
            let root = self.root(k);
            let label = if root == k { self.list.len() } else { self.runs[root].label };
            let run = &mut self.runs[k];
            run.label = label;
            if root == k {
                self.list.push(Component {
                    area: 0,
                    left: run.start,
                    top: run.row,
                    right: run.end,
                    bottom: run.row + 1,
                    is_hollow: false,
                });
            }
            let c = &mut self.list[run.label];
            c.area += run.end - run.start;
            c.left = c.left.min(run.start);
            c.right = c.right.max(run.end);
            c.bottom = run.row + 1;
        }
        for run in &self.closing {
            self.list[self.runs[*run].label].is_hollow = true;
        }
    }
}
