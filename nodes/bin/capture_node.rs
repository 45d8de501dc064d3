//! `capture_node`: see [`jigsaw_nodes::capture`].

use std::process::ExitCode;

use jigsaw_nodes::capture::{PROGRAM, open_with_topics};
use jigsaw_nodes::ros::process;

fn main() -> ExitCode {
    process::main(PROGRAM, open_with_topics)
}
