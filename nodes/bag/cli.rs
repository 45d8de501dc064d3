//! `jigsaw bag info | play | record`.

use std::cell::Cell;
use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;
use std::rc::Rc;
use std::time::Duration;

use clap::{Args, Subcommand, ValueEnum};
use indicatif::{ProgressBar, ProgressStyle};
use serde_json::json;

use super::play::{PlayEvent, PlayOptions, play};
use super::qos::{Durability, QosProfile, Reliability};
use super::record::{RecordError, RecordEvent, RecordOptions, RequestedTopic, record};
use super::{BagReader, BagWriter, Compression, Storage, WriterOptions};
use crate::console::{complain, say};
use crate::ros::exit::{ProcessError, exit_code};
use crate::ros::process::Process;

/// Exit code for bad input.
const BAD_INPUT: u8 = 2;

/// Read, play and record rosbag2 bags (MCAP and sqlite3).
#[derive(Debug, Subcommand)]
pub enum BagCommand {
    /// Show what a bag holds.
    Info(InfoArgs),
    /// Publish the messages of a bag over DDS.
    #[command(after_help = PLAY_HELP)]
    Play(PlayArgs),
    /// Record topics from DDS into a new bag; Ctrl-C ends it.
    #[command(after_help = RECORD_HELP)]
    Record(RecordArgs),
}

const PLAY_HELP: &str = "\
At --rate 0 every message is sent as soon as those before it have arrived: acknowledged by reliable subscriptions, taken
from the sockets of this host for best-effort ones. Each topic must have a subscription before the first message.

Examples:
  jigsaw bag play bags/puzzle24 --rate 0
  jigsaw bag play run1 --topics /image/compressed --remap /image/compressed:=/camera/compressed --clock";

const RECORD_HELP: &str = "\
Types need not be known: discovery tells them. Name one as TOPIC:TYPE to subscribe before a publisher is there.

Examples:
  jigsaw bag record run1 --topics /image/compressed /assembly
  jigsaw bag record run2 --all --duration 30 --storage sqlite3";

/// Arguments of `jigsaw bag info`.
#[derive(Debug, Args)]
pub struct InfoArgs {
    /// Bag folder, or a single .mcap or .db3 file.
    bag: PathBuf,
    /// Print JSON instead of a table.
    #[arg(long)]
    json: bool,
}

/// Arguments of `jigsaw bag play`.
#[derive(Debug, Args)]
pub struct PlayArgs {
    /// Bag folder, or a single .mcap or .db3 file.
    bag: PathBuf,
    /// Speed relative to the recording; 0: as fast as possible without losing a message.
    #[arg(long, short, default_value_t = 1.0, value_parser = rate)]
    rate: f64,
    /// Publish the time of the recording on /clock, this often [Hz]; at --rate 0 before each message.
    #[arg(long, value_name = "HZ", num_args = 0..=1, default_missing_value = "40", value_parser = hertz)]
    clock: Option<f64>,
    /// Begin anew after the last message, until Ctrl-C.
    #[arg(long = "loop", short)]
    looped: bool,
    /// Play these topics only.
    #[arg(long, num_args = 1.., value_name = "TOPIC")]
    topics: Option<Vec<String>>,
    /// Publish a topic under another name.
    #[arg(long, short = 'm', num_args = 1.., value_name = "FROM:=TO")]
    remap: Vec<String>,
    /// Wait until each topic has this many subscriptions [default: 1 at --rate 0, else 0].
    #[arg(long, value_name = "N", num_args = 0..=1, default_missing_value = "1")]
    wait_for_subscribers: Option<usize>,
    /// Begin this long after the first message [s].
    #[arg(long, value_name = "SECONDS", default_value = "0", value_parser = seconds)]
    start_offset: Duration,
    #[command(flatten)]
    ros: RosArguments,
}

/// Arguments of `jigsaw bag record`.
#[derive(Debug, Args)]
pub struct RecordArgs {
    /// Folder of the new bag; must not exist.
    bag: PathBuf,
    /// Topics to record, as NAME or NAME:TYPE.
    #[arg(long, num_args = 1.., value_name = "TOPIC[:TYPE]", value_parser = requested, required_unless_present = "all")]
    topics: Vec<RequestedTopic>,
    /// Record every topic that is published, except hidden ones.
    #[arg(long, short, conflicts_with = "topics")]
    all: bool,
    /// Storage format.
    #[arg(long, short, value_enum, default_value_t = StorageName::Mcap)]
    storage: StorageName,
    /// Do not compress the chunks of an MCAP file (for messages that are compressed already).
    #[arg(long)]
    uncompressed: bool,
    /// End after this time [s].
    #[arg(long, short, value_name = "SECONDS", value_parser = seconds)]
    duration: Option<Duration>,
    /// End after this number of messages.
    #[arg(long, value_name = "N")]
    max_messages: Option<u64>,
    #[command(flatten)]
    ros: RosArguments,
}

/// ROS arguments at the end of a command line.
#[derive(Debug, Args)]
struct RosArguments {
    /// Arguments of ROS: -r FROM:=TO, -p NAME:=VALUE, -r __ns:=/NS …
    #[arg(long = "ros-args", num_args = 0.., allow_hyphen_values = true, value_terminator = "--", value_name = "ARGS")]
    ros_args: Vec<String>,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum StorageName {
    Mcap,
    Sqlite3,
}

fn number(text: &str, least: f64, rule: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value.is_finite() && value >= least => Ok(value),
        _ => Err(format!("must be {rule}")),
    }
}

fn rate(text: &str) -> Result<f64, String> {
    number(text, 0.0, "0 or a positive number")
}

fn hertz(text: &str) -> Result<f64, String> {
    // A lower bound keeps the period a duration.
    number(text, 1e-3, "a number of at least 0.001")
}

fn seconds(text: &str) -> Result<Duration, String> {
    const RULE: &str = "0 or a positive number of seconds";
    Duration::try_from_secs_f64(number(text, 0.0, RULE)?).map_err(|_| format!("must be {RULE}"))
}

fn requested(text: &str) -> Result<RequestedTopic, String> {
    let (name, type_name) = text.split_once(':').map_or((text, None), |(n, t)| (n, Some(t)));
    if type_name.is_some_and(|t| crate::ros::raw::dds_type_name(t).is_none()) {
        return Err("the type must have the form package/msg/Type".to_owned());
    }
    // Names are those of the graph; a relative one is meant from its root.
    let name = if name.starts_with('/') { name.to_owned() } else { format!("/{name}") };
    Ok(RequestedTopic { name, type_name: type_name.map(str::to_owned) })
}

/// Runs a command. Errors are told on stderr in one line.
#[must_use]
pub fn run(command: BagCommand) -> ExitCode {
    match command {
        BagCommand::Info(args) => info(&args),
        BagCommand::Play(args) => run_play(args),
        BagCommand::Record(args) => run_record(args),
    }
}

fn bad_input(error: impl std::fmt::Display) -> ExitCode {
    complain!("jigsaw bag: {error}");
    ExitCode::from(BAD_INPUT)
}

fn open(path: &std::path::Path) -> Result<BagReader, ExitCode> {
    let bag = BagReader::open(path).map_err(bad_input)?;
    for warning in bag.warnings() {
        complain!("jigsaw bag: warning: {warning}");
    }
    Ok(bag)
}

fn info(args: &InfoArgs) -> ExitCode {
    let bag = match open(&args.bag) {
        Ok(bag) => bag,
        Err(code) => return code,
    };
    let text = if args.json { info_json(&bag) } else { info_table(&bag) };
    // A reader such as `head` may have gone; that is no error of ours.
    let _ = std::io::stdout().write_all(text.as_bytes());
    ExitCode::SUCCESS
}

fn reliability(profile: &QosProfile) -> &'static str {
    match profile.reliability {
        Reliability::Reliable => "reliable",
        Reliability::BestEffort => "best_effort",
        Reliability::Unknown => "unknown",
    }
}

fn durability(profile: &QosProfile) -> &'static str {
    match profile.durability {
        Durability::TransientLocal => "transient_local",
        Durability::Volatile => "volatile",
        Durability::Unknown => "unknown",
    }
}

fn info_json(bag: &BagReader) -> String {
    let topics: Vec<_> = bag
        .topics()
        .iter()
        .map(|t| {
            let qos: Vec<_> = t
                .topic
                .offered_qos
                .iter()
                .map(|q| json!({"reliability": reliability(q), "durability": durability(q), "depth": q.depth}))
                .collect();
            json!({
                "name": t.topic.name, "type": t.topic.type_name, "messages": t.messages,
                "serialization": t.topic.serialization, "offered_qos": qos, "type_hash": t.topic.type_hash,
            })
        })
        .collect();
    let warnings: Vec<String> = bag.warnings().iter().map(ToString::to_string).collect();
    let value = json!({
        "path": bag.path().display().to_string(), "storage": bag.storage().identifier(), "files": bag.file_count(),
        "start_ns": bag.span_ns().map(|s| s.0), "end_ns": bag.span_ns().map(|s| s.1), "messages": bag.message_count(),
        "topics": topics, "warnings": warnings,
    });
    format!("{value:#}\n")
}

fn info_table(bag: &BagReader) -> String {
    let files = if bag.file_count() == 1 { "1 file".to_owned() } else { format!("{} files", bag.file_count()) };
    let mut text = format!("Bag:       {}\nStorage:   {}, {files}\n", bag.path().display(), bag.storage().identifier());
    if let Some((start, end)) = bag.span_ns() {
        let time = |ns: i64| chrono::DateTime::from_timestamp_nanos(ns).format("%Y-%m-%d %H:%M:%S%.3f UTC");
        let length = end.saturating_sub(start) as f64 / 1e9;
        text += &format!("Start:     {}\nEnd:       {}\nDuration:  {length:.3} s\n", time(start), time(end));
    }
    text += &format!("Messages:  {}\n\n", bag.message_count());
    let mut rows =
        vec![["Topic".to_owned(), "Type".to_owned(), "Messages".to_owned(), "Offered quality of service".to_owned()]];
    for t in bag.topics() {
        let mut qos: Vec<String> =
            t.topic.offered_qos.iter().map(|q| format!("{} {}", reliability(q), durability(q))).collect();
        qos.dedup();
        rows.push([t.topic.name.clone(), t.topic.type_name.clone(), t.messages.to_string(), qos.join(", ")]);
    }
    let width = |column: usize| rows.iter().map(|row| row[column].chars().count()).max().unwrap_or(0);
    let (name, type_name, count) = (width(0), width(1), width(2));
    for [a, b, c, d] in &rows {
        text += format!("{a:name$}  {b:type_name$}  {c:>count$}  {d}").trim_end();
        text.push('\n');
    }
    text
}

fn start(ros: RosArguments, remaps: &[String]) -> Result<Process, ProcessError> {
    let mut args = vec!["--ros-args".to_owned()];
    for rule in remaps {
        args.extend(["--remap".to_owned(), rule.clone()]);
    }
    args.extend(ros.ros_args);
    Process::start("jigsaw", args)
}

fn run_play(args: PlayArgs) -> ExitCode {
    let bag = match open(&args.bag) {
        Ok(bag) => bag,
        Err(code) => return code,
    };
    let options = PlayOptions {
        rate: args.rate,
        topics: args
            .topics
            .map(|names| names.into_iter().map(|n| if n.starts_with('/') { n } else { format!("/{n}") }).collect()),
        start_offset: args.start_offset,
        looped: args.looped,
        clock_hz: args.clock,
        subscriptions: args.wait_for_subscribers.unwrap_or(usize::from(args.rate == 0.0)),
    };
    let code = Rc::new(Cell::new(ExitCode::SUCCESS));
    let outcome = Rc::clone(&code);
    let result = start(args.ros, &args.remap).and_then(|process| {
        process.run(move |process| {
            let mut session = process.node("bag_player", &[])?;
            Ok(Box::pin(async move {
                let bar = bar();
                let result = play(&mut session, &bag, &options, |event| show_play(&bar, event)).await;
                bar.finish_and_clear();
                match result {
                    Ok(report) => {
                        for (port, drops) in &report.drops {
                            complain!(
                                "jigsaw bag: warning: the system dropped {drops} datagrams for the process at UDP port \
                                 {port}; raise net.core.rmem_max or the rate's inverse (--rate 1)"
                            );
                        }
                        let skipped =
                            if report.skipped > 0 { format!(", {} left out", report.skipped) } else { String::new() };
                        say!("{} messages played{skipped}", report.sent);
                    }
                    Err(error) => outcome.set(bad_input(error)),
                }
                Ok(())
            }))
        })
    });
    match result {
        Ok(()) => code.get(),
        Err(error) => exit_code("jigsaw bag play", Err(error)),
    }
}

fn bar() -> ProgressBar {
    let style = ProgressStyle::with_template("{bar:40} {pos}/{len} messages  {elapsed}  {msg}");
    ProgressBar::new(0).with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()))
}

fn show_play(bar: &ProgressBar, event: PlayEvent) {
    match event {
        PlayEvent::Waiting(topics) => {
            bar.suspend(|| complain!("jigsaw bag: waiting for a subscription of {}", topics.join(", ")));
        }
        PlayEvent::Started { messages } => bar.set_length(messages),
        PlayEvent::Sent(sent) => {
            // In a loop the count starts anew with each round.
            let length = bar.length().unwrap_or(sent).max(1);
            bar.set_position((sent - 1) % length + 1);
        }
        PlayEvent::Warning(text) => bar.suspend(|| complain!("jigsaw bag: warning: {text}")),
    }
}

fn run_record(args: RecordArgs) -> ExitCode {
    let options = RecordOptions {
        topics: (!args.all).then_some(args.topics),
        duration: args.duration,
        max_messages: args.max_messages,
    };
    let process = match start(args.ros, &[]) {
        Ok(process) => process,
        Err(error) => return exit_code("jigsaw bag record", Err(error)),
    };
    let writer_options = WriterOptions {
        storage: match args.storage {
            StorageName::Mcap => Storage::Mcap,
            StorageName::Sqlite3 => Storage::Sqlite3,
        },
        compression: if args.uncompressed { Compression::None } else { Compression::Zstd },
    };
    let mut bag = match BagWriter::create(&args.bag, writer_options) {
        Ok(bag) => bag,
        Err(error) => return bad_input(error),
    };
    let code = Rc::new(Cell::new(ExitCode::SUCCESS));
    let outcome = Rc::clone(&code);
    let result = process.run(move |process| {
        let mut session = process.node("bag_recorder", &[])?;
        let end = process.ending();
        Ok(Box::pin(async move {
            let spinner = ProgressBar::new_spinner();
            let result = record(&mut session, &mut bag, &options, end, |event| show_record(&spinner, event)).await;
            spinner.finish_and_clear();
            let count = bag.message_count();
            let finished = match result {
                // What can't be written to can't be completed either; what was flushed before can be read.
                Err(RecordError::Bag(error)) => Err(error),
                Err(error) => {
                    outcome.set(bad_input(error));
                    bag.finish()
                }
                Ok(()) => bag.finish(),
            };
            match finished {
                Ok(()) => say!("{count} messages recorded in {}", args.bag.display()),
                Err(error) => outcome.set(bad_input(error)),
            }
            Ok(())
        }))
    });
    match result {
        Ok(()) => code.get(),
        Err(error) => exit_code("jigsaw bag record", Err(error)),
    }
}

fn show_record(spinner: &ProgressBar, event: RecordEvent) {
    match event {
        RecordEvent::Subscribed { topic, type_name } => {
            spinner.suspend(|| complain!("jigsaw bag: recording {topic} [{type_name}]"));
        }
        RecordEvent::Warning(text) => spinner.suspend(|| complain!("jigsaw bag: {text}")),
        RecordEvent::Recorded(count) => {
            spinner.set_message(format!("{count} messages"));
            spinner.tick();
        }
    }
}
