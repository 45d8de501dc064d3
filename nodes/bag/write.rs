//! Writing a bag: a new folder with one storage file, readable at any moment, and `metadata.yaml` at the end.
//!
//! The storage file only ever grows and is flushed in whole chunks (MCAP) or transactions (sqlite3), so a writer that is
//! killed leaves a bag that [`super::BagReader`] opens up to the last flush. `metadata.yaml` is written beside and
//! renamed last: where it stands, the bag is complete.
//!
//! ```
//! use jigsaw_nodes::bag::{BagReader, BagWriter, QosProfile, Selection, Topic, WriterOptions, cdr};
//! let folder = tempfile::tempdir()?;
//! let path = folder.path().join("pair");
//! let mut bag = BagWriter::create(&path, WriterOptions::default())?;
//! let topic = bag.add_topic(Topic::known("/name", "std_msgs/msg/String", vec![QosProfile::reliable(10)]))?;
//! bag.write(topic, 2_000, 1_000, &cdr::encode(&"tab".to_owned())?)?;
//! bag.finish()?;
//! assert_eq!(BagReader::open(&path)?.messages(Selection::all())?.count(), 1);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::metadata::{self, Contents};
use super::storage::{Compression, StorageWriter};
use super::{BagError, Storage, Topic, TopicCount, mcap, sqlite};

/// How to write a bag.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct WriterOptions {
    /// Storage format.
    pub storage: Storage,
    /// Compression of MCAP chunks; sqlite3 has none.
    pub compression: Compression,
}

impl Default for WriterOptions {
    fn default() -> Self {
        Self { storage: Storage::Mcap, compression: Compression::Zstd }
    }
}

/// A topic of a [`BagWriter`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct TopicId(usize);

/// Writes a new bag.
pub struct BagWriter {
    folder: PathBuf,
    file_name: String,
    storage: Storage,
    writer: Box<dyn StorageWriter + Send>,
    topics: Vec<(u16, TopicCount)>,
    span_ns: Option<(i64, i64)>,
}

impl BagWriter {
    /// Starts a bag in the folder `folder`, which must not exist. The storage file is named after the folder.
    ///
    /// # Errors
    /// [`BagError::Exists`], or [`BagError::Io`] where the folder cannot be made.
    pub fn create(folder: &Path, options: WriterOptions) -> Result<Self, BagError> {
        let io = |source| BagError::Io { path: folder.to_owned(), source };
        if let Some(parent) = folder.parent() {
            std::fs::create_dir_all(parent).map_err(io)?;
        }
        std::fs::create_dir(folder).map_err(|source| match source.kind() {
            std::io::ErrorKind::AlreadyExists => BagError::Exists { path: folder.to_owned() },
            _ => io(source),
        })?;
        // A folder such as `.` or `..` has no name of its own, but it exists, so it was refused above.
        let name = folder.file_name().map_or_else(|| "bag".into(), |n| n.to_string_lossy());
        let file_name = format!("{name}_0.{}", options.storage.extension());
        let path = folder.join(&file_name);
        let writer: Box<dyn StorageWriter + Send> = match options.storage {
            Storage::Mcap => Box::new(mcap::McapWriter::create(&path, options.compression)?),
            Storage::Sqlite3 => Box::new(sqlite::SqliteWriter::create(&path)?),
        };
        Ok(Self {
            folder: folder.to_owned(),
            file_name,
            storage: options.storage,
            writer,
            topics: Vec::new(),
            span_ns: None,
        })
    }

    /// Announces a topic; each one once, before its first message.
    ///
    /// # Errors
    /// [`BagError::TopicName`], or [`BagError::Write`].
    pub fn add_topic(&mut self, topic: Topic) -> Result<TopicId, BagError> {
        let good = topic.name.strip_prefix('/').is_some_and(|rest| rest.split('/').all(|part| !part.is_empty()));
        if !good {
            return Err(BagError::TopicName { name: topic.name });
        }
        let id = self.writer.add_topic(&topic)?;
        self.topics.push((id, TopicCount { topic: Arc::new(topic), messages: 0 }));
        Ok(TopicId(self.topics.len() - 1))
    }

    /// Appends a message: its time of receipt and of sending \[ns since the epoch\], and its CDR with header.
    ///
    /// # Errors
    /// [`BagError::Write`], for example when the disk is full.
    pub fn write(
        &mut self,
        topic: TopicId,
        log_time_ns: i64,
        publish_time_ns: i64,
        cdr: &[u8],
    ) -> Result<(), BagError> {
        let Some((id, count)) = self.topics.get_mut(topic.0) else {
            return Err(BagError::Write { path: self.folder.clone(), reason: "topic of another bag".to_owned() });
        };
        self.writer.write(*id, log_time_ns, publish_time_ns, cdr)?;
        count.messages += 1;
        let (start, end) = self.span_ns.unwrap_or((log_time_ns, log_time_ns));
        self.span_ns = Some((start.min(log_time_ns), end.max(log_time_ns)));
        Ok(())
    }

    /// Makes what was written so far survive the end of the process.
    ///
    /// # Errors
    /// [`BagError::Write`].
    pub fn flush(&mut self) -> Result<(), BagError> {
        self.writer.flush()
    }

    /// Number of messages written so far.
    #[must_use]
    pub fn message_count(&self) -> u64 {
        self.topics.iter().map(|(_, count)| count.messages).sum()
    }

    /// Completes the storage file and writes `metadata.yaml`.
    ///
    /// # Errors
    /// [`BagError::Write`] or [`BagError::Io`].
    pub fn finish(mut self) -> Result<(), BagError> {
        let path = self.folder.join(metadata::FILE_NAME);
        let topics: Vec<TopicCount> = self.topics.iter().map(|(_, count)| count.clone()).collect();
        let contents =
            Contents { storage: self.storage, file_name: &self.file_name, topics: &topics, span_ns: self.span_ns };
        let yaml =
            metadata::to_yaml(&contents).map_err(|e| BagError::Write { path: path.clone(), reason: e.to_string() })?;
        self.writer.finish(&yaml)?;
        let beside = self.folder.join(format!("{}.part", metadata::FILE_NAME));
        let io = |source| BagError::Io { path: path.clone(), source };
        std::fs::write(&beside, yaml).map_err(io)?;
        std::fs::rename(&beside, &path).map_err(io)
    }
}
