//! The cell under test: the three nodes as `launch-scripts/cell.sh` runs them, a camera that shows a bag over and over,
//! a witness that hears everything the cell says, and the truth about the puzzle.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::fs::File;
use std::net::Ipv4Addr;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex};
use std::time::{Duration, Instant};

use futures::StreamExt;
use jigsaw_msgs::diagnostic_msgs::msg::DiagnosticArray;
use jigsaw_msgs::geometry_msgs::msg::Pose;
use jigsaw_msgs::msg::Assembly;
use jigsaw_msgs::tf2_msgs::msg::TFMessage;
use jigsaw_nodes::ros::mends::peers::Courier;
use jigsaw_nodes::ros::topics::{self, Topic};
use jigsaw_nodes::ros::transforms::PixelPlane;
use nalgebra::{Isometry2, Point2, Vector2};
use nix::sys::signal::Signal;
use ros2_client::{Context, MessageTypeName, Name, Node, NodeName, NodeOptions};
use rustdds::RTPSEntity;

/// What may pass until an awaited event counts as missing. Generous: the machine may be busy with other tests.
pub(crate) const PATIENCE: Duration = Duration::from_secs(90);

/// How long one looks again for what can't be awaited, such as a process.
pub(crate) const LOOK: Duration = Duration::from_millis(10);

/// The nodes of the cell.
pub(crate) const NODES: [&str; 3] = ["capture_node", "feature_node", "solver_node"];

/// Tolerance of a mating against the truth, in pixels and radians: the truth's centroids know nothing of blur.
const TRUTH_PX: f64 = 1.5;
const TRUTH_RAD: f64 = 0.02;

/// Tolerance between two assemblies of the same pieces, which may have come in another order.
const SAME_PX: f64 = 0.05;
const SAME_RAD: f64 = 5e-4;

/// Scale of the generated bags, the default of `metres_per_pixel`.
const METRES_PER_PIXEL: f64 = 1e-4;

pub(crate) fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// The script that runs the nodes.
pub(crate) fn script() -> PathBuf {
    root().join("launch-scripts/cell.sh")
}

/// The folder of the binaries under test.
pub(crate) fn binaries() -> PathBuf {
    std::env::var_os("JIGSAW_BIN_DIR")
        .map_or_else(|| Path::new(env!("CARGO_BIN_EXE_jigsaw")).parent().unwrap().to_owned(), PathBuf::from)
}

/// A command of this project's command line.
pub(crate) fn jigsaw() -> Command {
    let mut command = Command::new(binaries().join("jigsaw"));
    command.stdout(Stdio::null());
    command
}

/// The bag of 24 pieces that comes with the project.
pub(crate) fn bag24() -> PathBuf {
    root().join("bags/puzzle24")
}

/// Sends a signal; false if the process has gone.
pub(crate) fn signal(pid: i32, signal: Signal) -> bool {
    nix::sys::signal::kill(nix::unistd::Pid::from_raw(pid), signal).is_ok()
}

/// A process that ends with the test.
pub(crate) struct Running(pub Child);

impl Drop for Running {
    fn drop(&mut self) {
        signal(self.0.id() as i32, Signal::SIGTERM);
        let deadline = Instant::now() + Duration::from_secs(6);
        while Instant::now() < deadline {
            if matches!(self.0.try_wait(), Ok(Some(_)) | Err(_)) {
                return;
            }
            std::thread::sleep(LOOK);
        }
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// The nodes under `cell.sh`.
pub(crate) struct Cell {
    script: Running,
    log: PathBuf,
}

impl Cell {
    /// Starts it, on this host.
    pub(crate) fn start(folder: &Path, environment: &[(&str, String)], args: &[&str]) -> Self {
        Self::start_by(Command::new(script()), folder.join("cell.log"), environment, args)
    }

    /// Starts it by a command that may begin with something else than the script.
    pub(crate) fn start_by(mut command: Command, log: PathBuf, environment: &[(&str, String)], args: &[&str]) -> Self {
        let file = File::options().create(true).append(true).open(&log).unwrap();
        let script = command
            .args(args)
            .env("BIN", binaries())
            .env_remove("ROS_LOCALHOST_ONLY")
            .envs(environment.iter().map(|(name, value)| (*name, value.as_str())))
            .stdout(Stdio::null())
            .stderr(file)
            .spawn()
            .unwrap();
        Self { script: Running(script), log }
    }

    /// The process of a node, as soon as there is one.
    pub(crate) fn pid(&self, node: &str) -> i32 {
        let script = self.script.0.id();
        eventually(&format!("process of {node}"), || descendant_of(script, node))
    }

    pub(crate) fn log(&self) -> String {
        std::fs::read_to_string(&self.log).unwrap_or_default()
    }
}

impl Drop for Cell {
    fn drop(&mut self) {
        if std::thread::panicking() {
            let log = self.log();
            let tail: Vec<&str> = log.lines().rev().take(60).collect();
            eprintln!("the last lines of {}:", self.log.display());
            tail.iter().rev().for_each(|line| eprintln!("  {line}"));
        }
    }
}

/// Waits for something that can only be looked for.
pub(crate) fn eventually<T>(what: &str, mut look: impl FnMut() -> Option<T>) -> T {
    let deadline = Instant::now() + PATIENCE;
    loop {
        if let Some(found) = look() {
            return found;
        }
        assert!(Instant::now() < deadline, "no {what} within {PATIENCE:?}");
        std::thread::sleep(LOOK);
    }
}

/// The process of this name that descends from another.
fn descendant_of(ancestor: u32, name: &str) -> Option<i32> {
    let mut parents = HashMap::new();
    let mut candidates = Vec::new();
    for entry in std::fs::read_dir("/proc").ok()?.flatten() {
        let Some(pid) = entry.file_name().to_str().and_then(|text| text.parse::<u32>().ok()) else { continue };
        let Ok(stat) = std::fs::read_to_string(entry.path().join("stat")) else { continue };
        // 1234 (name) S 12 …: number, name, state, parent.
        let Some((head, tail)) = stat.rsplit_once(") ") else { continue };
        let parent = tail.split(' ').nth(1)?.parse::<u32>().ok()?;
        parents.insert(pid, parent);
        if head.split_once('(').is_some_and(|(_, comm)| comm == name) && !tail.starts_with('Z') {
            candidates.push(pid);
        }
    }
    let descends = |pid: &u32| std::iter::successors(Some(*pid), |p| parents.get(p).copied()).any(|p| p == ancestor);
    candidates.into_iter().find(descends).map(|pid| pid as i32)
}

/// The state of a process, as the system's table has it.
fn state(pid: i32) -> Option<char> {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    stat.rsplit_once(") ").and_then(|(_, tail)| tail.chars().next())
}

/// Whether a process still runs.
pub(crate) fn runs(pid: i32) -> bool {
    state(pid).is_some_and(|state| state != 'Z')
}

/// Whether a process has been stopped.
pub(crate) fn is_stopped(pid: i32) -> bool {
    state(pid) == Some('T')
}

/// What the cell has said so far.
#[derive(Default)]
pub(crate) struct Heard {
    /// Every assembly, with the time.
    pub assemblies: Vec<(Instant, Assembly)>,
    /// The latest goal of each piece, by its frame.
    pub goals: HashMap<String, Isometry2<f64>>,
    /// When each node has last reported.
    pub reports: HashMap<String, Instant>,
    /// How much each node says it has published.
    pub published: HashMap<String, u64>,
}

impl Heard {
    /// The latest assembly, if it holds this many pieces and is complete.
    pub(crate) fn complete(&self, pieces: usize) -> Option<Assembly> {
        let (_, latest) = self.assemblies.last()?;
        (latest.state == Assembly::COMPLETE && latest.pieces.len() == pieces).then(|| latest.clone())
    }
}

/// A listener on another participant.
pub(crate) struct Witness {
    heard: Arc<(Mutex<Heard>, Condvar)>,
    ended: Arc<AtomicBool>,
    thread: Option<std::thread::JoinHandle<()>>,
}

impl Witness {
    /// On this host.
    pub(crate) fn new(domain: u16) -> Self {
        Self::at(domain, Ipv4Addr::LOCALHOST, Vec::new())
    }

    /// On the interface with this address; announces itself to these hosts by unicast.
    pub(crate) fn at(domain: u16, address: Ipv4Addr, peers: Vec<Ipv4Addr>) -> Self {
        let heard: Arc<(Mutex<Heard>, Condvar)> = Arc::default();
        let ended = Arc::new(AtomicBool::new(false));
        let (shared, end) = (Arc::clone(&heard), Arc::clone(&ended));
        let thread = std::thread::spawn(move || listen(domain, address, peers, &shared, &end));
        Self { heard, ended, thread: Some(thread) }
    }

    /// Waits until something was heard.
    pub(crate) fn until<T>(&self, what: &str, mut look: impl FnMut(&Heard) -> Option<T>) -> T {
        let deadline = Instant::now() + PATIENCE;
        let (lock, changed) = &*self.heard;
        let mut heard = lock.lock().unwrap();
        loop {
            if let Some(found) = look(&heard) {
                return found;
            }
            let left = deadline.saturating_duration_since(Instant::now());
            let latest = heard.assemblies.last().map(|(_, a)| (a.state, a.pieces.len(), a.unplaced.len()));
            assert!(!left.is_zero(), "no {what} within {PATIENCE:?}; latest assembly: {latest:?}");
            heard = changed.wait_timeout(heard, left).unwrap().0;
        }
    }

    pub(crate) fn with<T>(&self, look: impl FnOnce(&Heard) -> T) -> T {
        look(&self.heard.0.lock().unwrap())
    }
}

impl Drop for Witness {
    fn drop(&mut self) {
        self.ended.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn listen(domain: u16, address: Ipv4Addr, peers: Vec<Ipv4Addr>, shared: &(Mutex<Heard>, Condvar), ended: &AtomicBool) {
    let courier = (!peers.is_empty()).then(|| Courier::open(domain, &[address.into()]).unwrap());
    let participant = rustdds::DomainParticipantBuilder::new(domain).with_only_networks([address]).build().unwrap();
    if let Some(courier) = courier {
        courier.serve(participant.guid(), peers).unwrap();
    }
    let context = Context::from_domain_participant(participant).unwrap();
    let mut node = context.new_node(NodeName::new("/", "witness").unwrap(), NodeOptions::new()).unwrap();
    let mut assemblies = subscribe(&mut node, &topics::ASSEMBLY).fuse();
    let mut transforms = subscribe(&mut node, &topics::TF_STATIC).fuse();
    let mut reports = subscribe(&mut node, &topics::DIAGNOSTICS).fuse();
    let tell = |change: &mut dyn FnMut(&mut Heard)| {
        change(&mut shared.0.lock().unwrap());
        shared.1.notify_all();
    };
    smol::block_on(async {
        while !ended.load(Ordering::Relaxed) {
            let mut tick = futures::FutureExt::fuse(smol::Timer::after(Duration::from_millis(100)));
            futures::select! {
                assembly = assemblies.next() => if let Some(assembly) = assembly {
                    tell(&mut |heard| heard.assemblies.push((Instant::now(), assembly.clone())));
                },
                message = transforms.next() => if let Some(TFMessage { transforms }) = message {
                    tell(&mut |heard| for t in &transforms {
                        let goal = plane(&t.transform.translation, &t.transform.rotation);
                        heard.goals.insert(t.child_frame_id.clone(), goal);
                    });
                },
                report = reports.next() => if let Some(DiagnosticArray { status, .. }) = report {
                    tell(&mut |heard| for s in &status {
                        heard.reports.insert(s.name.clone(), Instant::now());
                        let published = s.values.iter().find(|value| value.key == "published");
                        if let Some(count) = published.and_then(|value| value.value.parse().ok()) {
                            heard.published.insert(s.name.clone(), count);
                        }
                    });
                },
                _ = tick => {}
            }
        }
    });
}

fn subscribe<M: jigsaw_msgs::Message>(
    node: &mut Node,
    topic: &Topic<M>,
) -> std::pin::Pin<Box<dyn futures::Stream<Item = M>>> {
    let name = format!("/{}", topic.name.trim_start_matches('/'));
    let type_name = MessageTypeName::new(M::TYPE.package, M::TYPE.name);
    // As deep as can be: nothing said in between may be missed.
    let qos = topic.qos.clone().history(ros2_client::qos::History::KeepLast { depth: 1000 });
    let dds_topic = node.create_topic(&Name::parse(&name).unwrap(), type_name, &topic.qos).unwrap();
    let subscription = node.create_subscription::<M>(&dds_topic, Some(qos)).unwrap();
    Box::pin(futures::stream::unfold(subscription, |subscription| async {
        let (message, _) = subscription.async_take().await.unwrap();
        Some((message, subscription))
    }))
}

fn plane(
    translation: &jigsaw_msgs::geometry_msgs::msg::Vector3,
    rotation: &jigsaw_msgs::geometry_msgs::msg::Quaternion,
) -> Isometry2<f64> {
    Isometry2::new(Vector2::new(translation.x, translation.y), 2.0 * rotation.z.atan2(rotation.w))
}

fn plane_pose(pose: &Pose) -> Isometry2<f64> {
    Isometry2::new(Vector2::new(pose.position.x, pose.position.y), 2.0 * pose.orientation.z.atan2(pose.orientation.w))
}

/// What is true of a generated bag.
pub(crate) struct Truth {
    /// Where each piece belongs, in metres, y up.
    goals: HashMap<String, Isometry2<f64>>,
    neighbours: BTreeSet<(String, String)>,
}

impl Truth {
    pub(crate) fn of(bag: &Path) -> Self {
        let text = std::fs::read_to_string(bag.join("truth.json")).unwrap();
        let json: serde_json::Value = serde_json::from_str(&text).unwrap();
        let mut truth = Self { goals: HashMap::new(), neighbours: BTreeSet::new() };
        for piece in json["pieces"].as_array().unwrap() {
            let id = piece["id"].as_str().unwrap().to_owned();
            let number = |value: &serde_json::Value| value.as_f64().unwrap();
            let pose = &piece["puzzle_from_image"];
            let puzzle_from_image =
                Isometry2::new(Vector2::new(number(&pose["x"]), number(&pose["y"])), number(&pose["theta"]));
            let centroid = Point2::new(number(&piece["centroid"][0]), number(&piece["centroid"][1]));
            let plane = PixelPlane { metres_per_pixel: METRES_PER_PIXEL, origin_px: Point2::origin() };
            for side in piece["sides"].as_array().unwrap() {
                if let Some(neighbour) = side["neighbour"].as_str() {
                    truth.neighbours.insert((id.clone(), neighbour.to_owned()));
                }
            }
            truth.goals.insert(id, plane.pose(&puzzle_from_image, centroid));
        }
        truth
    }

    pub(crate) fn pieces(&self) -> usize {
        self.goals.len()
    }

    /// Whether nothing in an assembly, partial or not, is wrong.
    pub(crate) fn check(&self, assembly: &Assembly) -> Result<(), String> {
        let mut seen = BTreeSet::new();
        let placed = assembly.pieces.iter().map(|p| &p.id);
        for id in placed.chain(&assembly.unplaced) {
            if !self.goals.contains_key(id) {
                return Err(format!("there is no piece {id}"));
            }
            if !seen.insert(id) {
                return Err(format!("piece {id} is counted twice"));
            }
        }
        let found: HashMap<&str, _> = assembly.pieces.iter().map(|p| (p.id.as_str(), plane_pose(&p.goal))).collect();
        for mating in &assembly.matings {
            let (a, b) = (&mating.positive_piece, &mating.negative_piece);
            if !self.neighbours.contains(&(a.clone(), b.clone())) {
                return Err(format!("{a} and {b} are mated and are no neighbours"));
            }
            let (Some(found_a), Some(found_b)) = (found.get(a.as_str()), found.get(b.as_str())) else {
                return Err(format!("{a} and {b} are mated and not placed"));
            };
            let error = (found_a.inverse() * found_b).inverse() * (self.goals[a].inverse() * self.goals[b]);
            let (shift, turn) = (error.translation.vector.norm() / METRES_PER_PIXEL, error.rotation.angle().abs());
            if shift > TRUTH_PX || turn > TRUTH_RAD {
                return Err(format!("{a} and {b} are {shift:.2} px and {turn:.4} rad off"));
            }
        }
        Ok(())
    }
}

/// Where two assemblies of all pieces differ, if they do.
pub(crate) fn difference(a: &Assembly, b: &Assembly) -> Option<String> {
    let ids = |assembly: &Assembly| assembly.pieces.iter().map(|p| p.id.clone()).collect::<BTreeSet<_>>();
    if ids(a) != ids(b) {
        return Some(format!("pieces {:?} and {:?}", ids(a), ids(b)));
    }
    let matings = |assembly: &Assembly| {
        assembly
            .matings
            .iter()
            .map(|m| {
                let positive = (m.positive_piece.clone(), m.positive_isthmus);
                (positive, (m.negative_piece.clone(), m.negative_isthmus))
            })
            .collect::<BTreeSet<_>>()
    };
    let (in_a, in_b) = (matings(a), matings(b));
    if in_a != in_b {
        return Some(format!("matings differ in {:?}", in_a.symmetric_difference(&in_b).collect::<Vec<_>>()));
    }
    let poses = |assembly: &Assembly| -> BTreeMap<String, Isometry2<f64>> {
        assembly.pieces.iter().map(|p| (p.id.clone(), plane_pose(&p.goal))).collect()
    };
    let (in_a, in_b) = (poses(a), poses(b));
    let first = in_a.keys().next()?;
    let b_from_a = in_b[first] * in_a[first].inverse();
    in_a.iter().find_map(|(id, pose)| {
        let error = (b_from_a * pose).inverse() * in_b[id];
        let (shift, turn) = (error.translation.vector.norm() / METRES_PER_PIXEL, error.rotation.angle().abs());
        (shift > SAME_PX || turn > SAME_RAD).then(|| format!("piece {id} is {shift:.3} px and {turn:.5} rad off"))
    })
}

/// A folder that goes with the test.
pub(crate) struct Folder(pub PathBuf);

impl Folder {
    pub(crate) fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("jigsaw-{name}-{}", std::process::id()));
        std::fs::create_dir_all(&path).unwrap();
        Self(path)
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}
