//! Messages of an sqlite3 file that is not whole, page by page.
//!
//! The tree of a table is no use where the file was cut: its inner pages lie anywhere, also behind the cut. The pages that
//! hold the rows say what they are by themselves, and so does a row of the table of messages, by its columns. So all pages
//! are looked at, once and in order. `O(n)` in the bytes of the file; 40 bytes of memory a message.
//!
//! The layout is that of the [file format](https://www.sqlite.org/fileformat2.html), sections 1.3 (header), 1.6 (pages) and
//! 2.1 (records).

use std::collections::{HashMap, HashSet};
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;

use super::storage::{MAX_RECORD_BYTES, MAX_RESIDENT_BYTES};

/// Where the header says how long pages are, and how many bytes at the end of each are not used.
const HEADER_BYTES: usize = 100;
const PAGE_SIZE: std::ops::Range<usize> = 16..18;
const RESERVED: usize = 20;

/// Sizes that pages may have.
const PAGE_SIZES: std::ops::RangeInclusive<usize> = 512..=65536;

/// Kind of a page that holds rows, where it says how many, and where the list of their places begins.
const LEAF: u8 = 0x0d;
const CELLS: std::ops::Range<usize> = 3..5;
const CELL_LIST: usize = 8;

/// Bytes of a page's number.
const NUMBER: usize = 4;

/// Serial types of a column: nothing (the id stands in the key), and from where on contents of so many bytes, even ones.
const NOTHING: u64 = 0;
const FIRST_BLOB: u64 = 12;

/// Most messages that are remembered.
const MOST: usize = MAX_RESIDENT_BYTES / size_of::<Place>();

/// Where a message lies.
#[derive(Debug, Clone, Copy)]
pub(super) struct Place {
    /// When it was received \[ns since the epoch\].
    pub(super) time_ns: i64,
    /// Its number, in the order of writing.
    pub(super) id: i64,
    /// Its topic.
    pub(super) topic_id: i64,
    page: u32,
    cell: u16,
}

/// A file, read by pages. The last one counts only if all of it is there.
pub(super) struct Pages {
    file: File,
    size: usize,
    usable: usize,
    count: u32,
    last_is_cut: bool,
}

/// A row as its page holds it.
struct Row<'a> {
    id: i64,
    topic_id: i64,
    time_ns: i64,
    /// Bytes of the message, those that stand here, and the page with the next ones.
    length: usize,
    here: &'a [u8],
    next: u32,
}

impl Pages {
    /// Opens a file that begins as an sqlite3 database does.
    pub(super) fn open(path: &Path) -> std::io::Result<Self> {
        let mut file = File::open(path)?;
        let mut header = [0; HEADER_BYTES];
        file.read_exact(&mut header)?;
        // 1 stands for the size that two bytes can't hold.
        let size = match big_endian(&header[PAGE_SIZE]) {
            1 => *PAGE_SIZES.end(),
            size => size as usize,
        };
        let usable = size.saturating_sub(usize::from(header[RESERVED]));
        if !PAGE_SIZES.contains(&size) || !size.is_power_of_two() || usable < *PAGE_SIZES.start() - 32 {
            return Err(std::io::Error::new(std::io::ErrorKind::InvalidData, "no size of pages"));
        }
        let length = file.metadata()?.len();
        let count = u32::try_from(length / size as u64).unwrap_or(u32::MAX);
        Ok(Self { file, size, usable, count, last_is_cut: !length.is_multiple_of(size as u64) })
    }

    /// Whether the file ends within a page.
    pub(super) fn last_is_cut(&self) -> bool {
        self.last_is_cut
    }

    /// The messages on these topics, ordered by time, and by number where equal.
    pub(super) fn places(&mut self, is_topic: impl Fn(i64) -> bool) -> Vec<Place> {
        let mut places: HashMap<i64, Place> = HashMap::new();
        for page in 1..=self.count {
            let Some(bytes) = self.page(page) else { break };
            let cells = if bytes[0] == LEAF { big_endian(&bytes[CELLS]) as u16 } else { 0 };
            for cell in 0..cells {
                let Some(row) = row(&bytes, self.usable, cell) else { continue };
                let Row { id, topic_id, time_ns, .. } = row;
                // A row that has moved may stand twice.
                if is_topic(topic_id) && places.len() < MOST {
                    places.entry(id).or_insert(Place { time_ns, id, topic_id, page, cell });
                }
            }
        }
        let mut places: Vec<Place> = places.into_values().collect();
        places.sort_unstable_by_key(|place| (place.time_ns, place.id));
        places
    }

    /// The bytes of a message; `None` if some lie behind the cut.
    pub(super) fn data(&mut self, place: &Place) -> Option<Vec<u8>> {
        let bytes = self.page(place.page)?;
        let row = row(&bytes, self.usable, place.cell)?;
        let (mut data, length, mut next) = (row.here.to_vec(), row.length, row.next);
        let mut seen = HashSet::new();
        while data.len() < length {
            if next == 0 || !seen.insert(next) {
                return None;
            }
            let bytes = self.page(next)?;
            next = big_endian(&bytes[..NUMBER]) as u32;
            let rest = &bytes[NUMBER..self.usable];
            data.extend(&rest[..rest.len().min(length - data.len())]);
        }
        Some(data)
    }

    /// The first page has the number 1.
    fn page(&mut self, number: u32) -> Option<Vec<u8>> {
        if number == 0 || number > self.count {
            return None;
        }
        let mut bytes = vec![0; self.size];
        self.file.seek(SeekFrom::Start(u64::from(number - 1) * self.size as u64)).ok()?;
        self.file.read_exact(&mut bytes).ok()?;
        Some(bytes)
    }
}

/// A row, if it can be one of the table of messages.
fn row(page: &[u8], usable: usize, cell: u16) -> Option<Row<'_>> {
    let at = CELL_LIST + 2 * usize::from(cell);
    let start = big_endian(page.get(at..at + 2)?) as usize;
    let mut rest = page.get(start..usable)?;
    let payload = usize::try_from(varint(&mut rest)?).ok()?;
    let id = varint(&mut rest)? as i64;
    if payload > MAX_RECORD_BYTES {
        return None;
    }
    // How much of a long row stands here (1.6): at least the one, at most the other.
    let (least, most) = ((usable - 12) * 32 / 255 - 23, usable - 35);
    let local = match least + payload.saturating_sub(least) % (usable - NUMBER) {
        _ if payload <= most => payload,
        local if local <= most => local,
        _ => least,
    };
    let next = if local < payload { big_endian(rest.get(local..local + NUMBER)?) as u32 } else { 0 };
    let record = rest.get(..local)?;

    let mut head = record;
    let head_length = usize::try_from(varint(&mut head)?).ok()?;
    let mut head = record.get(record.len() - head.len()..head_length)?;
    let kinds = [varint(&mut head)?, varint(&mut head)?, varint(&mut head)?, varint(&mut head)?];
    let [NOTHING, topic, time, blob] = kinds else { return None };
    if !head.is_empty() || blob < FIRST_BLOB || blob % 2 != 0 {
        return None;
    }
    let mut body = record.get(head_length..)?;
    let (topic_id, time_ns) = (integer(&mut body, topic)?, integer(&mut body, time)?);
    let length = usize::try_from((blob - FIRST_BLOB) / 2).ok()?;
    // The message is what is left of the row.
    (payload.checked_sub(local)?.checked_add(body.len())? == length).then_some(Row {
        id,
        topic_id,
        time_ns,
        length,
        here: body,
        next,
    })
}

/// A number of up to eight bytes.
fn big_endian(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0, |number, &byte| number << 8 | u64::from(byte))
}

/// A number of one to nine bytes, of which the first eight say whether another one follows.
fn varint(bytes: &mut &[u8]) -> Option<u64> {
    let mut number = 0;
    for k in 0..9 {
        let (&byte, rest) = bytes.split_first()?;
        *bytes = rest;
        if k == 8 {
            return Some(number << 8 | u64::from(byte));
        }
        number = number << 7 | u64::from(byte & 0x7f);
        if byte < 0x80 {
            break;
        }
    }
    Some(number)
}

/// An integer column of this serial type.
fn integer(bytes: &mut &[u8], kind: u64) -> Option<i64> {
    let length = match kind {
        1..=4 => kind as usize,
        5 => 6,
        6 => 8,
        // The numbers 0 and 1 need no bytes.
        8 | 9 => return Some(kind as i64 - 8),
        _ => return None,
    };
    let (number, rest) = bytes.split_at_checked(length)?;
    *bytes = rest;
    let unused = 64 - 8 * length as u32;
    Some(((big_endian(number) << unused) as i64) >> unused)
}
