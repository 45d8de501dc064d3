//! Parameters of the capture node.

use std::path::PathBuf;

use crate::ros::params::{Default, Parameters, Rule, Spec};

/// Where the pictures come from.
pub const SOURCE: Spec = Spec {
    name: "source",
    default: Default::Text(""),
    unit: "",
    rule: Rule::Any,
    description: "Folder of pictures to take instead of the topics image and image/compressed; empty for the topics.",
    read_only: true,
};

/// Scale of the pictures.
pub const METRES_PER_PIXEL: Spec = Spec {
    name: "metres_per_pixel",
    default: Default::Double(0.0001),
    unit: "m/px",
    // From a micrometre (a microscope) to ten centimetres (an aerial view): beyond, it is a slip of the pen.
    rule: Rule::Doubles(1e-6, 0.1),
    description: "Scale of the pictures on the table.",
    read_only: false,
};

/// When a piece counts as one that was seen before.
pub const SAME_PLACE_OVERLAP: Spec = Spec {
    name: "same_place_overlap",
    default: Default::Double(0.97),
    unit: "",
    rule: Rule::Doubles(0.5, 1.0),
    description: "A piece whose area coincides with that of a known piece of the same camera by at least this share \
                  (intersection over union) is that piece, seen again; it is not published twice.",
    read_only: false,
};

/// Frames worked on at a time.
pub const THREADS: Spec = Spec {
    name: "threads",
    default: Default::Integer(0),
    unit: "",
    rule: Rule::Integers(0, 64),
    description: "Frames that are worked on at the same time; 0 for as many as there are processors.",
    read_only: true,
};

/// All of them.
pub const PARAMETERS: &[Spec] = &[SOURCE, METRES_PER_PIXEL, SAME_PLACE_OVERLAP, THREADS];

/// The folder that was given, if any.
pub fn source_folder(parameters: &Parameters) -> Option<PathBuf> {
    Some(parameters.text(&SOURCE)).filter(|text| !text.is_empty()).map(PathBuf::from)
}
