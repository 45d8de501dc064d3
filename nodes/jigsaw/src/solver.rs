//! The incremental solver: pieces come and go, candidates are kept, a solution is made on demand.

use crate::correlation::correlate;
use crate::index::{Entry, Hit, Index, Windows, shape_distance};
use crate::matching::{List, Match};
use crate::memory::Memory;
use crate::outline::{Outline, Segment};
use crate::paper;
use crate::params::{Budget, Time};
use crate::placement::Joint;
use crate::search::{self, Mated, Outcome};
use crate::{
    Assembly, Mating, Params, ParamsError, Piece, Placement, Policy, TableCounts, Timings, frame, matching, placement,
};
use nalgebra::Isometry2;
use rayon::prelude::*;
use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;
use thiserror::Error;

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

/// Part of the budget after which no more candidates are looked for: what has been found is to be assembled, too.
const MATCHING_SHARE: f64 = 0.5;

/// Puzzles of up to so many pairs of a tab and a mouth have every pair in the candidate table (the paper's 24 pieces have
/// 2377; this is some 60 pieces). Of larger ones the refined pairs are listed, and the rest counted.
const LISTED_PAIRS: usize = 25_000;

/// A piece that can't be taken in.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum SolverError {
    /// A parameter is out of range.
    #[error(transparent)]
    Params(#[from] ParamsError),
    /// The id is taken.
    #[error("duplicate piece id {0:?}: ids must be unique")]
    DuplicateId(String),
    /// Too few points, or coordinates that aren't numbers.
    #[error("invalid border of piece {id:?}: {points} points; must be at least {min} finite points", min = Solver::MIN_BORDER_POINTS)]
    Border {
        /// The piece.
        id: String,
        /// How many points its border has.
        points: usize,
    },
    /// The threads asked for can't be started.
    #[error("cannot start {threads} threads: {reason}")]
    Threads {
        /// How many.
        threads: usize,
        /// What the system says.
        reason: String,
    },
}

/// What is kept of one piece.
#[derive(Debug, Clone)]
struct Kept {
    /// Number that no other piece of this solver has had.
    serial: u64,
    outline: Option<Outline>,
    /// For each mouth the nearest tabs.
    lists: Vec<List>,
    /// Whether the lists know all tabs that have been offered.
    current: bool,
    /// Whether its own tabs have been offered to all others.
    offered: bool,
}

/// The solver. Pieces are taken in one by one; [`Solver::solve`] matches what is new and assembles all.
#[derive(Debug, Clone)]
pub struct Solver {
    params: Params,
    pool: Option<Arc<rayon::ThreadPool>>,
    pieces: Vec<Piece>,
    index_of: HashMap<String, usize>,
    kept: Vec<Kept>,
    serials: u64,
    memory: Memory,
    /// What the last solution was made from, for [`Solver::candidates`].
    last: Option<Solution>,
}

/// What a solution was made from.
#[derive(Debug, Clone)]
struct Solution {
    order: Vec<usize>,
    outcome: Outcome,
    table: TableCounts,
}

impl Solver {
    /// A border with fewer points has no shape to speak of.
    pub const MIN_BORDER_POINTS: usize = 8;

    /// An empty solver.
    ///
    /// # Errors
    /// A parameter out of range; threads that can't be started.
    pub fn new(params: Params) -> Result<Self, SolverError> {
        params.validate()?;
        let pool = match params.threads {
            0 => None,
            threads => Some(Arc::new(
                rayon::ThreadPoolBuilder::new()
                    .num_threads(threads)
                    .build()
                    .map_err(|e| SolverError::Threads { threads, reason: e.to_string() })?,
            )),
        };
        Ok(Self {
            params,
            pool,
            pieces: Vec::new(),
            index_of: HashMap::new(),
            kept: Vec::new(),
            serials: 0,
            memory: Memory::default(),
            last: None,
        })
    }

    /// The parameters in force.
    pub fn params(&self) -> &Params {
        &self.params
    }

    /// The pieces; indices in results point here.
    pub fn pieces(&self) -> &[Piece] {
        &self.pieces
    }

    /// Takes a piece in and returns its index. What it brings is matched by the next [`Solver::solve`].
    ///
    /// # Errors
    /// The id is taken, or the border is no border.
    pub fn insert(&mut self, piece: Piece) -> Result<usize, SolverError> {
        if self.index_of.contains_key(&piece.id) {
            return Err(SolverError::DuplicateId(piece.id));
        }
        let border = &piece.features.border;
        let finite = border.spacing.is_finite() && border.points.iter().all(|p| p.x.is_finite() && p.y.is_finite());
        if border.points.len() < Self::MIN_BORDER_POINTS || border.spacing <= 0.0 || !finite {
            return Err(SolverError::Border { points: border.points.len(), id: piece.id });
        }
        let index = self.pieces.len();
        self.index_of.insert(piece.id.clone(), index);
        self.pieces.push(piece);
        self.serials += 1;
        self.kept.push(Kept { serial: self.serials, outline: None, lists: Vec::new(), current: false, offered: false });
        Ok(index)
    }

    /// Takes a piece out again; the pieces behind it move up by one index. `None` if there is no such piece.
    pub fn remove(&mut self, id: &str) -> Option<Piece> {
        let index = self.index_of.remove(id)?;
        for other in self.index_of.values_mut().filter(|other| **other > index) {
            *other -= 1;
        }
        self.kept.remove(index);
        for kept in &mut self.kept {
            for list in &mut kept.lists {
                let before = list.matches.len();
                list.matches.retain(|m| m.hit.piece as usize != index);
                // A mouth that loses a candidate may gain the next best one: it is looked for again.
                if list.matches.len() < before {
                    kept.current = false;
                    list.fits = None;
                }
                let fits = list.fits.iter_mut().flatten().map(|(hit, _)| hit);
                for hit in list.matches.iter_mut().map(|m| &mut m.hit).chain(fits) {
                    hit.piece -= u32::from(hit.piece as usize > index);
                }
            }
        }
        self.last = None;
        Some(self.pieces.remove(index))
    }

    /// Forgets all pieces.
    pub fn reset(&mut self) {
        self.pieces.clear();
        self.index_of.clear();
        self.kept.clear();
        self.memory = Memory::default();
        self.last = None;
    }

    /// The best assembly of the pieces that are there, within [`Params::time_budget`].
    pub fn solve(&mut self) -> Assembly {
        let time = Time { begin: Instant::now(), seconds: self.params.time_budget };
        self.solve_within(&time)
    }

    /// The best assembly of the pieces that are there that a budget allows. What is not done for want of it is done by
    /// the next solution.
    pub fn solve_within(&mut self, budget: &dyn Budget) -> Assembly {
        // All of it on one of the threads: handing each small step over to them would take longer than most steps.
        match self.pool.clone() {
            Some(pool) => pool.install(|| self.solve_here(budget)),
            None => rayon::scope(|_| self.solve_here(budget)),
        }
    }

    fn solve_here(&mut self, budget: &dyn Budget) -> Assembly {
        let begin = Instant::now();
        // Ranks by id make the result independent of the order of insertion.
        let mut order: Vec<usize> = (0..self.pieces.len()).collect();
        order.sort_by(|p, q| self.pieces[*p].id.cmp(&self.pieces[*q].id));
        let mut rank = vec![0; order.len()];
        for (r, k) in order.iter().enumerate() {
            rank[*k] = r;
        }
        let pieces = &self.pieces;
        self.kept.par_iter_mut().enumerate().for_each(|(k, kept)| {
            kept.outline.get_or_insert_with(|| Outline::new(&pieces[k], kept.serial));
        });
        let (joints, mut table, whole) = if self.params.policy == Policy::Paper {
            paper::candidates(&ranked(&self.kept, &order), &|| budget.spent() >= MATCHING_SHARE)
        } else {
            let whole = self.match_new(&rank, budget);
            let (joints, kept) = self.joints(&order, &rank);
            let table = count(&ranked(&self.kept, &order), &joints, kept);
            (joints, table, whole)
        };
        let matched = Instant::now();
        self.memory.next_solution();
        let outlines = ranked(&self.kept, &order);
        // What is only counted is counted meanwhile.
        let (outcome, passed) = rayon::join(
            || search::assemble(&outlines, joints, &self.params, &self.memory, budget),
            || (self.params.policy == Policy::Standard).then(|| within_windows(&outlines)),
        );
        if let Some(passed) = passed {
            (table.after_opening, table.after_length) = passed;
        }
        self.count_brought_up(&mut table, &order, &outlines, &outcome);
        let mut assembly = report(&order, &outlines, &outcome, &self.memory);
        assembly.table = TableCounts { backtracks: outcome.backtracks, ..table };
        assembly.partial = outcome.partial || !whole;
        assembly.timings =
            Timings { matching: (matched - begin).as_secs_f64(), assembly: matched.elapsed().as_secs_f64() };
        self.last = Some(Solution { order, outcome, table });
        assembly
    }

    /// Finds the candidates of new mouths among all tabs, and of old mouths among the new tabs; tells whether the budget
    /// was enough for all.
    fn match_new(&mut self, rank: &[usize], budget: &dyn Budget) -> bool {
        if self.kept.iter().all(|k| k.current && k.offered) {
            return true;
        }
        // Lists and outlines are taken apart, so that the ones can be filled while the others are read.
        let mut lists: Vec<(bool, Vec<List>)> =
            self.kept.iter_mut().map(|k| (k.current, std::mem::take(&mut k.lists))).collect();
        let outlines: Vec<&Outline> = self.kept.iter().filter_map(|k| k.outline.as_ref()).collect();
        let entries = |pieces: &mut dyn Iterator<Item = usize>| -> Vec<Entry> {
            let mut entries = Vec::new();
            for piece in pieces {
                entries.extend(outlines[piece].tabs.iter().enumerate().map(|(tab, segment)| Entry {
                    piece: piece as u32,
                    tab: tab as u32,
                    rank: rank[piece] as u32,
                    segment,
                }));
            }
            entries
        };
        // New mouths ask for all tabs, others for new ones.
        let mouths = |current: bool| -> usize {
            lists.iter().zip(&outlines).filter(|(list, _)| list.0 == current).map(|(_, o)| o.mouths.len()).sum()
        };
        let all = Index::new(entries(&mut (0..outlines.len())), mouths(false));
        let new = Index::new(entries(&mut (0..outlines.len()).filter(|k| !self.kept[*k].offered)), mouths(true));
        let most = self.params.candidates;
        let free = self.params.fit_clearance;
        let whole = AtomicBool::new(true);
        lists.par_iter_mut().enumerate().for_each_init(placement::Feet::default, |feet, (piece, (current, lists))| {
            if budget.spent() >= MATCHING_SHARE {
                whole.store(false, Ordering::Relaxed);
                *current = false;
                return;
            }
            let outline = outlines[piece];
            let index = if *current { &new } else { &all };
            lists.resize(outline.mouths.len(), List::default());
            for (mouth, list) in outline.mouths.iter().zip(lists) {
                let matches = &mut list.matches;
                for hit in index.nearest(mouth, piece as u32, &Windows::of(outline), most) {
                    // Ranks shift with each new id.
                    let before =
                        |m: &Match| Hit { rank: rank[m.hit.piece as usize] as u32, ..m.hit }.order(&hit).is_lt();
                    if matches.get(most - 1).is_some_and(before) {
                        break;
                    }
                    let place = matches.partition_point(before);
                    if matches.get(place).is_some_and(|m| (m.hit.piece, m.hit.tab) == (hit.piece, hit.tab)) {
                        continue;
                    }
                    matches.insert(place, Match::new(hit, mouth, &outlines, (outline.scale, free), feet));
                    matches.truncate(most);
                    list.fits = None;
                }
                let choose = || matching::refine(matches, mouth, &outlines, (outline.scale, free), feet);
                list.fits.get_or_insert_with(choose);
            }
            *current = true;
        });
        for (kept, (current, lists)) in self.kept.iter_mut().zip(lists) {
            (kept.current, kept.lists) = (current, lists);
            kept.offered = true;
        }
        whole.into_inner()
    }

    /// The refined candidates in ranks, and how many the index keeps.
    fn joints(&self, order: &[usize], rank: &[usize]) -> (Vec<Joint>, usize) {
        let fits = self.kept.iter().flat_map(|kept| &kept.lists).filter_map(|list| list.fits.as_ref());
        let mut joints = Vec::with_capacity(fits.map(Vec::len).sum());
        let mut near = 0;
        for &piece in order {
            for (mouth, list) in self.kept[piece].lists.iter().enumerate() {
                near += list.matches.len();
                for (hit, fit) in list.fits.iter().flatten() {
                    let (a, b) = (rank[hit.piece as usize], rank[piece]);
                    joints.push(Joint { a, tab: hit.tab as usize, b, mouth, fit: *fit });
                }
            }
        }
        (joints, near)
    }

    /// Counts the candidates that the assembly brought up among what each rule left, whatever the rule had said.
    fn count_brought_up(&self, table: &mut TableCounts, order: &[usize], outlines: &[&Outline], outcome: &Outcome) {
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
    /// add up to [`Assembly::table`]; of larger ones only the pairs that were refined are, and the rest is counted there.
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

/// Outlines in the order of ranks.
fn ranked<'a>(kept: &'a [Kept], order: &[usize]) -> Vec<&'a Outline> {
    order.iter().filter_map(|k| kept[*k].outline.as_ref()).collect()
}

/// Whether the borders of a candidate don't follow each other at all.
fn hopeless(joint: &Joint, mouth: &Outline) -> bool {
    joint.fit.residual > HOPELESS * placement::RESIDUAL_CAP * mouth.scale
}

/// Turns ranks into indices and lays the islands out.
fn report(order: &[usize], outlines: &[&Outline], outcome: &Outcome, memory: &Memory) -> Assembly {
    let mut islands: std::collections::BTreeMap<usize, Vec<usize>> = std::collections::BTreeMap::new();
    for (k, pose) in outcome.poses.iter().enumerate() {
        if let Some((island, _)) = pose {
            islands.entry(*island).or_default().push(k);
        }
    }
    let mut islands: Vec<Vec<usize>> = islands.into_values().collect();
    islands.sort_by(|p, q| q.len().cmp(&p.len()).then(p.cmp(q)));
    let poses: Vec<Isometry2<f64>> =
        outcome.poses.iter().map(|p| p.map_or_else(Isometry2::identity, |p| p.1)).collect();
    let mating = |mated: &Mated| {
        let j = &outcome.joints[mated.joint];
        let (tab, mouth) = (&outlines[j.a].tabs[j.tab], &outlines[j.b].mouths[j.mouth]);
        Mating {
            positive_piece: order[j.a],
            positive_isthmus: tab.isthmus,
            negative_piece: order[j.b],
            negative_isthmus: mouth.isthmus,
            correlation: memory.correlation((outlines[j.a].serial, j.tab), (outlines[j.b].serial, j.mouth), || {
                correlation_of(tab, mouth)
            }),
            ave_gap: j.fit.ave_gap,
            clearance: mated.clearance,
            confidence: mated.confidence,
        }
    };
    let (laid_out, matings) =
        rayon::join(|| frame::lay_out(outlines, &poses, &islands), || outcome.matings.par_iter().map(mating).collect());
    let mut assembly = Assembly { matings, ..Assembly::default() };
    let mut placed = vec![false; order.len()];
    for (component, (members, motion)) in laid_out.into_iter().enumerate() {
        for k in members {
            placed[k] = true;
            assembly.placements.push(Placement {
                piece: order[k],
                puzzle_from_image: motion * poses[k],
                component,
                confidence: outcome.confidence[k],
            });
        }
    }
    assembly.unplaced = (0..order.len()).filter(|k| !placed[*k]).map(|k| order[k]).collect();
    assembly
}

/// Counts of the candidate table but for [`within_windows`]; `near` are the pairs that the index keeps.
fn count(outlines: &[&Outline], joints: &[Joint], near: usize) -> TableCounts {
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
fn within_windows(outlines: &[&Outline]) -> (usize, usize) {
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

/// A mean residual above this part of the cap means that the borders don't follow each other at all.
const HOPELESS: f64 = 0.5;

/// Eq. 1 of a tab and a mouth.
fn correlation_of(tab: &Segment, mouth: &Segment) -> f64 {
    let samples = |s: &Segment| s.shape.iter().map(|v| f64::from(*v)).collect::<Vec<f64>>();
    correlate(&samples(tab), &samples(mouth), 0.75, 8).value
}

/// Assembles a whole set of pieces at once; indices in the result point into `pieces`.
///
/// # Errors
/// As [`Solver::new`] and [`Solver::insert`].
pub fn assemble(pieces: &[Piece], params: &Params) -> Result<Assembly, SolverError> {
    let mut solver = Solver::new(*params)?;
    for piece in pieces {
        solver.insert(piece.clone())?;
    }
    Ok(solver.solve())
}
