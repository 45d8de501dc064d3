//! The isthmus jigsaw cell: camera frames in, piece poses out. The pipeline on one page:
//!
//! ```text
//! image ── capture ── pieces/image ── feature ── pieces/features ── solver ── assembly, /tf_static
//! ```

pub mod bag;
pub mod capture;
pub mod cell;
pub mod cli;
mod console;
pub mod feature;
mod fields;
pub mod offline;
pub mod picture;
mod results;
pub mod ros;
pub mod solver;
pub mod watch;
