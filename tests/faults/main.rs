//! The real cell under faults, from outside: nodes that are killed, stopped and started again while a bag plays, networks
//! that lose, delay and cut.
//!
//! Each test is brief unless the environment asks for more:
//!
//! | variable | what it does |
//! | --- | --- |
//! | `JIGSAW_FAULTS` | faults of each run (default: a few) |
//! | `JIGSAW_FAULTS_SEED` | seed of their order (default: 1) |
//! | `JIGSAW_BIN_DIR` | folder of the binaries to test (default: those just built) |
//!
//! `JIGSAW_FAULTS=50 cargo test --test faults -- --nocapture kill` prints the table of the operators' page.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod cell;
#[path = "../domain/mod.rs"]
mod domain;
mod kill;
mod network;
