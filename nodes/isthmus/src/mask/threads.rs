//! Threads that hang on a component: what of it is narrow and leads far away from its body.
//!
//! # Method
//! An opening with a square takes away what is narrower than the square (G. Matheron, *Random sets and integral geometry*, 1975); what
//! it leaves is the body. On rows of spans, all in one pass each:
//! 1. Holes are filled: a strip that is split off a shape's edge, but not its ends, is no thread.
//! 2. *Core*: spans are shortened at both ends, and a row keeps what it has in common with the rows about it.
//! 3. *Body*: the core grown by as much, and by a little more for its own corners. Spans that it covers, nearly all, are told by a look at the
//!    cores about them; from the others it is taken off.
//! 4. What remains is joined to connected components once more; those that are long are threads.
//!
//! # Cost
//! Linear in the number of spans, times the height of the square; linear memory, kept from one component to the next.

use super::runs::{Components, Run};

/// How far beyond an opening the body of a component may reach, in pixels: its corners, and what noise adds to its edge.
const BODY_END: usize = 2;

/// Least length of a thread beyond that, in widths: what is shorter may be a sharp corner.
const LENGTH: usize = 4;

/// From a pixel to one past the last, in one row.
type Span = [usize; 2];

/// Spans row by row, in one list.
#[derive(Debug, Clone, Default)]
struct Rows {
    spans: Vec<Span>,
    /// Where in the list each row begins, and where the last one ends.
    bounds: Vec<usize>,
}

impl Rows {
    fn clear(&mut self) {
        self.spans.clear();
        self.bounds.clear();
        self.bounds.push(0);
    }

    /// Number of rows that are closed.
    fn count(&self) -> usize {
        self.bounds.len().saturating_sub(1)
    }

    /// The spans of some rows that follow each other.
    fn of(&self, rows: std::ops::Range<usize>) -> &[Span] {
        &self.spans[self.bounds[rows.start]..self.bounds[rows.end]]
    }

    fn row(&self, row: usize) -> &[Span] {
        self.of(row..row + 1)
    }

    /// Closes the current row; how many spans it has.
    fn close_row(&mut self) -> usize {
        let begin = self.bounds.last().copied().unwrap_or_default();
        self.bounds.push(self.spans.len());
        self.spans.len() - begin
    }
}

/// Finds threads, keeping its buffers from one component to the next.
#[derive(Debug, Clone, Default)]
pub(super) struct Threads {
    filled: Rows,
    narrow: Rows,
    core: Rows,
    common: Vec<Span>,
    next: Vec<Span>,
    body: Vec<Span>,
    gaps: Components,
    /// For each of the gaps whether it leads out of the component.
    is_open: Vec<bool>,
    rest: Components,
}

impl Threads {
    /// What of a component is at most `2 reach` pixels wide and leads far away from its body.
    pub(super) fn find(&mut self, components: &Components, label: usize, reach: usize) -> impl Iterator<Item = &Run> {
        self.fill(components, label);
        self.erode(reach);
        let top = components.list.get(label).map_or(0, |c| c.top);
        self.subtract_body(top, reach + BODY_END);
        let rest = &self.rest;
        let is_long = move |run: &&Run| {
            let c = &rest.list[run.label];
            (c.right - c.left).max(c.bottom - c.top) >= LENGTH * 2 * reach
        };
        rest.runs.iter().filter(is_long)
    }

    /// Takes the spans of a component over, its holes filled.
    fn fill(&mut self, components: &Components, label: usize) {
        let Self { filled, gaps, is_open, .. } = self;
        filled.clear();
        let Some(c) = components.list.get(label) else { return };
        for run in components.runs_of(label) {
            while filled.count() < run.row - c.top {
                filled.close_row();
            }
            filled.spans.push([run.start, run.end]);
        }
        filled.close_row();
        let rows = filled.count();
        if filled.spans.len() == rows {
            return;
        }
        gaps.clear();
        for row in 0..rows {
            gaps.begin_row(row);
            for pair in filled.row(row).windows(2) {
                gaps.push(pair[0][1], pair[1][0]);
            }
        }
        gaps.close();
        // A gap leads out where it passes the ends of the row above or below.
        is_open.clear();
        is_open.resize(gaps.list.len(), false);
        for gap in &gaps.runs {
            let is_within = |row: usize| match (row < rows).then(|| filled.row(row)) {
                Some([first, .., last]) => first[0] <= gap.start && gap.end <= last[1],
                Some([only]) => only[0] <= gap.start && gap.end <= only[1],
                _ => false,
            };
            is_open[gap.label] |= gap.row == 0 || !is_within(gap.row - 1) || !is_within(gap.row + 1);
        }
        let (mut from, mut kept, mut gap) = (0, 0, 0);
        for end in filled.bounds.iter_mut().skip(1) {
            for at in from..*end {
                let span = filled.spans[at];
                if at > from {
                    gap += 1;
                    if !is_open[gaps.runs[gap - 1].label] {
                        filled.spans[kept - 1][1] = span[1];
                        continue;
                    }
                }
                filled.spans[kept] = span;
                kept += 1;
            }
            from = std::mem::replace(end, kept);
        }
        filled.spans.truncate(kept);
    }

    /// The core: all whose surroundings up to `reach` are within the component.
    fn erode(&mut self, reach: usize) {
        let Self { filled, narrow, core, common, next, .. } = self;
        let (rows, height) = (filled.count(), 2 * reach + 1);
        narrow.clear();
        core.clear();
        // The square does not fit in about the rows at the top, nor those at the bottom.
        (0..reach.min(rows)).for_each(|_| _ = core.close_row());
        // How many rows up to this one, without a break, have a single span.
        let mut single = 0;
        for row in 0..rows {
            for [start, end] in filled.row(row) {
                let [start, end] = [start + reach, end.saturating_sub(reach)];
                if start < end {
                    narrow.spans.push([start, end]);
                }
            }
            single = if narrow.close_row() == 1 { single + 1 } else { 0 };
            if row + 1 < height {
                continue;
            }
            if single >= height {
                let spans = narrow.spans[narrow.spans.len() - height..].iter();
                let [from, to] = spans.fold([0, usize::MAX], |common, span| intersection(common, *span));
                if from < to {
                    core.spans.push([from, to]);
                }
            } else {
                common.clear();
                common.extend_from_slice(narrow.row(row + 1 - height));
                for other in row + 2 - height..=row {
                    next.clear();
                    intersect(common, narrow.row(other), next);
                    std::mem::swap(common, next);
                }
                core.spans.extend_from_slice(common);
            }
            core.close_row();
        }
        while core.count() < rows {
            core.close_row();
        }
    }

    /// Collects what lies beyond the core grown by `grown`.
    fn subtract_body(&mut self, top: usize, grown: usize) {
        let Self { filled, core, body, rest, .. } = self;
        let grow = |[start, end]: Span| [start.saturating_sub(grown), end + grown];
        let rows = filled.count();
        rest.clear();
        for row in 0..rows {
            rest.begin_row(top + row);
            let (spans, cores) = (filled.row(row), core.row(row));
            let around = core.of(row.saturating_sub(grown)..rows.min(row + grown + 1));
            // The usual row: as many spans as cores, and those about each of them, joined to it where they meet, reach from end to end.
            let is_covered = |k: usize| {
                let [mut low, mut high] = grow(cores[k]);
                let is_whole = |low: usize, high: usize| low <= spans[k][0] && high >= spans[k][1];
                is_whole(low, high)
                    || around.iter().skip(k).step_by(cores.len()).any(|span| {
                        let [from, to] = grow(*span);
                        if from <= high && to >= low {
                            (low, high) = (low.min(from), high.max(to));
                        }
                        is_whole(low, high)
                    })
            };
            if spans.len() == cores.len() && (0..spans.len()).all(is_covered) {
                continue;
            }
            body.clear();
            body.extend(around.iter().copied().map(grow));
            body.sort_unstable();
            for &[first, end] in spans {
                let mut start = first;
                for [from, to] in body.iter().copied().chain([[end, end]]) {
                    if start < from.min(end) {
                        rest.push(start, from.min(end));
                    }
                    start = start.max(to);
                }
            }
        }
        rest.close();
    }
}

/// What two spans have in common; where that is nothing, it ends before it begins.
fn intersection([from, to]: Span, [start, end]: Span) -> Span {
    [from.max(start), to.min(end)]
}

/// Appends what two rows of spans have in common; the spans of each rise without overlap.
fn intersect(a: &[Span], b: &[Span], common: &mut Vec<Span>) {
    let (mut i, mut j) = (0, 0);
    while let (Some(p), Some(q)) = (a.get(i), b.get(j)) {
        let [from, to] = intersection(*p, *q);
        if from < to {
            common.push([from, to]);
        }
        if p[1] < q[1] {
            i += 1;
        } else {
            j += 1;
        }
    }
}
