//! From the tabs that resemble a mouth to refined candidates, coarse to fine.
//!
//! Each tab that the index names is posed roughly by a few samples; those whose residual isn't far beyond the least are
//! fitted on a part of their nodes, and the best of these on all. What is fitted depends on the list alone, not on the
//! order in which it came to be. Most of the work goes into rough poses, O(1) each.

use crate::index::Hit;
use crate::outline::{Outline, Segment};
use crate::placement;

/// A tab that may fit a mouth.
#[derive(Debug, Clone)]
pub(crate) struct Match {
    pub(crate) hit: Hit,
    /// `None` where not even a rough pose was found.
    rough: Option<placement::Rough>,
    /// Coarse fit, of the roughly best only, and refined fit, of the best of these: of few, so that lists stay short in memory.
    coarse: Option<Box<placement::Fit>>,
    fine: Option<Box<placement::Fit>>,
}

/// The tabs that resemble a mouth most.
#[derive(Debug, Clone, Default)]
pub(crate) struct List {
    /// Nearest first.
    pub(crate) matches: Vec<Match>,
    /// Those that were good enough to be refined; none where they have to be chosen.
    pub(crate) fits: Option<Vec<(Hit, placement::Fit)>>,
}

impl List {
    /// Whether a tab is among them.
    pub(crate) fn names(&self, piece: usize, tab: usize) -> bool {
        self.matches.iter().any(|m| (m.hit.piece as usize, m.hit.tab as usize) == (piece, tab))
    }
}

impl Match {
    /// A tab that the index found, posed roughly; `scale` is the scale of the mouth's piece, `free` whether the clearance
    /// is fitted.
    pub(crate) fn new(
        hit: Hit,
        mouth: &Segment,
        outlines: &[&Outline],
        (scale, free): (f64, bool),
        feet: &mut placement::Feet,
    ) -> Self {
        let tab = &outlines[hit.piece as usize].tabs[hit.tab as usize];
        Self { hit, rough: placement::rough(tab, mouth, scale, free, feet), coarse: None, fine: None }
    }

    /// The same tab, as the index finds it now.
    pub(crate) fn again(self, hit: Hit) -> Self {
        Self { hit, ..self }
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
fn best(residuals: impl Iterator<Item = (f64, usize)>, near: (f64, f64), scale: f64) -> Vec<usize> {
    let mut places: Vec<(f64, usize)> = residuals.collect();
    // Of equals the nearest, as in the list.
    places.sort_by(|p, q| p.0.total_cmp(&q.0).then(p.1.cmp(&q.1)));
    let limit = places.first().map_or(0.0, |p| near.0 * p.0 + near.1 * scale);
    let within = places.partition_point(|p| p.0 <= limit);
    places.truncate(within.max(REFINED));
    places.into_iter().map(|p| p.1).collect()
}

/// Places in a mouth's list of the candidates to fit coarsely.
fn roughly_best(list: &[Match], scale: f64) -> Vec<usize> {
    let residuals = list.iter().enumerate().filter_map(|(k, m)| Some((m.rough?.residual, k)));
    best(residuals, ROUGHLY, scale)
}

/// Those of them to refine.
fn coarsely_best(list: &[Match], places: &[usize], scale: f64) -> Vec<usize> {
    let residuals = places.iter().filter_map(|k| Some((list[*k].coarse.as_ref()?.residual, *k)));
    best(residuals, COARSELY, scale)
}

/// Fits what has to be fitted in a mouth's list and isn't yet, and gives the fits that stand: refined where
/// the coarse one is good enough. Which these are depends on the list alone, not on what was fitted while it was another.
pub(crate) fn refine(
    list: &mut [Match],
    mouth: &Segment,
    outlines: &[&Outline],
    (scale, free): (f64, bool),
    feet: &mut placement::Feet,
) -> Vec<(Hit, placement::Fit)> {
    let tab = |m: &Match| &outlines[m.hit.piece as usize].tabs[m.hit.tab as usize];
    let places = roughly_best(list, scale);
    for &place in &places {
        let m = &mut list[place];
        if let (Some(rough), None) = (&m.rough, &m.coarse) {
            m.coarse = placement::coarse(tab(m), mouth, rough, scale, free, feet).map(Box::new);
        }
    }
    let fine = coarsely_best(list, &places, scale);
    for &place in &fine {
        let m = &mut list[place];
        if let (Some(coarse), None) = (&m.coarse, &m.fine) {
            let from = (&coarse.negative_from_positive, coarse.clearance);
            m.fine = placement::refine(tab(m), mouth, from, scale, free, feet).map(Box::new);
        }
    }
    let fit = |k: usize| if fine.contains(&k) { list[k].fine.as_deref() } else { list[k].coarse.as_deref() };
    places.into_iter().filter_map(|k| Some((list[k].hit, *fit(k)?))).collect()
}
