//! `capture_node`: see [`jigsaw_nodes::capture`].

use std::process::ExitCode;

use jigsaw_nodes::capture::{PROGRAM, open};
use jigsaw_nodes::ros::{process, topics};

fn main() -> ExitCode {
    process::main(PROGRAM, |mut session| {
        let (pieces, _) = session.publish(&topics::PIECE_IMAGE)?;
        open(session, pieces)
    })
}
