//! The incremental solver: pieces come and go, candidates are kept, a solution is made on demand.

use crate::correlation::correlate;
use crate::index::shape_distance;
use crate::index::{Entry, Hit, Index, Windows};
use crate::outline::{Outline, Segment};
use crate::paper;
use crate::search::{self, Joint, Outcome};
use crate::{Assembly, Mating, Params, ParamsError, Piece, Placement, Policy, TableCounts, Timings, frame, placement};
use nalgebra::Isometry2;
use rayon::prelude::*;
use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};
use thiserror::Error;

/// Window on the difference of mouth and neck width, in piece scales: clearance on both sides (3 % each) and the
/// uncertainty of a flat minimum on both.
const OPENING_WINDOW: f64 = 0.15;
/// Window on the difference of path lengths, in piece scales: the critical points of a neck with near-parallel sides
/// may slide along it.
const PATH_WINDOW: f64 = 0.4;

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
    /// The two overlap too much, or the borders don't follow each other.
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
    /// How many loops of pieces close over it.
    pub support: usize,
    /// Pose: `p_negative_image = negative_from_positive * p_positive_image`.
    pub negative_from_positive: Isometry2<f64>,
    /// What became of it in the last solution.
    pub fate: Fate,
}

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

/// A tab that may fit a mouth.
#[derive(Debug, Clone, Copy)]
struct Match {
    hit: Hit,
    /// `None` where not even a rough pose was found.
    rough: Option<placement::Rough>,
    /// Coarse fit, of the roughly best only, and refined fit, of the best of these.
    coarse: Option<placement::Fit>,
    fine: Option<placement::Fit>,
}

/// The solver. Pieces are taken in one by one; [`Solver::solve`] matches what is new and assembles all.
#[derive(Debug, Clone)]
pub struct Solver {
    params: Params,
    pool: Option<Arc<rayon::ThreadPool>>,
    pieces: Vec<Piece>,
    index_of: HashMap<String, usize>,
    outlines: Vec<Option<Outline>>,
    /// For each piece and mouth the nearest tabs; `None` where they have to be looked for.
    matches: Vec<Option<Vec<Vec<Match>>>>,
    /// What the last solution was made from, for [`Solver::candidates`].
    last: Option<Solution>,
}

/// What a solution was made from.
#[derive(Debug, Clone)]
struct Solution {
    order: Vec<usize>,
    joints: Vec<Joint>,
    shape_distances: Vec<f64>,
    outcome: Outcome,
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
            outlines: Vec::new(),
            matches: Vec::new(),
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
        self.outlines.push(None);
        self.matches.push(None);
        Ok(index)
    }

    /// Takes a piece out again; the pieces behind it move up by one index. `None` if there is no such piece.
    pub fn remove(&mut self, id: &str) -> Option<Piece> {
        let index = self.index_of.remove(id)?;
        for other in self.index_of.values_mut().filter(|other| **other > index) {
            *other -= 1;
        }
        self.outlines.remove(index);
        self.matches.remove(index);
        for lists in &mut self.matches {
            // A mouth that loses a candidate may gain the next best one: it is looked for again.
            if lists.iter().flatten().flatten().any(|m| m.hit.piece as usize == index) {
                *lists = None;
            }
            for m in lists.iter_mut().flatten().flatten() {
                if m.hit.piece as usize > index {
                    m.hit.piece -= 1;
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
        self.outlines.clear();
        self.matches.clear();
        self.last = None;
    }

    /// The best assembly of the pieces that are there.
    pub fn solve(&mut self) -> Assembly {
        match self.pool.clone() {
            Some(pool) => pool.install(|| self.solve_here()),
            None => self.solve_here(),
        }
    }

    fn solve_here(&mut self) -> Assembly {
        let begin = Instant::now();
        let deadline =
            (self.params.time_budget > 0.0).then(|| begin + Duration::from_secs_f64(self.params.time_budget));
        // Ranks by id make the result independent of the order of insertion.
        let mut order: Vec<usize> = (0..self.pieces.len()).collect();
        order.sort_by(|p, q| self.pieces[*p].id.cmp(&self.pieces[*q].id));
        let mut rank = vec![0; order.len()];
        for (r, k) in order.iter().enumerate() {
            rank[*k] = r;
        }
        let pieces = &self.pieces;
        self.outlines.par_iter_mut().enumerate().for_each(|(k, outline)| {
            outline.get_or_insert_with(|| Outline::new(&pieces[k]));
        });
        let outlines: Vec<&Outline> = order.iter().filter_map(|k| self.outlines[*k].as_ref()).collect();
        let (joints, shape_distances, table) = if self.params.policy == Policy::Paper {
            let (joints, table) = paper::candidates(&outlines);
            let distances = joints
                .iter()
                .map(|j| f64::from(shape_distance(&outlines[j.a].tabs[j.tab], &outlines[j.b].mouths[j.mouth])))
                .collect();
            (joints, distances, Some(table))
        } else {
            drop(outlines);
            self.match_new(&rank);
            let (joints, distances) = self.joints(&order, &rank);
            (joints, distances, None)
        };
        let matched = Instant::now();
        let outlines: Vec<&Outline> = order.iter().filter_map(|k| self.outlines[*k].as_ref()).collect();
        let outcome = search::assemble(&outlines, &joints, &self.params, deadline);
        let mut assembly = report(&order, &outlines, &joints, &outcome);
        assembly.table = table.unwrap_or_else(|| count(&outlines, &joints));
        assembly.table.backtracks = outcome.backtracks;
        assembly.partial = outcome.partial;
        assembly.timings =
            Timings { matching: (matched - begin).as_secs_f64(), assembly: matched.elapsed().as_secs_f64() };
        self.last = Some(Solution { order, joints, shape_distances, outcome });
        assembly
    }

    /// Finds the candidates of new mouths among all tabs, and of old mouths among the new tabs.
    fn match_new(&mut self, rank: &[usize]) {
        let fresh: Vec<usize> = (0..self.pieces.len()).filter(|k| self.matches[*k].is_none()).collect();
        if fresh.is_empty() {
            return;
        }
        let outlines: Vec<&Outline> = self.outlines.iter().flatten().collect();
        let entries = |pieces: &[usize]| -> Vec<Entry> {
            let mut entries = Vec::new();
            for &piece in pieces {
                entries.extend(outlines[piece].tabs.iter().enumerate().map(|(tab, segment)| Entry {
                    piece: piece as u32,
                    tab: tab as u32,
                    rank: rank[piece] as u32,
                    segment,
                }));
            }
            entries
        };
        let everything: Vec<usize> = (0..outlines.len()).collect();
        let all = Index::new(entries(&everything));
        let new = Index::new(entries(&fresh));
        let keep = self.params.candidates;
        let free = self.params.fit_clearance;
        self.matches.par_iter_mut().enumerate().for_each_init(placement::Feet::default, |feet, (piece, lists)| {
            let outline = outlines[piece];
            let index = if lists.is_none() { &all } else { &new };
            let lists = lists.get_or_insert_with(|| vec![Vec::new(); outline.mouths.len()]);
            for (mouth, list) in outline.mouths.iter().zip(lists) {
                for hit in index.nearest(mouth, piece as u32, &windows(outline), keep) {
                    let place = list.partition_point(|m: &Match| m.hit.order(&hit).is_lt());
                    let known = list.get(place).is_some_and(|m| (m.hit.piece, m.hit.tab) == (hit.piece, hit.tab));
                    if place >= keep || known {
                        continue;
                    }
                    let tab = &outlines[hit.piece as usize].tabs[hit.tab as usize];
                    let rough = placement::rough(tab, mouth, outline.scale, free, feet);
                    list.insert(place, Match { hit, rough, coarse: None, fine: None });
                    list.truncate(keep);
                }
                refine(list, mouth, &outlines, (outline.scale, free), feet);
            }
        });
    }

    /// The refined candidates in ranks, and their shape distances.
    fn joints(&self, order: &[usize], rank: &[usize]) -> (Vec<Joint>, Vec<f64>) {
        let mut joints = Vec::new();
        let mut distances = Vec::new();
        for &piece in order {
            let scale = self.outlines[piece].as_ref().map_or(1.0, |o| o.scale);
            for (mouth, list) in self.matches[piece].iter().flatten().enumerate() {
                for (place, fit) in best_fits(list, scale) {
                    let m = &list[place];
                    let (a, b) = (rank[m.hit.piece as usize], rank[piece]);
                    joints.push(Joint { a, tab: m.hit.tab as usize, b, mouth, fit });
                    distances.push(f64::from(m.hit.distance));
                }
            }
        }
        (joints, distances)
    }

    /// The candidate table of the last [`Solver::solve`]: each refined candidate with its figures and its fate. What
    /// the windows and the shape index drop before is counted in [`Assembly::table`] only.
    pub fn candidates(&self) -> Vec<Candidate> {
        let Some(Solution { order, joints, shape_distances, outcome }) = &self.last else { return Vec::new() };
        let outlines: Vec<&Outline> = order.iter().filter_map(|k| self.outlines[*k].as_ref()).collect();
        let mut mated = vec![false; joints.len()];
        let mut taken = std::collections::HashSet::new();
        for (k, _) in &outcome.matings {
            mated[*k] = true;
            let j = &joints[*k];
            taken.insert((true, j.a, j.tab));
            taken.insert((false, j.b, j.mouth));
        }
        let describe = |(k, j): (usize, &Joint)| {
            let (tab, mouth) = (&outlines[j.a].tabs[j.tab], &outlines[j.b].mouths[j.mouth]);
            let rival = taken.contains(&(true, j.a, j.tab)) || taken.contains(&(false, j.b, j.mouth));
            let fate = if mated[k] {
                Fate::Mated
            } else if hopeless(j, outlines[j.b]) {
                Fate::Dropped(Rule::Overlap)
            } else if rival {
                Fate::Dropped(Rule::Rival)
            } else {
                Fate::Dropped(Rule::Support)
            };
            Candidate {
                positive_piece: order[j.a],
                positive_isthmus: tab.isthmus,
                negative_piece: order[j.b],
                negative_isthmus: mouth.isthmus,
                opening: mouth.width - tab.width,
                path_difference: mouth.path - tab.path,
                shape_distance: shape_distances[k],
                correlation: correlation_of(tab, mouth),
                pos_gap: j.fit.pos_gap,
                neg_gap: j.fit.neg_gap,
                ave_gap: j.fit.ave_gap,
                residual: j.fit.residual,
                clearance: j.fit.clearance,
                support: outcome.support[k],
                negative_from_positive: j.fit.negative_from_positive,
                fate,
            }
        };
        joints.par_iter().enumerate().map(describe).collect()
    }
}

/// Whether the borders of a candidate don't follow each other at all.
fn hopeless(joint: &Joint, mouth: &Outline) -> bool {
    joint.fit.residual > HOPELESS * placement::RESIDUAL_CAP * mouth.scale
}

/// Turns ranks into indices and lays the islands out.
fn report(order: &[usize], outlines: &[&Outline], joints: &[Joint], outcome: &Outcome) -> Assembly {
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
    let mut assembly = Assembly::default();
    let mut placed = vec![false; order.len()];
    for (component, (members, motion)) in frame::lay_out(outlines, &poses, &islands).into_iter().enumerate() {
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
    for (k, confidence) in &outcome.matings {
        let j = &joints[*k];
        let (tab, mouth) = (&outlines[j.a].tabs[j.tab], &outlines[j.b].mouths[j.mouth]);
        assembly.matings.push(Mating {
            positive_piece: order[j.a],
            positive_isthmus: tab.isthmus,
            negative_piece: order[j.b],
            negative_isthmus: mouth.isthmus,
            correlation: correlation_of(tab, mouth),
            ave_gap: j.fit.ave_gap,
            clearance: j.fit.clearance,
            confidence: *confidence,
        });
    }
    assembly
}

/// Counts of the candidate table: windows counted on sorted widths, the rest on the candidates themselves.
fn count(outlines: &[&Outline], joints: &[Joint]) -> TableCounts {
    let mut tabs: Vec<(f64, f64)> = outlines.iter().flat_map(|o| o.tabs.iter().map(|t| (t.width, t.path))).collect();
    tabs.sort_by(|p, q| p.0.total_cmp(&q.0));
    let negative: usize = outlines.iter().map(|o| o.mouths.len()).sum();
    let same: usize = outlines.iter().map(|o| o.mouths.len() * o.tabs.len()).sum();
    let within = |v: f64, w: (f64, f64)| v >= w.0 && v <= w.1;
    let (after_opening, after_length) = outlines
        .par_iter()
        .map(|o| {
            let w = windows(o);
            let (mut opening, mut length) = (0, 0);
            for m in &o.mouths {
                let from = tabs.partition_point(|t| m.width - t.0 > w.opening.1);
                let to = tabs.partition_point(|t| m.width - t.0 >= w.opening.0);
                let own: Vec<&Segment> = o.tabs.iter().filter(|t| within(m.width - t.width, w.opening)).collect();
                opening += (to - from) - own.len();
                length += tabs[from..to].iter().filter(|t| within(m.path - t.1, w.path)).count()
                    - own.iter().filter(|t| within(m.path - t.path, w.path)).count();
            }
            (opening, length)
        })
        .reduce(|| (0, 0), |p, q| (p.0 + q.0, p.1 + q.1));
    let hopeless = joints.iter().filter(|j| hopeless(j, outlines[j.b])).count();
    TableCounts {
        positive: tabs.len(),
        negative,
        pairs: tabs.len() * negative - same,
        after_opening,
        after_length,
        after_correlation: joints.len(),
        after_overlap: joints.len() - hopeless,
        backtracks: 0,
    }
}

/// Candidates of a mouth that are refined in any case.
const REFINED: usize = 4;
/// More are fitted coarsely if their rough residual is at most this many times the best one's, and this much more, in
/// piece scales: what a rough pose may be off.
const ROUGHLY: (f64, f64) = (2.0, 0.0015);
/// The same for a refined fit, by the residuals of the coarse ones.
const COARSELY: (f64, f64) = (1.5, 0.001);

/// Those of some places in a mouth's list whose residual is within `near` of the least, but at least [`REFINED`]; best
/// first.
fn best(list: &[Match], residuals: impl Iterator<Item = (f64, usize)>, near: (f64, f64), scale: f64) -> Vec<usize> {
    let mut places: Vec<(f64, usize)> = residuals.collect();
    places.sort_by(|p, q| p.0.total_cmp(&q.0).then(list[p.1].hit.order(&list[q.1].hit)));
    let limit = places.first().map_or(0.0, |p| near.0 * p.0 + near.1 * scale);
    let within = places.partition_point(|p| p.0 <= limit);
    places.truncate(within.max(REFINED));
    places.into_iter().map(|p| p.1).collect()
}

/// Places in a mouth's list of the candidates to fit coarsely.
fn roughly_best(list: &[Match], scale: f64) -> Vec<usize> {
    let residuals = list.iter().enumerate().filter_map(|(k, m)| Some((m.rough?.residual, k)));
    best(list, residuals, ROUGHLY, scale)
}

/// Those of them to refine.
fn coarsely_best(list: &[Match], places: &[usize], scale: f64) -> Vec<usize> {
    let residuals = places.iter().filter_map(|k| Some((list[*k].coarse?.residual, *k)));
    best(list, residuals, COARSELY, scale)
}

/// Fits what has to be fitted in a mouth's list and isn't yet.
fn refine(
    list: &mut [Match],
    mouth: &Segment,
    outlines: &[&Outline],
    (scale, free): (f64, bool),
    feet: &mut placement::Feet,
) {
    let tab = |m: &Match| &outlines[m.hit.piece as usize].tabs[m.hit.tab as usize];
    let places = roughly_best(list, scale);
    for &place in &places {
        let m = &mut list[place];
        if let (Some(rough), None) = (&m.rough, &m.coarse) {
            m.coarse = placement::coarse(tab(m), mouth, rough, scale, free, feet);
        }
    }
    for place in coarsely_best(list, &places, scale) {
        let m = &mut list[place];
        if let (Some(coarse), None) = (&m.coarse, &m.fine) {
            m.fine = placement::refine(tab(m), mouth, coarse, scale, free, feet);
        }
    }
}

/// The fits of a mouth's list that stand: refined where the coarse one is good enough. Which these are depends on the
/// list alone, not on what was fitted while it was another.
fn best_fits(list: &[Match], scale: f64) -> Vec<(usize, placement::Fit)> {
    let places = roughly_best(list, scale);
    let fine = coarsely_best(list, &places, scale);
    let fit = |k: usize| if fine.contains(&k) { list[k].fine } else { list[k].coarse };
    places.into_iter().filter_map(|k| Some((k, fit(k)?))).collect()
}

/// A mean residual above this part of the cap means that the borders don't follow each other at all.
const HOPELESS: f64 = 0.5;

/// Eq. 1 of a tab and a mouth.
fn correlation_of(tab: &Segment, mouth: &Segment) -> f64 {
    let samples = |s: &Segment| s.shape.iter().map(|v| f64::from(*v)).collect::<Vec<f64>>();
    correlate(&samples(tab), &samples(mouth), 0.75, 8).value
}

fn windows(outline: &Outline) -> Windows {
    let (w, p) = (OPENING_WINDOW * outline.scale, PATH_WINDOW * outline.scale);
    Windows { opening: (-w, w), path: (-p, p) }
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
