//! A second look: candidates among the isthmuses that are still open.
//!
//! The index keeps the tabs that resemble a mouth most. In a large heap of worn pieces the right one may not be among
//! them, or may have been outshone by one that has found its place since. Where little is left open few pairs remain, and
//! each mouth is compared with many times as many of the tabs that are open as well, but only once as pieces come.
//! Complexity O(open mouths · tabs tried) rough poses, limited by [`TRIES`].

use super::learn::rank;
use super::{Assembler, edge};
use crate::index::{Entry, Hit, Index, Windows};
use crate::loops::Edge;
use crate::matching::{self, Match};
use crate::placement::{Feet, Joint};
use crate::slots::Slot;
use rayon::prelude::*;
use std::collections::HashSet;

/// Tabs tried for each mouth, in what the index keeps otherwise.
const WIDER: usize = 8;
/// Rough poses in all, about: some 30 ms of one core. Where so much is open that a mouth's share of them is less than this
/// many times what the index keeps, too much is missing yet for a second look to be worth it.
const TRIES: usize = 20_000;
const LEAST: usize = 2;

impl Assembler<'_> {
    /// Adds candidates between open isthmuses of different islands; tells whether there are any.
    pub(super) fn widen(&mut self) -> bool {
        let waiting = (0..self.outlines.len()).filter(|k| !self.aside[*k]);
        let (mut tabs, mut mouths) = (Vec::new(), Vec::new());
        for piece in waiting {
            let outline = self.outlines[piece];
            tabs.extend(
                outline
                    .tabs
                    .iter()
                    .enumerate()
                    .filter(|(k, _)| self.open(self.slots.tab(piece, *k), None))
                    .map(|(tab, segment)| Entry { piece: piece as u32, tab: tab as u32, rank: piece as u32, segment }),
            );
            let some = (0..outline.mouths.len()).filter(|k| self.open(self.slots.mouth(piece, *k), None));
            mouths.extend(some.map(|mouth| (piece, mouth)));
        }
        let most = (TRIES / mouths.len().max(1)).min(WIDER * self.params.candidates);
        if most < LEAST * self.params.candidates {
            return false;
        }
        let index = Index::new(tabs, mouths.len());
        let known: HashSet<[Slot; 2]> = self.edges.iter().map(|e| e.slots).collect();
        let found: Vec<Vec<Joint>> = mouths
            .into_par_iter()
            .map_init(Feet::default, |feet, (b, mouth)| {
                let (outline, segment) = (self.outlines[b], &self.outlines[b].mouths[mouth]);
                let fit = (outline.scale, self.params.fit_clearance);
                let mut hits = index.nearest(segment, b as u32, &Windows::of(outline), most);
                hits.retain(|hit| {
                    let (a, tab) = (hit.piece as usize, hit.tab as usize);
                    let pair = [self.slots.tab(a, tab), self.slots.mouth(b, mouth)];
                    self.state.island(a) != self.state.island(b) && !known.contains(&pair)
                });
                let this = (outline.serial, mouth);
                let isthmus = |hit: &Hit| (self.outlines[hit.piece as usize].serial, hit.tab as usize);
                let mut seen = self.memory.matches(this);
                let known = |hit: Hit| seen.remove(&isthmus(&hit)).map_or_else(|| Match::new(hit), |m| m.again(hit));
                let mut list: Vec<Match> = hits.into_iter().map(known).collect();
                let fits = matching::refine(&mut list, segment, self.outlines, fit, feet);
                self.memory.keep_matches(this, list.into_iter().map(|m| (isthmus(&m.hit), m)).collect());
                let joint =
                    |(hit, fit): (Hit, _)| Joint { a: hit.piece as usize, tab: hit.tab as usize, b, mouth, fit };
                fits.into_iter().map(joint).collect()
            })
            .collect();
        let before = self.edges.len();
        for joint in found.into_iter().flatten() {
            self.at[joint.a].push(self.edges.len());
            self.at[joint.b].push(self.edges.len());
            self.edges.push(Edge { cost: self.cost(&joint), ..edge(&joint, self.outlines, &self.slots, self.usual) });
            self.joints.push(joint);
        }
        let any = self.edges.len() > before;
        if any {
            self.best = rank(&mut self.edges, &self.slots);
        }
        any
    }
}
