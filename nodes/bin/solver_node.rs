//! `solver_node`: see [`jigsaw_nodes::solver`].

use std::process::ExitCode;

use jigsaw_nodes::ros::{process, topics};
use jigsaw_nodes::solver::{PROGRAM, open};

fn main() -> ExitCode {
    process::main(PROGRAM, |mut session| {
        let features = session.subscribe(&topics::PIECE_FEATURES)?;
        open(session, features)
    })
}
