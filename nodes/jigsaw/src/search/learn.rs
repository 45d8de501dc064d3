//! What is learnt from the puzzle itself: how right and wrong candidates differ, and which of them close loops.
//!
//! The cost of a candidate is the logarithm of its residual, and how unusual its clearance is besides. Right ones are
//! those in loops (the best of which show how the puzzle's loops close, and what its clearance is), wrong ones the best
//! others of the same mouths, and where those are few of all other mouths. Before any loop is known, and where there are none,
//! the candidates that stand out serve.
//! The logarithm of how much likelier a cost is for a right candidate than for a wrong one is its evidence; all
//! decisions of the search are taken on sums of it.

use super::Assembler;
use crate::loops::{self, Closure, Edge, Tolerance};
use crate::placement::Joint;
use crate::slots::{Slot, Slots};

/// Loops of refined poses close to within this on real pieces (0.8 % and 0.44° measured); calibration tightens it.
const LOOSE: Tolerance = Tolerance { position: 0.04, angle: 0.05 };
/// True loops close this many times as wide as the borders' residuals say, as a first guess: neighbouring residuals
/// are alike (1 to 3.5 on generated pieces).
const STIFFNESS: f64 = 2.0;
/// Real pieces don't keep their shape: however small their residuals are, loops close as if these were this part of a piece
/// scale (0.0055 to 0.0126 on five sets, 3 to 13 times the residuals).
const BENT: f64 = 0.008;
/// Residuals up to so many times the borders' noise don't show that: noise alone leaves up to 1.3 times.
const NOISY: f64 = 2.0;
/// A heap of pieces that all have a candidate standing out has true loops, before anything is seen of them: the natural
/// logarithm of the odds.
const LOOPS: f64 = 3.0;
/// Candidates of each mouth (and tab) that take part in loops: more and chance loops drown the true ones.
const LOOP_RANKS: usize = 6;
/// The same for the loops by which the puzzle is calibrated.
const FIRST_RANKS: usize = 2;

/// Costs (logarithms of residuals) of right candidates, and of the best wrong one beside each: mean and deviation.
#[derive(Debug, Clone, Copy)]
pub(super) struct Model {
    pub(super) right: (f64, f64),
    pub(super) wrong: (f64, f64),
}

impl Model {
    /// From mean and deviation of either. Deviations are kept within what is reasonable: never so narrow that a good
    /// candidate looks bad, never so wide that everything looks alike. Wrong ones cost no less and spread no less than
    /// right ones, so that a greater cost is never better evidence.
    pub(super) fn between(right: (f64, f64), wrong: (f64, f64)) -> Self {
        let right = (right.0.min(wrong.0), right.1.clamp(0.15, 0.5));
        Self { right, wrong: (wrong.0, wrong.1.clamp(0.2, 0.7).max(right.1)) }
    }

    /// Logarithm of how much likelier a cost is for a right candidate than for the best wrong one of a mouth.
    pub(super) fn evidence(&self, cost: f64) -> f64 {
        // Where wrong costs spread more than right ones, those of extreme candidates would look wrong again.
        let [right, wrong] = [self.right, self.wrong].map(|(_, deviation)| deviation * deviation);
        let best = self.right.0 - (self.wrong.0 - self.right.0) * right / (wrong - right).max(f64::MIN_POSITIVE);
        let density = |(mean, deviation): (f64, f64)| {
            let z = (cost.max(best) - mean) / deviation;
            -0.5 * z * z - f64::ln(deviation)
        };
        (density(self.right) - density(self.wrong)).clamp(-STRONG, STRONG)
    }
}

/// Evidence beyond which more doesn't count (natural logarithm of odds).
pub(super) const STRONG: f64 = 12.0;
/// Evidence of one more candidate that agrees on a pose, or of one closed loop: chance agreement is rarer than this.
pub(super) const AGREEMENT: f64 = 4.0;
/// Evidence that a join must have: odds of twenty to one.
pub(super) const ACCEPT: f64 = 3.0;
/// The same while no joint has shown yet how this puzzle's joints fit: what borders of any puzzle would do says less.
pub(super) const UNLEARNT: f64 = 6.0;
/// Evidence that a loop must have, on which all else is built: odds of a hundred to one.
pub(super) const FOUND: f64 = 4.5;
/// Evidence below which a candidate is no mating, whatever supports it.
pub(super) const IMPLAUSIBLE: f64 = -6.0;
/// Most that one candidate counts against the pose that it shares with others.
pub(super) const WORN: f64 = -3.0;

impl Assembler<'_> {
    /// Finds loops among the best candidates to calibrate closure, clearance and residual, then, with what was learnt,
    /// among more. The best come first; what is more likely chance is left out.
    pub(super) fn close_loops(&mut self) -> Vec<loops::Loop> {
        let mut guess = self.first_guess();
        let (mut first, decoys) = self.ways(FIRST_RANKS).close();
        if self.params.recalibrate {
            weigh(&guess, &decoys, &mut first);
            let sure = first.iter().filter(|l| l.evidence >= FOUND);
            let mut supported: Vec<usize> = sure.flat_map(|l| l.edges.iter().copied()).collect();
            supported.sort_unstable();
            supported.dedup();
            self.calibrate(&supported);
            self.best = rank(&mut self.edges, &self.slots);
            self.learn(&supported);
            guess = self.first_guess();
        }
        // The fewer candidates take part, the fewer loops close by chance: those of the best ones say more.
        let (all, more_decoys) = self.ways(LOOP_RANKS).close();
        let among = |l: &loops::Loop| l.edges.iter().all(|k| self.among(*k, FIRST_RANKS));
        let (mut best, others): (Vec<loops::Loop>, Vec<loops::Loop>) = all.into_iter().partition(among);
        weigh(&guess, &decoys, &mut best);
        let mut found = best;
        found.extend(others);
        self.closure = weigh(&guess, &more_decoys, &mut found);
        self.sorted(found)
    }

    /// Whether a candidate is among so many of its mouth and of its tab, and its pieces don't wait.
    fn among(&self, k: usize, ranks: usize) -> bool {
        self.edges[k].mouth_rank < ranks && self.edges[k].tab_rank < ranks && !self.waits(k)
    }

    /// The ways along the best candidates.
    fn ways(&self, ranks: usize) -> loops::Ways<'_> {
        let active: Vec<usize> = (0..self.edges.len()).filter(|k| self.among(*k, ranks)).collect();
        loops::Ways::new((&self.edges, &active), (self.outlines, &self.slots), LOOSE)
    }

    /// How loops should close: by the residuals of the best candidates, as far as these are more than noise by the piece scale,
    /// and by the tolerance of the search.
    fn first_guess(&self) -> Closure {
        let best = self.edges.iter().filter(|e| e.mouth_rank == 0);
        let residual = median(&mut best.clone().map(|e| e.cost.exp()).collect::<Vec<f64>>()).unwrap_or(1.0);
        // The box of the tolerance, in units of what four candidates leave open.
        let open = |e: &Edge| (64.0 * e.covariance.determinant()).max(f64::MIN_POSITIVE).sqrt();
        let open = median(&mut best.map(open).collect::<Vec<f64>>()).unwrap_or(1.0);
        let volume = (LOOSE.position * self.scale).powi(2) * LOOSE.angle;
        // The fewer mouths have a candidate that stands out, the less is there to make loops of, or to tell them by.
        let mouths = self.edges.iter().filter(|e| e.mouth_rank == 0).count();
        let outstanding = (self.outstanding().len() as f64 + 1.0) / (mouths as f64 + 1.0);
        let bent = (1.0 - (NOISY * self.prior.noise / residual).powi(2)).max(0.0).sqrt();
        let narrow = (STIFFNESS * residual).hypot(bent * BENT * self.scale);
        Closure::guess(narrow, (volume / open).cbrt(), LOOPS + outstanding.ln())
    }

    /// Counts what supports what, leaves out loops that are more likely chance, and puts the best first.
    fn sorted(&mut self, found: Vec<loops::Loop>) -> Vec<loops::Loop> {
        let costs = |l: &loops::Loop| -> Vec<f64> {
            l.edges.iter().map(|k| self.model.evidence(self.edges[*k].cost)).collect()
        };
        // One worn joint doesn't refute a loop; several do, however good the others are: those may be right without it.
        let believed = |l: &loops::Loop| {
            let costs = costs(l);
            let worst = costs.iter().copied().fold(f64::INFINITY, f64::min);
            let all: f64 = costs.iter().map(|c| c.min(ACCEPT)).sum();
            l.evidence >= 0.0 && l.evidence + all - worst.min(ACCEPT) + worst.clamp(WORN, ACCEPT) >= FOUND
        };
        let value = |l: &loops::Loop| l.evidence + costs(l).into_iter().map(|c| c.max(WORN)).sum::<f64>();
        let believed = found.into_iter().filter(believed);
        let mut keyed: Vec<(f64, loops::Loop)> = believed.map(|l| (value(&l), l)).collect();
        keyed.sort_by(|p, q| q.0.total_cmp(&p.0).then_with(|| p.1.edges.cmp(&q.1.edges)));
        for (_, l) in &keyed {
            for &k in &l.edges {
                self.edges[k].support += 1;
            }
        }
        keyed.into_iter().map(|(_, l)| l).collect()
    }

    /// Clearance and residual of true matings, from supported ones; costs follow.
    fn calibrate(&mut self, supported: &[usize]) {
        if supported.is_empty() {
            return;
        }
        let mut clearances: Vec<f64> = supported.iter().map(|k| self.joints[*k].fit.clearance).collect();
        let (mean, deviation) = spread_of(&mut clearances);
        // Small sets measure the deviation badly, and clearances may differ from cut to cut.
        self.prior.mean = mean;
        self.prior.deviation = deviation.max(0.002 * self.scale);
        self.calibrated = true;
        let costs: Vec<f64> = self.joints.iter().map(|j| self.cost(j)).collect();
        for (e, cost) in self.edges.iter_mut().zip(costs) {
            e.cost = cost;
        }
    }

    /// What a candidate costs: its residual and, once that is known for this puzzle, how unusual its clearance is.
    pub(super) fn cost(&self, joint: &Joint) -> f64 {
        /// Clearances vary from cut to cut, so one that is three deviations off costs no more than a residual half as large
        /// again.
        const UNUSUAL: f64 = 0.06;
        const MOST: f64 = 9.0;
        let z = (joint.fit.clearance - self.prior.mean) / self.prior.deviation;
        joint.fit.residual.max(1e-4).ln() + if self.calibrated { UNUSUAL * (z * z).min(MOST) } else { 0.0 }
    }

    /// Learns what right and wrong candidates cost: right ones are those `trusted`, wrong ones the best others of their
    /// mouths, and as far as those are few the rest of the mouths.
    pub(super) fn learn(&mut self, trusted: &[usize]) {
        /// So many wrong ones show how they spread.
        const MANY: usize = 30;
        self.learn_from(trusted, MANY.saturating_sub(trusted.len()) as f64);
    }

    /// The same from candidates that stand out. The others of their mouths are far off for that reason alone, so that the
    /// rest of the mouths counts in full.
    pub(super) fn learn_from_outstanding(&mut self) {
        self.learn_from(&self.outstanding(), f64::INFINITY);
    }

    /// Of the rest of the mouths, which count as so many at most, the best candidate is wrong, or the second best if the
    /// first is right; which it is, and in how many mouths, follows from what is learnt (expectation and maximisation).
    fn learn_from(&mut self, trusted: &[usize], most: f64) {
        /// Fewer say too little about the spread.
        const FEW: usize = 4;
        const STEPS: usize = 12;
        let mut right: Vec<f64> = trusted.iter().map(|k| self.edges[*k].cost).collect();
        let mut settled = vec![false; self.slots.count()];
        trusted.iter().for_each(|k| settled[self.edges[*k].slots[1].number] = true);
        let mut wrong: Vec<(f64, f64)> = trusted.iter().filter_map(|k| Some((self.best_other(*k)?, 1.0))).collect();
        let rest: Vec<(f64, Option<f64>)> = (0..self.edges.len())
            .filter(|k| self.edges[*k].mouth_rank == 0 && !settled[self.edges[*k].slots[1].number])
            .map(|k| (self.edges[k].cost, self.best_other(k)))
            .collect();
        if right.len() < FEW || wrong.len() + rest.len() < FEW {
            return;
        }
        let right = spread_of(&mut right);
        let known = wrong.len();
        let weight = (most / rest.len().max(1) as f64).min(1.0);
        let mut share = 0.0;
        let mut likelier = vec![0.0; rest.len()];
        for step in 0..STEPS {
            wrong.truncate(known);
            let mut sum = 0.0;
            for ((best, second), likelier) in rest.iter().zip(&likelier) {
                let odds = share / (1.0 - share) * likelier;
                let is_right = odds / (1.0 + odds);
                sum += is_right;
                if weight > 0.0 {
                    wrong.push((*best, weight * (1.0 - is_right)));
                    wrong.extend(second.map(|second| (second, weight * is_right)));
                }
            }
            // Where the rest doesn't count, nothing changes the model any more.
            if weight > 0.0 || step == 0 {
                self.model = Model::between(right, weighted_spread(&mut wrong.clone()));
                likelier = rest.iter().map(|(best, _)| self.model.evidence(*best).exp()).collect();
            }
            // As if one mouth more had its tab, and one more had not.
            share = (sum + 1.0) / (rest.len() as f64 + 2.0);
        }
        self.present = (share / (1.0 - share)).ln().min(0.0);
        self.learnt = true;
    }

    /// Cost of the best other candidate in the mouth of one.
    fn best_other(&self, k: usize) -> Option<f64> {
        let e = &self.edges[k];
        let cost = self.best[e.slots[1].number][usize::from(e.mouth_rank == 0)];
        cost.is_finite().then_some(cost)
    }

    /// Before anything is trusted: right candidates cost what noise and sampling make them, wrong ones what the second
    /// and third of the mouths do.
    pub(super) fn first_model(&self) -> Model {
        let runners_up = self.edges.iter().filter(|e| (1..=2).contains(&e.mouth_rank));
        match spread_of(&mut runners_up.map(|e| e.cost).collect::<Vec<f64>>()) {
            (_, 0.0) => self.model,
            wrong => Model::between(self.model.right, wrong),
        }
    }

    /// Candidates that are the best of their tab and of their mouth by a wide margin: what to learn from without loops.
    fn outstanding(&self) -> Vec<usize> {
        const WIDE: f64 = 0.7; // half the residual of any rival
        (0..self.edges.len())
            .filter(|&k| {
                let e = &self.edges[k];
                let clear = |slot: Slot| self.best[slot.number][1] > e.cost + WIDE;
                e.mouth_rank == 0 && e.tab_rank == 0 && e.slots.into_iter().all(clear)
            })
            .collect()
    }
}

/// How loops close, beside those of decoys; gives each loop the evidence that follows, unless it has more already.
fn weigh(guess: &Closure, decoys: &loops::Decoys, found: &mut [loops::Loop]) -> Closure {
    let closure = Closure::fit(guess, found, decoys);
    for l in found {
        l.evidence = l.evidence.max(closure.evidence(&l.misclosure));
    }
    closure
}

/// Ranks the candidates of each mouth and tab by cost, and tells for each of these what the best two cost; infinitely much
/// where there are none.
pub(super) fn rank(edges: &mut [Edge], slots: &Slots) -> Vec<[f64; 2]> {
    let mut order: Vec<(f64, usize)> = edges.iter().enumerate().map(|(k, e)| (e.cost, k)).collect();
    order.sort_unstable_by(|p, q| p.0.total_cmp(&q.0).then(p.1.cmp(&q.1)));
    let mut counts = vec![0; slots.count()];
    let mut best = vec![[f64::INFINITY; 2]; slots.count()];
    for (cost, k) in order {
        let ranks = edges[k].slots.map(|s| {
            let rank = counts[s.number];
            counts[s.number] += 1;
            if let Some(place) = best[s.number].get_mut(rank) {
                *place = cost;
            }
            rank
        });
        [edges[k].tab_rank, edges[k].mouth_rank] = ranks;
    }
    best
}

pub(super) fn median(values: &mut [f64]) -> Option<f64> {
    if values.is_empty() {
        return None;
    }
    let middle = values.len() / 2;
    Some(*values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// Median and robust deviation.
pub(super) fn spread_of(values: &mut [f64]) -> (f64, f64) {
    let middle = median(values).unwrap_or(0.0);
    let mut off: Vec<f64> = values.iter().map(|v| (v - middle).abs()).collect();
    (middle, 1.48 * median(&mut off).unwrap_or(0.0))
}

/// The same of values with weights.
fn weighted_spread(values: &mut [(f64, f64)]) -> (f64, f64) {
    let middle = weighted_median(values);
    values.iter_mut().for_each(|v| v.0 = (v.0 - middle).abs());
    (middle, 1.48 * weighted_median(values))
}

/// The value up to which lies half of the weight; 0 where there is none.
fn weighted_median(values: &mut [(f64, f64)]) -> f64 {
    let mut half = 0.5 * values.iter().map(|v| v.1).sum::<f64>();
    let mut rest = values;
    while !rest.is_empty() {
        let (below, at, above) = rest.select_nth_unstable_by(rest.len() / 2, |p, q| p.0.total_cmp(&q.0));
        let weight = below.iter().map(|v| v.1).sum::<f64>();
        if weight > half {
            rest = below;
        } else if weight + at.1 > half {
            return at.0;
        } else {
            half -= weight + at.1;
            rest = above;
        }
    }
    0.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_greater_cost_is_never_better_evidence() {
        for (right, wrong) in [((0.0, 0.4), (1.0, 0.4)), ((0.0, 0.3), (0.8, 0.7)), ((0.0, 0.2), (0.0, 0.2))] {
            let model = Model::between(right, wrong);
            let evidence: Vec<f64> = (-40..40).map(|k| model.evidence(0.1 * f64::from(k))).collect();
            assert!(evidence.is_sorted_by(|p, q| p >= q), "{evidence:?}");
        }
    }

    #[test]
    fn a_better_joint_than_usual_counts_more() {
        let model = Model::between((0.0, 0.4), (1.0, 0.5));
        assert!(model.evidence(-0.4) > model.evidence(0.0));
    }
}
