//! `jigsaw bag` as a user runs it: real processes, real DDS over loopback.

mod domain;

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use jigsaw_nodes::bag::cdr::LITTLE_ENDIAN_HEADER;
use jigsaw_nodes::bag::{BagReader, BagWriter, QosProfile, Selection, Topic, WriterOptions};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

/// Most that any of these processes may take; they need a few seconds.
const PATIENCE: Duration = Duration::from_secs(60);

/// Bytes of a large message: a camera frame as PNG.
const LARGE: usize = 150_000;

fn jigsaw(domain: u16, args: &[&str]) -> Command {
    by(Command::new(env!("CARGO_BIN_EXE_jigsaw")), domain, args)
}

/// A command that begins with something else than the binary.
fn by(mut command: Command, domain: u16, args: &[&str]) -> Command {
    command.args(args).env("ROS_DOMAIN_ID", domain.to_string()).env("ROS_LOCALHOST_ONLY", "1");
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

/// A process that is ended with the test.
struct Running(Option<Child>);

impl Running {
    fn start(mut command: Command) -> Self {
        Self(Some(command.spawn().expect("the binary starts")))
    }

    /// Reads stderr until a line contains `text`, and leaves the rest to a thread.
    fn wait_for(&mut self, text: &str) {
        let child = self.0.as_mut().expect("running");
        let mut lines = BufReader::new(child.stderr.take().expect("piped")).lines();
        let mut seen = Vec::new();
        for line in lines.by_ref().map_while(Result::ok) {
            seen.push(line.clone());
            if line.contains(text) {
                std::thread::spawn(move || lines.for_each(drop));
                return;
            }
        }
        panic!("no line with {text:?} in {seen:#?}");
    }

    fn interrupt(&self) {
        let id = i32::try_from(self.0.as_ref().expect("running").id()).expect("a process id");
        kill(Pid::from_raw(id), Signal::SIGINT).expect("the process is there");
    }

    fn output(mut self) -> Output {
        let begun = Instant::now();
        let mut child = self.0.take().expect("running");
        while child.try_wait().expect("a child").is_none() {
            if begun.elapsed() > PATIENCE {
                child.kill().expect("a child");
                panic!("not done after {PATIENCE:?}: {:?}", child.wait_with_output());
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        child.wait_with_output().expect("a child")
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        if let Some(child) = &mut self.0 {
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// A bag of large messages, small ones and a latched topic of a type nobody knows.
fn write_bag(path: &Path, large: usize) -> Vec<(String, Vec<u8>)> {
    let mut bag = BagWriter::create(path, WriterOptions::default()).expect("a new bag");
    let camera = Topic::known("/image/compressed", "sensor_msgs/msg/CompressedImage", vec![QosProfile::reliable(10)]);
    let camera = bag.add_topic(camera).expect("a topic");
    let odd = bag.add_topic(Topic::new("/odd", "odd_msgs/msg/Thing", vec![QosProfile::latched(100)])).expect("a topic");
    let mut messages = Vec::new();
    for i in 0..large {
        let mut cdr = LITTLE_ENDIAN_HEADER.to_vec();
        cdr.extend((0..LARGE).map(|k| (i * 31 + k * 7) as u8));
        let time = i as i64 * 1_000_000;
        bag.write(camera, time, time, &cdr).expect("written");
        messages.push(("/image/compressed".to_owned(), cdr));
        let small = [&LITTLE_ENDIAN_HEADER[..], &[i as u8; 8]].concat();
        bag.write(odd, time, time, &small).expect("written");
        messages.push(("/odd".to_owned(), small));
    }
    bag.finish().expect("finished");
    messages
}

fn messages(path: &Path) -> Vec<(String, Vec<u8>)> {
    let bag = BagReader::open(path).expect("a bag");
    assert_eq!(bag.warnings(), []);
    bag.messages(Selection::all())
        .expect("messages")
        .map(|m| {
            let m = m.expect("a message");
            (m.topic.name.clone(), m.cdr)
        })
        .collect()
}

/// The messages of one topic, in order.
fn of_topic(messages: &[(String, Vec<u8>)], topic: &str) -> Vec<Vec<u8>> {
    messages.iter().filter(|(name, _)| name == topic).map(|(_, cdr)| cdr.clone()).collect()
}

fn assert_same(played: &[(String, Vec<u8>)], recorded: &Path) {
    let recorded = messages(recorded);
    for topic in ["/image/compressed", "/odd"] {
        let (sent, got) = (of_topic(played, topic), of_topic(&recorded, topic));
        assert_eq!(got.len(), sent.len(), "{topic}: messages lost");
        assert!(got == sent, "{topic}: other bytes or another order");
    }
}

fn folder() -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().to_owned();
    (folder, path)
}

#[test]
fn a_bag_played_at_full_speed_is_recorded_byte_for_byte() {
    let domain = domain::free();
    let (_keep, folder) = folder();
    let (source, copy) = (folder.join("source"), folder.join("copy"));
    let played = write_bag(&source, 40);
    let count = played.len().to_string();
    let (source_text, copy_text) = (source.to_string_lossy(), copy.to_string_lossy());
    let recorder = jigsaw(
        domain,
        &["bag", "record", &copy_text, "--topics", "/image/compressed", "/odd", "--max-messages", &count],
    );
    let recorder = Running::start(recorder);
    let player = Running::start(jigsaw(domain, &["bag", "play", &source_text, "--rate", "0"])).output();
    assert!(player.status.success(), "{}", text(&player.stderr));
    assert!(text(&player.stdout).contains(&format!("{count} messages played")));
    let recorder = recorder.output();
    assert!(recorder.status.success(), "{}", text(&recorder.stderr));
    assert!(text(&recorder.stderr).contains("the definition of odd_msgs/msg/Thing is not known"));
    assert_same(&played, &copy);
    // The recording notes what was offered.
    let bag = BagReader::open(&copy).expect("a bag");
    let odd = bag.topics().iter().find(|t| t.topic.name == "/odd").expect("the topic");
    assert_eq!(odd.topic.offered_qos[0].durability, QosProfile::latched(1).durability);
}

#[test]
fn best_effort_subscriptions_lose_nothing_at_full_speed() {
    let domain = domain::free();
    let (_keep, folder) = folder();
    let (source, copy) = (folder.join("source"), folder.join("copy"));
    let played = write_bag(&source, 100);
    let (source_text, copy_text) = (source.to_string_lossy(), copy.to_string_lossy());
    let topics = ["/image/compressed:sensor_msgs/msg/CompressedImage", "/odd:odd_msgs/msg/Thing"];
    let mut recorder = Running::start(jigsaw(
        domain,
        &["bag", "record", &copy_text, "--topics", topics[0], topics[1], "--storage", "sqlite3"],
    ));
    // Without a publisher to go by, both are subscribed best effort.
    recorder.wait_for("recording /odd");
    let player = Running::start(jigsaw(domain, &["bag", "play", &source_text, "-r", "0"])).output();
    assert!(player.status.success(), "{}", text(&player.stderr));
    assert!(!text(&player.stderr).contains("dropped"), "{}", text(&player.stderr));
    recorder.interrupt();
    let recorder = recorder.output();
    assert!(recorder.status.success());
    assert!(text(&recorder.stdout).contains("messages recorded"), "Ctrl-C completes the bag");
    assert_same(&played, &copy);
}

#[test]
fn a_recorder_that_can_write_no_more_says_so_in_one_line_and_leaves_what_it_has_flushed() {
    // A file may have this many blocks of 512 or 1024 bytes, less than the messages take: as on a full disk, but for the
    // system's words. Without the trap the signal would end the process.
    const LIMITED: &str = "trap '' XFSZ; ulimit -f 4000; exec \"$0\" \"$@\"";
    let (_keep, folder) = folder();
    let source = folder.join("source");
    let played = write_bag(&source, 40);
    for storage in ["mcap", "sqlite3"] {
        let domain = domain::free();
        let copy = folder.join(storage);
        let (source, bag) = (source.to_string_lossy(), copy.to_string_lossy());
        let mut command = Command::new("sh");
        command.args(["-c", LIMITED, env!("CARGO_BIN_EXE_jigsaw")]);
        let args = ["bag", "record", &bag, "--storage", storage, "--uncompressed", "--topics", "/image/compressed"];
        let recorder = Running::start(by(command, domain, &args));
        let _player = Running::start(jigsaw(domain, &["bag", "play", &source, "--rate", "0.01", "--loop"]));
        let recorder = recorder.output();
        let said = text(&recorder.stderr);
        assert_eq!(recorder.status.code(), Some(2), "{said}");
        assert_eq!(said.matches("cannot write").count(), 1, "{said}");
        assert!(!text(&recorder.stdout).contains("recorded in"), "{said}");
        let bag = BagReader::open(&copy).expect("what was flushed can be opened");
        let read: Vec<Vec<u8>> =
            bag.messages(Selection::all()).expect("messages").map_while(Result::ok).map(|m| m.cdr).collect();
        assert!(read.len() > 1, "{storage}: {} messages", read.len());
        assert!(read.iter().all(|cdr| played.iter().any(|(_, one)| one == cdr)), "{storage}: other bytes");
    }
}

#[test]
fn info_tells_what_is_in_a_bag() {
    let domain = domain::free();
    let (_keep, folder) = folder();
    let path = folder.join("bag");
    write_bag(&path, 3);
    let table = Running::start(jigsaw(domain, &["bag", "info", &path.to_string_lossy()])).output();
    let out = text(&table.stdout);
    assert!(table.status.success());
    assert!(
        out.contains("Messages:  6") && out.contains("/image/compressed") && out.contains("transient_local"),
        "{out}"
    );
    let json = Running::start(jigsaw(domain, &["bag", "info", "--json", &path.to_string_lossy()])).output();
    let value: serde_json::Value = serde_json::from_slice(&json.stdout).expect("JSON");
    assert_eq!(value["messages"], 6);
    assert_eq!(value["topics"][0]["type"], "sensor_msgs/msg/CompressedImage");
}

#[test]
fn bad_input_is_one_clear_line_and_code_2() {
    let domain = domain::free();
    let (_keep, folder) = folder();
    let bag = folder.join("bag");
    write_bag(&bag, 1);
    let bag = bag.to_string_lossy().into_owned();
    let not_a_bag = folder.join("text.mcap");
    std::fs::write(&not_a_bag, "text").expect("written");
    let nothing = folder.join("nothing").to_string_lossy().into_owned();
    let not_a_bag = not_a_bag.to_string_lossy().into_owned();
    for (args, wanted) in [
        (vec!["bag", "info", &nothing], "No such file"),
        (vec!["bag", "play", &not_a_bag], "starts neither as MCAP nor as sqlite3"),
        (vec!["bag", "record", &bag, "--all"], "exists already"),
        (
            vec!["bag", "play", &bag, "--topics", "/camera"],
            "topic '/camera' is not in the bag; it holds /image/compressed, /odd",
        ),
        (vec!["bag", "play", &bag, "--start-offset", "5"], "nothing to play"),
        (vec!["bag", "play", &bag, "--remap", "a=b"], "remap rule 'a=b'"),
    ] {
        let out = Running::start(jigsaw(domain, &args)).output();
        let error = text(&out.stderr);
        assert_eq!(out.status.code(), Some(2), "{args:?}: {error}");
        assert!(error.contains(wanted), "{args:?}: {error}");
    }
}
