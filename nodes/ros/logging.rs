//! Log lines: to the console as ROS prints them, and to `/rosout`.
//!
//! The levels come from `--log-level`, or from `RUST_LOG` where that is set. Lines of the middleware's own libraries are
//! off unless `RUST_LOG` asks for them: they report the orderly end of a node as errors.

use std::collections::HashMap;
use std::io::Write;
use std::sync::{Mutex, OnceLock, PoisonError};
use std::time::{Duration, Instant};

use log::{Level, LevelFilter, Log, Metadata, Record};
use ros2_client::builtin_interfaces::Time;
use ros2_client::ros2::LogLevel;
use ros2_client::{NodeLoggingHandle, RosoutRaw};

use super::args::RosArgs;

const NANOS: i64 = 1_000_000_000;

/// Where this crate's log lines come from, by module path.
const OWN_TARGET: &str = "jigsaw";

static LOGGER: OnceLock<Logger> = OnceLock::new();

struct Logger {
    console: Option<env_logger::Logger>,
    level: LevelFilter,
    rosout: bool,
    nodes: Mutex<Vec<(String, NodeLoggingHandle)>>,
}

impl Log for Logger {
    fn enabled(&self, metadata: &Metadata<'_>) -> bool {
        self.console.as_ref().is_some_and(|console| console.enabled(metadata)) || self.to_rosout(metadata)
    }

    fn log(&self, record: &Record<'_>) {
        if let Some(console) = &self.console {
            console.log(record);
        }
        if self.to_rosout(record.metadata()) {
            let nodes = self.nodes.lock().unwrap_or_else(PoisonError::into_inner);
            // A line of the module `…::capture` belongs to the node that registered as `capture_node`.
            let node = nodes.iter().find(|(module, _)| record.target().split("::").any(|part| part == module));
            if let Some((_, handle)) = node.or(nodes.first()) {
                handle.rosout_raw(
                    Time::now(),
                    rosout_level(record.level()),
                    handle.base_name(),
                    &record.args().to_string(),
                    record.file().unwrap_or_default(),
                    "",
                    record.line().unwrap_or_default(),
                );
            }
        }
    }

    fn flush(&self) {}
}

impl Logger {
    fn to_rosout(&self, metadata: &Metadata<'_>) -> bool {
        self.rosout && metadata.target().starts_with(OWN_TARGET) && metadata.level() <= self.level
    }
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
        let mut builder = env_logger::Builder::new();
        match std::env::var("RUST_LOG") {
            Ok(filters) if args.log_level.is_none() => builder.parse_filters(&filters),
            _ => builder.filter_level(LevelFilter::Off).filter_module(OWN_TARGET, level),
        };
        for (logger, level) in &args.logger_levels {
            builder.filter_module(logger, *level);
        }
        let program = program.to_owned();
        builder.format(move |out, record| {
            let nanos = Time::now().to_nanos();
            let (sec, nanosec) = (nanos.div_euclid(NANOS), nanos.rem_euclid(NANOS));
            writeln!(out, "[{}] [{sec}.{nanosec:09}] [{program}]: {}", record.level(), record.args())
        });
        Logger {
            console: args.console.then(|| builder.build()),
            level,
            rosout: args.rosout,
            nodes: Mutex::new(Vec::new()),
        }
    });
    let most = logger.console.as_ref().map_or(LevelFilter::Off, env_logger::Logger::filter).max(level);
    if log::set_logger(logger).is_ok() {
        log::set_max_level(most);
    }
}

/// Sends the log lines of a node (those of the module it is named after) to `/rosout`.
pub fn add_node(name: &str, handle: NodeLoggingHandle) {
    if let Some(logger) = LOGGER.get() {
        let module = name.trim_end_matches("_node").to_owned();
        logger.nodes.lock().unwrap_or_else(PoisonError::into_inner).push((module, handle));
    }
}

/// Stops sending to `/rosout`: the nodes are about to go.
pub fn remove_nodes() {
    if let Some(logger) = LOGGER.get() {
        logger.nodes.lock().unwrap_or_else(PoisonError::into_inner).clear();
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
