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

use crate::TableCounts;
use crate::correlation::correlate;
use crate::outline::{Outline, Segment};
use crate::placement::{as_posed, rigid_fit};
use crate::search::Joint;
use isthmus::Point;
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

/// The pairs that are left, ranked by AVE-GAP, and the counts after each rule.
pub(crate) fn candidates(outlines: &[&Outline]) -> (Vec<Joint>, TableCounts) {
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
    let (tabs, mouths) = (profiles(true), profiles(false));
    let found: Vec<(Vec<Joint>, TableCounts)> = (0..outlines.len())
        .into_par_iter()
        .map(|b| {
            let mut counts = TableCounts::default();
            let mut joints = Vec::new();
            for (mouth, segment) in outlines[b].mouths.iter().enumerate() {
                for a in (0..outlines.len()).filter(|a| *a != b) {
                    for (tab, other) in outlines[a].tabs.iter().enumerate() {
                        counts.pairs += 1;
                        if segment.width < other.width {
                            continue;
                        }
                        counts.after_opening += 1;
                        if (segment.path - other.path).abs() > LENGTH * segment.path.max(other.path) {
                            continue;
                        }
                        counts.after_length += 1;
                        let (f, g) = (&tabs[a][tab], &mouths[b][mouth]);
                        let best = correlate(&f.distances, &g.distances, TAKING_PART, REACH);
                        if best.value < CORRELATION {
                            continue;
                        }
                        counts.after_correlation += 1;
                        let from = best.offset.max(0) as usize;
                        let to = f.points.len().min((best.offset + g.points.len() as i64).max(0) as usize);
                        let shifted = (from as i64 - best.offset).max(0) as usize;
                        let pose = rigid_fit(&f.points[from..to], &g.points[shifted..]);
                        let Some(fit) = as_posed(other, segment, &pose, outlines[b].scale) else { continue };
                        let gap = fit.pos_gap + fit.neg_gap;
                        if fit.pos_gap > OVERLAP * gap {
                            continue;
                        }
                        counts.after_overlap += 1;
                        let ave_gap = gap / other.path;
                        let fit = crate::placement::Fit { ave_gap, residual: ave_gap, ..fit };
                        joints.push(Joint { a, tab, b, mouth, fit });
                    }
                }
            }
            (joints, counts)
        })
        .collect();
    let mut table = TableCounts {
        positive: outlines.iter().map(|o| o.tabs.len()).sum(),
        negative: outlines.iter().map(|o| o.mouths.len()).sum(),
        ..TableCounts::default()
    };
    let mut joints = Vec::new();
    for (some, counts) in found {
        joints.extend(some);
        table.pairs += counts.pairs;
        table.after_opening += counts.after_opening;
        table.after_length += counts.after_length;
        table.after_correlation += counts.after_correlation;
        table.after_overlap += counts.after_overlap;
    }
    (joints, table)
}
