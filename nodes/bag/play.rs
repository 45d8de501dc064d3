//! Playing a bag over DDS, without knowing the types.
//!
//! Messages go out in the order and with the spacing of their receive times divided by the rate. At rate 0 they go out
//! as fast as nothing is lost:
//!
//! - A publisher takes the next message only once the one before it was sent and acknowledged by every reliable
//!   subscription.
//! - Where a subscription is best effort, the sockets of its host are watched until they are empty (see the module
//!   `queues`), so that the kernel drops nothing. What a subscription has received but its node has not yet taken lies in
//!   the node's own history: one that keeps `n` samples and falls `n` behind loses some, as with any publisher. A reliable
//!   subscription with a deeper history, or a rate, helps there.
//! - Before the first message, every topic that is played must have a subscription.
//!
//! At a rate, a publisher does not wait for acknowledgements, as a camera does not: a subscription that has died (its
//! participant counts as alive for another 50 s) holds up neither the bag nor the other subscriptions.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use futures::SinkExt;
use jigsaw_msgs::builtin_interfaces::msg::Time;
use jigsaw_msgs::rosgraph_msgs::msg::Clock;
use rustdds::bytes::Bytes;
use thiserror::Error;

use super::cdr::{self, ByteOrder};
use super::qos::{Durability, History, QosProfile, Reliability};
use super::queues::{ReaderQueues, blind_pause};
use super::{BagError, BagReader, Selection, Topic};
use crate::ros::raw::{RawPublisher, RawQos, RemoteEndpoint, Sent};
use crate::ros::session::{Session, SessionError};
use crate::ros::topics;

/// History depth where the bag does not say: the default of ROS publishers.
const DEFAULT_DEPTH: usize = 10;

/// Time given to discovery before the first message. A writer learns that a reader exists, but not that the reader has
/// learnt of the writer; until then the reader drops what it gets.
const SETTLE: Duration = Duration::from_millis(500);

/// How often to look whether subscriptions have come.
const LOOK_PERIOD: Duration = Duration::from_millis(50);

/// How long to wait for reliable subscriptions to take a message before saying so.
const STALL: Duration = Duration::from_secs(5);

/// How long publishers stay after the last message for what is still under way to best-effort subscriptions.
const LINGER: Duration = Duration::from_millis(300);

/// Bytes that wait, at a rate, for the acknowledgement of a subscription that may have died; when they are full, the
/// publisher waits too.
const BACKLOG_BYTES: usize = 256 << 20;

/// Messages that wait so, however small they are.
const BACKLOG_MESSAGES: usize = 4096;

/// Nanoseconds in a second.
const NANOSECONDS: i64 = 1_000_000_000;

/// How to play a bag.
#[derive(Debug, Clone, PartialEq)]
pub struct PlayOptions {
    /// Speed relative to the recording; 0 for as fast as nothing is lost.
    pub rate: f64,
    /// Topics to play, all of them if `None`.
    pub topics: Option<Vec<String>>,
    /// Where to begin, counted from the first message.
    pub start_offset: Duration,
    /// Begin anew after the last message.
    pub looped: bool,
    /// Publish `/clock` this often \[Hz of real time\]; at rate 0, once before each message.
    pub clock_hz: Option<f64>,
    /// Subscriptions that each topic must have before the first message.
    pub subscriptions: usize,
}

/// Why a bag cannot be played.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum PlayError {
    /// The bag.
    #[error(transparent)]
    Bag(#[from] BagError),
    /// The middleware.
    #[error(transparent)]
    Session(#[from] SessionError),
    /// A topic asked for is not in the bag.
    #[error("topic '{name}' is not in the bag; it holds {known}")]
    UnknownTopic {
        /// The topic.
        name: String,
        /// The topics of the bag.
        known: String,
    },
    /// Nothing in the bag can be played.
    #[error("nothing to play: the bag holds no message of a known type{}", hint.as_deref().unwrap_or(""))]
    Nothing {
        /// What may be the cause.
        hint: Option<String>,
    },
}

/// What is going on, for a progress display.
#[derive(Debug, Clone, PartialEq)]
pub enum PlayEvent {
    /// Waits for subscriptions of these topics.
    Waiting(Vec<String>),
    /// Plays this many messages from now on.
    Started {
        /// Number of messages.
        messages: u64,
    },
    /// This many messages were sent since the start.
    Sent(u64),
    /// Something went wrong, but playing goes on.
    Warning(String),
}

/// What was played.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct PlayReport {
    /// Messages sent.
    pub sent: u64,
    /// Messages left out: unreadable, or of another byte order than the first of their topic.
    pub skipped: u64,
    /// Datagrams that the kernel dropped for processes of this domain on this host, by port.
    pub drops: Vec<(u16, u64)>,
}

/// Plays a bag.
///
/// # Errors
/// [`PlayError`]. Damage within the bag is told as a [`PlayEvent::Warning`], and the rest is played.
pub async fn play(
    session: &mut Session,
    bag: &BagReader,
    options: &PlayOptions,
    mut tell: impl FnMut(PlayEvent),
) -> Result<PlayReport, PlayError> {
    let selection = select(bag, options)?;
    let publishers = open(session, bag, &selection, options.rate <= 0.0, &mut tell)?;
    if publishers.is_empty() {
        return Err(PlayError::Nothing { hint: None });
    }
    let mut clock = match options.clock_hz {
        Some(_) => Some(session.publish(&topics::CLOCK)?.0),
        None => None,
    };
    wait_for_subscriptions(&publishers, options.subscriptions, &mut tell).await;
    let mut queues = ReaderQueues::new(session.domain_id());
    let mut best_effort = best_effort_readers(session, &mut queues);
    let messages: u64 =
        bag.topics().iter().filter(|t| publishers.contains_key(&t.topic.name)).map(|t| t.messages).sum();
    tell(PlayEvent::Started { messages });

    let mut report = PlayReport::default();
    loop {
        let begun = Instant::now();
        let mut first_ns = None;
        for message in bag.messages(selection.clone())? {
            let message = match message {
                Ok(message) => message,
                Err(error) => {
                    tell(PlayEvent::Warning(error.to_string()));
                    report.skipped += 1;
                    continue;
                }
            };
            let Some(publisher) = publishers.get(&message.topic.name) else { continue };
            let first_ns = *first_ns.get_or_insert(message.log_time_ns);
            if options.rate > 0.0 {
                let due = message.log_time_ns.saturating_sub(first_ns).max(0) as f64 / 1e9 / options.rate;
                let bag_time = |elapsed: f64| first_ns.saturating_add((elapsed * options.rate * 1e9) as i64);
                wait_until(begun, due, options.clock_hz, &mut clock, bag_time).await;
            } else if let Some(clock) = &mut clock {
                let _ = clock.send(Clock { clock: ros_time(message.log_time_ns) }).await;
            }
            let bytes = message.cdr.len();
            match send(publisher, Bytes::from(message.cdr), &message.topic, &mut tell).await? {
                Sent::Yes => report.sent += 1,
                Sent::Unfit | Sent::Stalled => {
                    report.skipped += 1;
                    continue;
                }
            }
            tell(PlayEvent::Sent(report.sent));
            if options.rate <= 0.0 {
                match best_effort.get(&message.topic.name) {
                    Some(Sight::Visible) => queues.empty().await,
                    Some(Sight::Blind) => {
                        queues.empty().await;
                        smol::Timer::after(blind_pause(bytes)).await;
                    }
                    None => {}
                }
            }
        }
        if !options.looped {
            break;
        }
        best_effort = best_effort_readers(session, &mut queues);
        // A bag that yields nothing must not spin.
        smol::Timer::after(LOOK_PERIOD).await;
    }
    for (name, publisher) in &publishers {
        if publisher.reliable && !publisher.acknowledged(STALL).await {
            tell(PlayEvent::Warning(format!("a subscription of {name} has not acknowledged the last messages")));
        }
    }
    smol::Timer::after(LINGER).await;
    queues.empty().await;
    report.drops = queues.drops();
    Ok(report)
}

fn select(bag: &BagReader, options: &PlayOptions) -> Result<Selection, PlayError> {
    let mut selection = Selection::all();
    if let Some(names) = &options.topics {
        for name in names {
            if !bag.topics().iter().any(|t| t.topic.name == *name) {
                let known: Vec<&str> = bag.topics().iter().map(|t| t.topic.name.as_str()).collect();
                return Err(PlayError::UnknownTopic { name: name.clone(), known: known.join(", ") });
            }
        }
        selection.topics = Some(names.iter().cloned().collect());
    }
    if let Some((start, end)) = bag.span_ns() {
        let offset = i64::try_from(options.start_offset.as_nanos()).unwrap_or(i64::MAX);
        if offset > 0 {
            selection.from_ns = start.saturating_add(offset);
            if selection.from_ns > end {
                let length = end.saturating_sub(start) as f64 / 1e9;
                return Err(PlayError::Nothing {
                    hint: Some(format!(" after the start offset; it is {length:.3} s long")),
                });
            }
        }
    }
    Ok(selection)
}

/// Opens a publisher for every topic of the selection that has messages and a type.
fn open(
    session: &mut Session,
    bag: &BagReader,
    selection: &Selection,
    lossless: bool,
    tell: &mut impl FnMut(PlayEvent),
) -> Result<HashMap<String, RawPublisher>, PlayError> {
    let mut publishers = HashMap::new();
    for count in bag.topics().iter().filter(|t| t.messages > 0 && selection.has_topic(&t.topic.name)) {
        let topic = &count.topic;
        let fault = if topic.type_name.is_empty() {
            Some("its type is not in the bag".to_owned())
        } else if topic.serialization != "cdr" {
            Some(format!("it is serialized as '{}', not as CDR", topic.serialization))
        } else if publishers.contains_key(&topic.name) {
            Some(format!("it has a second type, {}", topic.type_name))
        } else {
            None
        };
        if let Some(fault) = fault {
            tell(PlayEvent::Warning(format!("{} is not played: {fault}", topic.name)));
            continue;
        }
        // The byte order of a publisher is fixed; all messages of a topic have that of the machine that sent them.
        let first = bag.messages(Selection::topics([topic.name.as_str()]))?.next();
        let big_endian = matches!(&first, Some(Ok(m)) if matches!(cdr::split_header(&m.cdr), Ok((ByteOrder::Big, _))));
        let unacknowledged = match &first {
            _ if lossless => 1,
            Some(Ok(message)) => (BACKLOG_BYTES / message.cdr.len().max(1)).clamp(1, BACKLOG_MESSAGES),
            _ => BACKLOG_MESSAGES,
        };
        let qos = offered(&topic.offered_qos, lossless);
        let publisher = session.publish_raw(&topic.name, &topic.type_name, qos, unacknowledged, big_endian)?;
        publishers.insert(topic.name.clone(), publisher);
    }
    Ok(publishers)
}

/// The quality to offer: what the recorded publishers offered where they agree, else the weaker of each; reliable and
/// volatile where the bag does not say. Where nothing may be lost it is reliable in any case: such a publisher serves
/// reliable and best-effort subscriptions alike.
fn offered(profiles: &[QosProfile], lossless: bool) -> RawQos {
    let depth = profiles
        .iter()
        .filter(|p| p.history == History::KeepLast && p.depth > 0)
        .map(|p| p.depth as usize)
        .max()
        .unwrap_or(DEFAULT_DEPTH);
    RawQos {
        reliable: lossless || profiles.iter().all(|p| p.reliability != Reliability::BestEffort),
        transient_local: !profiles.is_empty() && profiles.iter().all(|p| p.durability == Durability::TransientLocal),
        depth,
    }
}

async fn wait_for_subscriptions(
    publishers: &HashMap<String, RawPublisher>,
    wanted: usize,
    tell: &mut impl FnMut(PlayEvent),
) {
    let mut told = Vec::new();
    loop {
        let mut missing: Vec<String> =
            publishers.iter().filter(|(_, p)| p.audience().count() < wanted).map(|(name, _)| name.clone()).collect();
        if missing.is_empty() {
            break;
        }
        missing.sort();
        // A subscription that is there is found within the settling time; no need to tell of waiting for that.
        if told != missing {
            tell(PlayEvent::Waiting(missing.clone()));
            told = missing;
        }
        smol::Timer::after(LOOK_PERIOD).await;
    }
    smol::Timer::after(SETTLE).await;
}

/// Whether the sockets of the best-effort subscriptions of a topic can be watched.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Sight {
    Visible,
    Blind,
}

/// The topics, by their name in the bag, that someone subscribes best effort.
fn best_effort_readers(session: &Session, queues: &mut ReaderQueues) -> HashMap<String, Sight> {
    let mut sights = HashMap::new();
    let readers: Vec<RemoteEndpoint> = session.remote_subscriptions();
    for reader in readers.into_iter().filter(|r| !r.qos.reliable) {
        queues.watch(reader.addresses.iter().map(std::net::SocketAddr::port));
        let local = ReaderQueues::visible() && is_here(&reader);
        let sight = sights.entry(reader.topic).or_insert(Sight::Visible);
        if !local {
            *sight = Sight::Blind;
        }
    }
    sights
}

/// Whether a reader is on this host: one of its addresses is, or it announces none of its own.
fn is_here(reader: &RemoteEndpoint) -> bool {
    reader.addresses.is_empty() || reader.addresses.iter().any(|a| std::net::UdpSocket::bind((a.ip(), 0)).is_ok())
}

/// Sends a message, for as long as it takes; says so where it takes long.
async fn send(
    publisher: &RawPublisher,
    cdr: Bytes,
    topic: &Arc<Topic>,
    tell: &mut impl FnMut(PlayEvent),
) -> Result<Sent, PlayError> {
    let mut told = false;
    loop {
        match publisher.send(&cdr, STALL).await? {
            Sent::Stalled => {
                if !told {
                    let text = format!("waiting for a subscription of {} that takes no messages", topic.name);
                    tell(PlayEvent::Warning(text));
                    told = true;
                }
            }
            Sent::Unfit => {
                let text = format!("a message of {} is left out: no CDR of the topic's byte order", topic.name);
                tell(PlayEvent::Warning(text));
                return Ok(Sent::Unfit);
            }
            Sent::Yes => return Ok(Sent::Yes),
        }
    }
}

/// Sleeps until `due` seconds after `begun`, publishing the clock meanwhile.
async fn wait_until(
    begun: Instant,
    due: f64,
    clock_hz: Option<f64>,
    clock: &mut Option<futures::channel::mpsc::Sender<Clock>>,
    bag_time: impl Fn(f64) -> i64,
) {
    loop {
        let now = begun.elapsed().as_secs_f64();
        let mut left = due - now;
        if let (Some(clock), Some(hz)) = (clock.as_mut(), clock_hz) {
            let _ = clock.send(Clock { clock: ros_time(bag_time(now.min(due.max(0.0)))) }).await;
            left = left.min(1.0 / hz);
        }
        if left <= 0.0 {
            return;
        }
        smol::Timer::after(Duration::from_secs_f64(left)).await;
        if begun.elapsed().as_secs_f64() >= due {
            return;
        }
    }
}

fn ros_time(ns: i64) -> Time {
    Time {
        sec: i32::try_from(ns.div_euclid(NANOSECONDS)).unwrap_or(i32::MAX),
        nanosec: u32::try_from(ns.rem_euclid(NANOSECONDS)).unwrap_or(0),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn offers_what_every_recorded_publisher_offered() {
        assert_eq!(offered(&[], false), RawQos { reliable: true, transient_local: false, depth: 10 });
        assert_eq!(
            offered(&[QosProfile::latched(1), QosProfile::best_effort(5)], false),
            RawQos { reliable: false, transient_local: false, depth: 5 }
        );
        assert_eq!(
            offered(&[QosProfile::latched(3)], false),
            RawQos { reliable: true, transient_local: true, depth: 3 }
        );
        assert!(offered(&[QosProfile::best_effort(5)], true).reliable);
    }
}
