//! DDS Security with the real binaries: `cargo test --features security --test security`. The three nodes assemble a puzzle
//! encrypted and authenticated; a process without a certificate neither hears them nor is heard, and one whose
//! permissions lack a topic does not get it.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod domain;

use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::mpsc;
use std::time::{Duration, Instant};

use jigsaw::generate::{Options, Puzzle};
use jigsaw_msgs::Message;
use jigsaw_msgs::msg::{Assembly, PieceFeatures};
use jigsaw_nodes::ros::topics::{self, Topic};
use ros2_client::{Context, MessageTypeName, Name, NodeName, NodeOptions};

/// How long the secured cell may take; key exchange between all processes takes seconds.
const PATIENCE: Duration = Duration::from_secs(45);

/// How long one listens that is to hear nothing: several times what an authorised one takes to hear the first thing.
const SILENCE: Duration = Duration::from_secs(10);

/// How much longer than it listens a process may take to start and to end.
const MARGIN: Duration = Duration::from_secs(60);

/// How often is looked whether a process has ended.
const LOOK: Duration = Duration::from_millis(20);

/// Pieces of the puzzle: two rows, three columns.
const PIECES: usize = 6;

struct Cell {
    folder: tempfile::TempDir,
    domain: u16,
}

impl Cell {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("launch-scripts/keystore.sh");
        let made = Command::new(script)
            .arg(folder.path().join("keys"))
            .args(["/cell", "/poor=rt/image"])
            .stdout(Stdio::null())
            .status()
            .unwrap();
        assert!(made.success());
        Self { folder, domain: domain::free() }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn start(&self, binary: &str, enclave: Option<&str>, args: &[&str]) -> Process {
        let name = Path::new(binary).file_name().unwrap().to_string_lossy();
        let log = self.path(&format!("{name}_{}.log", enclave.unwrap_or("none").trim_matches('/')));
        let mut command = Command::new(binary);
        command.args(args).env("ROS_DOMAIN_ID", self.domain.to_string()).env("ROS_LOCALHOST_ONLY", "1");
        if let Some(enclave) = enclave {
            command
                .env("ROS_SECURITY_ENABLE", "true")
                .env("ROS_SECURITY_STRATEGY", "Enforce")
                .env("ROS_SECURITY_KEYSTORE", self.path("keys"))
                .env("ROS_SECURITY_ENCLAVE_OVERRIDE", enclave);
        }
        let out = File::create(&log).unwrap();
        let child = command.stdout(Stdio::null()).stderr(out).spawn().unwrap();
        Process { child, log }
    }

    /// Listens for the assembly; whether it came complete, where it was written, and what was said.
    fn watch(&self, enclave: Option<&str>, patience: Duration, pieces: usize) -> (ExitStatus, PathBuf, String) {
        let out = self.path(&format!("seen_{}", enclave.unwrap_or("none").trim_matches('/')));
        let (pieces, seconds) = (pieces.to_string(), patience.as_secs().to_string());
        let args = ["watch", "--timeout", &seconds, "--pieces", &pieces, "--out", out.to_str().unwrap()];
        let mut watcher = self.start(env!("CARGO_BIN_EXE_jigsaw"), enclave, &args);
        let status = watcher.wait(patience + MARGIN);
        (status, out, watcher.said())
    }

    /// Whether a listener of the cell gets the complete assembly.
    fn is_heard(&self) -> bool {
        let (status, out, _) = self.watch(Some("/cell"), PATIENCE, PIECES);
        status.success() && out.join("assembly.json").is_file()
    }
}

struct Process {
    child: Child,
    log: PathBuf,
}

impl Process {
    /// Waits for its end, which has to come in this time.
    fn wait(&mut self, patience: Duration) -> ExitStatus {
        let end = Instant::now() + patience;
        loop {
            match self.child.try_wait().unwrap() {
                Some(status) => return status,
                None if Instant::now() < end => std::thread::sleep(LOOK),
                None => panic!("{} has not ended after {patience:?}: {}", self.log.display(), self.said()),
            }
        }
    }

    fn said(&self) -> String {
        std::fs::read_to_string(&self.log).unwrap()
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Publishes a message again and again, without a certificate, while something else is done.
fn injecting<M: Message, T>(domain: u16, topic: &Topic<M>, message: M, action: impl FnOnce() -> T) -> T {
    let (name, qos) = (Name::parse(&format!("/{}", topic.name)).unwrap(), topic.qos.clone());
    let (publishes, begun) = mpsc::channel();
    let (done, going_on) = mpsc::channel::<()>();
    std::thread::spawn(move || {
        let participant = rustdds::DomainParticipantBuilder::new(domain)
            .with_only_networks([std::net::IpAddr::from([127, 0, 0, 1])])
            .build()
            .unwrap();
        let context = Context::from_domain_participant(participant).unwrap();
        let options = NodeOptions::new().enable_rosout(false);
        let mut node = context.new_node(NodeName::new("/", "stranger").unwrap(), options).unwrap();
        let kind = MessageTypeName::new(M::TYPE.package, M::TYPE.name);
        let dds_topic = node.create_topic(&name, kind, &qos).unwrap();
        let publisher = node.create_publisher::<M>(&dds_topic, None).unwrap();
        publishes.send(()).unwrap();
        // A publisher of ten messages a second.
        while going_on.recv_timeout(Duration::from_millis(100)) == Err(mpsc::RecvTimeoutError::Timeout) {
            let _ = publisher.publish(message.clone());
        }
    });
    begun.recv_timeout(MARGIN).expect("the stranger publishes");
    let result = action();
    // It takes its leave while the test goes on.
    drop(done);
    result
}

#[test]
fn a_forged_assembly_reaches_the_unprotected_alone() {
    let cell = Cell::new();
    let forged = Assembly { state: Assembly::COMPLETE, ..Assembly::default() };
    injecting(cell.domain, &topics::ASSEMBLY, forged, || {
        assert!(cell.watch(None, PATIENCE, 0).0.success(), "the forged assembly is one that a listener takes");
        let (status, out, _) = cell.watch(Some("/cell"), SILENCE, 0);
        assert!(!status.success() && !out.join("assembly.json").exists(), "a secured listener hears a stranger");
    });
}

#[test]
fn the_cell_talks_among_itself_alone() {
    let cell = Cell::new();
    let puzzle = Puzzle::generate(&Options { rows: 2, columns: 3, seed: 5, ..Options::default() }).unwrap();
    let frames = cell.path("frames");
    std::fs::create_dir(&frames).unwrap();
    for frame in 0..puzzle.frame_count() {
        let picture = puzzle.render(frame);
        let path = frames.join(format!("{}.png", puzzle.frame_stem(frame)));
        image::save_buffer(path, &picture.pixels, picture.width, picture.height, image::ExtendedColorType::L8).unwrap();
    }
    let source = format!("source:={}", frames.display());
    let solver = cell.start(env!("CARGO_BIN_EXE_solver_node"), Some("/cell"), &[]);
    let _feature = cell.start(env!("CARGO_BIN_EXE_feature_node"), Some("/cell"), &[]);
    let _capture = cell.start(env!("CARGO_BIN_EXE_capture_node"), Some("/cell"), &["--ros-args", "-p", &source]);

    assert!(cell.is_heard(), "{}", solver.said());
    assert!(solver.said().contains("secured by the enclave"));

    let (status, out, _) = cell.watch(None, SILENCE, PIECES);
    assert!(!status.success() && !out.join("assembly.json").exists(), "one without a certificate hears the cell");
    let (status, out, said) = cell.watch(Some("/poor"), SILENCE, PIECES);
    assert!(!status.success() && !out.join("assembly.json").exists(), "one without the permission hears the cell");
    assert!(said.contains("rt/assembly"), "{said}");

    let strange = PieceFeatures { id: "in/jected".to_owned(), ..PieceFeatures::default() };
    injecting(cell.domain, &topics::PIECE_FEATURES, strange, || {
        assert!(cell.is_heard(), "{}", solver.said());
    });
    assert!(!solver.said().contains("jected"), "{}", solver.said());
}

#[test]
fn without_its_files_a_node_does_not_start() {
    let cell = Cell::new();
    let mut node = cell.start(env!("CARGO_BIN_EXE_solver_node"), Some("/nobody"), &[]);
    assert_eq!(node.wait(MARGIN).code(), Some(2));
    let said = node.said();
    assert!(said.contains("nobody") && said.lines().count() == 1, "{said}");
}
