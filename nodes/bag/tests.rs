//! Bags written, read back, cut and corrupted.

use std::path::Path;

use super::*;

/// Messages of the test bags: two topics, times that overlap the chunks.
const MESSAGES: usize = 200;

/// Seed of the corruption tests.
const SEED: u64 = 0x6a69_6773_6177;

/// A xorshift generator: the tests need noise, not quality.
struct Noise(u64);

impl Noise {
    fn next(&mut self) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0
    }

    fn below(&mut self, n: usize) -> usize {
        usize::try_from(self.next() % n as u64).unwrap()
    }
}

/// A message's bytes: header, and content of varying length that does not compress to nothing.
fn content(i: usize) -> Vec<u8> {
    let mut noise = Noise(SEED + i as u64);
    let mut cdr = cdr::LITTLE_ENDIAN_HEADER.to_vec();
    cdr.extend((0..(i * 37) % 9000).map(|_| noise.next() as u8));
    cdr
}

/// Every seventh message is received out of order.
fn log_time(i: usize) -> i64 {
    1_000_000_000 + 1_000_000 * i as i64 - if i.is_multiple_of(7) { 2_500_000 } else { 0 }
}

fn write_bag(folder: &Path, options: WriterOptions) {
    let mut bag = BagWriter::create(folder, options).unwrap();
    let camera = bag
        .add_topic(Topic::known("/camera", "sensor_msgs/msg/CompressedImage", vec![QosProfile::best_effort(5)]))
        .unwrap();
    let tf = bag.add_topic(Topic::known("/tf_static", "tf2_msgs/msg/TFMessage", vec![QosProfile::latched(1)])).unwrap();
    for i in 0..MESSAGES {
        let topic = if i.is_multiple_of(3) { tf } else { camera };
        bag.write(topic, log_time(i), log_time(i) - 1000, &content(i)).unwrap();
    }
    bag.finish().unwrap();
}

fn all_options() -> [WriterOptions; 3] {
    let mcap = |compression| WriterOptions { storage: Storage::Mcap, compression };
    [
        mcap(Compression::Zstd),
        mcap(Compression::None),
        WriterOptions { storage: Storage::Sqlite3, compression: Compression::None },
    ]
}

fn storage_file(folder: &Path) -> PathBuf {
    let files = std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().path());
    files.into_iter().find(|p| p.extension().is_some_and(|e| e == "mcap" || e == "db3")).unwrap()
}

/// The messages as they must come out: by log time, in order of writing where equal.
fn expected() -> Vec<(i64, String, Vec<u8>)> {
    let mut list: Vec<_> = (0..MESSAGES)
        .map(|i| {
            let topic = if i.is_multiple_of(3) { "/tf_static" } else { "/camera" };
            (log_time(i), topic.to_owned(), content(i))
        })
        .collect();
    list.sort_by_key(|(time, ..)| *time);
    list
}

fn contents(bag: &BagReader, selection: Selection) -> Vec<(i64, String, Vec<u8>)> {
    bag.messages(selection)
        .unwrap()
        .map(|m| {
            let m = m.unwrap();
            (m.log_time_ns, m.topic.name.clone(), m.cdr)
        })
        .collect()
}

#[test]
fn what_is_written_comes_back_in_order_of_time() {
    for options in all_options() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("bag");
        write_bag(&path, options);
        // By the folder, and by the storage file alone.
        for path in [path.clone(), storage_file(&path)] {
            let bag = BagReader::open(&path).unwrap();
            assert_eq!(bag.warnings(), [], "{options:?}");
            assert_eq!(bag.storage(), options.storage);
            assert_eq!(contents(&bag, Selection::all()), expected(), "{options:?}");
            assert_eq!(bag.message_count(), MESSAGES as u64);
            let times = expected();
            assert_eq!(bag.span_ns(), Some((times[0].0, times[MESSAGES - 1].0)));
            let tf = &bag.topics()[1];
            assert_eq!((tf.topic.name.as_str(), tf.messages), ("/tf_static", 67));
            assert_eq!(*tf.topic, Topic::known("/tf_static", "tf2_msgs/msg/TFMessage", vec![QosProfile::latched(1)]));
            assert!(tf.topic.definition.contains("MSG: geometry_msgs/Transform"));
            assert!(tf.topic.type_hash.starts_with("RIHS01_"));
        }
    }
}

#[test]
fn a_selection_by_topic_and_time() {
    for options in all_options() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("bag");
        write_bag(&path, options);
        let bag = BagReader::open(&path).unwrap();
        let from_ns = log_time(100);
        let selection = Selection { from_ns, ..Selection::topics(["/camera"]) };
        let wanted: Vec<_> =
            expected().into_iter().filter(|(time, topic, _)| topic == "/camera" && *time >= from_ns).collect();
        assert_eq!(contents(&bag, selection), wanted, "{options:?}");
        assert_eq!(contents(&bag, Selection::topics(["/nothing"])), []);
        assert_eq!(contents(&bag, Selection { from_ns: i64::MAX, ..Selection::all() }), []);
    }
}

#[test]
fn a_folder_without_metadata_and_one_split_into_files() {
    let folder = tempfile::tempdir().unwrap();
    let whole = folder.path().join("whole");
    write_bag(&whole, WriterOptions::default());
    let split = folder.path().join("split");
    std::fs::create_dir(&split).unwrap();
    // Two files whose times overlap; no metadata.
    std::fs::copy(storage_file(&whole), split.join("split_0.mcap")).unwrap();
    let other = folder.path().join("other");
    let mut writer = BagWriter::create(&other, WriterOptions::default()).unwrap();
    let topic = writer.add_topic(Topic::known("/camera", "sensor_msgs/msg/CompressedImage", vec![])).unwrap();
    writer.write(topic, log_time(50) + 1, 0, &content(1)).unwrap();
    writer.finish().unwrap();
    std::fs::copy(storage_file(&other), split.join("split_1.mcap")).unwrap();
    std::fs::write(split.join("split_2.mcap"), b"no bag").unwrap();

    let bag = BagReader::open(&split).unwrap();
    assert_eq!(bag.file_count(), 2);
    assert!(matches!(bag.warnings(), [BagWarning::Metadata { .. }, BagWarning::FileSkipped { .. }]));
    let all = contents(&bag, Selection::all());
    assert_eq!(all.len(), MESSAGES + 1);
    assert!(all.is_sorted_by_key(|(time, ..)| *time));
    assert_eq!(bag.topics()[0].messages, 133 + 1);
}

#[test]
fn compressed_files_and_messages() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bag");
    write_bag(&path, WriterOptions { storage: Storage::Sqlite3, compression: Compression::None });
    // The whole file, as `compression_mode: file` leaves it.
    let file = storage_file(&path);
    let packed = path.join("bag_0.db3.zstd");
    std::fs::write(&packed, zstd::encode_all(std::fs::File::open(&file).unwrap(), 1).unwrap()).unwrap();
    std::fs::remove_file(&file).unwrap();
    let metadata = std::fs::read_to_string(path.join("metadata.yaml")).unwrap();
    std::fs::write(path.join("metadata.yaml"), metadata.replace("bag_0.db3", "bag_0.db3.zstd")).unwrap();
    let bag = BagReader::open(&path).unwrap();
    assert_eq!(bag.warnings(), []);
    assert_eq!(contents(&bag, Selection::all()), expected());

    // Each message, as `compression_mode: message` leaves them.
    let path = folder.path().join("messages");
    let mut writer = BagWriter::create(&path, WriterOptions::default()).unwrap();
    let topic = writer.add_topic(Topic::known("/camera", "sensor_msgs/msg/CompressedImage", vec![])).unwrap();
    writer.write(topic, 5, 5, &zstd::encode_all(&content(9)[..], 1).unwrap()).unwrap();
    writer.write(topic, 6, 6, b"not zstd").unwrap();
    writer.finish().unwrap();
    let metadata = std::fs::read_to_string(path.join("metadata.yaml")).unwrap();
    std::fs::write(path.join("metadata.yaml"), metadata.replace("compression_mode: ''", "compression_mode: MESSAGE"))
        .unwrap();
    let bag = BagReader::open(&path).unwrap();
    let mut messages = bag.messages(Selection::all()).unwrap();
    assert_eq!(messages.next().unwrap().unwrap().cdr, content(9));
    assert!(matches!(messages.next(), Some(Err(BagError::Damaged { .. }))));
    assert!(messages.next().is_none());

    // Without the metadata, which a recorder that was killed has not written, only the content tells.
    let bag = BagReader::open(&storage_file(&path)).unwrap();
    let cdrs: Vec<_> = contents(&bag, Selection::all()).into_iter().map(|(.., cdr)| cdr).collect();
    assert_eq!(cdrs, [content(9), b"not zstd".to_vec()]);
}

#[test]
fn another_compression_than_zstd_is_refused_by_its_name() {
    for mode in ["file", "MESSAGE"] {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("bag");
        write_bag(&path, WriterOptions::default());
        let metadata = std::fs::read_to_string(path.join("metadata.yaml")).unwrap();
        let claim = |format: &str| {
            let claimed = metadata
                .replace("compression_mode: ''", &format!("compression_mode: {mode}"))
                .replace("compression_format: ''", &format!("compression_format: {format}"));
            std::fs::write(path.join("metadata.yaml"), claimed).unwrap();
            BagReader::open(&path).map(|_| ()).map_err(|error| error.to_string())
        };
        let message = claim("lz4").unwrap_err();
        assert!(message.ends_with("metadata.yaml: compression 'lz4' in place of zstd is not supported"), "{message}");
        assert_eq!(claim("ZSTD"), Ok(()));
    }
}

#[test]
fn what_is_no_bag_is_refused_with_its_name() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x");
    assert!(matches!(BagReader::open(&path), Err(BagError::Io { .. })));
    assert!(matches!(BagReader::open(folder.path()), Err(BagError::NoStorage { .. })));
    std::fs::write(&path, b"a text").unwrap();
    let error = BagReader::open(&path).err().unwrap();
    assert!(matches!(error, BagError::NotABag { .. }));
    assert!(error.to_string().contains(&path.display().to_string()));
    std::fs::write(&path, b"").unwrap();
    assert!(matches!(BagReader::open(&path), Err(BagError::NotABag { .. })));

    write_bag(&folder.path().join("bag"), WriterOptions::default());
    let again = BagWriter::create(&folder.path().join("bag"), WriterOptions::default());
    assert!(matches!(again, Err(BagError::Exists { .. })));
    let mut writer = BagWriter::create(&folder.path().join("new"), WriterOptions::default()).unwrap();
    for name in ["camera", "", "/", "//x", "/x/"] {
        let refused = writer.add_topic(Topic::new(name, "std_msgs/msg/String", vec![]));
        assert!(matches!(refused, Err(BagError::TopicName { .. })), "{name}");
    }
}

#[test]
fn an_unfinished_bag_is_read_up_to_the_last_flush() {
    for options in all_options() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("bag");
        let mut writer = BagWriter::create(&path, options).unwrap();
        let topic = writer.add_topic(Topic::known("/camera", "sensor_msgs/msg/CompressedImage", vec![])).unwrap();
        for i in 0..50 {
            writer.write(topic, i, i, &content(i as usize)).unwrap();
        }
        writer.flush().unwrap();
        writer.write(topic, 50, 50, &content(50)).unwrap();
        // Another process looks at the files while they are written, as after a kill.
        let copy = folder.path().join("copy");
        std::fs::create_dir(&copy).unwrap();
        for entry in std::fs::read_dir(&path).unwrap() {
            let entry = entry.unwrap();
            std::fs::copy(entry.path(), copy.join(entry.file_name())).unwrap();
        }
        let bag = BagReader::open(&copy).unwrap();
        let times: Vec<i64> = contents(&bag, Selection::all()).iter().map(|m| m.0).collect();
        assert_eq!(times, (0..50).collect::<Vec<_>>(), "{options:?}");
        drop(writer);
    }
}

/// Opens and reads whatever a damaged file still yields; what comes out must be what went in.
fn survivors(path: &Path) -> Option<Vec<(i64, String, Vec<u8>)>> {
    let bag = BagReader::open(path).ok()?;
    let messages = bag.messages(Selection::all()).ok()?;
    Some(messages.filter_map(Result::ok).map(|m| (m.log_time_ns, m.topic.name.clone(), m.cdr)).collect())
}

/// Where to cut a file: near both ends, where its structure is, at every byte, and in between at every `step`.
fn cuts(length: usize, step: usize) -> Vec<usize> {
    let near = 400.min(length / 2);
    (0..near).chain((near..length - near).step_by(step)).chain(length - near..length).collect()
}

#[test]
fn a_bag_cut_anywhere_is_read_up_to_the_cut() {
    // A prime number, so that the places fall anywhere in pages and records.
    const STEP: usize = 2999;
    for options in all_options() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("bag");
        write_bag(&path, options);
        let whole = std::fs::read(storage_file(&path)).unwrap();
        let cut = folder.path().join("cut");
        let expected = expected();
        let (mut most, mut opened) = (0, 0);
        for length in cuts(whole.len(), STEP) {
            std::fs::write(&cut, &whole[..length]).unwrap();
            let Some(read) = survivors(&cut) else {
                assert_eq!(most, 0, "{options:?} cut at {length}: a longer file can't be opened");
                continue;
            };
            opened += 1;
            let at = |message: &_| expected.iter().position(|m| m == message);
            let places: Vec<usize> = read.iter().map_while(at).collect();
            assert_eq!(places.len(), read.len(), "{options:?} cut at {length}: what was not written");
            assert!(places.is_sorted(), "{options:?} cut at {length}: out of order");
            assert!(!BagReader::open(&cut).unwrap().warnings().is_empty(), "{options:?} cut at {length}");
            assert!(read.len() >= most, "{options:?} cut at {length}: a longer file yields less");
            most = read.len();
        }
        assert!(opened > 500, "{options:?}: {opened} of the cuts can be opened");
        match options.storage {
            Storage::Mcap => assert_eq!(most, MESSAGES, "cutting the summary alone loses no message"),
            // The last page may hold some.
            Storage::Sqlite3 => assert!(most > MESSAGES - 10, "cutting the last byte loses {}", MESSAGES - most),
        }
    }
}

#[test]
fn a_large_sqlite_bag_yields_what_lies_before_the_cut() {
    const MANY: usize = 20_000;
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bag");
    let options = WriterOptions { storage: Storage::Sqlite3, compression: Compression::None };
    let mut bag = BagWriter::create(&path, options).unwrap();
    let topic = Topic::known("/camera", "sensor_msgs/msg/CompressedImage", vec![]);
    let topic = bag.add_topic(topic).unwrap();
    for i in 0..MANY {
        let time = i as i64;
        bag.write(topic, time, time, &content(1 + i % 40)).unwrap();
    }
    bag.finish().unwrap();
    let file = storage_file(&path);
    let length = std::fs::metadata(&file).unwrap().len();
    // At a tenth the tree of the table has no root any more that leads anywhere.
    for tenths in (1..10).rev() {
        std::fs::File::options().write(true).open(&file).unwrap().set_len(length * tenths / 10).unwrap();
        let read = survivors(&file).unwrap();
        assert!(read.iter().map(|m| m.0).eq(0..read.len() as i64), "{tenths} tenths: a gap");
        let wanted = MANY * tenths as usize / 10;
        assert!(read.len() > wanted - MANY / 100, "{tenths} tenths: {} of about {wanted}", read.len());
    }
}

#[test]
fn a_corrupted_bag_gives_errors_and_no_panic() {
    for options in all_options() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("bag");
        write_bag(&path, options);
        let file = storage_file(&path);
        let whole = std::fs::read(&file).unwrap();
        let mut noise = Noise(SEED);
        let damaged = folder.path().join("damaged");
        let mut untouched = 0;
        for round in 0..150 {
            let mut bytes = whole.clone();
            // Few flips hit contents, flips near the ends hit headers, indexes and the summary.
            for _ in 0..1 + noise.below(4) {
                let place = match round % 3 {
                    0 => noise.below(bytes.len()),
                    1 => bytes.len() - 1 - noise.below(2000.min(bytes.len())),
                    _ => noise.below(600),
                };
                bytes[place] = noise.next() as u8;
            }
            std::fs::write(&damaged, &bytes).unwrap();
            untouched += usize::from(survivors(&damaged).is_some_and(|read| read.len() == MESSAGES));
        }
        // Most flips fall on contents, so the test is void if nothing could be read.
        assert!(untouched > 10, "{options:?}: {untouched}");
    }
}
