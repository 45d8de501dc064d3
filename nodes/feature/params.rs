//! Parameters of the feature node.

use crate::ros::params::{Default, Rule, Spec};

/// Pieces worked on at a time.
pub const THREADS: Spec = Spec {
    name: "threads",
    default: Default::Integer(0),
    unit: "",
    rule: Rule::Integers(0, 64),
    description: "Pieces that are worked on at the same time; 0 for as many as there are processors.",
    read_only: true,
};

/// All of them.
pub const PARAMETERS: &[Spec] = &[THREADS];
