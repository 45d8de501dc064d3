//! The literal rules of Webster, Ross, LaFollette and Stafford 1990 (`policy: paper`).
//!
//! 1. *Opening*: a mouth narrower than the neck is dropped.
//! 2. *Path length*: a pair whose match segments differ by more than half of the longer one is dropped.
//! 3. *Correlation*: Eq. 1 below 0.80 is dropped; the best offset poses the two pieces (see [`crate::correlation`]).
//! 4. *Gap*: POS-GAP (overlap) more than half of GAP = POS-GAP + NEG-GAP (underlap) is dropped.
//! 5. AVE-GAP = GAP / path length ranks the rest, the smallest first.
//!
//! Nothing is refined and no clearance is fitted. All pairs are tried: O(tabs · mouths · samples · offsets). On a
//! puzzle cut without clearance rules 1 and 4 throw away almost half of the true pairs each; that is the paper's
//! method, kept so that its figures can be reproduced.

use crate::correlation::correlate;
use crate::outline::{Outline, Segment};
use crate::placement::{Fit, Joint, rigid_fit};
use crate::{Rule, TableCounts};
use isthmus::Point;
use nalgebra::{Isometry2, Matrix3};
use rayon::prelude::*;

/// Least value of Eq. 1.
const CORRELATION: f64 = 0.80;
/// Greatest difference of path lengths over the longer one.
const LENGTH: f64 = 0.5;
/// Greatest share of the overlap in the gap.
const OVERLAP: f64 = 0.5;
/// Part of the shorter IDF that must take part at an offset.
const TAKING_PART: f64 = 0.75;
/// Greatest offset tried, in samples.
const REACH: i64 = 24;

/// Gaps count at most this, in piece scales.
const FAR: f64 = 0.2;

/// One IDF with its points, at steps of `step` pixels of path.
struct Profile {
    points: Vec<Point>,
    distances: Vec<f64>,
}

impl Profile {
    /// `reverse` walks a mouth's segment backwards, as mating borders run opposite ways.
    fn new(outline: &Outline, segment: &Segment, step: f64, reverse: bool) -> Self {
        let count = (segment.path / step) as usize + 1;
        let mut points: Vec<Point> =
            (0..count).map(|k| outline.at_arc(segment.arc + (k as f64 * step).min(segment.path))).collect();
        if reverse {
            points.reverse();
        }
        let distances = points.iter().map(|p| (p - segment.origin).norm()).collect();
        Self { points, distances }
    }
}

/// Judges pairs by the rules.
pub(crate) struct Judge<'a> {
    outlines: &'a [&'a Outline],
    tabs: Vec<Vec<Profile>>,
    mouths: Vec<Vec<Profile>>,
}

impl<'a> Judge<'a> {
    pub(crate) fn new(outlines: &'a [&'a Outline]) -> Self {
        // A pixel, or the sampling of the borders where that is coarser.
        let step = outlines.iter().map(|o| o.spacing).fold(1.0, f64::max);
        let profiles = |tabs: bool| -> Vec<Vec<Profile>> {
            outlines
                .par_iter()
                .map(|o| {
                    let segments = if tabs { &o.tabs } else { &o.mouths };
                    segments.iter().map(|s| Profile::new(o, s, step, !tabs)).collect()
                })
                .collect()
        };
        Self { outlines, tabs: profiles(true), mouths: profiles(false) }
    }

    /// The pair as a candidate, or the rule that drops it.
    pub(crate) fn pair(&self, (a, tab): (usize, usize), (b, mouth): (usize, usize)) -> Result<Joint, Rule> {
        let (other, segment) = (&self.outlines[a].tabs[tab], &self.outlines[b].mouths[mouth]);
        if segment.width < other.width {
            return Err(Rule::Opening);
        }
        if (segment.path - other.path).abs() > LENGTH * segment.path.max(other.path) {
            return Err(Rule::PathLength);
        }
        let (f, g) = (&self.tabs[a][tab], &self.mouths[b][mouth]);
        let best = correlate(&f.distances, &g.distances, TAKING_PART, REACH);
        if best.value < CORRELATION {
            return Err(Rule::Correlation);
        }
        let from = best.offset.max(0) as usize;
        let to = f.points.len().min((best.offset + g.points.len() as i64).max(0) as usize);
        let shifted = (from as i64 - best.offset).max(0) as usize;
        let pose = rigid_fit(&f.points[from..to], &g.points[shifted..]);
        let (pos_gap, neg_gap) = self.gaps(&f.points, b, &pose, other.path);
        if pos_gap > OVERLAP * (pos_gap + neg_gap) {
            return Err(Rule::Overlap);
        }
        let ave_gap = (pos_gap + neg_gap) / other.path;
        let fit = Fit {
            negative_from_positive: pose,
            clearance: 0.0,
            residual: ave_gap,
            ave_gap,
            pos_gap,
            neg_gap,
            information: Matrix3::identity(),
        };
        Ok(Joint { a, tab, b, mouth, fit })
    }

    /// Areas of overlap and underlap between the points of a neck's segment, posed, and the border of a piece.
    fn gaps(&self, points: &[Point], piece: usize, pose: &Isometry2<f64>, path: f64) -> (f64, f64) {
        let outline = self.outlines[piece];
        let reach = FAR * outline.scale;
        let width = path / points.len() as f64;
        points
            .iter()
            .map(|p| outline.gap(pose * p, reach).map_or(reach, |(gap, _)| gap))
            .fold((0.0, 0.0), |(pos, neg), d| if d < 0.0 { (pos - d * width, neg) } else { (pos, neg + d * width) })
    }
}

/// The pairs that are left, the counts after each rule, and whether all pairs were judged before `late` said to stop.
pub(crate) fn candidates(outlines: &[&Outline], late: &(dyn Fn() -> bool + Sync)) -> (Vec<Joint>, TableCounts, bool) {
    let judge = Judge::new(outlines);
    let found: Vec<(Vec<Joint>, TableCounts, bool)> = (0..outlines.len())
        .into_par_iter()
        .map(|b| {
            let mut counts = TableCounts::default();
            let mut joints = Vec::new();
            if late() {
                return (joints, counts, false);
            }
            for mouth in 0..outlines[b].mouths.len() {
                for a in (0..outlines.len()).filter(|a| *a != b) {
                    for tab in 0..outlines[a].tabs.len() {
                        counts.pairs += 1;
                        let judged = judge.pair((a, tab), (b, mouth));
                        let passed = match &judged {
                            Err(Rule::Opening) => 0,
                            Err(Rule::PathLength) => 1,
                            Err(Rule::Correlation) => 2,
                            Err(_) => 3,
                            Ok(_) => 4,
                        };
                        counts.after_opening += usize::from(passed > 0);
                        counts.after_length += usize::from(passed > 1);
                        counts.after_correlation += usize::from(passed > 2);
                        counts.after_overlap += usize::from(passed > 3);
                        joints.extend(judged);
                    }
                }
            }
            (joints, counts, true)
        })
        .collect();
    let mut table = TableCounts {
        positive: outlines.iter().map(|o| o.tabs.len()).sum(),
        negative: outlines.iter().map(|o| o.mouths.len()).sum(),
        ..TableCounts::default()
    };
    let mut joints = Vec::new();
    let mut whole = true;
    for (some, counts, finished) in found {
        joints.extend(some);
        whole &= finished;
        table.pairs += counts.pairs;
        table.after_opening += counts.after_opening;
        table.after_length += counts.after_length;
        table.after_correlation += counts.after_correlation;
        table.after_overlap += counts.after_overlap;
    }
    (joints, table, whole)
}
