//! Parameters of the solver node.

use std::path::PathBuf;

use jigsaw::{Params, Policy};

use crate::ros::params::{Default, Parameters, Rule, Spec};

/// Which rules decide.
pub const POLICY: Spec = Spec {
    name: "policy",
    default: Default::Text("standard"),
    unit: "",
    rule: Rule::OneOf(&["standard", "paper"]),
    description: "Rules of the assembly: standard (refined poses, loop closure), or paper (the literal rules of 1990).",
    read_only: false,
};

/// Limit of one solution.
pub const TIME_BUDGET: Spec = Spec {
    name: "time_budget",
    default: Default::Double(0.0),
    unit: "s",
    rule: Rule::Doubles(0.0, 86_400.0),
    description: "Time that one solution may take; when it is over the best assembly so far is taken; 0 for no limit.",
    read_only: false,
};

/// Least confidence.
pub const MINIMUM_CONFIDENCE: Spec = Spec {
    name: "minimum_confidence",
    default: Default::Double(0.5),
    unit: "",
    rule: Rule::Doubles(0.0, 0.999),
    description: "A piece or mating that is less sure than this is left out of the assembly.",
    read_only: false,
};

/// Size of the shape index.
pub const CANDIDATES: Spec = Spec {
    name: "candidates",
    default: Default::Integer(40),
    unit: "",
    rule: Rule::Integers(1, Params::MAX_CANDIDATES as i64),
    description: "Tabs that are tried for a mouth; more for puzzles with very regular tabs.",
    read_only: false,
};

/// Worker threads.
pub const THREADS: Spec = Spec {
    name: "threads",
    default: Default::Integer(0),
    unit: "",
    rule: Rule::Integers(0, 64),
    description: "Threads for matching; 0 for as many as there are processors.",
    read_only: false,
};

/// Size of the puzzle.
pub const EXPECTED_PIECES: Spec = Spec {
    name: "expected_pieces",
    default: Default::Integer(0),
    unit: "",
    rule: Rule::Integers(0, MOST_PIECES),
    description: "Pieces of the whole puzzle: complete is an assembly of this many; 0 if that is not known, then \
                  complete is an assembly of all pieces seen in which no mouth is open.",
    read_only: false,
};

/// Pieces that are kept.
pub const MAXIMUM_PIECES: Spec = Spec {
    name: "maximum_pieces",
    default: Default::Integer(2000),
    unit: "",
    rule: Rule::Integers(1, MOST_PIECES),
    description: "Further pieces are refused, so that memory stays bounded.",
    read_only: false,
};

/// Wait before solving.
pub const SETTLE_TIME: Spec = Spec {
    name: "settle_time",
    default: Default::Double(0.005),
    unit: "s",
    rule: Rule::Doubles(0.0, 10.0),
    description: "Time without a new piece after which is solved, four times it at most; pieces that come together are solved together.",
    read_only: false,
};

/// Frame of the table.
pub const TABLE_FRAME: Spec = Spec {
    name: "table_frame",
    default: Default::Text("table"),
    unit: "",
    rule: Rule::Texts("a frame name: not empty, without blanks, not beginning with '/'", is_frame_name),
    description: "Frame in which the pieces lie; origin at the centre of the picture, x right, y up, z to the camera.",
    read_only: true,
};

/// Frame of the puzzle.
pub const PUZZLE_FRAME: Spec = Spec {
    name: "puzzle_frame",
    default: Default::Text("puzzle"),
    unit: "",
    rule: Rule::Texts("a frame name: not empty, without blanks, not beginning with '/'", is_frame_name),
    description: "Frame in which the pieces belong; origin at the bottom left corner of the assembly.",
    read_only: true,
};

/// Where pieces are kept.
pub const JOURNAL: Spec = Spec {
    name: "journal",
    default: Default::Text(""),
    unit: "",
    rule: Rule::Any,
    description: "Folder in which the pieces taken in are kept, one file each, so that they outlast this process; a \
                  reset empties it. Without one, what the feature node still holds is taken.",
    read_only: true,
};

/// A hundred times the largest common puzzle; beyond it a number is a slip of the pen.
const MOST_PIECES: i64 = 100_000;

/// All of them.
pub const PARAMETERS: &[Spec] = &[
    POLICY,
    TIME_BUDGET,
    MINIMUM_CONFIDENCE,
    CANDIDATES,
    THREADS,
    EXPECTED_PIECES,
    MAXIMUM_PIECES,
    SETTLE_TIME,
    TABLE_FRAME,
    PUZZLE_FRAME,
    JOURNAL,
];

fn is_frame_name(text: &str) -> bool {
    // tf2 knows no frame of a name that begins so.
    !text.is_empty() && !text.starts_with('/') && !text.chars().any(|c| c.is_whitespace() || c.is_control())
}

/// The solver's own parameters.
pub fn solver_params(parameters: &Parameters) -> Params {
    Params {
        policy: if parameters.text(&POLICY) == "paper" { Policy::Paper } else { Policy::Standard },
        time_budget: parameters.double(&TIME_BUDGET),
        minimum_confidence: parameters.double(&MINIMUM_CONFIDENCE),
        candidates: count(parameters, &CANDIDATES),
        threads: count(parameters, &THREADS),
        ..Params::default()
    }
}

/// The folder of the journal, if there is one.
pub fn journal_folder(parameters: &Parameters) -> Option<PathBuf> {
    Some(parameters.text(&JOURNAL)).filter(|text| !text.is_empty()).map(PathBuf::from)
}

/// The value of a whole number that the table keeps from being negative.
pub(super) fn count(parameters: &Parameters, spec: &Spec) -> usize {
    usize::try_from(parameters.integer(spec)).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_defaults_are_those_of_the_solver() {
        let parameters = Parameters::declare("n", &[PARAMETERS]);
        assert_eq!(solver_params(&parameters), Params::default());
    }

    #[test]
    fn frames_have_names_that_tf2_knows() {
        assert!(["table", "cell_1/table", "tisch_ä"].into_iter().all(is_frame_name));
        assert!(!["", "light table", "/table"].into_iter().any(is_frame_name));
    }

    #[test]
    fn every_value_in_range_is_one_the_solver_takes() {
        for spec in PARAMETERS {
            let extremes = match spec.rule {
                Rule::Doubles(from, to) => {
                    vec![ros2_client::ParameterValue::Double(from), ros2_client::ParameterValue::Double(to)]
                }
                Rule::Integers(from, to) => {
                    vec![ros2_client::ParameterValue::Integer(from), ros2_client::ParameterValue::Integer(to)]
                }
                _ => Vec::new(),
            };
            for value in extremes {
                let parameters = Parameters::declare("n", &[PARAMETERS]);
                parameters.set(spec.name, &value).unwrap();
                assert!(solver_params(&parameters).validate().is_ok(), "{} = {value:?}", spec.name);
            }
        }
    }
}
