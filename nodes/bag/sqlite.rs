//! sqlite3 storage: reading schema versions 1 to 4, writing version 4.
//!
//! Messages come out by the index of their times. A file that was cut or damaged is read page by page instead (`pages`); the
//! topics stand in its first pages. The library takes a file that is shorter than its header says for damaged unless it
//! is told to take the schema as it is (`writable_schema`, here on a connection that cannot write).

use std::collections::HashMap;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use rusqlite::config::DbConfig;
use rusqlite::{Connection, ErrorCode, OpenFlags, OptionalExtension, params};

use super::pages::{Pages, Place};
use super::storage::{FileContents, MAX_RECORD_BYTES, MessageIter, Selection, StorageWriter, up_to_error};
use super::{BagError, BagWarning, RawMessage, Topic, TopicCount, qos};

/// The first bytes of every sqlite3 database.
pub(super) const MAGIC: &[u8] = b"SQLite format 3\0";

/// Keys of messages fetched ahead; their contents are fetched one by one, so that memory does not depend on their size.
const PAGE_ROWS: i64 = 4096;

/// Tables of schema version 4, as `rosbag2_storage_sqlite3` lays them out.
const SCHEMA: &str = "
    CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL);
    CREATE TABLE metadata(id INTEGER PRIMARY KEY, metadata_version INTEGER NOT NULL, metadata TEXT NOT NULL);
    CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,
        serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL, type_description_hash TEXT NOT NULL);
    CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT NOT NULL, encoding TEXT NOT NULL,
        encoded_message_definition TEXT NOT NULL, type_description_hash TEXT NOT NULL);
    CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL,
        data BLOB NOT NULL);
    CREATE INDEX timestamp_idx ON messages (timestamp ASC);
    INSERT INTO schema(schema_version, ros_distro) VALUES (4, '');
";

fn damaged(path: &Path, error: &rusqlite::Error) -> BagError {
    BagError::Damaged { path: path.to_owned(), reason: error.to_string() }
}

/// A database that was looked through.
pub(super) struct SqliteFile {
    path: PathBuf,
    topics: HashMap<i64, Arc<Topic>>,
    access: Access,
}

enum Access {
    /// By the index of times.
    Indexed,
    /// By pages: the messages that were found.
    Pages(Vec<Place>),
}

fn connect(path: &Path) -> Result<Connection, BagError> {
    connect_by(path, path.as_os_str(), OpenFlags::empty())
}

/// The file as it is. A recorder that ended within a transaction has left a journal by which the library would take the
/// transaction back, for which it would have to write to the bag.
fn connect_as_is(path: &Path) -> Result<Connection, BagError> {
    let plain = |byte: &u8| byte.is_ascii_alphanumeric() || b"/._-~".contains(byte);
    let bytes = path.as_os_str().as_encoded_bytes();
    let encoded: String = bytes
        .iter()
        .map(|byte| if plain(byte) { char::from(*byte).to_string() } else { format!("%{byte:02x}") })
        .collect();
    connect_by(path, format!("file:{encoded}?immutable=1").as_ref(), OpenFlags::SQLITE_OPEN_URI)
}

fn connect_by(path: &Path, name: &OsStr, how: OpenFlags) -> Result<Connection, BagError> {
    let flags = OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_NO_MUTEX | how;
    let connection = Connection::open_with_flags(name, flags).map_err(|e| damaged(path, &e))?;
    // A damaged page may claim anything; a message longer than this is refused by the library itself.
    let limit = i32::try_from(MAX_RECORD_BYTES).unwrap_or(i32::MAX);
    connection.set_limit(rusqlite::limits::Limit::SQLITE_LIMIT_LENGTH, limit).map_err(|e| damaged(path, &e))?;
    Ok(connection)
}

impl SqliteFile {
    /// Reads topics and counts.
    pub(super) fn open(path: &Path) -> Result<(Self, FileContents), BagError> {
        let connection = connect(path)?;
        match read_topics(&connection).and_then(|topics| Ok((topics, read_counts(&connection)?))) {
            // The library takes what is missing of the last page for zeros.
            Ok(_) if Pages::open(path).is_ok_and(|pages| pages.last_is_cut()) => {
                Self::salvage(path, "the last page is cut".to_owned())
            }
            Ok((topics, counts)) => Ok(Self::with(path, topics, Access::Indexed, &counts, None)),
            Err(error) if error.sqlite_error_code() == Some(ErrorCode::ReadOnly) => {
                Self::salvage(path, "the recorder ended within a transaction".to_owned())
            }
            Err(error) => Self::salvage(path, error.to_string()),
        }
    }

    /// Looks through a file that is not whole.
    fn salvage(path: &Path, reason: String) -> Result<(Self, FileContents), BagError> {
        let connection = connect_as_is(path)?;
        let topics = connection
            .set_db_config(DbConfig::SQLITE_DBCONFIG_WRITABLE_SCHEMA, true)
            .and_then(|_| read_topics(&connection))
            .map_err(|_| BagError::Damaged { path: path.to_owned(), reason: reason.clone() })?;
        let fail = |source| BagError::Io { path: path.to_owned(), source };
        let mut pages = Pages::open(path).map_err(fail)?;
        let mut places = pages.places(|id| topics.iter().any(|(topic, _)| *topic == id));
        places.retain(|place| pages.data(place).is_some());
        let mut counts: HashMap<i64, CountRow> = HashMap::new();
        for &Place { topic_id, time_ns, .. } in &places {
            let row = counts.entry(topic_id).or_insert(CountRow {
                topic_id,
                messages: 0,
                first_ns: time_ns,
                last_ns: time_ns,
            });
            row.messages += 1;
            row.last_ns = time_ns;
        }
        let counts: Vec<CountRow> = counts.into_values().collect();
        Ok(Self::with(path, topics, Access::Pages(places), &counts, Some(reason)))
    }

    fn with(
        path: &Path,
        topics: Vec<(i64, Arc<Topic>)>,
        access: Access,
        counts: &[CountRow],
        reason: Option<String>,
    ) -> (Self, FileContents) {
        let by_id = topics.iter().cloned().collect();
        let messages: u64 = counts.iter().map(|c| c.messages).sum();
        let contents = FileContents {
            topics: topics
                .into_iter()
                .map(|(id, topic)| TopicCount {
                    topic,
                    messages: counts.iter().find(|c| c.topic_id == id).map_or(0, |c| c.messages),
                })
                .collect(),
            span_ns: counts.iter().map(|c| c.first_ns).min().zip(counts.iter().map(|c| c.last_ns).max()),
            warning: reason.map(|reason| BagWarning::Incomplete { path: path.to_owned(), reason, messages }),
        };
        (Self { path: path.to_owned(), topics: by_id, access }, contents)
    }

    /// The messages of the selection, ordered by time.
    pub(super) fn messages(&self, selection: &Selection) -> Result<MessageIter, BagError> {
        let topics = self.topics.iter().filter(|(_, t)| selection.has_topic(&t.name));
        let topics: HashMap<i64, Arc<Topic>> = topics.map(|(id, t)| (*id, t.clone())).collect();
        let from_ns = selection.from_ns;
        if let Access::Pages(places) = &self.access {
            let fail = |source| BagError::Io { path: self.path.clone(), source };
            let mut pages = Pages::open(&self.path).map_err(fail)?;
            let places: Vec<Place> = places.iter().filter(|place| place.time_ns >= from_ns).copied().collect();
            return Ok(Box::new(places.into_iter().filter_map(move |place| {
                let topic = topics.get(&place.topic_id)?;
                pages.data(&place).map(|cdr| Ok(message(topic, place.time_ns, cdr)))
            })));
        }
        let mut rows = Rows {
            path: self.path.clone(),
            connection: connect(&self.path)?,
            topics,
            after: None,
            from_ns,
            page: Vec::new().into_iter(),
        };
        Ok(up_to_error(move || rows.step()))
    }
}

/// A message as the storage keeps it: with one time.
fn message(topic: &Arc<Topic>, time_ns: i64, cdr: Vec<u8>) -> RawMessage {
    RawMessage { topic: topic.clone(), log_time_ns: time_ns, publish_time_ns: time_ns, cdr }
}

struct CountRow {
    topic_id: i64,
    messages: u64,
    first_ns: i64,
    last_ns: i64,
}

fn has_column(connection: &Connection, table: &str, column: &str) -> rusqlite::Result<bool> {
    connection
        .query_row("SELECT 1 FROM pragma_table_info(?1) WHERE name = ?2", params![table, column], |_| Ok(()))
        .optional()
        .map(|found| found.is_some())
}

fn read_topics(connection: &Connection) -> rusqlite::Result<Vec<(i64, Arc<Topic>)>> {
    // Columns came with the schema versions; asking for them is simpler and more tolerant than the version number.
    let column = |table: &str, name: &str, otherwise: &str| -> rusqlite::Result<String> {
        Ok(if has_column(connection, table, name)? { name.to_owned() } else { otherwise.to_owned() })
    };
    let sql = format!(
        "SELECT id, name, type, serialization_format, {}, {} FROM topics ORDER BY id",
        column("topics", "offered_qos_profiles", "''")?,
        column("topics", "type_description_hash", "''")?,
    );
    let mut definitions: HashMap<String, String> = HashMap::new();
    if has_column(connection, "message_definitions", "encoded_message_definition")? {
        let mut statement = connection.prepare(
            "SELECT topic_type, encoded_message_definition FROM message_definitions WHERE encoding = 'ros2msg'",
        )?;
        let rows = statement.query_map([], |row| Ok((row.get(0)?, row.get(1)?)))?;
        for row in rows {
            let (type_name, definition) = row?;
            definitions.insert(type_name, definition);
        }
    }
    let mut statement = connection.prepare(&sql)?;
    let rows = statement.query_map([], |row| {
        let type_name: String = row.get(2)?;
        let topic = Topic {
            name: row.get(1)?,
            definition: definitions.get(&type_name).cloned().unwrap_or_default(),
            type_name,
            serialization: row.get(3)?,
            offered_qos: qos::parse_profiles(&row.get::<_, String>(4)?),
            type_hash: row.get(5)?,
        };
        Ok((row.get(0)?, Arc::new(topic)))
    })?;
    rows.collect()
}

fn read_counts(connection: &Connection) -> rusqlite::Result<Vec<CountRow>> {
    let mut statement = connection
        .prepare("SELECT topic_id, COUNT(*), MIN(timestamp), MAX(timestamp) FROM messages GROUP BY topic_id")?;
    let rows = statement.query_map([], |row| {
        Ok(CountRow {
            topic_id: row.get(0)?,
            messages: u64::try_from(row.get::<_, i64>(1)?).unwrap_or(0),
            first_ns: row.get(2)?,
            last_ns: row.get(3)?,
        })
    })?;
    rows.collect()
}

/// Where a message lies: the page holds only these.
#[derive(Clone, Copy)]
struct Key {
    time_ns: i64,
    id: i64,
    topic_id: i64,
}

struct Rows {
    path: PathBuf,
    connection: Connection,
    topics: HashMap<i64, Arc<Topic>>,
    after: Option<Key>,
    from_ns: i64,
    page: std::vec::IntoIter<Key>,
}

impl Rows {
    fn next_page(&self) -> Result<Vec<Key>, BagError> {
        let fail = |e: rusqlite::Error| damaged(&self.path, &e);
        let (time, id) = self.after.map_or((self.from_ns, i64::MIN), |key| (key.time_ns, key.id));
        let sql = "SELECT timestamp, id, topic_id FROM messages WHERE timestamp >= ?1 AND (timestamp > ?1 OR id > ?2) \
                   ORDER BY timestamp, id LIMIT ?3";
        let mut statement = self.connection.prepare_cached(sql).map_err(fail)?;
        let key = |row: &rusqlite::Row<'_>| Ok(Key { time_ns: row.get(0)?, id: row.get(1)?, topic_id: row.get(2)? });
        let rows = statement.query_map(params![time, id, PAGE_ROWS], key).map_err(fail)?;
        let page: Vec<Key> = rows.collect::<Result<_, _>>().map_err(fail)?;
        // A damaged index could lead back to where one was, for ever.
        if page.is_sorted_by_key(|key| (key.time_ns, key.id)) {
            return Ok(page);
        }
        let reason = "the index of times is out of order".to_owned();
        Err(BagError::Damaged { path: self.path.clone(), reason })
    }

    fn data(&self, id: i64) -> rusqlite::Result<Vec<u8>> {
        let mut statement = self.connection.prepare_cached("SELECT data FROM messages WHERE id = ?1")?;
        statement.query_row([id], |row| row.get(0))
    }

    fn step(&mut self) -> Option<Result<RawMessage, BagError>> {
        loop {
            let Some(key) = self.page.next() else {
                match self.next_page() {
                    Err(e) => return Some(Err(e)),
                    Ok(page) if page.is_empty() => return None,
                    Ok(page) => {
                        self.after = page.last().copied();
                        self.page = page.into_iter();
                        continue;
                    }
                }
            };
            let Some(topic) = self.topics.get(&key.topic_id) else { continue };
            let data = self.data(key.id).map_err(|e| damaged(&self.path, &e));
            return Some(data.map(|cdr| message(topic, key.time_ns, cdr)));
        }
    }
}

/// Writes an sqlite3 bag file. What is flushed survives when the process is killed.
pub(super) struct SqliteWriter {
    path: PathBuf,
    connection: Connection,
    topics: u16,
}

impl SqliteWriter {
    pub(super) fn create(path: &Path) -> Result<Self, BagError> {
        // Claims the name, so that nobody else's file is appended to.
        std::fs::File::create_new(path).map_err(|source| BagError::Io { path: path.to_owned(), source })?;
        let create = || -> rusqlite::Result<Connection> {
            let connection = Connection::open(path)?;
            connection.execute_batch(SCHEMA)?;
            connection.execute_batch("BEGIN")?;
            Ok(connection)
        };
        let connection = create().map_err(|e| write_error(path, &e))?;
        Ok(Self { path: path.to_owned(), connection, topics: 0 })
    }
}

fn write_error(path: &Path, error: &rusqlite::Error) -> BagError {
    BagError::Write { path: path.to_owned(), reason: error.to_string() }
}

impl StorageWriter for SqliteWriter {
    fn add_topic(&mut self, topic: &Topic) -> Result<u16, BagError> {
        let full = || BagError::Write { path: self.path.clone(), reason: "more than 65535 topics".to_owned() };
        let id = self.topics.checked_add(1).ok_or_else(full)?;
        let insert = || -> rusqlite::Result<()> {
            self.connection.execute(
                "INSERT INTO topics VALUES(?1, ?2, ?3, ?4, ?5, ?6)",
                params![
                    id,
                    topic.name,
                    topic.type_name,
                    topic.serialization,
                    qos::profiles_to_yaml(&topic.offered_qos),
                    topic.type_hash
                ],
            )?;
            self.connection.execute(
                "INSERT INTO message_definitions \
                 (topic_type, encoding, encoded_message_definition, type_description_hash) \
                 SELECT ?1, 'ros2msg', ?2, ?3 \
                 WHERE NOT EXISTS (SELECT 1 FROM message_definitions WHERE topic_type = ?1)",
                params![topic.type_name, topic.definition, topic.type_hash],
            )?;
            Ok(())
        };
        insert().map_err(|e| write_error(&self.path, &e))?;
        self.topics = id;
        Ok(id)
    }

    fn write(&mut self, id: u16, log_time_ns: i64, _publish_time_ns: i64, cdr: &[u8]) -> Result<(), BagError> {
        self.connection
            .prepare_cached("INSERT INTO messages (topic_id, timestamp, data) VALUES(?1, ?2, ?3)")
            .and_then(|mut statement| statement.execute(params![id, log_time_ns, cdr]))
            .map(|_| ())
            .map_err(|e| write_error(&self.path, &e))
    }

    fn flush(&mut self) -> Result<(), BagError> {
        self.connection.execute_batch("COMMIT; BEGIN").map_err(|e| write_error(&self.path, &e))
    }

    fn finish(&mut self, metadata_yaml: &str) -> Result<(), BagError> {
        self.connection
            .execute("INSERT INTO metadata(metadata_version, metadata) VALUES(9, ?1)", [metadata_yaml])
            .and_then(|_| self.connection.execute_batch("COMMIT"))
            .map_err(|e| write_error(&self.path, &e))
    }
}
