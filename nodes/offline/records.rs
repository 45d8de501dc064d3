//! What stands in the `assembly.json`, `features.json` and `matches.csv` of a run.

use std::path::Path;

use isthmus::Features;
use isthmus::isthmus::Polarity;
use isthmus::mask;
use isthmus::profile::distance_function;
use jigsaw::{Assembly, Candidate, Fate, Piece};
use serde::Serialize;

use super::look::Seen;
use crate::results::{
    AoiRecord, AssemblyFile, MatingRecord, PlacedRecord, PoseRecord, Seconds, SideRecord, WriteError, write_file,
};

/// Samples of an isthmus distance function in `features.json`.
const IDF_SAMPLES: usize = 64;

impl<'a> AssemblyFile<'a> {
    /// The file of an assembly; `known` are source and place of its pieces.
    pub(super) fn new(
        pieces: &'a [Piece],
        known: &'a [(String, mask::Aoi)],
        assembly: &Assembly,
        seconds: Seconds,
    ) -> Self {
        let mut placed: Vec<PlacedRecord<'a>> = assembly
            .placements
            .iter()
            .map(|placement| PlacedRecord {
                id: &pieces[placement.piece].id,
                source: &known[placement.piece].0,
                aoi: known[placement.piece].1.into(),
                puzzle_from_image: PoseRecord {
                    x: placement.puzzle_from_image.translation.x,
                    y: placement.puzzle_from_image.translation.y,
                    theta: placement.puzzle_from_image.rotation.angle(),
                },
                component: placement.component,
                confidence: placement.confidence,
            })
            .collect();
        placed.sort_by_key(|record| (record.component, record.id));
        let side = |piece: usize, isthmus: usize| SideRecord { piece: &pieces[piece].id, isthmus };
        let matings = assembly.matings.iter().map(|mating| MatingRecord {
            positive: side(mating.positive_piece, mating.positive_isthmus),
            negative: side(mating.negative_piece, mating.negative_isthmus),
            correlation: mating.correlation,
            ave_gap_px: mating.ave_gap,
            clearance_px: mating.clearance,
            confidence: mating.confidence,
        });
        let mut unplaced: Vec<&str> = assembly.without_place().map(|piece| pieces[piece].id.as_str()).collect();
        unplaced.sort_unstable();
        Self { pieces: placed, matings: matings.collect(), unplaced, table: assembly.table, seconds }
    }
}

/// One entry of `features.json`.
#[derive(Serialize)]
pub(super) struct FeaturesRecord {
    id: String,
    source: String,
    aoi: AoiRecord,
    border_length_px: f64,
    noise_px: f64,
    isthmuses: Vec<IsthmusRecord>,
}

#[derive(Serialize)]
struct IsthmusRecord {
    polarity: &'static str,
    salient: bool,
    point: [f64; 2],
    critical_points: [[f64; 2]; 2],
    width_px: f64,
    path_length_px: f64,
    persistence_px: f64,
    idf: Vec<f64>,
}

impl FeaturesRecord {
    pub(super) fn new(seen: &Seen) -> Self {
        let Features { border, noise, isthmuses, .. } = &seen.piece.features;
        let isthmuses = isthmuses
            .iter()
            .map(|isthmus| IsthmusRecord {
                polarity: match isthmus.polarity {
                    Polarity::Positive => "positive",
                    Polarity::Negative => "negative",
                },
                salient: isthmus.salient,
                point: [isthmus.point.x, isthmus.point.y],
                critical_points: isthmus.critical_points.map(|p| [p.x, p.y]),
                width_px: isthmus.width,
                path_length_px: isthmus.path_length,
                persistence_px: isthmus.persistence,
                idf: distance_function(border, isthmus, IDF_SAMPLES),
            })
            .collect();
        Self {
            id: seen.piece.id.clone(),
            source: seen.source.clone(),
            aoi: seen.aoi.into(),
            border_length_px: border.length(),
            noise_px: *noise,
            isthmuses,
        }
    }
}

/// One row of `matches.csv`; what was not computed, because a rule dropped the pair before, is empty.
#[derive(Serialize)]
struct MatchRow<'a> {
    positive_piece: &'a str,
    positive_isthmus: usize,
    negative_piece: &'a str,
    negative_isthmus: usize,
    opening_px: f64,
    path_difference_px: f64,
    shape_distance_px: f64,
    correlation: f64,
    pos_gap_px2: Option<f64>,
    neg_gap_px2: Option<f64>,
    ave_gap_px: Option<f64>,
    residual_px: Option<f64>,
    clearance_px: Option<f64>,
    support: usize,
    fate: String,
}

/// Writes `matches.csv`.
pub(super) fn write_csv(path: &Path, pieces: &[Piece], candidates: &[Candidate]) -> Result<(), WriteError> {
    write_file(path, |file| {
        let mut table = csv::Writer::from_writer(file);
        if candidates.is_empty() {
            // The writer takes the header from the first row: without one the file would be empty.
            table.write_record(MATCH_COLUMNS)?;
        }
        for candidate in candidates {
            table.serialize(MatchRow {
                positive_piece: &pieces[candidate.positive_piece].id,
                positive_isthmus: candidate.positive_isthmus,
                negative_piece: &pieces[candidate.negative_piece].id,
                negative_isthmus: candidate.negative_isthmus,
                opening_px: candidate.opening,
                path_difference_px: candidate.path_difference,
                shape_distance_px: candidate.shape_distance,
                correlation: candidate.correlation,
                pos_gap_px2: candidate.posed.map(|p| p.pos_gap),
                neg_gap_px2: candidate.posed.map(|p| p.neg_gap),
                ave_gap_px: candidate.posed.map(|p| p.ave_gap),
                residual_px: candidate.posed.map(|p| p.residual),
                clearance_px: candidate.posed.map(|p| p.clearance),
                support: candidate.support,
                fate: match candidate.fate {
                    Fate::Mated => "mated".into(),
                    Fate::Dropped(rule) => {
                        let name = serde_json::to_value(rule).unwrap_or_default();
                        format!("dropped: {}", name.as_str().unwrap_or("unknown rule"))
                    }
                },
            })?;
        }
        table.flush()
    })
}

/// Columns of `matches.csv`, as [`MatchRow`] names them.
const MATCH_COLUMNS: [&str; 15] = [
    "positive_piece",
    "positive_isthmus",
    "negative_piece",
    "negative_isthmus",
    "opening_px",
    "path_difference_px",
    "shape_distance_px",
    "correlation",
    "pos_gap_px2",
    "neg_gap_px2",
    "ave_gap_px",
    "residual_px",
    "clearance_px",
    "support",
    "fate",
];
