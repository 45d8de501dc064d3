//! The candidate table: every pair of a tab and a mouth, and which rule dropped it.
//!
//! What a solution leaves is counted ([`TableCounts`]) and, on demand, listed ([`Candidate`]). Counting how many pairs pass the
//! windows takes O(n log n), listing them all O(n²), which is why large puzzles list only what was refined.

use super::{Solution, Solver, correlation_of, ranked};
use crate::index::{Windows, shape_distance};
use crate::outline::{Outline, Segment};
use crate::placement::Joint;
use crate::search::{Mated, Outcome};
use crate::{Policy, TableCounts, paper, placement};
use nalgebra::Isometry2;
use rayon::prelude::*;

/// A rule that drops a candidate.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, serde::Serialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum Rule {
    /// The mouth is too narrow (or far too wide) for the neck.
    Opening,
    /// The match segments differ too much in length.
    PathLength,
    /// Other tabs resemble the mouth more: outside the index's nearest.
    Shape,
    /// Eq. 1 is too low.
    Correlation,
    /// The borders don't follow each other in the rough pose, or far worse than those of others.
    Placement,
    /// The two overlap too much, or the borders don't follow each other in the refined pose.
    Overlap,
    /// Another mating of the tab, the mouth or the two pieces is better.
    Rival,
    /// No other contact of the assembly supports it, and it isn't clear by itself.
    Support,
}

/// What became of a candidate.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Fate {
    /// It is a mating of the assembly.
    Mated,
    /// It was dropped by a rule.
    Dropped(Rule),
}

/// A tab and a mouth of two pieces that may belong together.
#[derive(Debug, Clone, PartialEq)]
pub struct Candidate {
    /// Index of the piece with the tab in [`Solver::pieces`].
    pub positive_piece: usize,
    /// Index of its isthmus.
    pub positive_isthmus: usize,
    /// Index of the piece with the mouth.
    pub negative_piece: usize,
    /// Index of its isthmus.
    pub negative_isthmus: usize,
    /// Width of the mouth less width of the neck, in pixels.
    pub opening: f64,
    /// Path length of the mouth less that of the neck, in pixels.
    pub path_difference: f64,
    /// Root mean square difference of the two IDFs, means removed, in pixels.
    pub shape_distance: f64,
    /// Best value of Eq. 1.
    pub correlation: f64,
    /// The refined pose; none if a rule dropped the pair before it was refined.
    pub posed: Option<Posed>,
    /// How many loops of pieces close over it.
    pub support: usize,
    /// What became of it in the last solution.
    pub fate: Fate,
}

/// A candidate in its refined pose (for the paper's rules: in the pose of its correlation).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Posed {
    /// `p_negative_image = negative_from_positive * p_positive_image`.
    pub negative_from_positive: Isometry2<f64>,
    /// Area of overlap (POS-GAP), in square pixels.
    pub pos_gap: f64,
    /// Area of underlap (NEG-GAP), in square pixels.
    pub neg_gap: f64,
    /// Mean gap along the match segment, clearance taken off, in pixels.
    pub ave_gap: f64,
    /// Mean gap along the match segment and its shoulders, clearance taken off, in pixels: what ranks candidates.
    pub residual: f64,
    /// Fitted clearance, in pixels.
    pub clearance: f64,
}

/// Puzzles of up to so many pairs of a tab and a mouth have every pair in the candidate table (the paper's 24 pieces have
/// 2377; this is some 60 pieces). Of larger ones the refined pairs are listed, and the rest counted.
const LISTED_PAIRS: usize = 25_000;

/// A mean residual above this part of the cap means that the borders don't follow each other at all.
const HOPELESS: f64 = 0.5;

impl Solver {
    /// Counts the candidates that the assembly brought up among what each rule left, whatever the rule had said.
    pub(super) fn count_brought_up(
        &self,
        table: &mut TableCounts,
        order: &[usize],
        outlines: &[&Outline],
        outcome: &Outcome,
    ) {
        for j in &outcome.joints[outcome.joints.len() - outcome.brought_up..] {
            if !self.kept[order[j.b]].lists.get(j.mouth).is_some_and(|list| list.names(order[j.a], j.tab)) {
                let (tab, mouth) = (&outlines[j.a].tabs[j.tab], &outlines[j.b].mouths[j.mouth]);
                let windows = Windows::of(outlines[j.b]);
                let opens = windows.let_opening_pass(mouth, tab);
                table.after_opening += usize::from(!opens);
                table.after_length += usize::from(!(opens && windows.let_path_pass(mouth, tab)));
                table.after_correlation += 1;
            }
            table.after_overlap += usize::from(!hopeless(j, outlines[j.b]));
        }
    }

    /// The candidate table of the last [`Solver::solve`]: pairs of a tab and a mouth of different pieces, each with its
    /// figures and its fate. Of small puzzles (up to 25 000 pairs, some 60 pieces) every pair is listed, and the rows
    /// add up to [`Assembly::table`](crate::Assembly::table); of larger ones only the pairs that were refined are, and the rest is counted there.
    pub fn candidates(&self) -> Vec<Candidate> {
        let Some(Solution { order, outcome, table }) = &self.last else { return Vec::new() };
        let joints = &outcome.joints;
        let outlines = ranked(&self.kept, order);
        let mut mated = vec![false; joints.len()];
        let mut taken = std::collections::HashSet::new();
        for Mated { joint, .. } in &outcome.matings {
            mated[*joint] = true;
            let j = &joints[*joint];
            taken.insert((true, j.a, j.tab));
            taken.insert((false, j.b, j.mouth));
        }
        let describe = |(a, tab): (usize, usize), (b, mouth): (usize, usize)| {
            let (t, m) = (&outlines[a].tabs[tab], &outlines[b].mouths[mouth]);
            Candidate {
                positive_piece: order[a],
                positive_isthmus: t.isthmus,
                negative_piece: order[b],
                negative_isthmus: m.isthmus,
                opening: m.width - t.width,
                path_difference: m.path - t.path,
                shape_distance: f64::from(shape_distance(t, m)),
                correlation: correlation_of(t, m),
                posed: None,
                support: 0,
                fate: Fate::Dropped(Rule::Shape),
            }
        };
        let refined = |(k, j): (usize, &Joint)| {
            let rival = taken.contains(&(true, j.a, j.tab)) || taken.contains(&(false, j.b, j.mouth));
            let fate = if mated[k] {
                Fate::Mated
            } else if self.params.policy == Policy::Standard && hopeless(j, outlines[j.b]) {
                Fate::Dropped(Rule::Overlap)
            } else if rival {
                Fate::Dropped(Rule::Rival)
            } else {
                Fate::Dropped(Rule::Support)
            };
            let posed = Posed {
                negative_from_positive: j.fit.negative_from_positive,
                pos_gap: j.fit.pos_gap,
                neg_gap: j.fit.neg_gap,
                ave_gap: j.fit.ave_gap,
                residual: j.fit.residual,
                clearance: j.fit.clearance,
            };
            Candidate {
                posed: Some(posed),
                support: outcome.support[k],
                fate,
                ..describe((j.a, j.tab), (j.b, j.mouth))
            }
        };
        let mut rows: Vec<Candidate> = joints.par_iter().enumerate().map(refined).collect();
        if table.pairs > LISTED_PAIRS {
            return rows;
        }
        let known: std::collections::HashSet<_> = joints.iter().map(|j| (j.a, j.tab, j.b, j.mouth)).collect();
        let judge = paper::Judge::new(&outlines);
        for (b, o) in outlines.iter().enumerate() {
            let windows = Windows::of(o);
            for (mouth, m) in o.mouths.iter().enumerate() {
                let list = self.kept[order[b]].lists.get(mouth);
                for (a, other) in outlines.iter().enumerate().filter(|(a, _)| *a != b) {
                    for (tab, t) in other.tabs.iter().enumerate() {
                        if known.contains(&(a, tab, b, mouth)) {
                            continue;
                        }
                        let rule = if self.params.policy == Policy::Paper {
                            // What the rules let pass is among the joints, unless the budget ran out before.
                            judge.pair((a, tab), (b, mouth)).err().unwrap_or(Rule::Support)
                        } else if !windows.let_opening_pass(m, t) {
                            Rule::Opening
                        } else if !windows.let_path_pass(m, t) {
                            Rule::PathLength
                        } else if list.is_some_and(|list| list.names(order[a], tab)) {
                            Rule::Placement
                        } else {
                            Rule::Shape
                        };
                        rows.push(Candidate { fate: Fate::Dropped(rule), ..describe((a, tab), (b, mouth)) });
                    }
                }
            }
        }
        rows
    }
}

/// Whether the borders of a candidate don't follow each other at all.
fn hopeless(joint: &Joint, mouth: &Outline) -> bool {
    joint.fit.residual > HOPELESS * placement::RESIDUAL_CAP * mouth.scale
}

/// Counts of the candidate table but for [`within_windows`]; `near` are the pairs that the index keeps.
pub(super) fn count(outlines: &[&Outline], joints: &[Joint], near: usize) -> TableCounts {
    let segments = |o: &'_ Outline, tabs: bool| if tabs { o.tabs.len() } else { o.mouths.len() };
    let positive: usize = outlines.iter().map(|o| segments(o, true)).sum();
    let negative: usize = outlines.iter().map(|o| segments(o, false)).sum();
    let own: usize = outlines.iter().map(|o| segments(o, true) * segments(o, false)).sum();
    let mut table = TableCounts { positive, negative, pairs: positive * negative - own, ..TableCounts::default() };
    table.after_correlation = near;
    table.after_overlap = joints.iter().filter(|j| !hopeless(j, outlines[j.b])).count();
    table
}

/// How many pairs pass the opening window, and how many the window of path lengths as well: counted by a sweep over the
/// widths with a tree of sums over the path lengths (Fenwick 1994), O(n log n) in all, and the pairs within one piece
/// taken off.
pub(super) fn within_windows(outlines: &[&Outline]) -> (usize, usize) {
    let mut tabs: Vec<(f64, f64)> = outlines.iter().flat_map(|o| o.tabs.iter().map(|t| (t.width, t.path))).collect();
    tabs.sort_by(|p, q| p.0.total_cmp(&q.0));
    let mut paths: Vec<f64> = tabs.iter().map(|t| t.1).collect();
    paths.sort_by(f64::total_cmp);
    // Each mouth asks for the tabs before two places of the sweep: those before the second less those before the first.
    let mut questions: Vec<(usize, bool, usize, usize)> = Vec::new();
    let (mut opening, mut length) = (0, 0);
    for o in outlines {
        let w = Windows::of(o);
        for m in &o.mouths {
            let own: Vec<&Segment> = o.tabs.iter().filter(|t| w.let_opening_pass(m, t)).collect();
            let from = tabs.partition_point(|t| m.width - t.0 > w.opening.1);
            let to = tabs.partition_point(|t| m.width - t.0 >= w.opening.0);
            opening += to - from - own.len();
            length -= own.iter().filter(|t| w.let_path_pass(m, t)).count() as i64;
            let low = paths.partition_point(|p| m.path - p > w.path.1);
            let high = paths.partition_point(|p| m.path - p >= w.path.0);
            questions.push((from, false, low, high));
            questions.push((to, true, low, high));
        }
    }
    questions.sort_unstable();
    let mut sums = vec![0i64; paths.len() + 1];
    let before = |sums: &[i64], mut k: usize| {
        let mut sum = 0;
        while k > 0 {
            sum += sums[k];
            k &= k - 1;
        }
        sum
    };
    let mut swept = 0;
    for (place, add, low, high) in questions {
        for tab in &tabs[swept..place] {
            let mut k = paths.partition_point(|p| *p < tab.1) + 1;
            while k < sums.len() {
                sums[k] += 1;
                k += k & k.wrapping_neg();
            }
        }
        swept = place;
        let inside = before(&sums, high) - before(&sums, low);
        length += if add { inside } else { -inside };
    }
    (opening, length.max(0) as usize)
}
