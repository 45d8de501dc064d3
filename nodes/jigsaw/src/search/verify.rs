//! Verification and backtracking: what overlaps or contradicts its neighbours is taken out, and what was kept out by it
//! is tried in its place.
//!
//! A step back that loses more evidence than it brings is undone; [`Params::backtracks`](crate::Params::backtracks)
//! limits how many such there are.

use super::Assembler;
use super::adjust::COARSE;
use super::join::OVERLAP;
use super::learn::{ACCEPT, AGREEMENT};
use std::collections::HashSet;

impl Assembler<'_> {
    /// Takes out pieces that overlap others, the less supported one of a pair; islands that fall apart are split.
    /// Tells whether anything was taken out.
    pub(super) fn verify(&mut self) -> bool {
        let mut changed = false;
        for _ in 0..4 {
            let mut evict: Vec<usize> = Vec::new();
            let joined = self.joined_at();
            for island in self.state.islands() {
                for (p, q) in self.neighbours(island) {
                    let pose = self.state.pose(q).inverse() * self.state.pose(p);
                    let area = self.memory.overlap(self.outlines[p], self.outlines[q], &pose);
                    if area <= OVERLAP * self.outlines[p].scale * self.outlines[q].scale {
                        continue;
                    }
                    evict.push(if self.weight(&joined[p]) < self.weight(&joined[q]) { p } else { q });
                }
            }
            // Matings that the adjusted poses contradict hold nothing.
            let broken: Vec<usize> = self.state.joined().iter().copied().filter(|k| !self.agrees(*k)).collect();
            if evict.is_empty() && broken.is_empty() {
                break;
            }
            changed = true;
            self.detach(&evict, &broken);
            self.refine_all(1, COARSE);
        }
        changed
    }

    /// Joined candidates at each piece.
    fn joined_at(&self) -> Vec<Vec<usize>> {
        let mut joined = vec![Vec::new(); self.outlines.len()];
        for &k in self.state.joined() {
            joined[self.edges[k].a].push(k);
            joined[self.edges[k].b].push(k);
        }
        joined
    }

    /// Undoes all matings of some pieces and some more matings; what no longer hangs together becomes islands apart.
    pub(super) fn detach(&mut self, pieces: &[usize], matings: &[usize]) {
        let gone = |p: &usize| pieces.contains(p);
        self.state.fitted.retain(|k, _| !gone(k));
        let edges = &self.edges;
        self.state.keep(edges, |k| !matings.contains(&k) && !gone(&edges[k].a) && !gone(&edges[k].b));
    }

    /// Islands that fit together but for a few pieces of one that lie where pieces of the other lie already (copies, or
    /// wrong ones): those are taken out, unless that is worth less than before.
    pub(super) fn reconcile(&mut self) {
        if !self.params.merge_islands {
            return;
        }
        let mut tried = HashSet::new();
        loop {
            let mut hypotheses = self.hypotheses();
            hypotheses.retain(|(_, group)| {
                let e = &self.edges[group[0]];
                let size = |p: usize| self.state.size(p);
                size(e.a).min(size(e.b)) > 1 && !tried.contains(group)
            });
            hypotheses.sort_by(|p, q| q.0.total_cmp(&p.0).then_with(|| p.1.cmp(&q.1)));
            let Some((_, group)) = hypotheses.into_iter().next() else { return };
            if self.backtracks >= self.params.backtracks || self.late() {
                return;
            }
            let saved = self.state.clone();
            let before = self.worth();
            let losers = self.losers(&group);
            self.detach(&losers, &[]);
            if losers.is_empty() || !self.join_by_all(&group) {
                self.state = saved;
                tried.insert(group);
                continue;
            }
            for k in &group[1..] {
                if self.admissible(*k) {
                    self.take(*k);
                }
            }
            self.refine_all(1, COARSE);
            self.grow();
            self.verify();
            if self.worth() <= before + 1e-9 {
                self.state = saved;
                self.backtracks += 1;
            }
            tried.insert(group);
        }
    }

    /// The pieces, of two islands that some candidates would join, that lie on others and have less evidence than
    /// those; none if they are too many to be exceptions.
    fn losers(&self, group: &[usize]) -> Vec<usize> {
        /// At most one piece in this many of the smaller island may have to go.
        const EXCEPTIONS: usize = 4;
        let (ia, ib, pose) = self.common_pose(group);
        let joined = self.joined_at();
        let mut losers = Vec::new();
        for p in self.state.members(ia) {
            let here = pose * self.state.pose(p);
            for q in self.state.members(ib) {
                let q_from_p = self.state.pose(q).inverse() * here;
                let area = self.memory.overlap(self.outlines[p], self.outlines[q], &q_from_p);
                if area > self.tolerated() * self.outlines[p].scale * self.outlines[q].scale {
                    losers.push(if self.weight(&joined[p]) < self.weight(&joined[q]) { p } else { q });
                }
            }
        }
        losers.sort_unstable();
        losers.dedup();
        let smaller = self.state.size(ia).min(self.state.size(ib));
        if losers.len() * EXCEPTIONS > smaller { Vec::new() } else { losers }
    }

    /// What the assembly is worth: the evidence of its matings.
    fn worth(&self) -> f64 {
        self.weight(self.state.joined())
    }

    /// The evidence of some matings.
    fn weight(&self, matings: &[usize]) -> f64 {
        matings.iter().map(|k| AGREEMENT + self.model.evidence(self.edges[*k].cost)).sum()
    }

    /// Backtracking: a piece left over that would fit where another sits is tried in its place; what is worth less
    /// than before is undone.
    pub(super) fn improve(&mut self) {
        let mut tried = HashSet::new();
        loop {
            let mut options: Vec<(f64, usize)> = (0..self.edges.len())
                .filter(|k| !tried.contains(k) && !self.same_island(*k) && !self.free(*k))
                .filter(|k| {
                    let e = &self.edges[*k];
                    self.state.alone(e.a) || self.state.alone(e.b)
                })
                .map(|k| (self.model.evidence(self.edges[k].cost), k))
                .filter(|(evidence, _)| *evidence >= ACCEPT)
                .collect();
            options.sort_by(|p, q| q.0.total_cmp(&p.0).then(p.1.cmp(&q.1)));
            let Some(&(_, k)) = options.first() else { return };
            if self.backtracks >= self.params.backtracks || self.late() {
                return;
            }
            tried.insert(k);
            let saved = self.state.clone();
            let before = self.worth();
            let mut occupants = Vec::new();
            for slot in self.edges[k].slots {
                for j in self.slots.rivals(slot).iter().filter_map(|s| self.state.mating_at(*s)) {
                    let e = &self.edges[j];
                    occupants.push(if e.a == slot.piece { e.b } else { e.a });
                }
            }
            occupants.sort_unstable();
            occupants.dedup();
            self.detach(&occupants, &[]);
            if self.join(k) {
                self.grow();
                self.verify();
            }
            if self.worth() <= before + 1e-9 {
                self.state = saved;
                self.backtracks += 1;
            }
        }
    }
}
