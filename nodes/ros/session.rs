//! One node: its topics as streams and sinks, its services as streams of calls.
//!
//! Streams and sinks are bounded channels, the same that join the nodes of a composed cell: a small task beside the
//! node's loop moves the messages between channel and middleware.

use std::cell::RefCell;
use std::collections::{HashMap, HashSet};
use std::rc::Rc;
use std::sync::{Arc, Mutex, PoisonError};

use futures::channel::{mpsc, oneshot};
use futures::{SinkExt, StreamExt};
use jigsaw_msgs::{Message, Service};
use ros2_client::qos::{History, Reliability};
use ros2_client::{Context, MessageInfo, MessageTypeName, Node, QosProfile, Subscription};
use rustdds::{GUID, RTPSEntity};

use super::activity::Activity;
use super::arguments::names::{NameError, NodeNames};
use super::clock::Clock;
use super::discovery::{Audience, Endpoints, LesserWriter, Offer};
use super::health::Health;
use super::params::Parameters;
use super::topics::{TOPIC_PREFIX, Topic};

/// Messages that may wait between two stages. Few: what waits further out waits in the stage before, or in the middleware's
/// cache.
pub const CHANNEL_DEPTH: usize = 4;

/// Why a node could not be opened.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SessionError {
    /// A name that ROS does not allow.
    #[error(transparent)]
    Name(#[from] NameError),
    /// The middleware refused something.
    #[error("{what}: {reason}")]
    Middleware {
        /// What was to be opened.
        what: String,
        /// The middleware's words.
        reason: String,
    },
}

impl SessionError {
    pub(super) fn middleware(what: impl Into<String>, reason: impl std::fmt::Display) -> Self {
        Self::Middleware { what: what.into(), reason: reason.to_string() }
    }
}

/// A request to a service, with the way back.
#[derive(Debug)]
pub struct Call<S: Service> {
    /// What the caller wants.
    pub request: S::Request,
    /// Where the answer goes; a call that is dropped is never answered.
    pub reply: oneshot::Sender<S::Response>,
}

/// What the loop of a node needs beside its streams.
#[derive(Debug, Clone)]
pub struct Settings {
    /// Parameters; a loop looks at them with every message.
    pub parameters: Arc<Parameters>,
    /// Counters.
    pub health: Arc<Health>,
    /// Whether the node works.
    pub activity: Activity,
}

/// An open node.
pub struct Session {
    pub(super) context: Context,
    pub(super) node: Rc<RefCell<Node>>,
    pub(super) names: NodeNames,
    pub(super) executor: Rc<smol::LocalExecutor<'static>>,
    pub(super) endpoints: Endpoints,
    /// Whether what goes out is encrypted.
    pub(super) secured: bool,
    /// The parameters, served while the process lives.
    pub parameters: Arc<Parameters>,
    /// The counters, published while the process lives.
    pub health: Arc<Health>,
    /// The time.
    pub clock: Clock,
    /// Whether the node works now; see [`Self::manage`].
    pub activity: Activity,
}

impl Session {
    /// The names of the node.
    pub fn names(&self) -> &NodeNames {
        &self.names
    }

    /// What the node's loop needs of this session.
    pub fn settings(&self) -> Settings {
        let Self { parameters, health, activity, .. } = self;
        Settings { parameters: Arc::clone(parameters), health: Arc::clone(health), activity: activity.clone() }
    }

    /// Runs something beside the node's loop for as long as the process lives.
    pub fn spawn(&self, future: impl Future<Output = ()> + 'static) {
        self.executor.spawn(future).detach();
    }

    /// The messages of a topic. One that can't be decoded is refused and left out.
    ///
    /// # Errors
    /// [`SessionError`] for a bad name, or where the middleware refuses.
    pub fn subscribe<M: Message>(&mut self, topic: &Topic<M>) -> Result<mpsc::Receiver<M>, SessionError> {
        self.subscribe_as(topic, |message, _| message)
    }

    /// The messages of a topic, made into something else together with what the middleware tells of each.
    ///
    /// # Errors
    /// As for [`Self::subscribe`].
    pub(super) fn subscribe_as<M: Message, T: Send + 'static>(
        &mut self,
        topic: &Topic<M>,
        make: impl Fn(M, MessageInfo) -> T + Send + 'static,
    ) -> Result<mpsc::Receiver<T>, SessionError> {
        let (name, dds_topic) = self.dds_topic(topic)?;
        let subscription = self.reader_opener().open::<M>(&name, &dds_topic, None)?;
        let (sender, receiver) = mpsc::channel(waiting(&topic.qos));
        listen(
            &self.executor,
            hand_on(subscription, name, Arc::clone(&self.health), sender, move |message, info| {
                Some(make(message, info))
            }),
        );
        Ok(receiver)
    }

    /// As [`Self::subscribe`], and heard are those as well who offer less than the topic asks for.
    ///
    /// # Errors
    /// As for [`Self::subscribe`].
    pub fn subscribe_to_all<M: Message>(&mut self, topic: &Topic<M>) -> Result<mpsc::Receiver<M>, SessionError> {
        self.subscribe_to_all_as(topic, |message, _| message)
    }

    /// As [`Self::subscribe_as`]. A publisher that offers less than the topic asks for is heard too: by a subscription that
    /// asks for no more, opened when the first of its kind is met, which hears that kind alone.
    pub(super) fn subscribe_to_all_as<M: Message, T: Send + 'static>(
        &mut self,
        topic: &Topic<M>,
        make: impl Fn(M, MessageInfo) -> T + Clone + Send + 'static,
    ) -> Result<mpsc::Receiver<T>, SessionError> {
        let (name, dds_topic) = self.dds_topic(topic)?;
        let opener = self.reader_opener();
        let subscription = opener.open::<M>(&name, &dds_topic, None)?;
        let mut met = self.endpoints.lesser_writers(subscription.guid());
        let (sender, receiver) = mpsc::channel(waiting(&topic.qos));
        let (qos, executor, health) = (topic.qos.clone(), Rc::clone(&self.executor), Arc::clone(&self.health));
        let every = make.clone();
        let handing_on =
            hand_on(subscription, name.clone(), Arc::clone(&health), sender.clone(), move |message, info| {
                Some(every(message, info))
            });
        listen(&self.executor, handing_on);
        self.spawn(async move {
            let offers: Arc<Mutex<HashMap<GUID, Offer>>> = Arc::default();
            let mut heard = HashSet::new();
            while let Some(LesserWriter { writer, offer }) = met.next().await {
                offers.lock().unwrap_or_else(PoisonError::into_inner).insert(writer, offer);
                if !heard.insert(offer) {
                    continue;
                }
                let subscription = match opener.open::<M>(&name, &dds_topic, Some(offer.at_most(qos.clone()))) {
                    Ok(subscription) => subscription,
                    Err(e) => {
                        health.warn("subscription", &e.to_string());
                        continue;
                    }
                };
                log::info!("a publisher on {name} offers less than is asked for, and is heard all the same: {offer:?}");
                let (offers, make) = (Arc::clone(&offers), make.clone());
                let of_its_kind = move |message, info: MessageInfo| {
                    // What offers more is heard by another subscription.
                    let is_this =
                        offers.lock().unwrap_or_else(PoisonError::into_inner).get(&info.publisher_gid().into())
                            == Some(&offer);
                    is_this.then(|| make(message, info))
                };
                let handing_on = hand_on(subscription, name.clone(), Arc::clone(&health), sender.clone(), of_its_kind);
                listen(&executor, handing_on);
            }
        });
        Ok(receiver)
    }

    fn reader_opener(&self) -> ReaderOpener {
        ReaderOpener { node: Rc::clone(&self.node), endpoints: self.endpoints.clone() }
    }

    /// A sink to a topic, and who listens. A message that no reader takes in time is reported and dropped.
    ///
    /// # Errors
    /// As for [`Self::subscribe`].
    pub fn publish<M: Message>(&mut self, topic: &Topic<M>) -> Result<(mpsc::Sender<M>, Audience), SessionError> {
        self.publish_counted(topic, || {})
    }

    /// As [`Self::publish`]; says of each message when it has been written.
    pub(super) fn publish_counted<M: Message>(
        &mut self,
        topic: &Topic<M>,
        written: impl Fn() + 'static,
    ) -> Result<(mpsc::Sender<M>, Audience), SessionError> {
        let (name, dds_topic) = self.dds_topic(topic)?;
        let publisher = self
            .node
            .borrow_mut()
            .create_publisher::<M>(&dds_topic, None)
            .map_err(|e| SessionError::middleware(format!("publisher of {name}"), e))?;
        let writer = publisher.guid();
        self.endpoints.opened(writer, &name);
        let (sender, mut receiver) = mpsc::channel(CHANNEL_DEPTH);
        let health = Arc::clone(&self.health);
        self.spawn(async move {
            while let Some(message) = receiver.next().await {
                match publisher.async_publish(message).await {
                    Ok(()) => written(),
                    Err(_) => health
                        .warn("write", &format!("a message on {name} was not written: its readers are too far behind")),
                }
            }
        });
        Ok((sender, self.endpoints.audience(writer)))
    }

    /// Who listens to a writer that was opened beside the publishers of this session.
    pub(super) fn audience_of(&self, writer: GUID, name: &str) -> Audience {
        self.endpoints.opened(writer, name);
        self.endpoints.audience(writer)
    }

    /// Gives the writers of a topic in other processes, as discovery knows them at the time of the call.
    ///
    /// # Errors
    /// A bad name.
    pub fn writers_of<M>(&self, topic: &Topic<M>) -> Result<impl Fn() -> Vec<GUID> + use<M>, SessionError> {
        let name = format!("{TOPIC_PREFIX}{}", self.names.topic(topic.name)?);
        let participant = self.context.domain_participant().clone();
        let own = participant.guid().prefix;
        Ok(move || {
            let writers = participant.discovered_writers().into_iter();
            writers
                .filter(|writer| writer.publication_topic_data.topic_name == name)
                .map(|writer| writer.writer_proxy.remote_writer_guid)
                .filter(|writer| writer.prefix != own)
                .collect()
        })
    }

    fn dds_topic<M: Message>(&self, topic: &Topic<M>) -> Result<(String, rustdds::Topic), SessionError> {
        let name = self.names.topic(topic.name)?;
        let type_name = MessageTypeName::new(M::TYPE.package, M::TYPE.name);
        let dds_topic = self
            .context
            .create_topic(format!("{TOPIC_PREFIX}{name}"), type_name, &topic.qos)
            .map_err(|e| SessionError::middleware(format!("topic {name}"), e))?;
        Ok((name, dds_topic))
    }
}

/// Messages of a topic that may wait between the middleware and a node's loop. Of a reliable one all that the middleware
/// keeps: RustDDS gives out nothing more of a writer that is gone, though it was received and acknowledged.
fn waiting(qos: &QosProfile) -> usize {
    match (&qos.reliability, &qos.history) {
        (Reliability::Reliable { .. }, History::KeepLast { depth }) => (*depth).max(CHANNEL_DEPTH),
        _ => CHANNEL_DEPTH,
    }
}

/// Opens subscriptions of a node, also while it runs.
struct ReaderOpener {
    node: Rc<RefCell<Node>>,
    endpoints: Endpoints,
}

impl ReaderOpener {
    /// A subscription, of the quality of service of its topic unless another one is given.
    fn open<M: Message>(
        &self,
        name: &str,
        topic: &rustdds::Topic,
        qos: Option<QosProfile>,
    ) -> Result<Subscription<M>, SessionError> {
        let subscription = self
            .node
            .borrow_mut()
            .create_subscription::<M>(topic, qos)
            .map_err(|e| SessionError::middleware(format!("subscription of {name}"), e))?;
        self.endpoints.opened(subscription.guid(), name);
        Ok(subscription)
    }
}

/// Runs what hands on messages for as long as the executor lives, on a thread that does nothing else: the loop of a node works
/// for milliseconds at a time, in which a writer may come and go.
fn listen(executor: &smol::LocalExecutor<'static>, handing_on: impl Future<Output = ()> + Send + 'static) {
    executor.spawn(smol::spawn(handing_on)).detach();
}

/// Hands what a subscription hears on to a channel, as long as someone takes it there.
async fn hand_on<M: Message, T>(
    subscription: Subscription<M>,
    name: String,
    health: Arc<Health>,
    mut sender: mpsc::Sender<T>,
    make: impl Fn(M, MessageInfo) -> Option<T>,
) {
    let mut messages = Box::pin(subscription.async_stream());
    while let Some(message) = messages.next().await {
        match message {
            Ok((message, info)) => {
                if let Some(made) = make(message, info)
                    && sender.send(made).await.is_err()
                {
                    break;
                }
            }
            Err(e) => health.refuse("undecodable", &format!("message on {name} can't be decoded: {e}")),
        }
    }
}
