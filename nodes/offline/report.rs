//! What a run tells: how far it is, what is wrong with a part of its input, and why it can't go on.

use std::io;
use std::path::PathBuf;

use crate::bag::BagError;
use crate::capture::source::PICTURE_ENDINGS;
use crate::results::WriteError;

/// Input or output that can't be used at all.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum OfflineError {
    /// A path that can't be read.
    #[error("{}: {error}", path.display())]
    Read {
        /// The path.
        path: PathBuf,
        /// Why.
        error: io::Error,
    },
    /// A folder without an image.
    #[error("{}: no image in this folder; expected files ending in .{}", path.display(), PICTURE_ENDINGS.join(", ."))]
    EmptyFolder {
        /// The folder.
        path: PathBuf,
    },
    /// Nothing of the input can be used.
    #[error("no usable piece in {images} image{}: {reason}", if *images == 1 { "" } else { "s" })]
    NoPiece {
        /// How many images were looked at.
        images: usize,
        /// Why the first of them couldn't be used.
        reason: String,
    },
    /// A bag that can't be read, or written.
    #[error(transparent)]
    Bag(#[from] BagError),
    /// A bag without pictures.
    #[error("{}: no topic of type sensor_msgs/msg/Image or CompressedImage in this bag", path.display())]
    NoTopic {
        /// The bag.
        path: PathBuf,
    },
    /// A file that can't be written.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// A parameter of the solver out of its range.
    #[error(transparent)]
    Solver(#[from] jigsaw::SolverError),
}

/// What a run tells while it goes on: the caller shows it or not.
pub trait Progress: Sync {
    /// A stage begins: its name and how many steps it takes (0 where that isn't known).
    fn stage(&self, name: &str, steps: usize);
    /// One step is done.
    fn step(&self);
    /// Something is wrong with a part of the input; the run goes on without it.
    fn warning(&self, text: &str);
}
