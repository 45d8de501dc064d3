//! Opening a bag and iterating over its messages, ordered by time over all its files.
//!
//! ```no_run
//! use jigsaw_nodes::bag::{BagReader, Selection};
//! let bag = BagReader::open("bags/puzzle6".as_ref())?;
//! for message in bag.messages(Selection::all())? {
//!     let message = message?;
//!     println!("{} {} bytes at {} ns", message.topic.name, message.cdr.len(), message.log_time_ns);
//! }
//! # Ok::<(), jigsaw_nodes::bag::BagError>(())
//! ```

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use tempfile::NamedTempFile;

use super::metadata::{self, Metadata};
use super::storage::{FileContents, MAX_RECORD_BYTES, MessageIter, Selection};
use super::{BagError, BagWarning, RawMessage, Storage, TopicCount, mcap, sqlite};

/// The first bytes of a zstd frame: a whole storage file or a message compressed by the recorder. No message begins so
/// by itself, since the representations of CDR have small numbers.
const ZSTD_MAGIC: &[u8] = &[0x28, 0xb5, 0x2f, 0xfd];

enum Opened {
    Mcap(mcap::McapFile),
    Sqlite(sqlite::SqliteFile),
}

struct StorageFile {
    opened: Opened,
    span_ns: Option<(i64, i64)>,
    /// Holds the decompressed copy of a file that was compressed as a whole.
    _decompressed: Option<NamedTempFile>,
}

/// An opened bag: a rosbag2 folder or a bare storage file.
pub struct BagReader {
    path: PathBuf,
    storage: Storage,
    files: Vec<StorageFile>,
    topics: Vec<TopicCount>,
    span_ns: Option<(i64, i64)>,
    messages_compressed: bool,
    warnings: Vec<BagWarning>,
}

impl BagReader {
    /// Opens a bag folder, a `.mcap` or a `.db3` file. The format is told by the content, not by the file name.
    ///
    /// # Errors
    /// [`BagError`] where nothing can be read; what is merely incomplete is in [`BagReader::warnings`].
    pub fn open(path: &Path) -> Result<Self, BagError> {
        let kind = std::fs::metadata(path).map_err(|source| BagError::Io { path: path.to_owned(), source })?;
        let mut warnings = Vec::new();
        let mut messages_compressed = false;
        let paths = if kind.is_dir() {
            let metadata_path = path.join(metadata::FILE_NAME);
            let mut names = Vec::new();
            match Metadata::read(&metadata_path) {
                Ok(metadata) => {
                    if let Some(format) = metadata.foreign_compression {
                        let feature = format!("compression '{format}' in place of zstd");
                        return Err(BagError::Unsupported { path: metadata_path, feature });
                    }
                    messages_compressed = metadata.messages_compressed;
                    names = metadata.files;
                }
                Err(reason) => warnings.push(BagWarning::Metadata { path: metadata_path, reason }),
            }
            if names.is_empty() { storage_files(path)? } else { names.iter().map(|name| path.join(name)).collect() }
        } else {
            vec![path.to_owned()]
        };

        let mut bag = Self {
            path: path.to_owned(),
            storage: Storage::Mcap,
            files: Vec::new(),
            topics: Vec::new(),
            span_ns: None,
            messages_compressed,
            warnings,
        };
        let mut failures = Vec::new();
        for file in &paths {
            match open_file(file) {
                Ok((file, storage, contents)) => bag.add(file, storage, contents),
                Err(error) => failures.push(error),
            }
        }
        if bag.files.is_empty() {
            return Err(failures.into_iter().next().unwrap_or(BagError::NoStorage { path: path.to_owned() }));
        }
        bag.warnings.extend(failures.iter().map(|e| BagWarning::FileSkipped { reason: e.to_string() }));
        bag.topics.sort_by(|a, b| (&a.topic.name, &a.topic.type_name).cmp(&(&b.topic.name, &b.topic.type_name)));
        Ok(bag)
    }

    fn add(&mut self, file: StorageFile, storage: Storage, contents: FileContents) {
        self.storage = storage;
        self.warnings.extend(contents.warning);
        if let Some((start, end)) = contents.span_ns {
            self.span_ns = Some(self.span_ns.map_or((start, end), |(s, e)| (s.min(start), e.max(end))));
        }
        for count in contents.topics {
            let same = |known: &&mut TopicCount| {
                known.topic.name == count.topic.name && known.topic.type_name == count.topic.type_name
            };
            match self.topics.iter_mut().find(same) {
                Some(known) => known.messages += count.messages,
                None => self.topics.push(count),
            }
        }
        self.files.push(file);
    }

    /// Where the bag was opened.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Storage format of the files.
    #[must_use]
    pub fn storage(&self) -> Storage {
        self.storage
    }

    /// Number of storage files.
    #[must_use]
    pub fn file_count(&self) -> usize {
        self.files.len()
    }

    /// The topics with their numbers of messages, by name.
    #[must_use]
    pub fn topics(&self) -> &[TopicCount] {
        &self.topics
    }

    /// Number of messages on all topics.
    #[must_use]
    pub fn message_count(&self) -> u64 {
        self.topics.iter().map(|t| t.messages).sum()
    }

    /// Receive times of the first and the last message \[ns since the epoch\]; `None` for a bag without a message.
    #[must_use]
    pub fn span_ns(&self) -> Option<(i64, i64)> {
        self.span_ns
    }

    /// What is wrong with the bag, if anything.
    #[must_use]
    pub fn warnings(&self) -> &[BagWarning] {
        &self.warnings
    }

    /// The selected messages of all files, ordered by receive time.
    ///
    /// # Errors
    /// [`BagError`] where a file that could be opened before cannot be opened again.
    pub fn messages(&self, selection: Selection) -> Result<Messages<'_>, BagError> {
        let cursors = self
            .files
            .iter()
            .filter_map(|file| {
                // A file is opened when its first message is due, so a bag split into many files needs few at a time.
                let (start, end) = file.span_ns?;
                (end >= selection.from_ns).then_some(Cursor { file, start, state: State::Waiting })
            })
            .collect();
        Ok(Messages { cursors, selection, decompress: self.messages_compressed })
    }
}

/// The storage files of a folder, by name with numbers in order: `x_2` before `x_10`.
fn storage_files(folder: &Path) -> Result<Vec<PathBuf>, BagError> {
    let io = |source| BagError::Io { path: folder.to_owned(), source };
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(io)? {
        let path = entry.map_err(io)?.path();
        let name = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        let name = name.strip_suffix(".zstd").unwrap_or(&name);
        if [Storage::Mcap, Storage::Sqlite3].iter().any(|s| name.ends_with(&format!(".{}", s.extension()))) {
            files.push(path);
        }
    }
    if files.is_empty() {
        return Err(BagError::NoStorage { path: folder.to_owned() });
    }
    files.sort_by_key(|path| (path.as_os_str().len(), path.clone()));
    Ok(files)
}

fn open_file(path: &Path) -> Result<(StorageFile, Storage, FileContents), BagError> {
    let start = first_bytes(path)?;
    if !start.starts_with(ZSTD_MAGIC) {
        return open_plain(path, &start, None);
    }
    let (copy, failure) = decompress_file(path)?;
    let start = first_bytes(copy.path())?;
    let plain = copy.path().to_owned();
    let (file, storage, mut contents) = open_plain(&plain, &start, Some(copy))?;
    if let Some(reason) = failure {
        let messages = contents.topics.iter().map(|t| t.messages).sum();
        contents.warning = Some(BagWarning::Incomplete { path: path.to_owned(), reason, messages });
    }
    Ok((file, storage, contents))
}

fn open_plain(
    path: &Path,
    start: &[u8],
    decompressed: Option<NamedTempFile>,
) -> Result<(StorageFile, Storage, FileContents), BagError> {
    let (opened, storage, contents) = if start.starts_with(mcap::MAGIC) {
        let (file, contents) = mcap::McapFile::open(path)?;
        (Opened::Mcap(file), Storage::Mcap, contents)
    } else if start.starts_with(sqlite::MAGIC) {
        let (file, contents) = sqlite::SqliteFile::open(path)?;
        (Opened::Sqlite(file), Storage::Sqlite3, contents)
    } else {
        return Err(BagError::NotABag { path: path.to_owned() });
    };
    Ok((StorageFile { opened, span_ns: contents.span_ns, _decompressed: decompressed }, storage, contents))
}

fn first_bytes(path: &Path) -> Result<Vec<u8>, BagError> {
    let io = |source| BagError::Io { path: path.to_owned(), source };
    let mut start = Vec::new();
    File::open(path).map_err(io)?.take(sqlite::MAGIC.len() as u64).read_to_end(&mut start).map_err(io)?;
    Ok(start)
}

/// Unpacks a file to a temporary one. Where the compressed data ends early, what came before is kept and the text says
/// so.
fn decompress_file(path: &Path) -> Result<(NamedTempFile, Option<String>), BagError> {
    let io = |source| BagError::Io { path: path.to_owned(), source };
    let mut copy = NamedTempFile::new().map_err(io)?;
    let mut decoder = zstd::Decoder::new(File::open(path).map_err(io)?).map_err(io)?;
    let failure = std::io::copy(&mut decoder, &mut copy).err().map(|e| e.to_string());
    Ok((copy, failure))
}

struct Cursor<'a> {
    file: &'a StorageFile,
    start: i64,
    state: State,
}

enum State {
    Waiting,
    Reading {
        next: RawMessage,
        rest: MessageIter,
    },
    /// The file cannot be read on; to be told once.
    Failed(BagError),
    Ended,
}

/// Iterator over the messages of a bag, ordered by time. After an error it goes on with the other files.
pub struct Messages<'a> {
    cursors: Vec<Cursor<'a>>,
    selection: Selection,
    decompress: bool,
}

impl Messages<'_> {
    fn open(&self, file: &StorageFile) -> State {
        let messages = match &file.opened {
            Opened::Mcap(file) => file.messages(&self.selection),
            Opened::Sqlite(file) => file.messages(&self.selection),
        };
        messages.map_or_else(State::Failed, advance)
    }

    /// The cursor whose turn it is: a failed one, else the one with the earliest message.
    fn turn(&self) -> Option<usize> {
        let due = |cursor: &Cursor<'_>| match &cursor.state {
            State::Waiting => Some(cursor.start),
            State::Reading { next, .. } => Some(next.log_time_ns),
            State::Failed(_) => Some(i64::MIN),
            State::Ended => None,
        };
        let turns = self.cursors.iter().enumerate().filter_map(|(i, cursor)| Some((due(cursor)?, i)));
        turns.min().map(|(_, i)| i)
    }
}

/// Takes the next message of a file, if any.
fn advance(mut rest: MessageIter) -> State {
    match rest.next() {
        None => State::Ended,
        Some(Ok(next)) => State::Reading { next, rest },
        Some(Err(error)) => State::Failed(error),
    }
}

impl Iterator for Messages<'_> {
    type Item = Result<RawMessage, BagError>;

    fn next(&mut self) -> Option<Self::Item> {
        loop {
            let index = self.turn()?;
            let state = std::mem::replace(&mut self.cursors[index].state, State::Ended);
            match state {
                State::Waiting => self.cursors[index].state = self.open(self.cursors[index].file),
                State::Reading { next, rest } => {
                    self.cursors[index].state = advance(rest);
                    // A recorder that was killed has left no metadata to say what it did.
                    let compressed = self.decompress || next.cdr.starts_with(ZSTD_MAGIC);
                    return Some(if compressed { decompress_message(next) } else { Ok(next) });
                }
                State::Failed(error) => return Some(Err(error)),
                State::Ended => return None,
            }
        }
    }
}

/// Unpacks a message that was compressed by itself.
fn decompress_message(mut message: RawMessage) -> Result<RawMessage, BagError> {
    match zstd::bulk::decompress(&message.cdr, MAX_RECORD_BYTES) {
        Ok(cdr) => {
            message.cdr = cdr;
            Ok(message)
        }
        Err(e) => Err(BagError::Damaged {
            path: PathBuf::from(&message.topic.name),
            reason: format!("message at {} ns does not decompress: {e}", message.log_time_ns),
        }),
    }
}
