//! From the tabs that resemble a mouth to refined candidates, coarse to fine.
//!
//! Of the tabs that the index names those that don't resemble the mouth far less than the nearest are posed roughly by a few samples;
//! those whose residual isn't far beyond the least are fitted on a part of their nodes, and the best of these on all. What is
//! posed and fitted depends on the list alone, not on the order in which it came to be. O(1) each.

use crate::index::Hit;
use crate::outline::{Outline, Segment};
use crate::placement;

/// A tab that may fit a mouth.
#[derive(Debug, Clone)]
pub(crate) struct Match {
    pub(crate) hit: Hit,
    /// Rough pose, of the nearest only.
    rough: Option<placement::Rough>,
    /// Coarse fit, of the roughly best, and refined fit, of the best of these: of few, so that lists stay short in memory.
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
    /// A tab that the index found.
    pub(crate) fn new(hit: Hit) -> Self {
        Self { hit, rough: None, coarse: None, fine: None }
    }

    /// The same tab, as the index finds it now.
    pub(crate) fn again(self, hit: Hit) -> Self {
        Self { hit, ..self }
    }
}

/// Which candidates go on to the next step: those whose figure is at most so many times the best one's, and so much more, in piece
/// scales; but so many of them in any case.
struct Choice {
    times: f64,
    more: f64,
    least: usize,
}

/// To be posed roughly, by the index's distance: of 4 000 matings, generated and real, all but one would still be found at twice the
/// least distance, and this much more, where mostly one in thirty candidates is as near, and of worn pieces one in two.
const NEARLY: Choice = Choice { times: 4.0, more: 0.004, least: 12 };
/// To be fitted coarsely, by the residual of the rough pose and what that may be off.
const ROUGHLY: Choice = Choice { times: 2.0, more: 0.0015, least: 4 };
/// To be refined, by the residual of the coarse fit.
const COARSELY: Choice = Choice { times: 1.5, more: 0.001, least: 4 };

impl Choice {
    /// Of some figures, with places in a mouth's list, the places; best first.
    fn of(&self, figures: impl Iterator<Item = (f64, usize)>, scale: f64) -> Vec<usize> {
        let mut places: Vec<(f64, usize)> = figures.collect();
        // Of equals the nearest, as in the list.
        places.sort_by(|p, q| p.0.total_cmp(&q.0).then(p.1.cmp(&q.1)));
        let limit = places.first().map_or(0.0, |p| self.times * p.0 + self.more * scale);
        let within = places.partition_point(|p| p.0 <= limit);
        places.truncate(within.max(self.least));
        places.into_iter().map(|p| p.1).collect()
    }
}

/// Poses and fits what has to be in a mouth's list and isn't yet, and gives the fits that stand: refined where
/// the coarse one is good enough. Which these are depends on the list alone, not on what was fitted while it was another.
/// `scale` is the scale of the mouth's piece, `free` whether the clearance is fitted.
pub(crate) fn refine(
    list: &mut [Match],
    mouth: &Segment,
    outlines: &[&Outline],
    (scale, free): (f64, bool),
    feet: &mut placement::Feet,
) -> Vec<(Hit, placement::Fit)> {
    let tab = |m: &Match| &outlines[m.hit.piece as usize].tabs[m.hit.tab as usize];
    let near = NEARLY.of(list.iter().enumerate().map(|(k, m)| (f64::from(m.hit.distance), k)), scale);
    for &place in &near {
        let m = &mut list[place];
        if m.rough.is_none() {
            m.rough = placement::rough(tab(m), mouth, scale, free, feet);
        }
    }
    let places = ROUGHLY.of(near.iter().filter_map(|k| Some((list[*k].rough?.residual, *k))), scale);
    for &place in &places {
        let m = &mut list[place];
        if let (Some(rough), None) = (&m.rough, &m.coarse) {
            m.coarse = placement::coarse(tab(m), mouth, rough, scale, free, feet).map(Box::new);
        }
    }
    let fine = COARSELY.of(places.iter().filter_map(|k| Some((list[*k].coarse.as_ref()?.residual, *k))), scale);
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
