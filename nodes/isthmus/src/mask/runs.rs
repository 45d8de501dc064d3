//! Connected components of a binary picture as runs of pixels (A. Rosenfeld, J. L. Pfaltz, *Sequential operations in digital
//! picture processing*, J. ACM 13, 1966; on runs, with union-find): one pass, memory linear in the number of runs.

use crate::changes::changes;

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
}

/// How far beyond an opening the body of a component may reach, in pixels: its corners, and what noise adds to its edge.
const BODY_END: usize = 2;

/// Least length of a thread beyond that, in widths: what is shorter may be a sharp corner.
const THREAD_LENGTH: usize = 4;

/// Keeps of spans what they have in common with others; both rise, without overlap among themselves.
fn keep_common(spans: &mut Vec<[usize; 2]>, others: &[[usize; 2]]) {
    let common = |[from, to]: [usize; 2], [s, e]: [usize; 2]| [from.max(s), to.min(e)];
    if let ([span], [other]) = (&mut spans[..], others) {
        *span = common(*span, *other);
    } else {
        *spans = spans.iter().flat_map(|span| others.iter().map(|other| common(*span, *other))).collect();
    }
    spans.retain(|[from, to]| from < to);
}

/// Runs and components, filled row by row.
#[derive(Debug, Clone, Default)]
pub(super) struct Components {
    pub(super) runs: Vec<Run>,
    pub(super) list: Vec<Component>,
    parent: Vec<usize>,
    previous: std::ops::Range<usize>,
    current: usize,
    row: usize,
}

impl Components {
    pub(super) fn clear(&mut self) {
        self.runs.clear();
        self.list.clear();
        self.parent.clear();
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

    /// What of a component is at most `2 reach` pixels wide and leads far away from its body: what an opening with a square takes away (G. Matheron,
    /// *Random sets and integral geometry*, 1975), the body's own corners aside.
    pub(super) fn threads(&self, label: usize, reach: usize) -> Vec<Run> {
        let Some(c) = self.list.get(label) else { return Vec::new() };
        let rows = self.filled(label, c);
        let near = |row: usize, reach: usize| row.saturating_sub(reach)..rows.len().min(row + reach + 1);
        let shrunk = |spans: &[[usize; 2]]| -> Vec<[usize; 2]> {
            spans.iter().map(|[start, end]| [start + reach, end.saturating_sub(reach)]).filter(|[s, e]| s < e).collect()
        };
        let narrow: Vec<Vec<[usize; 2]>> = rows.iter().map(|spans| shrunk(spans)).collect();
        let core = |row: usize| {
            let whole = row >= reach && row + reach < rows.len();
            let mut core = if whole { narrow[row].clone() } else { Vec::new() };
            narrow[near(row, reach)].iter().for_each(|spans| keep_common(&mut core, spans));
            core
        };
        let core: Vec<Vec<[usize; 2]>> = (0..rows.len()).map(core).collect();
        let grown = reach + BODY_END;
        let mut threads = Self::default();
        for (row, spans) in rows.iter().enumerate() {
            threads.begin_row(c.top + row);
            // The usual row: its body reaches from end to end.
            if let ([[from, to]], [[start, end]]) = (&core[row][..], &spans[..])
                && from.saturating_sub(grown) <= *start
                && to + grown >= *end
            {
                continue;
            }
            let around = core[near(row, grown)].iter().flatten();
            let mut body: Vec<[usize; 2]> = around.map(|[s, e]| [s.saturating_sub(grown), e + grown]).collect();
            body.sort_unstable();
            for &[first, end] in spans {
                let mut start = first;
                for [from, to] in body.iter().copied().chain([[end, end]]) {
                    if start < from.min(end) {
                        threads.push(start, from.min(end));
                    }
                    start = start.max(to);
                }
            }
        }
        threads.close();
        let is_long = |t: &Component| (t.right - t.left).max(t.bottom - t.top) >= THREAD_LENGTH * 2 * reach;
        threads.runs.iter().filter(|run| is_long(&threads.list[run.label])).copied().collect()
    }

    /// The spans of a component row by row, its holes filled: a strip that is split off a shape's edge, but not its ends, is no thread.
    fn filled(&self, label: usize, c: &Component) -> Vec<Vec<[usize; 2]>> {
        let mut rows: Vec<Vec<[usize; 2]>> = vec![Vec::new(); c.bottom - c.top];
        self.runs_of(label).for_each(|run| rows[run.row - c.top].push([run.start, run.end]));
        let mut gaps = Self::default();
        for (row, spans) in rows.iter().enumerate() {
            gaps.begin_row(row);
            let ends = std::iter::once(c.left).chain(spans.iter().map(|s| s[1]));
            let starts = spans.iter().map(|s| s[0]).chain([c.right]);
            ends.zip(starts).filter(|(from, to)| from < to).for_each(|(from, to)| gaps.push(from, to));
        }
        gaps.close();
        let end = rows.len();
        let is_hole = |g: &Component| g.left > c.left && g.right < c.right && g.top > 0 && g.bottom < end;
        for gap in gaps.runs.iter().filter(|gap| is_hole(&gaps.list[gap.label])) {
            let spans = &mut rows[gap.row];
            if let Some(after) = spans.iter().position(|span| span[0] == gap.end)
                && after > 0
            {
                spans[after - 1][1] = spans[after][1];
                spans.remove(after);
            }
        }
        rows
    }

    fn push(&mut self, start: usize, end: usize) {
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
        let mut index = vec![usize::MAX; self.parent.len()];
        for k in 0..self.runs.len() {
            let root = self.root(self.runs[k].label);
            let run = &mut self.runs[k];
            if index[root] == usize::MAX {
                index[root] = self.list.len();
                self.list.push(Component {
                    area: 0,
                    left: run.start,
                    top: run.row,
                    right: run.end,
                    bottom: run.row + 1,
                });
            }
            run.label = index[root];
            let c = &mut self.list[run.label];
            c.area += run.end - run.start;
            c.left = c.left.min(run.start);
            c.right = c.right.max(run.end);
            c.bottom = run.row + 1;
        }
    }
}
