//! What stands out from the ground, in blocks, and to which component each block belongs.

use super::blocks::Blocks;
use super::ground::Ground;
use super::runs::{Component, Components, Run};
use std::ops::Range;

/// Owner of the blocks that belong to no component.
pub(super) const NOBODY: u32 = u32::MAX;
/// Greatest depth that is told apart, in blocks: beyond the blur of any edge worth measuring.
pub(super) const MAX_DEPTH: u8 = 7;

/// Blocks on each side that stand out about one that lies deep within: more than any edge takes.
const WITHIN: usize = 2;

/// Makes every coarse component own its blocks and the free ones next to them; before, nobody owns any.
pub(super) fn claim(blocks: &Blocks, coarse: &Components, owner: &mut Vec<u32>) {
    let columns = blocks.columns;
    owner.resize(columns * blocks.rows, NOBODY);
    for run in &coarse.runs {
        let label = run.label as u32;
        owner[run.row * columns + run.start..run.row * columns + run.end].fill(label);
    }
    for run in &coarse.runs {
        let label = run.label as u32;
        for part in around(blocks, run) {
            for owner in &mut owner[part] {
                *owner = if *owner == NOBODY { label } else { *owner };
            }
        }
    }
}

/// Takes back what [`claim`] gave: less than all blocks, as a rule.
pub(super) fn release(blocks: &Blocks, coarse: &Components, owner: &mut [u32]) {
    for run in &coarse.runs {
        around(blocks, run).for_each(|part| owner[part].fill(NOBODY));
    }
}

/// The blocks of a run and those next to them, row by row.
fn around(blocks: &Blocks, run: &Run) -> impl Iterator<Item = Range<usize>> + use<> {
    let columns = blocks.columns;
    let (start, end) = (run.start.saturating_sub(1), columns.min(run.end + 1));
    (run.row.saturating_sub(1)..blocks.rows.min(run.row + 2)).map(move |row| row * columns + start..row * columns + end)
}

/// Blocks that stand out from a ground, joined to components.
#[derive(Clone, Copy)]
pub(super) struct Standing<'a> {
    pub(super) blocks: &'a Blocks,
    pub(super) ground: &'a Ground,
    pub(super) components: &'a Components,
    /// For each block the component that owns it, or [`NOBODY`]: its blocks and those next to them.
    pub(super) owner: &'a [u32],
}

impl Standing<'_> {
    /// Whether a block belongs to a component itself, rather than to its surroundings.
    pub(super) fn is_of(&self, k: usize, column: usize, row: usize) -> bool {
        self.are_of(k, column..column + 1, row).all(|is_of| is_of)
    }

    /// The same for neighbouring blocks of a row.
    pub(super) fn are_of(&self, k: usize, columns: Range<usize>, row: usize) -> impl Iterator<Item = bool> {
        let (begin, threshold) = (row * self.blocks.columns, self.ground.threshold);
        let blocks = begin + columns.start..begin + columns.end;
        let owners = self.owner[blocks.clone()].iter();
        owners.zip(&self.ground.residual[blocks]).map(move |(owner, r)| (*owner == k as u32) & (*r > threshold))
    }

    /// Whether a block is no ground, and no other component's.
    fn may_be_of(&self, k: usize, block: usize) -> bool {
        let owner = self.owner[block];
        self.ground.residual[block] > self.ground.weak_threshold() && (owner == NOBODY || owner == k as u32)
    }

    /// Whether blocks deep within what stands out about a component do so by less than half its level, and as no shadow does.
    pub(super) fn has_weak_part(&self, k: usize, level: f32) -> bool {
        let (columns, rows) = (self.blocks.columns, self.blocks.rows);
        let (c, weak) = (self.components.list[k], self.ground.weak_threshold());
        let around = |from: usize| from - WITHIN..from + WITHIN + 1;
        // What lies along the frame's rim is not known to be deep within.
        let within = |from: usize, to: usize, count: usize| from.max(WITHIN)..to.min(count.saturating_sub(WITHIN));
        let across = within(c.left, c.right, columns);
        within(c.top, c.bottom, rows).filter(|_| across.start < across.end).any(|row| {
            let line = self.ground.residual[row * columns..][across.clone()].iter().zip(across.clone());
            line.filter(|(r, _)| (weak..level / 2.0).contains(*r)).any(|(_, column)| {
                around(row).all(|v| around(column).all(|u| self.may_be_of(k, v * columns + u)))
                    && !self.ground.may_be_shaded(self.blocks, (column, row))
            })
        })
    }

    /// The box of a component with what hangs together with it and is no ground either, unless it belongs to another one; at most half the
    /// box's longer side beyond it.
    pub(super) fn reach(&self, k: usize) -> Component {
        let (columns, rows) = (self.blocks.columns, self.blocks.rows);
        let mut reach = self.components.list[k];
        let most = (reach.right - reach.left).max(reach.bottom - reach.top) / 2;
        let within = |from: usize, to: usize, count: usize| from.saturating_sub(most)..count.min(to + most);
        let (across, down) = (within(reach.left, reach.right, columns), within(reach.top, reach.bottom, rows));
        let at = |column: usize, row: usize| (row - down.start) * across.len() + column - across.start;
        let mut known = vec![false; across.len() * down.len()];
        let runs = self.components.runs_of(k);
        let mut open: Vec<(usize, usize)> =
            runs.flat_map(|run| (run.start..run.end).map(|column| (column, run.row))).collect();
        open.iter().for_each(|(column, row)| known[at(*column, *row)] = true);
        while let Some((column, row)) = open.pop() {
            (reach.left, reach.right) = (reach.left.min(column), reach.right.max(column + 1));
            (reach.top, reach.bottom) = (reach.top.min(row), reach.bottom.max(row + 1));
            for v in row.saturating_sub(1).max(down.start)..down.end.min(row + 2) {
                for u in column.saturating_sub(1).max(across.start)..across.end.min(column + 2) {
                    if self.may_be_of(k, v * columns + u) && !std::mem::replace(&mut known[at(u, v)], true) {
                        open.push((u, v));
                    }
                }
            }
        }
        reach
    }

    /// How many blocks deep within a component each block of its box lies (1 along its border, 0 outside of it), up to
    /// [`MAX_DEPTH`]; what lies beyond the frame counts as within.
    pub(super) fn depths(&self, k: usize) -> Vec<u8> {
        let c = self.components.list[k];
        let (width, height) = (c.right - c.left, c.bottom - c.top);
        let mut depths = vec![0; width * height];
        for run in self.components.runs_of(k) {
            for column in run.start..run.end {
                if self.is_of(k, column, run.row) {
                    depths[(run.row - c.top) * width + column - c.left] = MAX_DEPTH;
                }
            }
        }
        let (left, top) = (c.left > 0, c.top > 0);
        let (right, bottom) = (c.right < self.blocks.columns, c.bottom < self.blocks.rows);
        // Distance along rows, columns and diagonals: one pass forward over the neighbours that come before, one back.
        let relax = |depths: &mut [u8], x: usize, y: usize, sense: isize| {
            let at = y * width + x;
            if depths[at] == 0 {
                return;
            }
            for (dx, dy) in [(-1, 0), (-1, -1), (0, -1), (1, -1)] {
                let (u, v) = (x as isize + sense * dx, y as isize + sense * dy);
                let open = (u < 0 && left)
                    || (u >= width as isize && right)
                    || (v < 0 && top)
                    || (v >= height as isize && bottom);
                let before = if open {
                    0
                } else if u < 0 || v < 0 || u >= width as isize || v >= height as isize {
                    MAX_DEPTH
                } else {
                    depths[v as usize * width + u as usize]
                };
                depths[at] = depths[at].min(before + 1);
            }
        };
        for y in 0..height {
            for x in 0..width {
                relax(&mut depths, x, y, 1);
            }
        }
        for y in (0..height).rev() {
            for x in (0..width).rev() {
                relax(&mut depths, x, y, -1);
            }
        }
        depths
    }
}
