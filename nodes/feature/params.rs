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

/// Whether there are others to share the work with.
pub const SHARE: Spec = Spec {
    name: "share",
    default: Default::Bool(false),
    unit: "",
    rule: Rule::Any,
    description: "Share the pieces with the other feature nodes that publish on the same topic; where one does not \
                  answer within 1 s, another takes its pieces over. To be set on all of them.",
    read_only: true,
};

/// All of them.
pub const PARAMETERS: &[Spec] = &[THREADS, SHARE];
