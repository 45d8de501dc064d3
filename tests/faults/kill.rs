//! Nodes that are killed, stopped for 12 s and ended, at random points while a bag plays: in the end the assembly is that
//! of a run without faults, and nothing wrong was said in between.

use std::collections::BTreeMap;
use std::fmt;
use std::path::Path;
use std::process::Stdio;
use std::time::{Duration, Instant};

use jigsaw_msgs::msg::Assembly;
use nix::sys::signal::Signal;
use rand::seq::{IndexedRandom, IteratorRandom};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::cell::{
    self, Cell, Folder, NODES, Running, Truth, Witness, bag24, difference, eventually, is_stopped, jigsaw, runs, signal,
};
use crate::domain;

/// How long a node is stopped: longer than any timeout between the nodes that is not there for dead hosts.
const STOP: Duration = Duration::from_secs(12);

/// How long a stopped node is left to find out that it is deaf.
const DEAF: Duration = Duration::from_secs(2);

/// Longest time between two faults.
const LONGEST_PAUSE: Duration = Duration::from_millis(1500);

/// Faults of a run, unless the environment says otherwise.
const FEW: usize = 7;

/// Speed at which bags are played: 24 pieces in 1.2 s, so that several faults fall into one showing and several
/// showings between two faults.
const RATE: &str = "4";

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Fault {
    Killed,
    Ended,
    Stopped,
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Killed => "killed (SIGKILL)",
            Self::Ended => "ended (SIGTERM)",
            Self::Stopped => "stopped for 12 s",
        })
    }
}

/// Which nodes a fault strikes, and how.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
struct Strike {
    nodes: Vec<&'static str>,
    fault: Fault,
}

/// What came of the faults.
#[derive(Default)]
struct Table(BTreeMap<Strike, Vec<Duration>>);

impl Table {
    fn print(&self, what: &str) {
        println!("{what}\n| fault | nodes | times | until all report again, longest |\n| --- | --- | --- | --- |");
        for (Strike { nodes, fault }, times) in &self.0 {
            let longest = times.iter().max().map_or(0.0, Duration::as_secs_f64);
            println!("| {fault} | {} | {} | {longest:.1} s |", nodes.join(", "), times.len());
        }
    }
}

fn environment_number(name: &str, default: usize) -> usize {
    std::env::var(name).map_or(default, |text| text.parse().unwrap())
}

/// The faults of a run: mostly single nodes, sometimes two or all, each kind in turn at least once.
fn plan(count: usize, seed: u64) -> Vec<(Strike, Duration)> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    (0..count)
        .map(|k| {
            let fault = match k % 7 {
                3 => Fault::Stopped,
                1 | 5 => Fault::Ended,
                _ => Fault::Killed,
            };
            let struck = *[1, 1, 1, 2, 3].choose(&mut random).unwrap();
            let mut nodes = NODES.into_iter().sample(&mut random, struck);
            nodes.sort_unstable();
            (Strike { nodes, fault }, LONGEST_PAUSE.mul_f64(random.random_range(0.03..1.0)))
        })
        .collect()
}

/// Does it, and waits until the nodes report again; how long that took.
fn strike(cell: &Cell, witness: &Witness, strike: &Strike) -> Duration {
    let pids: Vec<i32> = strike.nodes.iter().map(|node| cell.pid(node)).collect();
    let send = |s: Signal| pids.iter().for_each(|&pid| _ = signal(pid, s));
    match strike.fault {
        Fault::Killed => send(Signal::SIGKILL),
        Fault::Ended => send(Signal::SIGTERM),
        Fault::Stopped => {
            send(Signal::SIGSTOP);
            std::thread::sleep(STOP);
            send(Signal::SIGCONT);
        }
    }
    let begun = Instant::now();
    for (&pid, node) in pids.iter().zip(&strike.nodes) {
        if strike.fault == Fault::Stopped {
            // It may have been lucky: none of its threads was waiting. Then it must still talk.
            while runs(pid) && begun.elapsed() < DEAF {
                std::thread::sleep(cell::LOOK);
            }
        } else {
            eventually(&format!("end of {node} after {strike:?}"), || (!runs(pid)).then_some(()));
        }
    }
    for node in &strike.nodes {
        let since = if strike.fault == Fault::Stopped { begun + DEAF } else { begun };
        witness.until(&format!("report of {node} after {strike:?}"), |heard| {
            heard.reports.get(*node).filter(|&&at| at > since).map(|_| ())
        });
    }
    begun.elapsed()
}

fn environment(domain: u16) -> Vec<(&'static str, String)> {
    vec![("ROS_DOMAIN_ID", domain.to_string()), ("ROS_LOCALHOST_ONLY", "1".to_owned())]
}

fn play(bag: &Path, domain: u16) -> Running {
    let mut command = jigsaw();
    command.args(["bag", "play", "--loop", "--rate", RATE]).arg(bag);
    Running(command.envs(environment(domain)).stderr(Stdio::null()).spawn().unwrap())
}

fn args(pieces: usize) -> Vec<String> {
    vec!["--ros-args".to_owned(), "-p".to_owned(), format!("solver_node:expected_pieces:={pieces}")]
}

fn check_all(heard: &cell::Heard, truth: &Truth) {
    for (at, assembly) in &heard.assemblies {
        if let Err(error) = truth.check(assembly) {
            panic!("assembly of {} pieces, {:?} ago: {error}", assembly.pieces.len(), at.elapsed());
        }
    }
}

/// A run without faults: what it comes to.
fn calm(folder: &Path, bag: &Path, truth: &Truth, domain: u16) -> Assembly {
    let args = args(truth.pieces());
    let args: Vec<&str> = args.iter().map(String::as_str).collect();
    let _cell = Cell::start(folder, &environment(domain), &args);
    let witness = Witness::new(domain);
    let _camera = play(bag, domain);
    let calm = witness.until("complete assembly without faults", |heard| heard.complete(truth.pieces()));
    witness.with(|heard| check_all(heard, truth));
    calm
}

/// A run with faults.
fn survive(bag: &Path, faults: usize, seed: u64) {
    let domain = domain::free();
    let folder = Folder::new(&format!("kill-{domain}"));
    let truth = Truth::of(bag);
    let calm = calm(&folder.0, bag, &truth, domain);

    let args = args(truth.pieces());
    let args: Vec<&str> = args.iter().map(String::as_str).collect();
    let cell = Cell::start(&folder.0, &environment(domain), &args);
    let witness = Witness::new(domain);
    let camera = play(bag, domain);
    let mut table = Table::default();
    for (plan, pause) in plan(faults, seed) {
        // The one wait that is no event: faults come at any time.
        std::thread::sleep(pause);
        let time = strike(&cell, &witness, &plan);
        table.0.entry(plan).or_default().push(time);
    }
    let stormy = witness.until("complete assembly after the faults", |heard| heard.complete(truth.pieces()));
    assert_eq!(difference(&calm, &stormy), None);
    drop(camera);

    // The camera has gone. Nothing is lost all the same, also for who listens later.
    for nodes in NODES.map(|node| vec![node]).into_iter().chain([NODES.to_vec()]) {
        strike(&cell, &witness, &Strike { nodes: nodes.clone(), fault: Fault::Killed });
        let late = Witness::new(domain);
        let again = late
            .until(&format!("complete assembly after the end of {nodes:?}"), |heard| heard.complete(truth.pieces()));
        assert_eq!(difference(&calm, &again), None);
    }
    witness.with(|heard| {
        check_all(heard, &truth);
        for piece in &calm.pieces {
            assert!(heard.goals.contains_key(&format!("piece_{}_goal", piece.id)), "no transform of {}", piece.id);
        }
    });
    let said = witness.with(|heard| heard.assemblies.len());
    table.print(&format!(
        "{} pieces, {faults} faults, seed {seed}: the same assembly, {said} assemblies on the way, none wrong",
        truth.pieces()
    ));
}

#[test]
fn the_assembly_of_24_pieces_survives() {
    let seed = environment_number("JIGSAW_FAULTS_SEED", 1);
    survive(&bag24(), environment_number("JIGSAW_FAULTS", FEW), seed as u64);
}

#[test]
fn the_assembly_of_96_pieces_survives() {
    let Ok(faults) = std::env::var("JIGSAW_FAULTS") else {
        println!("skipped: set JIGSAW_FAULTS to a number of faults");
        return;
    };
    let folder = Folder::new("bag96");
    let bag = folder.0.join("puzzle96");
    let mut command = jigsaw();
    command.args(
        "generate --rows 8 --cols 12 --seed 96 --frame 400x400 --noise 0.5 --blur 0.8 --clearance 0.5 --bag".split(' '),
    );
    assert!(command.arg("--out").arg(&bag).status().unwrap().success());
    let seed = environment_number("JIGSAW_FAULTS_SEED", 1) as u64;
    survive(&bag, faults.parse().unwrap(), seed + 1);
}

#[test]
fn a_node_that_was_stopped_is_replaced() {
    let folder = Folder::new("stopped");
    let domain = domain::free();
    let cell = Cell::start(&folder.0, &environment(domain), &[]);
    let witness = Witness::new(domain);
    for node in NODES {
        witness.until(&format!("report of {node}"), |heard| heard.reports.get(node).map(|_| ()));
        let pid = cell.pid(node);
        let mut begun = Instant::now() - DEAF;
        eventually("end of the deaf node", || {
            // It may have been lucky: none of its threads was waiting. Then it is stopped once more.
            if runs(pid) && begun.elapsed() >= DEAF {
                signal(pid, Signal::SIGSTOP);
                eventually("stop", || is_stopped(pid).then_some(()));
                signal(pid, Signal::SIGCONT);
                begun = Instant::now();
            }
            (!runs(pid)).then_some(())
        });
        let next = cell.pid(node);
        assert_ne!(pid, next);
        witness.until(&format!("report of the next {node}"), |heard| {
            heard.reports.get(node).filter(|&&at| at > begun).map(|_| ())
        });
    }
    assert!(cell.log().contains("gone deaf"));
}
