//! The incremental solver: pieces come and go, candidates are kept, a solution is made on demand.

mod table;

use crate::copies::{Standing, copies};
use crate::correlation::correlate;
use crate::index::{Entry, Hit, Index, Windows};
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
pub use table::{Candidate, Fate, Posed, Rule};
use table::{count, within_windows};
use thiserror::Error;

/// Part of the budget after which no more candidates are looked for: what has been found is to be assembled, too.
const MATCHING_SHARE: f64 = 0.5;

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
    /// Whether it was seen again later, elsewhere: then it has no part in the puzzle.
    earlier: bool,
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
        let (serial, lists) = (self.serials, Vec::new());
        self.kept.push(Kept { serial, outline: None, lists, current: false, offered: false, earlier: false });
        Ok(index)
    }

    /// Takes a piece out again; the pieces behind it move up by one index. `None` if there is no such piece.
    pub fn remove(&mut self, id: &str) -> Option<Piece> {
        let index = self.index_of.remove(id)?;
        for other in self.index_of.values_mut().filter(|other| **other > index) {
            *other -= 1;
        }
        self.withdraw(index);
        self.kept.remove(index);
        for kept in &mut self.kept {
            for list in &mut kept.lists {
                let fits = list.fits.iter_mut().flatten().map(|(hit, _)| hit);
                for hit in list.matches.iter_mut().map(|m| &mut m.hit).chain(fits) {
                    hit.piece -= u32::from(hit.piece as usize > index);
                }
            }
        }
        self.last = None;
        Some(self.pieces.remove(index))
    }

    /// Takes a piece out of the candidates.
    fn withdraw(&mut self, index: usize) {
        for kept in &mut self.kept {
            for list in &mut kept.lists {
                let before = list.matches.len();
                list.matches.retain(|m| m.hit.piece as usize != index);
                // A mouth that loses a candidate may gain the next best one: it is looked for again.
                if list.matches.len() < before {
                    kept.current = false;
                    list.fits = None;
                }
            }
        }
        let kept = &mut self.kept[index];
        kept.lists.clear();
        (kept.current, kept.offered) = (false, false);
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
        let pieces = &self.pieces;
        self.kept.par_iter_mut().enumerate().for_each(|(k, kept)| {
            kept.outline.get_or_insert_with(|| Outline::new(&pieces[k], kept.serial));
        });
        let standings = copies(&ranked(&self.kept, &order));
        for (k, standing) in order.iter().zip(&standings) {
            let earlier = *standing == Standing::Earlier;
            if earlier && !self.kept[*k].earlier {
                self.withdraw(*k);
            }
            self.kept[*k].earlier = earlier;
        }
        let (earlier, order): (Vec<usize>, Vec<usize>) = order.into_iter().partition(|k| self.kept[*k].earlier);
        // Of pieces that are there twice one makes the puzzle: two would take each other's place.
        let present = standings.into_iter().filter(|s| *s != Standing::Earlier);
        let aside = present.map(|s| s == Standing::Copy && self.params.policy == Policy::Standard).collect();
        let mut rank = vec![0; self.pieces.len()];
        for (r, k) in order.iter().enumerate() {
            rank[*k] = r;
        }
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
            || search::assemble(&outlines, joints, aside, &self.params, &self.memory, budget),
            || (self.params.policy == Policy::Standard).then(|| within_windows(&outlines)),
        );
        if let Some(passed) = passed {
            (table.after_opening, table.after_length) = passed;
        }
        self.count_brought_up(&mut table, &order, &outlines, &outcome);
        let mut assembly = report(&order, &outlines, &outcome, &self.memory);
        assembly.earlier = earlier;
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
        if self.kept.iter().all(|k| k.earlier || k.current && k.offered) {
            return true;
        }
        // Lists and outlines are taken apart, so that the ones can be filled while the others are read.
        let mut lists: Vec<(bool, Vec<List>)> =
            self.kept.iter_mut().map(|k| (k.current, std::mem::take(&mut k.lists))).collect();
        let present = || (0..self.kept.len()).filter(|k| !self.kept[*k].earlier);
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
        let all = Index::new(entries(&mut present()), mouths(false));
        let new = Index::new(entries(&mut present().filter(|k| !self.kept[*k].offered)), mouths(true));
        let most = self.params.candidates;
        let free = self.params.fit_clearance;
        let whole = AtomicBool::new(true);
        lists.par_iter_mut().enumerate().for_each(|(piece, (current, lists))| {
            if self.kept[piece].earlier {
                return;
            }
            if budget.spent() >= MATCHING_SHARE {
                whole.store(false, Ordering::Relaxed);
                *current = false;
                return;
            }
            let outline = outlines[piece];
            let index = if *current { &new } else { &all };
            lists.resize(outline.mouths.len(), List::default());
            outline.mouths.par_iter().zip(lists).for_each_init(placement::Feet::default, |feet, (mouth, list)| {
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
                    matches.insert(place, Match::new(hit));
                    matches.truncate(most);
                    list.fits = None;
                }
                let choose = || matching::refine(matches, mouth, &outlines, (outline.scale, free), feet);
                list.fits.get_or_insert_with(choose);
            });
            *current = true;
        });
        for (kept, (current, lists)) in self.kept.iter_mut().zip(lists) {
            (kept.current, kept.lists) = (current, lists);
            kept.offered = !kept.earlier;
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
}

/// Outlines in the order of ranks.
fn ranked<'a>(kept: &'a [Kept], order: &[usize]) -> Vec<&'a Outline> {
    order.iter().filter_map(|k| kept[*k].outline.as_ref()).collect()
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
