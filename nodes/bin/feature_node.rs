//! `feature_node`: see [`jigsaw_nodes::feature`].

use std::process::ExitCode;

use jigsaw_nodes::feature::{PROGRAM, open};
use jigsaw_nodes::ros::{process, topics};

fn main() -> ExitCode {
    process::main(PROGRAM, |mut session| {
        let pieces = session.subscribe(&topics::PIECE_IMAGE)?;
        let (features, _) = session.publish(&topics::PIECE_FEATURES)?;
        open(session, pieces, features)
    })
}
