//! MCAP storage: reading with and without an index, and writing.
//!
//! A finished file ends in a summary with the index of its chunks: messages then come out ordered by log time with at
//! most the overlapping chunks in memory. A file without one (a recorder that was killed, a copy that was cut) is read
//! from front to back instead, once to see what it holds and once for the messages, which are put in order within a
//! window.

use std::collections::{BTreeMap, BTreeSet, BinaryHeap, HashMap};
use std::fs::File;
use std::io::{BufWriter, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use mcap::records::{ChunkIndex, MessageHeader, Metadata as MetadataRecord};
use mcap::sans_io::indexed_reader::{IndexedReadEvent, IndexedReader, IndexedReaderOptions};
use mcap::sans_io::linear_reader::LinearReaderOptions;
use mcap::sans_io::message_reader::{MessageReadEvent, MessageReader};
use mcap::sans_io::summary_reader::{SummaryReadEvent, SummaryReader, SummaryReaderOptions};
use mcap::{Channel, McapError, Summary};

use super::storage::{
    Compression, FileContents, MAX_RECORD_BYTES, MAX_RESIDENT_BYTES, MessageIter, REORDER_BYTES, Selection,
    StorageWriter, up_to_error,
};
use super::{BagError, BagWarning, RawMessage, Topic, TopicCount, qos};

/// The first bytes of every MCAP file.
pub(super) const MAGIC: &[u8] = mcap::MAGIC;

/// Encoding name of message definitions in `.msg` syntax.
const SCHEMA_ENCODING: &str = "ros2msg";

/// Key of the channel metadata that holds the offered QoS profiles, as rosbag2 writes it.
const QOS_KEY: &str = "offered_qos_profiles";

/// Key of the channel metadata that holds the type hash, as rosbag2 writes it.
const TYPE_HASH_KEY: &str = "topic_type_hash";

/// Chunk size aimed at \[bytes\]: small enough to seek in and to lose little when a recorder is killed, large enough to
/// compress well.
const CHUNK_BYTES: u64 = 1024 * 1024;

/// An MCAP file that was looked through.
pub(super) struct McapFile {
    path: PathBuf,
    access: Access,
}

enum Access {
    /// By the index in the summary.
    Indexed(Box<Summary>),
    /// From front to back; `ordered` tells that the log times never fall.
    Linear { ordered: bool },
}

fn damaged(path: &Path, error: &McapError) -> BagError {
    BagError::Damaged { path: path.to_owned(), reason: error.to_string() }
}

fn io_error(path: &Path, source: std::io::Error) -> BagError {
    BagError::Io { path: path.to_owned(), source }
}

/// Times in MCAP are unsigned, in rosbag2 signed.
fn signed(time_ns: u64) -> i64 {
    i64::try_from(time_ns).unwrap_or(i64::MAX)
}

fn topic_of(channel: &Channel<'_>) -> Topic {
    let text = |key: &str| channel.metadata.get(key).cloned().unwrap_or_default();
    Topic {
        name: channel.topic.clone(),
        type_name: channel.schema.as_ref().map(|s| s.name.clone()).unwrap_or_default(),
        serialization: channel.message_encoding.clone(),
        offered_qos: qos::parse_profiles(&text(QOS_KEY)),
        type_hash: text(TYPE_HASH_KEY),
        definition: channel
            .schema
            .as_ref()
            .filter(|s| s.encoding == SCHEMA_ENCODING)
            .map(|s| String::from_utf8_lossy(&s.data).into_owned())
            .unwrap_or_default(),
    }
}

impl McapFile {
    /// Looks through the file: by its summary, or by reading all of it where it has no usable one.
    pub(super) fn open(path: &Path) -> Result<(Self, FileContents), BagError> {
        if let Some(summary) = read_summary(path)
            && let Some(contents) = contents_of(&summary)
        {
            return Ok((Self { path: path.to_owned(), access: Access::Indexed(Box::new(summary)) }, contents));
        }
        let (contents, ordered) = scan(path)?;
        Ok((Self { path: path.to_owned(), access: Access::Linear { ordered } }, contents))
    }

    /// The messages of the selection, ordered by log time.
    pub(super) fn messages(&self, selection: &Selection) -> Result<MessageIter, BagError> {
        match &self.access {
            Access::Indexed(summary) => indexed_messages(&self.path, summary, selection),
            Access::Linear { ordered } => Ok(Box::new(Linear::open(&self.path, selection, *ordered)?)),
        }
    }
}

/// The summary, or `None` where the file has none or a broken one: then the data section is the only truth.
fn read_summary(path: &Path) -> Option<Summary> {
    let mut file = File::open(path).ok()?;
    let size = file.metadata().ok()?.len();
    let options = SummaryReaderOptions::default().with_file_size(size).with_record_length_limit(MAX_RECORD_BYTES);
    let mut reader = SummaryReader::new_with_options(options);
    while let Some(event) = reader.next_event() {
        match event.ok()? {
            SummaryReadEvent::ReadRequest(need) => {
                let got = file.read(reader.insert(need)).ok()?;
                reader.notify_read(got);
            }
            SummaryReadEvent::SeekRequest(to) => reader.notify_seeked(file.seek(to).ok()?),
        }
    }
    let summary = reader.finish()?;
    let stats = summary.stats.as_ref()?;
    let indexed = summary.chunk_indexes.len() as u64 == u64::from(stats.chunk_count)
        && (stats.message_count == 0 || !summary.chunk_indexes.is_empty())
        && summary.chunk_indexes.iter().all(|chunk| chunk_fits(chunk, size))
        && stats.channel_message_counts.keys().all(|id| summary.channels.contains_key(id))
        && overlap_bytes(&summary.chunk_indexes) <= MAX_RESIDENT_BYTES as u64;
    indexed.then_some(summary)
}

/// Whether the chunk lies inside the file and is not absurdly large.
fn chunk_fits(chunk: &ChunkIndex, file_size: u64) -> bool {
    chunk.uncompressed_size <= MAX_RECORD_BYTES as u64
        && chunk
            .compressed_data_offset()
            .ok()
            .and_then(|offset| offset.checked_add(chunk.compressed_size))
            .is_some_and(|end| end <= file_size)
}

/// The most bytes of chunks whose time spans overlap at any moment: what ordered reading holds in memory.
fn overlap_bytes(chunks: &[ChunkIndex]) -> u64 {
    let mut changes: Vec<(u64, i8, u64)> = chunks
        .iter()
        .flat_map(|c| [(c.message_start_time, 0, c.uncompressed_size), (c.message_end_time, 1, c.uncompressed_size)])
        .collect();
    changes.sort_unstable();
    let (mut resident, mut most) = (0_u64, 0_u64);
    for (_, end, bytes) in changes {
        resident = if end == 1 { resident.saturating_sub(bytes) } else { resident.saturating_add(bytes) };
        most = most.max(resident);
    }
    most
}

fn contents_of(summary: &Summary) -> Option<FileContents> {
    let stats = summary.stats.as_ref()?;
    let channels: BTreeMap<u16, &Arc<Channel<'static>>> = summary.channels.iter().map(|(id, c)| (*id, c)).collect();
    let topics = channels
        .iter()
        .map(|(id, channel)| TopicCount {
            topic: Arc::new(topic_of(channel)),
            messages: stats.channel_message_counts.get(id).copied().unwrap_or(0),
        })
        .collect();
    let span_ns = (stats.message_count > 0).then(|| (signed(stats.message_start_time), signed(stats.message_end_time)));
    Some(FileContents { topics, span_ns, warning: None })
}

/// Reads the whole file to see what it holds. The flag tells whether the log times never fall.
fn scan(path: &Path) -> Result<(FileContents, bool), BagError> {
    let mut source = Source::open(path)?;
    let mut counts: BTreeMap<u16, u64> = BTreeMap::new();
    let (mut first, mut last, mut previous, mut ordered) = (i64::MAX, i64::MIN, i64::MIN, true);
    let mut total = 0;
    let failure = loop {
        match source.next_message() {
            None => break None,
            Some(Err(e)) => break Some(e),
            Some(Ok(message)) => {
                let time = signed(message.log_time);
                ordered &= time >= previous;
                previous = time;
                first = first.min(time);
                last = last.max(time);
                total += 1;
                *counts.entry(message.channel.id).or_default() += 1;
            }
        }
    };
    // Ids are small numbers; the reader has no list of the channels it met.
    let topics: Vec<TopicCount> = (0..=u16::MAX)
        .filter_map(|id| source.reader.get_channel(id))
        .map(|channel| TopicCount {
            topic: Arc::new(topic_of(&channel)),
            messages: counts.get(&channel.id).copied().unwrap_or(0),
        })
        .collect();
    let warning = match failure {
        None => None,
        Some(error) if topics.is_empty() => return Err(error),
        Some(error) => Some(BagWarning::Incomplete {
            path: path.to_owned(),
            reason: match error {
                BagError::Damaged { reason, .. } => reason,
                other => other.to_string(),
            },
            messages: total,
        }),
    };
    Ok((FileContents { topics, span_ns: (total > 0).then_some((first, last)), warning }, ordered))
}

/// Feeds a file to the front-to-back reader.
struct Source {
    path: PathBuf,
    file: File,
    /// Bytes not yet read: nothing longer is asked for, whatever a record claims.
    left: u64,
    reader: MessageReader,
}

impl Source {
    fn open(path: &Path) -> Result<Self, BagError> {
        let file = File::open(path).map_err(|e| io_error(path, e))?;
        let left = file.metadata().map_err(|e| io_error(path, e))?.len();
        let options =
            LinearReaderOptions::default().with_validate_chunk_crcs(true).with_record_length_limit(MAX_RECORD_BYTES);
        Ok(Self { path: path.to_owned(), file, left, reader: MessageReader::new_with_options(options) })
    }

    fn next_message(&mut self) -> Option<Result<mcap::Message<'static>, BagError>> {
        loop {
            match self.reader.next_event()? {
                Err(e) => return Some(Err(damaged(&self.path, &e))),
                Ok(MessageReadEvent::Message(message)) => return Some(Ok(message)),
                Ok(MessageReadEvent::ReadRequest(need)) => {
                    let ask = usize::try_from(self.left).map_or(need, |left| need.min(left));
                    match self.file.read(self.reader.insert(ask)) {
                        Ok(got) => {
                            self.left -= got as u64;
                            self.reader.notify_read(got);
                        }
                        Err(e) => return Some(Err(io_error(&self.path, e))),
                    }
                }
            }
        }
    }
}

/// Messages read front to back and put in order within a window.
struct Linear {
    source: Source,
    selection: Selection,
    topics: HashMap<u16, Option<Arc<Topic>>>,
    window: BinaryHeap<Held>,
    window_bytes: usize,
    /// Most bytes held back for ordering; 0 where the file is in order.
    window_limit: usize,
    read: u64,
    ended: bool,
}

struct Held {
    /// Log time and place in the file, which orders equal times.
    key: (i64, u64),
    message: RawMessage,
}

impl PartialEq for Held {
    fn eq(&self, other: &Self) -> bool {
        self.key == other.key
    }
}
impl Eq for Held {}
impl PartialOrd for Held {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}
impl Ord for Held {
    // Reversed: the heap's greatest is the earliest.
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        other.key.cmp(&self.key)
    }
}

impl Linear {
    fn open(path: &Path, selection: &Selection, ordered: bool) -> Result<Self, BagError> {
        Ok(Self {
            source: Source::open(path)?,
            selection: selection.clone(),
            topics: HashMap::new(),
            window: BinaryHeap::new(),
            window_bytes: 0,
            window_limit: if ordered { 0 } else { REORDER_BYTES },
            read: 0,
            ended: false,
        })
    }

    fn pop(&mut self) -> Option<RawMessage> {
        let held = self.window.pop()?;
        self.window_bytes -= held.message.cdr.len();
        Some(held.message)
    }
}

impl Iterator for Linear {
    type Item = Result<RawMessage, BagError>;

    fn next(&mut self) -> Option<Self::Item> {
        while !self.ended {
            if !self.window.is_empty() && self.window_bytes >= self.window_limit {
                break;
            }
            match self.source.next_message() {
                // How the file ends was told when it was opened.
                None | Some(Err(_)) => self.ended = true,
                Some(Ok(message)) => {
                    self.read += 1;
                    let selection = &self.selection;
                    let topic = self.topics.entry(message.channel.id).or_insert_with(|| {
                        let topic = topic_of(&message.channel);
                        selection.has_topic(&topic.name).then(|| Arc::new(topic))
                    });
                    let log_time_ns = signed(message.log_time);
                    let Some(topic) = topic.clone().filter(|_| log_time_ns >= selection.from_ns) else { continue };
                    let message = RawMessage {
                        topic,
                        log_time_ns,
                        publish_time_ns: signed(message.publish_time),
                        cdr: message.data.into_owned(),
                    };
                    self.window_bytes += message.cdr.len();
                    self.window.push(Held { key: (log_time_ns, self.read), message });
                }
            }
        }
        self.pop().map(Ok)
    }
}

fn indexed_messages(path: &Path, summary: &Summary, selection: &Selection) -> Result<MessageIter, BagError> {
    let topics: HashMap<u16, Arc<Topic>> = summary
        .channels
        .iter()
        .filter(|(_, channel)| selection.has_topic(&channel.topic))
        .map(|(id, channel)| (*id, Arc::new(topic_of(channel))))
        .collect();
    if topics.is_empty() {
        // An empty selection means "all" to the reader.
        return Ok(Box::new(std::iter::empty()));
    }
    let names: BTreeSet<&str> = topics.values().map(|t| t.name.as_str()).collect();
    let options = IndexedReaderOptions::new()
        .starting_at(u64::try_from(selection.from_ns).unwrap_or(0))
        .include_topics(names)
        .with_record_length_limit(MAX_RECORD_BYTES);
    let reader = IndexedReader::new_with_options(summary, options).map_err(|e| damaged(path, &e))?;
    let file = File::open(path).map_err(|e| io_error(path, e))?;
    let mut indexed = Indexed { path: path.to_owned(), file, reader, topics, chunk: Vec::new() };
    Ok(up_to_error(move || indexed.step()))
}

/// Messages by the index.
struct Indexed {
    path: PathBuf,
    file: File,
    reader: IndexedReader,
    topics: HashMap<u16, Arc<Topic>>,
    chunk: Vec<u8>,
}

impl Indexed {
    fn step(&mut self) -> Option<Result<RawMessage, BagError>> {
        loop {
            let (offset, length) = match self.reader.next_event()? {
                Err(e) => return Some(Err(damaged(&self.path, &e))),
                Ok(IndexedReadEvent::Message { header, data }) => {
                    let Some(topic) = self.topics.get(&header.channel_id) else { continue };
                    return Some(Ok(RawMessage {
                        topic: topic.clone(),
                        log_time_ns: signed(header.log_time),
                        publish_time_ns: signed(header.publish_time),
                        cdr: data.to_vec(),
                    }));
                }
                Ok(IndexedReadEvent::ReadChunkRequest { offset, length }) => (offset, length),
            };
            // The index was checked against the size of the file, so `length` is no empty claim.
            self.chunk.resize(length, 0);
            let read = self.file.seek(SeekFrom::Start(offset)).and_then(|_| self.file.read_exact(&mut self.chunk));
            if let Err(e) = read {
                return Some(Err(io_error(&self.path, e)));
            }
            if let Err(e) = self.reader.insert_chunk_record_data(offset, &self.chunk) {
                return Some(Err(damaged(&self.path, &e)));
            }
        }
    }
}

/// Writes an MCAP file of profile `ros2`.
pub(super) struct McapWriter {
    path: PathBuf,
    writer: mcap::Writer<BufWriter<File>>,
    /// Per channel, the number of its next message.
    sequence: Vec<u32>,
}

impl McapWriter {
    pub(super) fn create(path: &Path, compression: Compression) -> Result<Self, BagError> {
        let file = File::create_new(path).map_err(|e| io_error(path, e))?;
        let writer = mcap::WriteOptions::new()
            .profile("ros2")
            .library(concat!("jigsaw_nodes ", env!("CARGO_PKG_VERSION")))
            .chunk_size(Some(CHUNK_BYTES))
            .compression(match compression {
                Compression::None => None,
                Compression::Zstd => Some(mcap::Compression::Zstd),
            })
            .create(BufWriter::new(file))
            .map_err(|e| write_error(path, &e))?;
        Ok(Self { path: path.to_owned(), writer, sequence: Vec::new() })
    }
}

fn write_error(path: &Path, error: &McapError) -> BagError {
    let reason = match error {
        McapError::Io(e) => e.to_string(),
        other => other.to_string(),
    };
    BagError::Write { path: path.to_owned(), reason }
}

impl StorageWriter for McapWriter {
    fn add_topic(&mut self, topic: &Topic) -> Result<u16, BagError> {
        let fail = |e: McapError| write_error(&self.path, &e);
        let schema =
            self.writer.add_schema(&topic.type_name, SCHEMA_ENCODING, topic.definition.as_bytes()).map_err(fail)?;
        let metadata = BTreeMap::from([
            (QOS_KEY.to_owned(), qos::profiles_to_yaml(&topic.offered_qos)),
            (TYPE_HASH_KEY.to_owned(), topic.type_hash.clone()),
        ]);
        let id = self.writer.add_channel(schema, &topic.name, &topic.serialization, &metadata).map_err(fail)?;
        let known = usize::from(id) + 1;
        if self.sequence.len() < known {
            self.sequence.resize(known, 0);
        }
        Ok(id)
    }

    fn write(&mut self, id: u16, log_time_ns: i64, publish_time_ns: i64, cdr: &[u8]) -> Result<(), BagError> {
        let sequence = self.sequence.get_mut(usize::from(id)).map_or(0, |next| {
            *next = next.wrapping_add(1);
            *next
        });
        let unsigned = |time: i64| u64::try_from(time).unwrap_or(0);
        let header = MessageHeader {
            channel_id: id,
            sequence,
            log_time: unsigned(log_time_ns),
            publish_time: unsigned(publish_time_ns),
        };
        self.writer.write_to_known_channel(&header, cdr).map_err(|e| write_error(&self.path, &e))
    }

    fn flush(&mut self) -> Result<(), BagError> {
        self.writer.flush().map_err(|e| write_error(&self.path, &e))
    }

    fn finish(&mut self, metadata_yaml: &str) -> Result<(), BagError> {
        let record = MetadataRecord {
            name: "rosbag2".to_owned(),
            metadata: BTreeMap::from([("serialized_metadata".to_owned(), metadata_yaml.to_owned())]),
        };
        let fail = |e: McapError| write_error(&self.path, &e);
        self.writer.write_metadata(&record).map_err(fail)?;
        self.writer.finish().map_err(fail)?;
        Ok(())
    }
}
