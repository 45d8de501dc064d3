//! `solver_node`: see [`jigsaw_nodes::solver`].

use std::process::ExitCode;

use jigsaw_nodes::ros::process;
use jigsaw_nodes::solver::{PROGRAM, open_with_topics};

fn main() -> ExitCode {
    process::main(PROGRAM, open_with_topics)
}
