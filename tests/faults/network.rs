//! The cell on three hosts, joined by a network that loses, delays, reorders and cuts: capture on the first, two feature
//! nodes that share the pieces on the second, the solver on the third.
//!
//! The hosts are network namespaces, the network is `relay.py`: it needs root, `ip` (iproute2), Python and `/dev/net/tun`.
//! Where one is missing the tests say that they are skipped, unless `JIGSAW_NETWORK=required` is set.

use std::io::{BufRead, BufReader, Write};
use std::net::Ipv4Addr;
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::time::{Duration, Instant};

use jigsaw_msgs::msg::Assembly;
use nix::sys::signal::Signal;

use crate::cell::{Cell, Folder, Running, Truth, Witness, bag24, binaries, root, script, signal};
use crate::domain;

/// How long a link is cut: for less than the time after which nodes forget one another (their lease of 50 s), and more.
const CUT: Duration = Duration::from_secs(10);
const LONG_CUT: Duration = Duration::from_secs(75);

/// Three hosts and this one.
struct Network {
    relay: Child,
    orders: ChildStdin,
    answers: BufReader<ChildStdout>,
    ports: Vec<String>,
    subnet: u8,
}

/// The host of the capture node, of the feature nodes, of the solver, and this one.
const CAPTURE: usize = 0;
const FEATURE: usize = 1;
const SOLVER: usize = 2;
const HERE: usize = 3;

/// Names of the feature nodes.
const FEATURES: [&str; 2] = ["feature_a", "feature_b"];

fn ip(args: &str) -> Result<(), String> {
    let output = Command::new("ip").args(args.split(' ')).output().map_err(|e| format!("ip (iproute2): {e}"))?;
    if output.status.success() { Ok(()) } else { Err(String::from_utf8_lossy(&output.stderr).trim().to_owned()) }
}

impl Network {
    /// The network; `None` where this machine does not allow it, which is told.
    fn new(test: u8) -> Option<Self> {
        match Self::open(test) {
            Ok(network) => Some(network),
            Err(why) => {
                assert!(std::env::var("JIGSAW_NETWORK").as_deref() != Ok("required"), "no network to test in: {why}");
                // Not by a macro: what a test prints is shown only where it fails.
                let _ = writeln!(std::io::stderr(), "skipped: no network to test in: {why}");
                None
            }
        }
    }

    fn open(test: u8) -> Result<Self, String> {
        let run = std::process::id() % 10_000;
        let ports: Vec<String> = (0..4).map(|k| format!("jig{run}-{test}{k}")).collect();
        let mut relay = Command::new("python3")
            .arg(root().join("tests/faults/relay.py"))
            .args(&ports)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .map_err(|e| format!("python3: {e}"))?;
        let orders = relay.stdin.take().ok_or("no standard input")?;
        let answers = BufReader::new(relay.stdout.take().ok_or("no standard output")?);
        let mut network = Self { relay, orders, answers, ports, subnet: (10 * (run % 24)) as u8 + test };
        network.answer().map_err(|_| "tap devices can't be made (root and /dev/net/tun are needed)".to_owned())?;
        for host in [CAPTURE, FEATURE, SOLVER] {
            let name = &network.ports[host];
            ip(&format!("netns add {name}"))?;
            ip(&format!("link set {name} netns {name}"))?;
            ip(&format!("-n {name} addr add {}/24 dev {name}", network.address(host)))?;
            ip(&format!("-n {name} link set {name} up"))?;
            ip(&format!("-n {name} link set lo up"))?;
        }
        let name = &network.ports[HERE];
        ip(&format!("addr add {}/24 dev {name}", network.address(HERE)))?;
        ip(&format!("link set {name} up"))?;
        // The witness hears everything.
        let here = name.clone();
        network.order(&format!("clean {here}"));
        Ok(network)
    }

    fn answer(&mut self) -> std::io::Result<()> {
        let mut line = String::new();
        match self.answers.read_line(&mut line)? {
            0 => Err(std::io::ErrorKind::UnexpectedEof.into()),
            _ => Ok(()),
        }
    }

    /// Tells the relay what to do from now on.
    fn order(&mut self, order: &str) {
        writeln!(self.orders, "{order}").unwrap();
        self.answer().unwrap();
    }

    fn address(&self, host: usize) -> Ipv4Addr {
        Ipv4Addr::new(10, 77, self.subnet, host as u8 + 1)
    }

    /// A command on a host.
    fn on(&self, host: usize, program: &Path) -> Command {
        let mut command = Command::new("ip");
        command.args(["netns", "exec", &self.ports[host]]).arg(program).env_remove("ROS_LOCALHOST_ONLY");
        command
    }
}

impl Drop for Network {
    fn drop(&mut self) {
        let _ = self.relay.kill();
        let _ = self.relay.wait();
        for host in [CAPTURE, FEATURE, SOLVER] {
            let _ = ip(&format!("netns del {}", self.ports[host]));
        }
    }
}

/// What becomes of feature nodes that have ended.
#[derive(Clone, Copy)]
enum Ended {
    StayAway,
    StartAgain,
}

/// The nodes on their hosts.
struct Spread {
    _capture: Cell,
    features: [Cell; 2],
    _solver: Cell,
    witness: Witness,
    environment: Vec<(&'static str, String)>,
    truth: Truth,
}

impl Spread {
    fn start(network: &Network, folder: &Path, environment: &[(&'static str, String)], feature_nodes: Ended) -> Self {
        let domain = domain::free();
        let mut environment = environment.to_vec();
        environment.push(("ROS_DOMAIN_ID", domain.to_string()));
        let node = |host: usize, name: &str, log: &str, args: &[&str]| {
            let mut environment = environment.clone();
            environment.push(("NODES", name.to_owned()));
            let args = [&["--ros-args"], args].concat();
            Cell::start_by(network.on(host, &script()), folder.join(log), &environment, &args)
        };
        let truth = Truth::of(&bag24());
        let expected = format!("solver_node:expected_pieces:={}", truth.pieces());
        // Which interface is used is a parameter.
        let interfaces = format!("network_interfaces:=[127.0.0.1, {}]", network.address(CAPTURE));
        let solver = node(SOLVER, "solver_node", "solver.log", &["-p", &expected]);
        let feature = |name: &str| {
            let (log, renamed) = (format!("{name}.log"), format!("__node:={name}"));
            let args = ["-p", "share:=true", "-r", &renamed];
            match feature_nodes {
                Ended::StartAgain => node(FEATURE, "feature_node", &log, &args),
                // Without the script.
                Ended::StayAway => {
                    let command = network.on(FEATURE, &binaries().join("feature_node"));
                    Cell::start_by(command, folder.join(log), &environment, &[&["--ros-args"], &args[..]].concat())
                }
            }
        };
        let features = FEATURES.map(feature);
        let capture = node(CAPTURE, "capture_node", "capture.log", &["-p", &interfaces]);
        let hosts = [CAPTURE, FEATURE, SOLVER].map(|host| network.address(host));
        let witness = Witness::at(domain, network.address(HERE), hosts.to_vec());
        Self { _capture: capture, features, _solver: solver, witness, environment, truth }
    }

    /// At a rate above 0 the camera waits for nobody: its first frames are lost unless it shows them again.
    fn play(&self, network: &Network, args: &[&str]) -> Running {
        let mut command = network.on(CAPTURE, &binaries().join("jigsaw"));
        command.args(["bag", "play"]).args(args).arg(bag24());
        let environment = self.environment.iter().map(|(name, value)| (*name, value.as_str()));
        Running(command.envs(environment).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap())
    }

    fn solved(&self) -> Assembly {
        let assembly = self.witness.until("complete assembly", |heard| heard.complete(self.truth.pieces()));
        self.witness.with(|heard| {
            for (_, assembly) in &heard.assemblies {
                assert_eq!(self.truth.check(assembly), Ok(()));
            }
        });
        assembly
    }

    /// Waits until each feature node has done some of its share.
    fn shared(&self) {
        self.witness.until("work of both feature nodes", |heard| {
            FEATURES.iter().all(|name| heard.published.get(*name).is_some_and(|&count| count > 0)).then_some(())
        });
    }
}

/// A line of the operators' table.
fn tell(what: &str, begun: Instant) {
    println!("| {what} | 24 of 24 | {:.1} s |", begun.elapsed().as_secs_f64());
}

/// Solves under these orders to the relay.
fn solve_under(test: u8, orders: &[&str]) {
    let Some(mut network) = Network::new(test) else { return };
    let folder = Folder::new(&format!("network-{test}"));
    orders.iter().for_each(|order| network.order(order));
    let spread = Spread::start(&network, &folder.0, &[], Ended::StayAway);
    let begun = Instant::now();
    let _camera = spread.play(&network, &["--rate", "0"]);
    spread.solved();
    tell(&orders.join(", "), begun);
}

/// One of two feature nodes gets this signal while the bag plays: the other one takes its share over.
fn solve_without(lost: Signal, test: u8, orders: &[&str], is_static: bool) {
    let Some(mut network) = Network::new(test) else { return };
    let folder = Folder::new(&format!("network-{test}"));
    orders.iter().for_each(|order| network.order(order));
    let peers = [CAPTURE, FEATURE, SOLVER, HERE].map(|host| network.address(host).to_string()).join(";");
    let environment = if is_static { vec![("ROS_STATIC_PEERS", peers)] } else { Vec::new() };
    let spread = Spread::start(&network, &folder.0, &environment, Ended::StayAway);
    // Slowly: when the two are seen to share, there must be pieces left to take over.
    let _camera = spread.play(&network, &["--loop", "--rate", "0.4"]);
    spread.shared();
    let pid = spread.features[1].pid("feature_node");
    assert!(signal(pid, lost));
    let begun = Instant::now();
    spread.solved();
    assert!(spread.features[0].log().contains("taken over"), "the other feature node has taken nothing over");
    signal(pid, Signal::SIGKILL);
    tell(&format!("{}, a feature node gets {lost}", orders.join(", ")), begun);
}

#[test]
fn a_feature_node_that_dies_leaves_its_share_to_the_other() {
    solve_without(Signal::SIGKILL, 0, &[], false);
}

#[test]
fn without_multicast_with_loss_and_delay_and_a_feature_node_that_falls_silent() {
    solve_without(Signal::SIGSTOP, 1, &["multicast off", "loss 0.05", "delay 0.001 0.005"], true);
}

#[test]
fn loss_of_1_percent() {
    solve_under(2, &["loss 0.01"]);
}

#[test]
fn loss_of_5_percent() {
    solve_under(3, &["loss 0.05"]);
}

#[test]
fn loss_of_10_percent() {
    solve_under(4, &["loss 0.1"]);
}

#[test]
fn frames_that_are_late_and_overtake_one_another() {
    solve_under(5, &["delay 0.02 0.08"]);
}

/// The link of the feature nodes is cut for a time while the bag plays over and over.
fn solve_after_a_cut(test: u8, cut: Duration, is_static: bool) {
    let Some(mut network) = Network::new(test) else { return };
    let folder = Folder::new(&format!("network-{test}"));
    let peers = [CAPTURE, FEATURE, SOLVER, HERE].map(|host| network.address(host).to_string()).join(";");
    let environment = if is_static { vec![("ROS_STATIC_PEERS", peers)] } else { Vec::new() };
    if is_static {
        network.order("multicast off");
    }
    let spread = Spread::start(&network, &folder.0, &environment, Ended::StartAgain);
    let _camera = spread.play(&network, &["--loop", "--rate", "1"]);
    spread.shared();
    let feature = network.ports[FEATURE].clone();
    network.order(&format!("cut {feature}"));
    // The one wait that is no event.
    std::thread::sleep(cut);
    network.order(&format!("mend {feature}"));
    let begun = Instant::now();
    spread.solved();
    let multicast = if is_static { ", no multicast" } else { "" };
    tell(&format!("the link of the feature nodes cut for {} s{multicast}", cut.as_secs()), begun);
}

#[test]
fn a_link_that_is_cut_for_10_s() {
    solve_after_a_cut(6, CUT, false);
}

#[test]
#[ignore = "takes 80 s; run before the figures of docs/operators.md are changed"]
fn a_link_that_is_cut_until_the_nodes_have_forgotten_each_other() {
    solve_after_a_cut(7, LONG_CUT, false);
}

#[test]
#[ignore = "takes 80 s; run before the figures of docs/operators.md are changed"]
fn the_same_without_multicast() {
    solve_after_a_cut(8, LONG_CUT, true);
}
