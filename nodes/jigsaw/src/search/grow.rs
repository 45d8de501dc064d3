//! Growth and coagulation: islands and single pieces are joined, the surest first.
//!
//! Candidates between the same two islands that agree on a pose are a group; its evidence is that of its members and of
//! their agreement. A group is taken if it is likely by itself and leads whatever else would take its place: the more
//! strangers vie for the place, the likelier some of them agree by chance.

use super::Assembler;
use super::adjust::COARSE;
use super::learn::{ACCEPT, STRONG, UNLEARNT, WORN};
use crate::loops::{self, Said, Tolerance};
use std::collections::BTreeMap;

/// Candidates of each mouth and tab that take part in growth.
const GROWTH_RANKS: usize = 12;

/// Poses farther apart than this are not weighed: no drift of an island accounts for it.
const FAR: Tolerance = Tolerance { position: 0.25, angle: 0.25 };

/// Candidates that agree on how two islands lie to each other, and the evidence for it.
#[derive(Debug, Clone)]
struct Group {
    members: Vec<usize>,
    evidence: f64,
}

impl Assembler<'_> {
    /// Joins islands and single pieces, best evidence first.
    pub(super) fn grow(&mut self) {
        loop {
            if self.late() {
                return;
            }
            let mut hypotheses = self.hypotheses();
            hypotheses.sort_by(|p, q| q.0.total_cmp(&p.0).then_with(|| p.1.cmp(&q.1)));
            let mut joined = 0;
            for (_, members) in hypotheses {
                // Earlier joins may have changed what is admissible; `join` checks again. A single candidate must
                // still lead its rivals.
                if self.same_island(members[0]) || (members.len() > 1 && members.iter().any(|k| !self.free(*k))) {
                    continue;
                }
                let ok = if members.len() > 1 { self.join_by_all(&members) } else { self.join(members[0]) };
                if ok {
                    joined += 1;
                    for k in &members[1..] {
                        if self.admissible(*k) {
                            self.take(*k);
                        }
                    }
                }
            }
            if joined == 0 {
                return;
            }
            self.refine_all(1, COARSE);
        }
    }

    /// Ways to join two islands: the evidence, the candidates that agree.
    pub(super) fn hypotheses(&self) -> Vec<(f64, Vec<usize>)> {
        let mut between: BTreeMap<(usize, usize), Vec<usize>> = BTreeMap::new();
        for (k, e) in self.edges.iter().enumerate() {
            if e.mouth_rank.min(e.tab_rank) >= GROWTH_RANKS || self.same_island(k) || !self.free(k) {
                continue;
            }
            let (ia, ib) = (self.state.island(e.a), self.state.island(e.b));
            between.entry((ia.min(ib), ia.max(ib))).or_default().push(k);
        }
        let mut grouped: BTreeMap<usize, Group> = BTreeMap::new();
        for ((low, high), candidates) in between {
            if !self.params.merge_islands && !self.state.alone(low) && !self.state.alone(high) {
                continue;
            }
            let said: Vec<Said> = candidates.iter().map(|k| self.said(*k, low)).collect();
            for (i, k) in candidates.iter().enumerate() {
                grouped.insert(*k, self.group(i, low, &candidates, &said));
            }
        }
        let least = if self.learnt { ACCEPT } else { UNLEARNT };
        // A candidate must be likely by itself, and lead whatever else would take its place.
        let likely = |g: &&Group| g.evidence + if g.members.len() > 1 { 0.0 } else { self.present } >= least;
        let acceptable = grouped.values().filter(likely).filter(|g| self.lead(g, &grouped) >= ACCEPT);
        acceptable.map(|g| (g.evidence, g.members.clone())).collect()
    }

    /// What a candidate says about where the island `moving` lies in the other one.
    fn said(&self, k: usize, moving: usize) -> Said<'_> {
        let e = &self.edges[k];
        let b_from_a = self.state.pose(e.b) * e.b_from_a * self.state.pose(e.a).inverse();
        let (from, pose) = if self.state.island(e.a) == moving { (e.b, b_from_a) } else { (e.a, b_from_a.inverse()) };
        Said { edge: e, from, fixed: *self.state.pose(from), pose }
    }

    /// The candidates that agree with the one at `i` on the pose of the island `moving`.
    fn group(&self, i: usize, moving: usize, candidates: &[usize], said: &[Said]) -> Group {
        // A worn joint among agreeing ones doesn't refute them.
        let single = |k: usize| self.model.evidence(self.edges[k].cost).max(WORN);
        let mut group = Group { members: vec![candidates[i]], evidence: single(candidates[i]) };
        for (j, other) in candidates.iter().enumerate().filter(|(j, _)| *j != i) {
            let e = &self.edges[*other];
            let piece = if self.state.island(e.a) == moving { e.a } else { e.b };
            let [p, q] = [i, j].map(|k| said[k].pose * self.state.pose(piece));
            if !FAR.allows(self.outlines[piece], &p, &q) {
                continue;
            }
            let misclosure = loops::disagreement(&said[i], &said[j], self.centre_of(piece));
            let slots = e.slots;
            let clashes = |g: &usize| {
                let taken = self.edges[*g].slots;
                taken.iter().any(|s| slots.iter().any(|t| self.slots.conflict(*s, *t)))
            };
            if self.closure.admits(&misclosure) && !group.members.iter().any(clashes) {
                group.members.push(*other);
                group.evidence += single(*other) + self.closure.agreement(&misclosure).clamp(0.0, STRONG);
            }
        }
        group
    }

    /// By how much a group of candidates leads its free rivals for the same tabs and mouths, as evidence.
    fn lead(&self, group: &Group, all: &BTreeMap<usize, Group>) -> f64 {
        let mut lead = STRONG;
        let mut strangers: BTreeMap<usize, f64> = BTreeMap::new();
        let size = |piece: usize| self.state.size(piece);
        for &k in &group.members {
            let e = &self.edges[k];
            let largest = size(e.a).max(size(e.b));
            for slot in e.slots {
                for &j in &self.at[slot.piece] {
                    let other = &self.edges[j];
                    if group.members.contains(&j)
                        || !other.slots.iter().any(|s| self.slots.conflict(*s, slot))
                        || !self.free(j)
                    {
                        continue;
                    }
                    if size(slot.piece) >= largest {
                        let stranger = if other.a == slot.piece { other.b } else { other.a };
                        let behind = self.model.evidence(other.cost) - self.model.evidence(e.cost).max(WORN);
                        let chance = strangers.entry(stranger).or_default();
                        *chance = chance.max(behind.min(0.0).exp());
                    }
                    let rival = all.get(&j);
                    let evidence = rival.map_or_else(|| self.model.evidence(other.cost), |r| r.evidence);
                    let mut ahead = group.evidence - evidence;
                    // Costs below the typical are alike as evidence, but between rivals the better one still leads.
                    if group.members.len() == 1 && rival.is_none_or(|r| r.members.len() == 1) {
                        ahead = ahead.max((other.cost - e.cost) / self.model.right.1);
                    }
                    lead = lead.min(ahead);
                }
            }
        }
        // Candidates that agree might do so by chance, and any that vies for the same place might have been the one,
        // the likelier the better it fits.
        let tries = if group.members.len() > 1 { (1.0 + strangers.values().sum::<f64>()).ln() } else { 0.0 };
        lead.min(group.evidence - tries)
    }
}
