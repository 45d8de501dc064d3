//! What a storage file is to the reader and the writer of bags, whichever format it has.

use std::collections::BTreeSet;

use super::{BagError, BagWarning, RawMessage, Topic, TopicCount};

/// Largest message, record or chunk believed \[bytes\]. Larger claims are taken for damage: an uncompressed 8k colour
/// frame has 100 MB.
pub const MAX_RECORD_BYTES: usize = 256 * 1024 * 1024;

/// Most bytes of overlapping MCAP chunks held in memory; files that need more are read front to back.
pub const MAX_RESIDENT_BYTES: usize = 512 * 1024 * 1024;

/// Bytes of messages held back to put a file without an index in order of time; recorders write nearly in order.
pub const REORDER_BYTES: usize = 32 * 1024 * 1024;

/// Which messages to read.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Selection {
    /// Topic names; `None` for all topics.
    pub topics: Option<BTreeSet<String>>,
    /// Only messages received at this time or later \[ns since the epoch\].
    pub from_ns: i64,
}

impl Selection {
    /// Every message of the bag.
    #[must_use]
    pub fn all() -> Self {
        Self { topics: None, from_ns: i64::MIN }
    }

    /// Every message on the topics named.
    #[must_use]
    pub fn topics<S: Into<String>>(names: impl IntoIterator<Item = S>) -> Self {
        Self { topics: Some(names.into_iter().map(Into::into).collect()), from_ns: i64::MIN }
    }

    pub(super) fn has_topic(&self, name: &str) -> bool {
        self.topics.as_ref().is_none_or(|names| names.contains(name))
    }
}

/// What a storage file holds.
pub(super) struct FileContents {
    pub(super) topics: Vec<TopicCount>,
    /// Times of the first and the last message \[ns since the epoch\].
    pub(super) span_ns: Option<(i64, i64)>,
    pub(super) warning: Option<BagWarning>,
}

/// Messages of one storage file.
pub(super) type MessageIter = Box<dyn Iterator<Item = Result<RawMessage, BagError>> + Send>;

/// The messages that `step` gives, up to the first error and with it: what comes after one can't be trusted to end.
pub(super) fn up_to_error(
    mut step: impl FnMut() -> Option<Result<RawMessage, BagError>> + Send + 'static,
) -> MessageIter {
    let mut ended = false;
    Box::new(std::iter::from_fn(move || {
        let item = if ended { None } else { step() };
        ended = !matches!(item, Some(Ok(_)));
        item
    }))
}

/// Compression of the chunks of an MCAP file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Compression {
    /// None: for messages that are compressed already, such as PNG.
    None,
    /// zstd, which readers of every language know.
    #[default]
    Zstd,
}

/// What a storage file takes in.
pub(super) trait StorageWriter {
    /// Announces a topic and gives it an id.
    fn add_topic(&mut self, topic: &Topic) -> Result<u16, BagError>;
    /// Appends a message.
    fn write(&mut self, id: u16, log_time_ns: i64, publish_time_ns: i64, cdr: &[u8]) -> Result<(), BagError>;
    /// Makes what was written so far survive the end of the process.
    fn flush(&mut self) -> Result<(), BagError>;
    /// Completes the file.
    fn finish(&mut self, metadata_yaml: &str) -> Result<(), BagError>;
}
