//! The three real binaries over loopback DDS: a folder of pictures in, the assembly and the poses out.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod domain;

use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use futures::StreamExt;
use jigsaw::generate::{Options, Puzzle};
use jigsaw_msgs::msg::Assembly;
use jigsaw_msgs::tf2_msgs::msg::TFMessage;
use jigsaw_nodes::ros::topics::{self, Topic};
use nix::sys::signal::Signal;
use nix::sys::wait::{WaitPidFlag, WaitStatus, waitpid};
use ros2_client::{Context, MessageTypeName, Name, Node, NodeName, NodeOptions};

/// What may pass before a test counts as hung. Generous: the machine may be busy with other tests.
const PATIENCE: Duration = Duration::from_secs(120);

/// How long a stopped node is left to find out that it is deaf before it is stopped once more.
const DEAF: Duration = Duration::from_secs(3);

/// A folder that goes with the test.
struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("jigsaw-{name}-{}", std::process::id()));
        std::fs::create_dir_all(&path).unwrap();
        Self(path)
    }

    fn of_puzzle(name: &str, options: &Options) -> Self {
        let folder = Self::new(name);
        let puzzle = Puzzle::generate(options).unwrap();
        for frame in 0..puzzle.frame_count() {
            let picture = puzzle.render(frame);
            let [width, height] = options.frame_size();
            let path = folder.0.join(format!("{}.png", puzzle.frame_stem(frame)));
            image::save_buffer(path, &picture.pixels, width, height, image::ExtendedColorType::L8).unwrap();
        }
        folder
    }

    fn path(&self) -> &Path {
        &self.0
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// A node that is killed if the test fails before it has ended.
struct Process(Child);

impl Process {
    fn start(binary: &str, domain: u16, args: &[&str]) -> Self {
        let child = Command::new(binary)
            .args(args)
            .env("ROS_DOMAIN_ID", domain.to_string())
            .env("ROS_LOCALHOST_ONLY", "1")
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        Self(child)
    }

    fn signal(&self, signal: Signal) {
        nix::sys::signal::kill(nix::unistd::Pid::from_raw(self.0.id() as i32), signal).unwrap();
    }

    fn wait_until_stopped(&self) {
        let pid = nix::unistd::Pid::from_raw(self.0.id() as i32);
        let stopped = waitpid(pid, Some(WaitPidFlag::WUNTRACED)).unwrap();
        assert!(matches!(stopped, WaitStatus::Stopped(..)), "{stopped:?}");
    }

    fn ends_within(&mut self, patience: Duration) -> bool {
        let deadline = Instant::now() + patience;
        while self.0.try_wait().unwrap().is_none() {
            if Instant::now() > deadline {
                return false;
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        true
    }

    /// Waits for the end; the exit status and what was said on standard error.
    fn end(mut self) -> (ExitStatus, String) {
        assert!(self.ends_within(PATIENCE), "the process did not end within {PATIENCE:?}");
        let mut said = String::new();
        self.0.stderr.take().unwrap().read_to_string(&mut said).unwrap();
        (self.0.wait().unwrap(), said)
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// A listener of its own.
struct Listener {
    node: Node,
    namespace: String,
}

impl Listener {
    fn new(domain: u16) -> Self {
        Self::in_namespace(domain, "")
    }

    /// Relative names are those of this namespace.
    fn in_namespace(domain: u16, namespace: &str) -> Self {
        let participant = rustdds::DomainParticipantBuilder::new(domain)
            .with_only_networks([std::net::IpAddr::from([127, 0, 0, 1])])
            .build()
            .unwrap();
        let context = Context::from_domain_participant(participant).unwrap();
        let node = context.new_node(NodeName::new("/", "listener").unwrap(), NodeOptions::new()).unwrap();
        Self { node, namespace: namespace.to_owned() }
    }

    /// The first message on a topic for which the condition holds.
    fn wait<M: jigsaw_msgs::Message>(&mut self, topic: &Topic<M>, wanted: impl Fn(&M) -> bool) -> M {
        let name = if topic.name.starts_with('/') {
            topic.name.to_owned()
        } else {
            format!("{}/{}", self.namespace, topic.name)
        };
        let type_name = MessageTypeName::new(M::TYPE.package, M::TYPE.name);
        let dds_topic = self.node.create_topic(&Name::parse(&name).unwrap(), type_name, &topic.qos).unwrap();
        let subscription = self.node.create_subscription::<M>(&dds_topic, None).unwrap();
        smol::block_on(async {
            let mut messages = Box::pin(subscription.async_stream());
            let search = async {
                loop {
                    let (message, _) = messages.next().await.unwrap().unwrap();
                    if wanted(&message) {
                        return message;
                    }
                }
            };
            let timeout = async {
                smol::Timer::after(PATIENCE).await;
                panic!("nothing of the kind on {name} within {PATIENCE:?}");
            };
            smol::future::or(search, timeout).await
        })
    }
}

fn complete(assembly: &Assembly) -> bool {
    assembly.state == Assembly::COMPLETE
}

#[test]
fn three_processes_assemble_a_folder_and_end_in_order() {
    let domain = domain::free();
    let options = Options { rows: 2, columns: 3, seed: 5, noise: 2.0, blur: 1.0, ..Options::default() };
    let folder = Folder::of_puzzle("nodes", &options);
    let source = format!("source:={}", folder.path().display());
    let nodes = [
        Process::start(env!("CARGO_BIN_EXE_solver_node"), domain, &[]),
        Process::start(env!("CARGO_BIN_EXE_feature_node"), domain, &[]),
        Process::start(env!("CARGO_BIN_EXE_capture_node"), domain, &["--ros-args", "-p", &source]),
    ];
    let mut listener = Listener::new(domain);
    let assembly = listener.wait(&topics::ASSEMBLY, |assembly| assembly.pieces.len() == 6 && complete(assembly));
    assert!(assembly.unplaced.is_empty());
    // A listener that comes late finds every transform in the one latched message.
    let transforms: TFMessage =
        Listener::new(domain).wait(&topics::TF_STATIC, |tf: &TFMessage| tf.transforms.len() == 12);
    for piece in &assembly.pieces {
        let goal =
            transforms.transforms.iter().find(|t| t.child_frame_id == format!("piece_{}_goal", piece.id)).unwrap();
        assert_eq!(goal.header.frame_id, "puzzle");
        assert_eq!(goal.transform.translation.x, piece.goal.position.x);
        assert!(piece.goal.position.x > 0.0 && piece.goal.position.y > 0.0);
    }
    for node in nodes {
        node.signal(Signal::SIGTERM);
        let (status, said) = node.end();
        assert_eq!(status.code(), Some(0), "{said}");
    }
}

#[test]
fn a_journal_that_cannot_be_written_keeps_no_piece_from_being_solved() {
    let domain = domain::free();
    let options = Options { rows: 2, columns: 2, seed: 5, ..Options::default() };
    let folder = Folder::of_puzzle("journal", &options);
    let kept = Folder::new("kept");
    // No file may be as long as a piece is: as on a full disk, but for the system's words.
    const LIMITED: &str = "trap '' XFSZ; ulimit -f 1; exec \"$0\" \"$@\"";
    let journal = format!("journal:={}", kept.path().display());
    let args = ["-c", LIMITED, env!("CARGO_BIN_EXE_solver_node"), "--ros-args", "-p", &journal];
    let solver = Process::start("sh", domain, &args);
    let _feature = Process::start(env!("CARGO_BIN_EXE_feature_node"), domain, &[]);
    let source = format!("source:={}", folder.path().display());
    let _capture = Process::start(env!("CARGO_BIN_EXE_capture_node"), domain, &["--ros-args", "-p", &source]);
    Listener::new(domain).wait(&topics::ASSEMBLY, |assembly| assembly.pieces.len() == 4 && complete(assembly));
    solver.signal(Signal::SIGTERM);
    let (status, said) = solver.end();
    assert_eq!(status.code(), Some(0), "{said}");
    assert!(said.contains("WARN") && said.contains("journal"), "{said}");
    assert_eq!(std::fs::read_dir(kept.path()).unwrap().count(), 0, "half a piece is left behind");
}

#[test]
fn bad_input_ends_with_one_line_and_code_2() {
    let domain = domain::free();
    let empty = Folder::new("empty");
    let source = format!("source:={}", empty.path().display());
    let capture = env!("CARGO_BIN_EXE_capture_node");
    let solver = env!("CARGO_BIN_EXE_solver_node");
    let cases: [(&str, &[&str], &str); 6] = [
        (capture, &["--ros-args", "-p", &source], "holds no picture"),
        (capture, &["--ros-args", "-p", "metres_per_pixel:=-1.0"], "'metres_per_pixel': -1.0 breaks the rule"),
        (capture, &["--ros-args", "-p", "metres:=1.0"], "'metres' is unknown"),
        (solver, &["--ros-args", "-p", "policy:=best"], "one of standard, paper"),
        (solver, &["--ros-args", "-r", "no rule"], "':=' is missing"),
        (solver, &["positional"], "unknown argument 'positional'"),
    ];
    for (binary, args, wanted) in cases {
        let (status, said) = Process::start(binary, domain, args).end();
        assert_eq!(status.code(), Some(2), "{args:?}: {said}");
        assert!(said.contains(wanted) && said.trim_end().lines().count() == 1, "{args:?}: {said}");
    }
}

#[test]
fn a_node_whose_middleware_died_ends_with_code_3() {
    let domain = domain::free();
    let mut node = Process::start(env!("CARGO_BIN_EXE_solver_node"), domain, &[]);
    // The diagnostics tell that it is up.
    Listener::new(domain).wait(&topics::DIAGNOSTICS, |_| true);
    // None of the middleware's threads may have been waiting: then the node is well, and is stopped once more.
    for _ in 0..10 {
        node.signal(Signal::SIGSTOP);
        node.wait_until_stopped();
        node.signal(Signal::SIGCONT);
        if node.ends_within(DEAF) {
            break;
        }
    }
    let (status, said) = node.end();
    assert_eq!(status.code(), Some(3), "{said}");
    assert!(said.contains("gone deaf"), "{said}");
}

#[test]
fn a_composed_cell_gives_the_same_assembly() {
    let domain = domain::free();
    let options = Options { rows: 2, columns: 3, seed: 5, noise: 2.0, blur: 1.0, ..Options::default() };
    let folder = Folder::of_puzzle("cell", &options);
    let args = ["cell", "--source", folder.path().to_str().unwrap(), "--ros-args", "-r", "__ns:=/cell"];
    let cell = Process::start(env!("CARGO_BIN_EXE_jigsaw"), domain, &args);
    let mut listener = Listener::in_namespace(domain, "/cell");
    let assembly = listener.wait(&topics::ASSEMBLY, |assembly| assembly.pieces.len() == 6 && complete(assembly));
    assert!(assembly.unplaced.is_empty());
    cell.signal(Signal::SIGINT);
    let (status, said) = cell.end();
    assert_eq!(status.code(), Some(0), "{said}");
}

#[test]
fn a_log_level_is_that_of_one_node() {
    let domain = domain::free();
    // Alone in its process, a node has all lines; the level of another one is no concern of it.
    for (given, heard) in
        [("solver_node:=debug", true), ("lab.solver_node:=debug", true), ("capture_node:=debug", false)]
    {
        let args = ["--ros-args", "-r", "__ns:=/lab", "--log-level", given];
        let node = Process::start(env!("CARGO_BIN_EXE_solver_node"), domain, &args);
        Listener::new(domain).wait(&topics::DIAGNOSTICS, |_| true);
        node.signal(Signal::SIGTERM);
        let (_, said) = node.end();
        assert_eq!(said.contains("[DEBUG]"), heard, "{given}: {said}");
        assert!(said.contains("[INFO]"), "{given}: {said}");
    }
    // In a composed cell a line is that of the node whose module it comes from.
    let options = Options { rows: 2, columns: 2, seed: 5, ..Options::default() };
    let folder = Folder::of_puzzle("levels", &options);
    let levels = ["--log-level", "warn", "--log-level", "feature_node:=debug", "--log-level", "capture_node:=info"];
    let args = [&["cell", "--source", folder.path().to_str().unwrap(), "--ros-args"], &levels[..]].concat();
    let cell = Process::start(env!("CARGO_BIN_EXE_jigsaw"), domain, &args);
    Listener::new(domain).wait(&topics::ASSEMBLY, |assembly| assembly.pieces.len() == 4 && complete(assembly));
    cell.signal(Signal::SIGTERM);
    let (_, said) = cell.end();
    let counted = |what: &str| said.lines().filter(|line| line.contains(what)).count();
    assert_eq!(counted("isthmuses"), 4, "the feature node at debug: {said}");
    assert_eq!((counted("pictures in"), counted("[INFO]")), (1, 1), "the capture node at info: {said}");
    assert_eq!(counted("[DEBUG]"), 4, "{said}");
}
