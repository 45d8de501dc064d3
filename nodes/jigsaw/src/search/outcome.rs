//! The outcome: which joints are matings, and how sure they and the pieces are.
//!
//! What agrees with the poses of one island is a mating, whether it was decided on or not. Each contact of a piece beyond
//! the first confirms its place; the confidence of a mating is that of the less sure of its pieces.

use super::adjust::FINE;
use super::learn::{AGREEMENT, IMPLAUSIBLE};
use super::{Assembler, Mated, Outcome, edge};
use crate::Policy;
use crate::placement::{self, Joint};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// An island of at most so many pieces is stray if the largest is this many times as large: pieces that lie face down
/// or twice may well mate with one another, but where they belong is taken. Halves of mixed puzzles are larger.
const STRAY: usize = 5;
pub(super) const STRAY_SHARE: usize = 4;

impl Assembler<'_> {
    /// The outcome without the pieces and matings that are less sure than asked for.
    pub(super) fn outcome(&mut self) -> Outcome {
        let least = self.params.minimum_confidence;
        let mut outcome = self.finish();
        // Each round takes something out, so there are no more rounds than pieces and matings.
        for _ in 0..self.outlines.len() + self.state.joined().len() {
            let unsure: Vec<usize> = (0..self.outlines.len())
                .filter(|k| outcome.poses[*k].is_some() && outcome.confidence[*k] < least)
                .collect();
            let weak: Vec<usize> = outcome.matings.iter().filter(|m| m.confidence < least).map(|m| m.joint).collect();
            let joined: Vec<usize> = weak.into_iter().filter(|k| self.holds(*k)).collect();
            if unsure.is_empty() && joined.is_empty() {
                break;
            }
            self.detach(&unsure, &joined);
            outcome = self.finish();
        }
        outcome.matings.retain(|m| m.confidence >= least);
        outcome.brought_up = self.joints.len() - self.given;
        outcome.joints = std::mem::take(&mut self.joints);
        outcome
    }

    /// Tabs that lie in mouths although that was no candidate (others resembled either more): where nothing else is
    /// joined, what the borders say there becomes a candidate. Of several at one stretch of border the nearest counts.
    pub(super) fn add_contacts(&mut self) {
        /// Isthmus points of a tab and of its mouth are no farther apart, in piece scales: flat minima slide along the neck.
        const NEAR: f64 = 0.15;
        let mut settled = vec![false; self.slots.count()];
        for (_, e) in self.edges.iter().enumerate().filter(|(k, _)| self.same_island(*k) && self.agrees(*k)) {
            e.slots.into_iter().flat_map(|s| self.slots.rivals(s)).for_each(|s| settled[s.number] = true);
        }
        let mut met: Vec<(f64, [usize; 2], [usize; 2])> = Vec::new();
        for (p, q) in self.state.islands().flat_map(|k| self.neighbours(k)) {
            for [a, b] in [[p, q], [q, p]] {
                let b_from_a = self.state.pose(b).inverse() * self.state.pose(a);
                let tabs = self.outlines[a].tabs.iter().enumerate();
                for (tab, t) in tabs.filter(|(tab, _)| !settled[self.slots.tab(a, *tab).number]) {
                    let mouths = self.outlines[b].mouths.iter().enumerate();
                    for (mouth, m) in mouths.filter(|(mouth, _)| !settled[self.slots.mouth(b, *mouth).number]) {
                        met.push(((b_from_a * t.origin - m.origin).norm(), [a, tab], [b, mouth]));
                    }
                }
            }
        }
        met.retain(|(distance, _, [b, _])| *distance <= NEAR * self.outlines[*b].scale);
        met.sort_by(|p, q| p.0.total_cmp(&q.0).then((p.1, p.2).cmp(&(q.1, q.2))));
        let mut feet = placement::Feet::default();
        for (_, [a, tab], [b, mouth]) in met {
            let ends = [self.slots.tab(a, tab), self.slots.mouth(b, mouth)];
            if ends.iter().any(|s| settled[s.number]) {
                continue;
            }
            let b_from_a = self.state.pose(b).inverse() * self.state.pose(a);
            let (t, m) = (&self.outlines[a].tabs[tab], &self.outlines[b].mouths[mouth]);
            let from = (&b_from_a, self.prior.mean);
            let scale = self.outlines[b].scale;
            let Some(fit) = placement::refine(t, m, from, scale, self.params.fit_clearance, &mut feet) else {
                continue;
            };
            ends.into_iter().flat_map(|s| self.slots.rivals(s)).for_each(|s| settled[s.number] = true);
            let joint = Joint { a, tab, b, mouth, fit };
            self.edges.push(edge(&joint, self.outlines, &self.slots, self.usual));
            self.joints.push(joint);
            self.contacts += 1;
        }
    }

    fn finish(&mut self) -> Outcome {
        let n = self.outlines.len();
        let mut matings = Vec::new();
        let mut taken = vec![false; self.slots.count()];
        let paper = self.params.policy == Policy::Paper;
        // Unrefined poses contradict each other too much to recognise contacts that weren't decided on.
        let mut order: Vec<usize> = if paper {
            self.state.joined().to_vec()
        } else {
            (0..self.edges.len()).filter(|k| self.same_island(*k) && self.agrees(*k)).collect()
        };
        let largest = self.state.largest();
        let stray = if paper { 1 } else { (largest / STRAY_SHARE).clamp(1, STRAY) };
        order.retain(|k| self.state.size(self.edges[*k].a) > stray);
        order.sort_by(|p, q| self.joints[*p].fit.residual.total_cmp(&self.joints[*q].fit.residual).then(p.cmp(q)));
        // Contacts that agree with a piece's pose: each beyond the first confirms it.
        let candidates = self.edges.len() - self.contacts;
        let mut evidence = vec![0.0f64; n];
        let mut chosen = Vec::new();
        for k in order {
            let slots = self.edges[k].slots;
            let own = self.model.evidence(self.edges[k].cost);
            let loops = self.edges[k].support.min(2) as f64 * AGREEMENT;
            if slots.iter().any(|s| taken[s.number]) || (!paper && own + loops < IMPLAUSIBLE) {
                continue;
            }
            // What was only looked for because the pieces lie there is no further evidence that they do.
            let more = if k < candidates { (own + self.present).max(0.0) + AGREEMENT } else { 0.0 };
            for s in slots {
                taken[s.number] = true;
                evidence[s.piece] += more;
            }
            chosen.push(k);
        }
        for (k, fitted) in &self.state.fitted {
            evidence[*k] = evidence[*k].max(fitted + AGREEMENT);
        }
        let sure = |evidence: f64| 1.0 / (1.0 + (-evidence).exp());
        let clearances = self.clearances(&chosen);
        for (k, clearance) in chosen.into_iter().zip(clearances) {
            let [tab, mouth] = self.edges[k].slots;
            // The first contact of a piece confirms nothing beside itself.
            let least = (evidence[tab.piece].min(evidence[mouth.piece]) - AGREEMENT).max(0.0);
            matings.push(Mated { joint: k, confidence: sure(least), clearance });
        }
        let confidence: Vec<f64> = evidence.iter().map(|e| sure((e - AGREEMENT).max(0.0))).collect();
        Outcome {
            poses: (0..n)
                .map(|k| (self.state.size(k) > stray).then(|| (self.state.island(k), *self.state.pose(k))))
                .collect(),
            support: self.edges.iter().map(|e| e.support).collect(),
            matings,
            confidence,
            backtracks: self.backtracks,
            partial: self.partial,
            ..Outcome::default()
        }
    }

    /// The clearances of some joints, each in the light of the others: a joint's own is known to what the borders' noise
    /// leaves, and as far as that explains how the joints of an assembly differ, they don't (empirical Bayes, Efron and
    /// Morris 1973).
    fn clearances(&self, joints: &[usize]) -> Vec<f64> {
        /// Joints that one thread looks at before others are asked.
        const JOINTS: usize = 8;
        let own = |k: &usize| {
            // All of the border where the pieces lie says more than the segment by which they were matched.
            let e = &self.edges[*k];
            let b_from_a = self.state.pose(e.b).inverse() * self.state.pose(e.a);
            let paper = self.params.policy == Policy::Paper;
            let contact = (!paper).then(|| self.contact_of(e.a, e.b, &b_from_a, FINE)).flatten();
            contact.map_or((self.joints[*k].fit.clearance, 0.0), |c| (c.clearance, c.variance))
        };
        let own: Vec<(f64, f64)> = joints.par_iter().with_min_len(JOINTS).map(own).collect();
        let mut clearances = vec![0.0; own.len()];
        let mut islands: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
        for (i, k) in joints.iter().enumerate() {
            islands.entry(self.state.island(self.edges[*k].a)).or_default().push(i);
        }
        for here in islands.into_values() {
            let n = here.len() as f64;
            let mean = here.iter().map(|i| own[*i].0).sum::<f64>() / n;
            let noise = here.iter().map(|i| own[*i].1).sum::<f64>() / n;
            let spread = here.iter().map(|i| (own[*i].0 - mean).powi(2)).sum::<f64>() / (n - 1.0).max(1.0);
            let share = if spread > noise { 1.0 - noise / spread } else { 0.0 };
            for i in here {
                clearances[i] = mean + share * (own[i].0 - mean);
            }
        }
        clearances
    }
}
