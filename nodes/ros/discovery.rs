//! What discovery tells of the endpoints of this process: who listens, who asks for or offers too little, who shakes
//! hands, and who comes back after it was forgotten.
//!
//! **Whoever was forgotten and comes back** (a link was down for longer than the lease, 50 s) stays a stranger: RustDDS
//! has taken its announcements of endpoints once and takes them for known when they come again. A node that sees that ends;
//! with its new identity both sides find each other as new.

use std::collections::{HashMap, HashSet, VecDeque};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use futures::StreamExt;
use futures::channel::mpsc;
use ros2_client::QosProfile;
use rustdds::dds::statusevents::{DomainParticipantStatusEvent, LostReason, StatusEvented};
use rustdds::policy::{Durability, Reliability};
use rustdds::{DomainParticipant, GUID, QosPolicies, RTPSEntity};

use super::mends::missed;

/// Most participants that are remembered as forgotten; beyond, those that have been away longest are not expected back.
const MOST_FORGOTTEN: usize = 1024;

/// How long shaking hands may take: longer than the lease, so that one that has died meanwhile has been forgotten.
/// RustDDS tries for some 20 s.
const HANDSHAKE_PATIENCE: Duration = Duration::from_secs(60);

/// How often is looked for handshakes that take longer.
const LOOK: Duration = Duration::from_secs(1);

/// How long after its start a process is one that joins: what it has not been let in by it can be as a new one.
const JOINING: Duration = Duration::from_secs(10);

/// This process and another one can't hear each other, and could if this one were started again.
#[derive(Debug, thiserror::Error)]
pub enum Estranged {
    /// One that was forgotten has come back.
    #[error(
        "participant {0} was away for longer than its lease and has come back, and the middleware can't find its topics again; start this node again"
    )]
    CameBack(String),
    /// One is there, and neither lets this process in nor turns it away.
    #[error(
        "participant {0} has not finished its handshake with this one in {n} s, so that neither hears the other; start one of them again",
        n = HANDSHAKE_PATIENCE.as_secs()
    )]
    NotLetIn(String),
}

/// What discovery has told of the endpoints of this process.
#[derive(Debug, Clone, Default)]
pub(super) struct Endpoints(Arc<Mutex<EndpointTable>>);

#[derive(Debug, Default)]
struct EndpointTable {
    names: HashMap<GUID, String>,
    requests: HashSet<GUID>,
    readers_of: HashMap<GUID, HashSet<GUID>>,
    lesser_writers: HashMap<GUID, mpsc::UnboundedSender<LesserWriter>>,
    handshakes: HashMap<GUID, Instant>,
}

/// A writer that offers less than a reader asks for.
#[derive(Debug, Clone, Copy)]
pub(super) struct LesserWriter {
    pub(super) writer: GUID,
    pub(super) offer: Offer,
}

/// What a writer offers of what can keep it apart from a reader.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) struct Offer {
    reliable: bool,
    latched: bool,
}

impl Offer {
    fn of(qos: &QosPolicies) -> Self {
        Self {
            // What goes without saying is the default of a writer.
            reliable: qos.reliability() != Some(Reliability::BestEffort),
            latched: qos.durability().is_some_and(|durability| durability >= Durability::TransientLocal),
        }
    }

    /// The quality of service of a reader that asks for no more than this.
    pub(super) fn at_most(self, asked: QosProfile) -> QosProfile {
        let asked = if self.reliable { asked } else { asked.reliability_best_effort() };
        if self.latched { asked } else { asked.durability(ros2_client::qos::Durability::Volatile) }
    }
}

impl Endpoints {
    fn with<R>(&self, action: impl FnOnce(&mut EndpointTable) -> R) -> R {
        action(&mut self.0.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// A reader or writer of this topic was opened.
    pub(super) fn opened(&self, endpoint: GUID, name: &str) {
        self.with(|table| table.names.insert(endpoint, name.to_owned()));
    }

    /// A reader of the requests to a service was opened.
    pub(super) fn opened_requests(&self, endpoint: GUID, service: &str) {
        self.opened(endpoint, service);
        self.with(|table| table.requests.insert(endpoint));
    }

    /// Whether this reads the requests to a service.
    fn is_of_requests(&self, endpoint: GUID) -> bool {
        self.with(|table| table.requests.contains(&endpoint))
    }

    fn matched(&self, writer: GUID, reader: GUID) {
        self.with(|table| table.readers_of.entry(writer).or_default().insert(reader));
    }

    fn lost(&self, reader: GUID) {
        self.with(|table| {
            table.readers_of.values_mut().for_each(|readers| {
                readers.remove(&reader);
            });
        });
    }

    /// All readers for which this holds are lost, as those of a participant that has died without a word.
    fn lost_all(&self, lost: impl Fn(&GUID) -> bool) {
        self.with(|table| table.readers_of.values_mut().for_each(|readers| readers.retain(|reader| !lost(reader))));
    }

    /// Tells a reader of a writer that offers less than it asks for. False if that is none of its concern.
    fn tell_of_lesser(&self, reader: GUID, writer: GUID, offered: &QosPolicies) -> bool {
        let met = LesserWriter { writer, offer: Offer::of(offered) };
        self.with(|table| table.lesser_writers.get(&reader).is_some_and(|told| told.unbounded_send(met).is_ok()))
    }

    /// The writers that offer less than a reader asks for, as they are met.
    pub(super) fn lesser_writers(&self, reader: GUID) -> mpsc::UnboundedReceiver<LesserWriter> {
        let (sender, receiver) = mpsc::unbounded();
        self.with(|table| table.lesser_writers.insert(reader, sender));
        receiver
    }

    /// Who listens to a writer.
    pub(super) fn audience(&self, writer: GUID) -> Audience {
        Audience { endpoints: self.clone(), writer }
    }

    /// With how many participants this one is shaking hands: they have been met, and are not yet let in or turned away.
    pub(super) fn handshakes(&self) -> usize {
        self.with(|table| table.handshakes.len())
    }

    #[cfg(any(feature = "security", test))]
    fn handshake_began(&self, participant: GUID, now: Instant) {
        self.with(|table| table.handshakes.insert(participant, now));
    }

    fn handshake_ended(&self, participant: GUID) {
        self.with(|table| table.handshakes.remove(&participant));
    }

    /// One that takes too long to shake hands, and since when; it is not told of again.
    fn take_overdue_handshake(&self, now: Instant) -> Option<(GUID, Instant)> {
        self.with(|table| {
            let overdue = table.handshakes.iter().find(|(_, since)| now.duration_since(**since) > HANDSHAKE_PATIENCE);
            let id = *overdue?.0;
            table.handshakes.remove_entry(&id)
        })
    }

    /// The name of the topic of an endpoint of this process.
    fn name(&self, endpoint: GUID) -> Option<String> {
        self.with(|table| table.names.get(&endpoint).cloned())
    }
}

/// Tells whether anyone listens to a topic.
#[derive(Debug, Clone)]
pub struct Audience {
    endpoints: Endpoints,
    writer: GUID,
}

impl Audience {
    /// The writer that is listened to.
    pub fn writer(&self) -> GUID {
        self.writer
    }

    /// How many subscriptions there are.
    pub fn count(&self) -> usize {
        self.endpoints.with(|table| table.readers_of.get(&self.writer).map_or(0, HashSet::len))
    }
}

/// Who can't be heard any more, and whether this process is to be started again for it.
struct Strangers {
    /// When this process began.
    start: Instant,
    /// Whether this process is started again where it ends for that.
    started_again: bool,
    /// Those that were forgotten, the last one first.
    forgotten: VecDeque<GUID>,
}

impl Strangers {
    fn new(start: Instant, started_again: bool) -> Self {
        Self { start, started_again, forgotten: VecDeque::new() }
    }

    /// A participant's lease was over.
    fn forget(&mut self, participant: GUID) {
        self.forgotten.truncate(MOST_FORGOTTEN - 1);
        self.forgotten.push_front(participant);
    }

    /// A participant was met: an error to end with if it was forgotten before.
    fn meet(&mut self, participant: GUID) -> Option<Estranged> {
        let before = self.forgotten.len();
        self.forgotten.retain(|id| *id != participant);
        let came_back = self.forgotten.len() < before;
        self.fatal(came_back.then(|| Estranged::CameBack(format!("{:?}", participant.prefix)))?, true)
    }

    /// Looks for a handshake that takes too long: an error to end with if one began while this process joined.
    fn look(&self, endpoints: &Endpoints, now: Instant) -> Option<Estranged> {
        let (participant, since) = endpoints.take_overdue_handshake(now)?;
        self.fatal(Estranged::NotLetIn(format!("{:?}", participant.prefix)), since < self.start + JOINING)
    }

    /// Gives the error back if this process is started again and that helps; otherwise it is a warning.
    fn fatal(&self, error: Estranged, another_start_helps: bool) -> Option<Estranged> {
        if self.started_again && another_start_helps {
            return Some(error);
        }
        log::warn!("{error}");
        None
    }
}

/// Keeps account of who listens, and warns of those who would but can't. Resolves when this process and another one can't
/// hear each other and it is for this one to be started again; otherwise that is a warning, too.
pub(super) async fn follow(
    participant: Option<DomainParticipant>,
    endpoints: Endpoints,
    started_again: bool,
) -> Estranged {
    let Some(participant) = participant else { return std::future::pending().await };
    let mut strangers = Strangers::new(Instant::now(), started_again);
    // Of a participant's id the middleware sometimes tells the prefix alone.
    let whole_id = |prefix| GUID { prefix, ..participant.guid() };
    let listener = participant.status_listener();
    let mut events = listener.as_async_status_stream();
    let mut looks = smol::Timer::interval(LOOK).fuse();
    loop {
        let event = futures::select! {
            event = events.next() => event,
            _ = looks.next() => {
                if let Some(error) = strangers.look(&endpoints, Instant::now()) {
                    return error;
                }
                continue;
            }
        };
        // Without events the participant is about to go.
        let Some(event) = event else { return std::future::pending().await };
        match event {
            DomainParticipantStatusEvent::RemoteReaderMatched { local_writer, remote_reader } => {
                endpoints.matched(local_writer, remote_reader);
            }
            DomainParticipantStatusEvent::RemoteWriterMatched { local_reader, remote_writer }
                if endpoints.is_of_requests(local_reader) =>
            {
                if let Err(e) = missed::ask(&participant, local_reader, remote_writer) {
                    log::debug!("a client was not asked for its first request: {e}");
                }
            }
            DomainParticipantStatusEvent::ReaderLost { guid, .. } => endpoints.lost(guid),
            DomainParticipantStatusEvent::ParticipantLost { id, reason } => {
                endpoints.lost_all(|reader| reader.prefix == id);
                endpoints.handshake_ended(whole_id(id));
                if matches!(reason, LostReason::Timeout { .. }) {
                    strangers.forget(whole_id(id));
                }
            }
            DomainParticipantStatusEvent::ParticipantDiscovered { dpd } => {
                if let Some(error) = strangers.meet(whole_id(dpd.guid.prefix)) {
                    return error;
                }
            }
            DomainParticipantStatusEvent::RemoteReaderQosIncompatible {
                local_writer: local,
                requested_qos,
                offered_qos,
                ..
            } => warn_of_incompatible(&endpoints, local, "subscription", &requested_qos, &offered_qos),
            DomainParticipantStatusEvent::RemoteWriterQosIncompatible {
                local_reader: local,
                remote_writer,
                requested_qos,
                offered_qos,
            } if !endpoints.tell_of_lesser(local, remote_writer, &offered_qos) => {
                warn_of_incompatible(&endpoints, local, "publisher", &requested_qos, &offered_qos);
            }
            #[cfg(feature = "security")]
            DomainParticipantStatusEvent::Authentication { participant, status } => {
                let other = whole_id(participant);
                match format!("{status:?}").as_str() {
                    // The middleware doesn't give out the type of this.
                    "Authenticating" => endpoints.handshake_began(other, Instant::now()),
                    _ => endpoints.handshake_ended(other),
                }
            }
            _ => {}
        }
    }
}

fn warn_of_incompatible(
    endpoints: &Endpoints,
    local: GUID,
    remote: &str,
    requested: &QosPolicies,
    offered: &QosPolicies,
) {
    if let Some(name) = endpoints.name(local) {
        log::warn!(
            "a {remote} on {name} does not match: requested {:?}, {:?}; offered {:?}, {:?}",
            requested.reliability(),
            requested.durability(),
            offered.reliability(),
            offered.durability()
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SOON: Duration = Duration::from_millis(1);

    fn participant(k: u8) -> GUID {
        GUID::from_bytes([k; 16])
    }

    #[test]
    fn a_handshake_that_takes_too_long_is_told_of_once() {
        let (endpoints, start) = (Endpoints::default(), Instant::now());
        let strangers = Strangers::new(start, true);
        for k in 1..=3 {
            endpoints.handshake_began(participant(k), start);
        }
        endpoints.handshake_ended(participant(2));
        // It begins anew.
        endpoints.handshake_began(participant(3), start + JOINING);
        assert!(strangers.look(&endpoints, start + HANDSHAKE_PATIENCE).is_none());
        let late = start + HANDSHAKE_PATIENCE + SOON;
        assert!(matches!(strangers.look(&endpoints, late), Some(Estranged::NotLetIn(_))));
        assert!(strangers.look(&endpoints, late).is_none(), "it was told of already");
        assert_eq!(endpoints.handshakes(), 1);
    }

    #[test]
    fn another_start_is_for_those_who_join_and_are_started_again() {
        let start = Instant::now();
        let ends = |began: Duration, started_again: bool| {
            let endpoints = Endpoints::default();
            endpoints.handshake_began(participant(1), start + began);
            let late = start + began + HANDSHAKE_PATIENCE + SOON;
            let ends = Strangers::new(start, started_again).look(&endpoints, late).is_some();
            assert_eq!(endpoints.handshakes(), 0);
            ends
        };
        assert!(ends(Duration::ZERO, true) && ends(JOINING - SOON, true));
        assert!(!ends(JOINING, true), "the other one joins, and is to be started again");
        assert!(!ends(Duration::ZERO, false));
    }

    #[test]
    fn one_that_was_forgotten_and_comes_back_is_a_stranger() {
        let mut strangers = Strangers::new(Instant::now(), true);
        let [one, other] = [1, 2].map(participant);
        strangers.forget(one);
        assert!(strangers.meet(other).is_none());
        assert!(matches!(strangers.meet(one), Some(Estranged::CameBack(_))));
        assert!(strangers.meet(one).is_none(), "it was told of already");
        strangers.forget(one);
        (0..MOST_FORGOTTEN).for_each(|_| strangers.forget(other));
        assert!(strangers.meet(one).is_none(), "those that have been away longest are not expected back");
    }
}
