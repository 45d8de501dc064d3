//! The paper's assembly: down the ranked table, and back.

use super::state::State;
use super::{Assembler, Outcome};
use nalgebra::{Point2, Vector2};
use std::cmp::Reverse;
use std::collections::VecDeque;

impl Assembler<'_> {
    /// The paper's assembly: down the ranked table, mating whatever fits without intolerable overlap; when pieces are
    /// left that can't be joined up, or mouths that nothing fills, back. Decisions are taken back by limited discrepancy search (Harvey and
    /// Ginsberg 1995): every descent that differs from the greedy one in one decision, the weakest first, then in two.
    pub(super) fn descend(&mut self) -> Outcome {
        let n = self.outlines.len();
        let mut ranked: Vec<usize> = (0..self.edges.len()).collect();
        ranked.sort_by(|p, q| self.edges[*p].cost.total_cmp(&self.edges[*q].cost).then(p.cmp(q)));
        let mut queue = VecDeque::from([Vec::new()]);
        let mut best: Option<((usize, Reverse<usize>), State)> = None;
        while let Some(skipped) = queue.pop_front() {
            self.state = State::new(n, &self.slots);
            let mut decisions = Vec::new();
            for &k in &ranked {
                if !skipped.contains(&k) && !self.same_island(k) && self.join(k) {
                    decisions.push(k);
                }
            }
            let worth = (self.state.largest(), Reverse(self.open_mouths()));
            if best.as_ref().is_none_or(|b| worth > b.0) {
                best = Some((worth, self.state.clone()));
            }
            if worth == (n, Reverse(0)) || self.backtracks >= self.params.backtracks || self.late() {
                break;
            }
            self.backtracks += 1;
            // Each set of decisions once: only later ones than the last taken back are added to a set.
            let last = skipped.last().and_then(|k| ranked.iter().position(|r| r == k));
            for &k in decisions.iter().rev() {
                if last.is_none_or(|l| ranked.iter().position(|r| *r == k).is_some_and(|r| r > l)) {
                    let mut more = skipped.clone();
                    more.push(k);
                    queue.push_back(more);
                }
            }
        }
        if let Some((_, state)) = best {
            self.state = state;
        }
        let trusted = self.state.joined().to_vec();
        self.learn(&trusted);
        self.outcome()
    }

    /// Mouths of placed pieces in whose middle no other piece of their island lies.
    fn open_mouths(&self) -> usize {
        let filled = |piece: usize, at: Point2<f64>| {
            self.state.members(self.state.island(piece)).filter(|q| *q != piece).any(|q| {
                let raster = &self.outlines[q].raster;
                raster.cell_of(self.state.pose(q).inverse() * at).is_some_and(|cell| raster.distance[cell] < 0.0)
            })
        };
        let placed = (0..self.outlines.len()).filter(|k| !self.state.alone(*k));
        let mouths = placed.flat_map(|k| self.outlines[k].mouths.iter().map(move |mouth| (k, mouth)));
        mouths
            .filter(|(k, mouth)| {
                let middle = mouth.origin + Vector2::new(f64::from(mouth.middle[0]), f64::from(mouth.middle[1]));
                !filled(*k, self.state.pose(*k) * middle)
            })
            .count()
    }
}
