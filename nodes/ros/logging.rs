//! Log lines: to the console as ROS prints them, and to `/rosout`.
//!
//! The levels come from `--log-level`, or from `RUST_LOG` where that is set. `--log-level NAME:=LEVEL` is for one logger:
//! that of a node, of the nodes of a namespace, or of a library by its module path. Lines of the middleware's own libraries
//! are off unless they are asked for: they report the orderly end of a node as errors.

use std::collections::HashMap;
use std::io::Write;
use std::sync::{Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::{Duration, Instant};

use log::{Level, LevelFilter, Log, Metadata, Record};
use ros2_client::builtin_interfaces::Time;
use ros2_client::ros2::LogLevel;
use ros2_client::{NodeLoggingHandle, RosoutRaw};

use super::arguments::RosArgs;
use super::arguments::names::NodeNames;

const NANOS: i64 = 1_000_000_000;

/// Where this crate's log lines come from, by module path.
const OWN_TARGET: &str = "jigsaw";

static LOGGER: OnceLock<Logger> = OnceLock::new();

struct Logger {
    console: Option<env_logger::Logger>,
    /// What of other crates, and of this one under `RUST_LOG`, goes to the console.
    filter: env_filter::Filter,
    /// The level that was asked for, of a node that no other was asked for.
    level: LevelFilter,
    /// The levels that were asked for by name.
    levels: Vec<(String, LevelFilter)>,
    rosout: bool,
    nodes: Mutex<Vec<NodeLogger>>,
}

/// The lines of a node: those of the module it is named after, or all of them where it is alone.
struct NodeLogger {
    /// As in ROS: the full name of the node, with dots.
    name: String,
    module: String,
    /// Asked for by name.
    level: Option<LevelFilter>,
    rosout: Option<NodeLoggingHandle>,
}

impl Log for Logger {
    fn enabled(&self, metadata: &Metadata<'_>) -> bool {
        if is_own(metadata) {
            let level = asked_for(&self.nodes(), metadata);
            self.to_console(level, metadata) || self.to_rosout(level, metadata)
        } else {
            self.to_console(None, metadata)
        }
    }

    fn log(&self, record: &Record<'_>) {
        // The middleware's lines, which writing to `/rosout` below may bring about, find the nodes locked.
        let nodes = is_own(record.metadata()).then(|| self.nodes());
        let nodes = nodes.as_ref().map_or(&[][..], |nodes| nodes.as_slice());
        let level = asked_for(nodes, record.metadata());
        if self.to_console(level, record.metadata())
            && let Some(console) = &self.console
        {
            console.log(record);
        }
        if self.to_rosout(level, record.metadata())
            && let Some(node) = node_of(nodes, record.target()).or(nodes.first())
            && let Some(handle) = &node.rosout
        {
            handle.rosout_raw(
                Time::now(),
                rosout_level(record.level()),
                &node.name,
                &record.args().to_string(),
                record.file().unwrap_or_default(),
                "",
                record.line().unwrap_or_default(),
            );
        }
    }

    fn flush(&self) {}
}

/// Whether a line is this crate's.
fn is_own(metadata: &Metadata<'_>) -> bool {
    metadata.target().starts_with(OWN_TARGET)
}

/// The node that a line belongs to.
fn node_of<'a>(nodes: &'a [NodeLogger], target: &str) -> Option<&'a NodeLogger> {
    match nodes {
        [only] => Some(only),
        _ => nodes.iter().find(|node| target.split("::").any(|part| part == node.module)),
    }
}

/// The level that was asked for by the name of the node that a line belongs to.
fn asked_for(nodes: &[NodeLogger], metadata: &Metadata<'_>) -> Option<LevelFilter> {
    node_of(nodes, metadata.target()).and_then(|node| node.level)
}

impl Logger {
    fn nodes(&self) -> MutexGuard<'_, Vec<NodeLogger>> {
        self.nodes.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn to_console(&self, asked_for: Option<LevelFilter>, metadata: &Metadata<'_>) -> bool {
        self.console.is_some()
            && asked_for.map_or_else(|| self.filter.enabled(metadata), |level| metadata.level() <= level)
    }

    fn to_rosout(&self, asked_for: Option<LevelFilter>, metadata: &Metadata<'_>) -> bool {
        self.rosout && is_own(metadata) && metadata.level() <= asked_for.unwrap_or(self.level)
    }
}

/// The name of a node's logger.
fn logger_name(names: &NodeNames) -> String {
    names.full_name().trim_start_matches('/').replace('/', ".")
}

/// The level that was asked for by one of the names of a node's logger: as in ROS the full name, with dots, or the
/// beginning of it; its own name without the namespace, and that of its module. The longest of them counts, and of equal
/// ones the last.
fn level_of(levels: &[(String, LevelFilter)], names: &NodeNames, module: &str) -> Option<LevelFilter> {
    let full_name = logger_name(names);
    let names_it = |name: &str| {
        let begins = full_name.strip_prefix(name).is_some_and(|rest| rest.is_empty() || rest.starts_with('.'));
        begins || name == names.name() || name == module
    };
    levels.iter().filter(|(name, _)| names_it(name)).max_by_key(|(name, _)| name.len()).map(|(_, level)| *level)
}

fn rosout_level(level: Level) -> LogLevel {
    match level {
        Level::Error => LogLevel::Error,
        Level::Warn => LogLevel::Warn,
        Level::Info => LogLevel::Info,
        Level::Debug | Level::Trace => LogLevel::Debug,
    }
}

/// Starts logging for a process; later calls change nothing.
pub fn start(program: &str, args: &RosArgs) {
    let level = args.log_level.unwrap_or(LevelFilter::Info);
    let logger = LOGGER.get_or_init(|| {
        let mut filter = env_filter::Builder::new();
        match std::env::var("RUST_LOG") {
            Ok(filters) if args.log_level.is_none() => filter.parse(&filters),
            _ => filter.filter_level(LevelFilter::Off).filter_module(OWN_TARGET, level),
        };
        for (logger, level) in &args.logger_levels {
            filter.filter_module(logger, *level);
        }
        // What is written was let through before.
        let mut console = env_logger::Builder::new();
        console.filter_level(LevelFilter::Trace);
        let program = program.to_owned();
        console.format(move |out, record| {
            let nanos = Time::now().to_nanos();
            let (sec, nanosec) = (nanos.div_euclid(NANOS), nanos.rem_euclid(NANOS));
            writeln!(out, "[{}] [{sec}.{nanosec:09}] [{program}]: {}", record.level(), record.args())
        });
        Logger {
            console: args.console.then(|| console.build()),
            filter: filter.build(),
            level,
            levels: args.logger_levels.clone(),
            rosout: args.rosout,
            nodes: Mutex::new(Vec::new()),
        }
    });
    let by_name = logger.levels.iter().map(|(_, level)| *level).max().unwrap_or(LevelFilter::Off);
    if log::set_logger(logger).is_ok() {
        log::set_max_level(logger.filter.filter().max(level).max(by_name));
    }
}

/// Makes the log lines of a node (those of the module that `program` names) its own, at the level that was asked for by
/// its name.
pub fn add_node(program: &str, names: &NodeNames) {
    if let Some(logger) = LOGGER.get() {
        let module = program.trim_end_matches("_node").to_owned();
        let level = level_of(&logger.levels, names, &module);
        logger.nodes().push(NodeLogger { name: logger_name(names), module, level, rosout: None });
    }
}

/// Sends the log lines of the node that was added last to `/rosout`.
pub fn open_rosout(handle: NodeLoggingHandle) {
    if let Some(logger) = LOGGER.get()
        && let Some(node) = logger.nodes().last_mut()
    {
        node.rosout = Some(handle);
    }
}

/// Stops sending to `/rosout`: the nodes are about to go.
pub fn remove_nodes() {
    if let Some(logger) = LOGGER.get() {
        logger.nodes().iter_mut().for_each(|node| node.rosout = None);
    }
}

/// Lets one line of a kind pass in a while, so that a flood of bad input doesn't become a flood of log lines.
#[derive(Debug)]
pub struct Throttle {
    period: Duration,
    last: HashMap<String, (Instant, u64)>,
}

impl Default for Throttle {
    /// One line of a kind every five seconds: often enough to see that something still goes on.
    fn default() -> Self {
        Self::new(Duration::from_secs(5))
    }
}

impl Throttle {
    /// Most kinds that are told apart; further ones are taken for one kind, so that memory stays bounded.
    const MOST_KINDS: usize = 64;

    /// A throttle that lets one line of a kind pass in this time.
    pub fn new(period: Duration) -> Self {
        Self { period, last: HashMap::new() }
    }

    /// Whether a line of this kind may pass now; if so, how many were held back since the last.
    pub fn pass(&mut self, kind: &str, now: Instant) -> Option<u64> {
        let kind = if self.last.len() >= Self::MOST_KINDS && !self.last.contains_key(kind) { "" } else { kind };
        match self.last.get_mut(kind) {
            Some((last, held_back)) if now.duration_since(*last) < self.period => {
                *held_back += 1;
                None
            }
            Some((last, held_back)) => {
                *last = now;
                Some(std::mem::take(held_back))
            }
            None => {
                self.last.insert(kind.to_owned(), (now, 0));
                Some(0)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_level_is_asked_for_by_the_names_of_a_node() {
        let level = |asked: &[&str]| {
            let args = asked.iter().flat_map(|asked| ["--log-level", asked]);
            let args = RosArgs::parse(["--ros-args", "-r", "__ns:=/lab/east"].into_iter().chain(args)).unwrap();
            level_of(&args.logger_levels, &args.node("/", "solver_node").unwrap(), "solver")
        };
        use LevelFilter::{Debug, Error, Warn};
        for name in ["lab.east.solver_node", "lab.east", "lab", "solver_node", "solver"] {
            assert_eq!(level(&[&format!("{name}:=debug")]), Some(Debug), "{name}");
        }
        for name in ["lab.east.solver", "la", "east", "capture_node", "solver_nod", "/lab/east"] {
            assert_eq!(level(&[&format!("{name}:=debug")]), None, "{name}");
        }
        assert_eq!(level(&["lab.east:=warn", "lab:=debug"]), Some(Warn), "the longest name");
        assert_eq!(level(&["lab:=warn", "lab:=error"]), Some(Error), "the last of equal ones");
        assert_eq!(level(&["debug"]), None);
    }

    #[test]
    fn one_line_of_a_kind_in_a_period() {
        let mut throttle = Throttle::new(Duration::from_secs(5));
        let start = Instant::now();
        let at = |seconds| start + Duration::from_secs(seconds);
        assert_eq!(throttle.pass("a", at(0)), Some(0));
        assert_eq!(throttle.pass("a", at(1)), None);
        assert_eq!(throttle.pass("b", at(1)), Some(0));
        assert_eq!(throttle.pass("a", at(4)), None);
        assert_eq!(throttle.pass("a", at(6)), Some(2));
        assert_eq!(throttle.pass("a", at(12)), Some(0));
    }

    #[test]
    fn kinds_without_end_take_no_memory_without_end() {
        let mut throttle = Throttle::default();
        let now = Instant::now();
        let passed = (0..10_000).filter(|i| throttle.pass(&i.to_string(), now).is_some()).count();
        assert_eq!(passed, Throttle::MOST_KINDS + 1);
        assert!(throttle.last.len() <= Throttle::MOST_KINDS + 1);
    }
}
