//! One service on DDS: requests in, answers out, none of them lost.
//!
//! A client that calls as soon as it has found the service may be quicker than discovery on this side: its request is
//! here before its reader of answers is known, and an answer written then is lost, for it is nobody's. So an answer
//! waits until the writer of answers has met the reader it is for. The client library's own server can't tell
//! when that is, and knows no services of actions by their names either, which is why the two ends stand here.

use std::collections::HashSet;
use std::rc::Rc;
use std::sync::Arc;
use std::time::{Duration, Instant};

use byteorder::LittleEndian;
use futures::channel::{mpsc, oneshot};
use futures::stream::FuturesUnordered;
use futures::{FutureExt, SinkExt, StreamExt};
use jigsaw_msgs::{Message, Service};
use ros2_client::{MessageInfo, RmwRequestId, Subscription};
use rustdds::no_key::DataWriter;
use rustdds::{
    CDRSerializerAdapter, DataWriterStatus, DomainParticipant, GUID, QosPolicies, SampleIdentity, SequenceNumber,
    StatusEvented, Timestamp, TopicKind, WriteOptionsBuilder,
};
use serde::Serialize;
use serde::de::DeserializeOwned;

use super::health::Health;
use super::mends::large;
use super::session::{CHANNEL_DEPTH, Call, Session, SessionError};
use super::topics::SERVICE_QOS;

/// How long an answer waits for its reader. Discovery takes about 0.1 s on one host and less than a second between
/// hosts; a client that was not met by then has gone, or hears answers in a way that can't be seen from here.
const INTRODUCTION: Duration = Duration::from_secs(2);

/// Most calls of a service that may wait for their answers; further ones are refused, so that memory stays bounded.
const MOST_CALLS: usize = 1024;

/// An answer that waits until its reader is known.
struct Early<Resp> {
    request: RmwRequestId,
    answer: Resp,
    until: Instant,
}

impl Session {
    /// The calls of a service.
    ///
    /// # Errors
    /// [`SessionError`] for a bad name, or where the middleware refuses.
    pub fn serve<S: Service + 'static>(&mut self, service: &str) -> Result<mpsc::Receiver<Call<S>>, SessionError> {
        let name = self.names.service(service)?;
        let types = [S::Request::TYPE.dds_name, S::Response::TYPE.dds_name].map(str::to_owned);
        self.open_server(&name, types, |request, reply| Call { request, reply })
    }

    /// The calls of a service of this absolute name and these types on DDS, each made into a `T` of the request and
    /// the way back. A call whose way back is dropped is never answered.
    ///
    /// # Errors
    /// [`SessionError`] where the middleware refuses.
    pub(super) fn open_server<Req, Resp, T>(
        &mut self,
        name: &str,
        [request_type, response_type]: [String; 2],
        call: impl Fn(Req, oneshot::Sender<Resp>) -> T + 'static,
    ) -> Result<mpsc::Receiver<T>, SessionError>
    where
        Req: DeserializeOwned + 'static,
        Resp: Serialize + 'static,
        T: 'static,
    {
        let fail = |e: rustdds::dds::CreateError| SessionError::middleware(format!("service {name}"), e);
        let participant = self.context.domain_participant();
        let policies = QosPolicies::from(SERVICE_QOS);
        let topic = |name, kind| participant.create_topic(name, kind, &policies, TopicKind::NoKey);
        let requests = topic(format!("rq{name}Request"), request_type).map_err(fail)?;
        let answers = topic(format!("rr{name}Reply"), response_type).map_err(fail)?;
        let requests = self
            .node
            .borrow_mut()
            .create_subscription::<Req>(&requests, None)
            .map_err(|e| SessionError::middleware(format!("service {name}"), e))?;
        self.endpoints.opened_requests(requests.guid(), name);
        let publisher = participant.create_publisher(&policies).map_err(fail)?;
        let answers = publisher.create_datawriter_no_key(&answers, None).map_err(fail)?;
        let (sender, receiver) = mpsc::channel(CHANNEL_DEPTH);
        let server = Server {
            name: name.to_owned(),
            requests,
            answers,
            participant: participant.clone(),
            secured: self.secured,
            health: Arc::clone(&self.health),
        };
        self.spawn(server.attend(sender, call));
        Ok(receiver)
    }
}

struct Server<Req, Resp: Serialize> {
    name: String,
    requests: Subscription<Req>,
    answers: DataWriter<Resp, CDRSerializerAdapter<Resp>>,
    participant: DomainParticipant,
    secured: bool,
    health: Arc<Health>,
}

impl<Req: DeserializeOwned + 'static, Resp: Serialize + 'static> Server<Req, Resp> {
    async fn attend<T>(self, mut calls: mpsc::Sender<T>, call: impl Fn(Req, oneshot::Sender<Resp>) -> T) {
        let this = Rc::new(self);
        let mut requests = Box::pin(this.requests.async_stream());
        let mut statuses = this.answers.as_async_status_stream().fuse();
        let mut under_way = FuturesUnordered::new();
        let mut met: HashSet<GUID> = HashSet::new();
        let mut early: Vec<Early<Resp>> = Vec::new();
        loop {
            let alarm = early.iter().map(|early| early.until).min();
            let mut alarm = FutureExt::fuse(alarm.map_or_else(smol::Timer::never, smol::Timer::at));
            futures::select! {
                request = requests.next() => match request {
                    Some(Ok((request, info))) => {
                        if under_way.len() + early.len() >= MOST_CALLS {
                            let rule = format!("{} has {MOST_CALLS} calls to answer already: a call is refused", this.name);
                            this.health.refuse("calls", &rule);
                            continue;
                        }
                        let (reply, answer) = oneshot::channel();
                        let id = identity(&info);
                        under_way.push(async move { (id, answer.await) });
                        if calls.send(call(request, reply)).await.is_err() {
                            break;
                        }
                    }
                    Some(Err(e)) => {
                        this.health.refuse("undecodable", &format!("request of {} can't be decoded: {e}", this.name));
                    }
                    None => break,
                },
                (request, answer) = under_way.select_next_some() => match answer {
                    Ok(answer) if knows(&met, &request) => this.send(request, answer).await,
                    Ok(answer) => early.push(Early { request, answer, until: Instant::now() + INTRODUCTION }),
                    Err(oneshot::Canceled) => {}
                },
                status = statuses.next() => match status {
                    Some(DataWriterStatus::PublicationMatched { current, reader, .. }) => {
                        if current.count_change() > 0 {
                            met.insert(reader);
                        } else {
                            met.remove(&reader);
                        }
                    }
                    Some(_) => {}
                    None => break,
                },
                _ = alarm => {}
            }
            let now = Instant::now();
            for ready in early.extract_if(.., |early| knows(&met, &early.request) || early.until <= now) {
                this.send(ready.request, ready.answer).await;
            }
        }
    }

    async fn send(&self, request: RmwRequestId, answer: Resp) {
        let mut options = WriteOptionsBuilder::new()
            .source_timestamp(Timestamp::now())
            .related_sample_identity(SampleIdentity::from(request));
        let client = GUID::from(request.writer_gid);
        if client.entity_id.kind().is_reader() {
            // The answers to others would crowd those to it out of its queue, which holds ten.
            options = options.to_single_reader(client);
        }
        let content = cdr_encoding::to_vec::<_, LittleEndian>(&answer).unwrap_or_default();
        match self.answers.async_write_with_options(answer, options.build()).await {
            // In the clear, so not where others must not read it.
            Ok(written) if content.len() > large::FRAGMENT.into() && !self.secured => {
                large::send(&self.participant, written, SampleIdentity::from(request), content);
            }
            Ok(_) => {}
            Err(e) => {
                self.health.warn("write", &format!("the answer of {} was not written: {}", self.name, e.forget_data()));
            }
        }
    }
}

/// What an answer has to carry so that the client knows which of its requests it belongs to. Fast DDS names its reader of
/// answers and leaves the number of the request to the request itself; others name the request.
fn identity(info: &MessageInfo) -> RmwRequestId {
    let own = RmwRequestId { writer_gid: info.publisher_gid(), sequence_number: info.sequence_number() };
    match info.related_request_id() {
        None => own,
        Some(named) if named.sequence_number == i64::from(SequenceNumber::UNKNOWN) => {
            RmwRequestId { writer_gid: named.writer_gid, ..own }
        }
        Some(named) => named,
    }
}

/// Whether the reader of the answer to a request has been met. Where the request names its writer, any reader of the
/// same participant stands for it.
fn knows(met: &HashSet<GUID>, request: &RmwRequestId) -> bool {
    let client = GUID::from(request.writer_gid);
    if client.entity_id.kind().is_reader() {
        met.contains(&client)
    } else {
        met.iter().any(|reader| reader.prefix == client.prefix)
    }
}
