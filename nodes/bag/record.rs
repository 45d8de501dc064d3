//! Recording topics from DDS into a bag, without knowing the types.
//!
//! Discovery tells which topics are published, with which type and quality of service; a subscription asks for what all
//! publishers of its topic offer, so it also gets what latched publishers sent before. The message definition comes from
//! [`jigsaw_msgs`]; for any other type it stays empty, and only tools that know the type can decode the messages.
//!
//! The bag can be read at any moment: it is flushed every second.

use std::collections::{BTreeMap, BTreeSet};
use std::pin::pin;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use futures::stream::SelectAll;
use futures::{FutureExt, StreamExt};
use thiserror::Error;

use super::qos::{Durability, History, QosProfile, Reliability};
use super::{BagError, BagWriter, Topic, TopicId};
use crate::ros::raw::{RawQos, RawSample, RemoteEndpoint};
use crate::ros::session::{Session, SessionError};

/// How often to look for new topics.
const LOOK_PERIOD: Duration = Duration::from_millis(100);

/// How often the bag is flushed.
const FLUSH_PERIOD: Duration = Duration::from_secs(1);

/// How long a topic of a given type may stay without a publisher before it is subscribed all the same.
const DISCOVERY: Duration = Duration::from_secs(1);

/// How often in turn those who bring the messages may have had nothing before all that was received counts as recorded:
/// each yields to all others, so once would do; a few times costs nothing.
const IDLE_TURNS: usize = 10;

/// Samples the middleware may hold while the disk is slow.
const DEPTH: usize = 256;

/// A topic to record.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct RequestedTopic {
    /// Full name.
    pub name: String,
    /// Type name, `package/msg/Type`; `None` for that of its publishers.
    pub type_name: Option<String>,
}

/// What to record, and for how long.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RecordOptions {
    /// The topics; `None` for all that are published, save hidden ones.
    pub topics: Option<Vec<RequestedTopic>>,
    /// End after this time.
    pub duration: Option<Duration>,
    /// End after this number of messages.
    pub max_messages: Option<u64>,
}

/// Why recording ended early.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum RecordError {
    /// The bag.
    #[error(transparent)]
    Bag(#[from] BagError),
    /// The middleware.
    #[error(transparent)]
    Session(#[from] SessionError),
}

/// What is going on, for a display.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum RecordEvent {
    /// A topic is recorded from now on.
    Subscribed {
        /// Its name.
        topic: String,
        /// Its type.
        type_name: String,
    },
    /// Something went wrong, but recording goes on.
    Warning(String),
    /// This many messages were recorded.
    Recorded(u64),
}

/// Records into `bag` until the duration or the number of messages is reached, or `end` has come; then what has been
/// received by then, and so was acknowledged, is still recorded. The bag stays with the caller, who finishes it.
///
/// # Errors
/// [`RecordError`].
pub async fn record(
    session: &mut Session,
    bag: &mut BagWriter,
    options: &RecordOptions,
    end: impl Future<Output = ()>,
    mut tell: impl FnMut(RecordEvent),
) -> Result<(), RecordError> {
    let mut end = pin!(end.fuse());
    let begun = Instant::now();
    let mut known = Subscriptions::default();
    let mut messages = SelectAll::new();
    let mut look = StreamExt::fuse(smol::Timer::interval(LOOK_PERIOD));
    let mut flushed = Instant::now();
    let mut recorded = 0;
    if let Some(topics) = &options.topics {
        tell(RecordEvent::Warning(format!(
            "waiting for {}",
            topics.iter().map(|t| t.name.as_str()).collect::<Vec<_>>().join(", ")
        )));
    }
    loop {
        let left = options.duration.map(|d| d.saturating_sub(begun.elapsed()));
        if left == Some(Duration::ZERO) || options.max_messages.is_some_and(|most| recorded >= most) {
            return Ok(());
        }
        futures::select! {
            message = messages.next() => {
                let Some(message) = message else { continue };
                write(bag, message)?;
                recorded += 1;
                tell(RecordEvent::Recorded(recorded));
            }
            () = end => break,
            _ = look.next() => {
                for found in known.due(session.remote_publishers(), options, begun.elapsed(), &mut tell) {
                    let Found { topic, qos } = found;
                    let stream = session.subscribe_raw(&topic.name, &topic.type_name, qos)?;
                    if topic.definition.is_empty() {
                        tell(RecordEvent::Warning(format!(
                            "{}: the definition of {} is not known; it is left empty in the bag",
                            topic.name, topic.type_name
                        )));
                    }
                    tell(RecordEvent::Subscribed { topic: topic.name.clone(), type_name: topic.type_name.clone() });
                    let id: TopicId = bag.add_topic(topic)?;
                    messages.push(stream.map(move |sample| (id, sample)));
                }
                if flushed.elapsed() >= FLUSH_PERIOD {
                    bag.flush()?;
                    flushed = Instant::now();
                }
            }
        }
    }
    let mut idle = 0;
    while idle < IDLE_TURNS && options.max_messages.is_none_or(|most| recorded < most) {
        match messages.next().now_or_never().flatten() {
            Some(message) => {
                write(bag, message)?;
                recorded += 1;
                idle = 0;
            }
            None => {
                smol::future::yield_now().await;
                idle += 1;
            }
        }
    }
    tell(RecordEvent::Recorded(recorded));
    Ok(())
}

fn write(bag: &mut BagWriter, (topic, sample): (TopicId, RawSample)) -> Result<(), BagError> {
    let now = now_ns();
    bag.write(topic, now, sample.source_time_ns.unwrap_or(now), &sample.cdr)
}

fn now_ns() -> i64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    i64::try_from(since.as_nanos()).unwrap_or(i64::MAX)
}

/// A topic to subscribe.
#[derive(Debug, Clone, PartialEq)]
struct Found {
    topic: Topic,
    qos: RawQos,
}

/// The topics subscribed so far.
#[derive(Debug, Default)]
struct Subscriptions {
    /// Name and type.
    topics: BTreeMap<String, String>,
    /// Names and types told of as conflicts.
    conflicts: BTreeSet<(String, String)>,
}

impl Subscriptions {
    /// The topics that are to be subscribed now, given who publishes.
    fn due(
        &mut self,
        publishers: Vec<RemoteEndpoint>,
        options: &RecordOptions,
        elapsed: Duration,
        tell: &mut impl FnMut(RecordEvent),
    ) -> Vec<Found> {
        let mut by_topic: BTreeMap<(String, String), Vec<RawQos>> = BTreeMap::new();
        for publisher in publishers.into_iter().filter(|p| wanted(options, &p.topic, &p.type_name)) {
            by_topic.entry((publisher.topic, publisher.type_name)).or_default().push(publisher.qos);
        }
        if let Some(topics) = &options.topics
            && elapsed >= DISCOVERY
        {
            // To be there from the first message on: best effort fits whatever comes.
            let typed = topics.iter().filter_map(|t| Some((t.name.clone(), t.type_name.clone()?)));
            for key in typed {
                by_topic.entry(key).or_default();
            }
        }
        let mut due = Vec::new();
        for ((name, type_name), offers) in by_topic {
            match self.topics.get(&name) {
                None => {
                    self.topics.insert(name.clone(), type_name.clone());
                    due.push(found(&name, &type_name, &offers));
                }
                Some(known) if *known != type_name => {
                    if self.conflicts.insert((name.clone(), type_name.clone())) {
                        let text = format!("{name} is recorded as {known}; what comes as {type_name} is not recorded");
                        tell(RecordEvent::Warning(text));
                    }
                }
                Some(_) => {}
            }
        }
        due
    }
}

fn wanted(options: &RecordOptions, name: &str, type_name: &str) -> bool {
    match &options.topics {
        // Hidden names have a part that begins with an underscore.
        None => !name.contains("/_"),
        Some(topics) => {
            topics.iter().any(|t| t.name == name && t.type_name.as_deref().is_none_or(|wanted| wanted == type_name))
        }
    }
}

/// What to ask for, and what to note as offered.
fn found(name: &str, type_name: &str, offers: &[RawQos]) -> Found {
    let all = |property: fn(&RawQos) -> bool| !offers.is_empty() && offers.iter().all(property);
    let qos = RawQos { reliable: all(|o| o.reliable), transient_local: all(|o| o.transient_local), depth: DEPTH };
    let mut profiles: Vec<QosProfile> = Vec::new();
    for offer in offers {
        let profile = QosProfile {
            // Discovery does not tell how much a publisher keeps.
            history: History::Unknown,
            depth: 0,
            reliability: if offer.reliable { Reliability::Reliable } else { Reliability::BestEffort },
            durability: if offer.transient_local { Durability::TransientLocal } else { Durability::Volatile },
        };
        if !profiles.contains(&profile) {
            profiles.push(profile);
        }
    }
    Found { topic: Topic::known(name, type_name, profiles), qos }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn publisher(topic: &str, type_name: &str, reliable: bool, transient_local: bool) -> RemoteEndpoint {
        RemoteEndpoint {
            topic: topic.to_owned(),
            type_name: type_name.to_owned(),
            qos: RawQos { reliable, transient_local, depth: 1 },
            addresses: Vec::new(),
        }
    }

    #[test]
    fn asks_for_what_all_publishers_offer_and_subscribes_once() {
        let options = RecordOptions { topics: None, duration: None, max_messages: None };
        let publishers = || {
            vec![
                publisher("/a", "std_msgs/msg/String", true, true),
                publisher("/a", "std_msgs/msg/String", true, false),
                publisher("/a", "std_msgs/msg/Header", true, false),
                publisher("/x/_hidden", "std_msgs/msg/String", true, false),
            ]
        };
        let mut known = Subscriptions::default();
        let mut warnings = 0;
        let due = known.due(publishers(), &options, Duration::ZERO, &mut |_| warnings += 1);
        assert_eq!(due.len(), 1);
        assert_eq!((due[0].qos.reliable, due[0].qos.transient_local), (true, false));
        // By name the types are in order, so the first met is the header.
        assert_eq!(due[0].topic.type_name, "std_msgs/msg/Header");
        assert_eq!(known.due(publishers(), &options, Duration::ZERO, &mut |_| warnings += 1), vec![]);
        assert_eq!(warnings, 1, "a conflict is told once");
    }

    #[test]
    fn a_topic_of_given_type_is_subscribed_without_a_publisher() {
        let requested = RequestedTopic { name: "/a".to_owned(), type_name: Some("std_msgs/msg/String".to_owned()) };
        let options = RecordOptions { topics: Some(vec![requested]), duration: None, max_messages: None };
        let mut known = Subscriptions::default();
        assert_eq!(known.due(vec![], &options, Duration::ZERO, &mut |_| {}), vec![]);
        let other = publisher("/a", "std_msgs/msg/Header", true, false);
        let due = known.due(vec![other], &options, DISCOVERY, &mut |_| {});
        assert_eq!(due.len(), 1);
        assert!(!due[0].qos.reliable);
    }
}
