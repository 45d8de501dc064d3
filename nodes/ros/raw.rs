//! Topics whose type is known by name only: messages go in and out as CDR bytes with their 4-byte header.
//!
//! RTPS fills short messages up to a multiple of 4 bytes and does not say by how much, so up to 3 zero bytes may stand
//! behind the content; decoders ignore them. RustDDS keeps the header apart from the content, and fixes the byte order of a writer by its type; so there is one
//! adapter for each order.

use std::net::SocketAddr;
use std::time::Duration;

use futures::channel::mpsc;
use futures::{FutureExt, SinkExt, StreamExt};
use rustdds::bytes::Bytes;
use rustdds::dds::WriteError;
use rustdds::no_key::{DataWriter, Decode, DefaultDecoder, DeserializerAdapter, SerializerAdapter, SimpleDataReader};
use rustdds::policy::{Durability, History, Reliability, ResourceLimits};
use rustdds::{QosPolicies, QosPolicyBuilder, RTPSEntity, RepresentationIdentifier, Timestamp, TopicKind};

use super::discovery::Audience;
use super::session::{Session, SessionError};
use super::topics::TOPIC_PREFIX;

/// Length of the header: two bytes representation identifier, two bytes options.
const HEADER_LEN: usize = 4;

/// Messages that may wait between the middleware and whoever takes them.
const CHANNEL_DEPTH: usize = 16;

/// Prefix that DDS puts before the name of a ROS message type, after its package.
const DDS_TYPE_PART: &str = "::msg::dds_::";

/// A ROS type name, `package/msg/Type`, as DDS knows it: `package::msg::dds_::Type_`.
pub fn dds_type_name(ros: &str) -> Option<String> {
    let (package, rest) = ros.split_once('/')?;
    // Old names leave the `msg` out.
    let name = rest.strip_prefix("msg/").unwrap_or(rest);
    let plain = |s: &str| !s.is_empty() && s.chars().all(|c| c.is_ascii_alphanumeric() || c == '_');
    (plain(package) && plain(name)).then(|| format!("{package}{DDS_TYPE_PART}{name}_"))
}

/// A DDS type name as ROS knows it; `None` for the type of a service, an action or of something that is not ROS.
fn ros_type_name(dds: &str) -> Option<String> {
    let (package, name) = dds.split_once(DDS_TYPE_PART)?;
    Some(format!("{package}/msg/{}", name.strip_suffix('_')?))
}

/// Quality of service of a raw topic.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RawQos {
    /// Reliable rather than best effort.
    pub reliable: bool,
    /// Transient local rather than volatile.
    pub transient_local: bool,
    /// Samples kept.
    pub depth: usize,
}

impl RawQos {
    fn of(qos: &QosPolicies) -> Self {
        Self {
            reliable: matches!(qos.reliability(), Some(Reliability::Reliable { .. })),
            transient_local: qos.durability().is_some_and(|d| d >= Durability::TransientLocal),
            depth: match qos.history() {
                Some(History::KeepLast { depth }) => usize::try_from(depth).unwrap_or(1),
                _ => 1,
            },
        }
    }

    fn policies(self) -> QosPolicyBuilder {
        let depth = i32::try_from(self.depth).unwrap_or(i32::MAX);
        QosPolicyBuilder::new()
            .reliability(if self.reliable {
                // The wait itself is ours, see `RawPublisher::send`.
                Reliability::Reliable { max_blocking_time: rustdds::Duration::ZERO }
            } else {
                Reliability::BestEffort
            })
            .durability(if self.transient_local { Durability::TransientLocal } else { Durability::Volatile })
            .history(History::KeepLast { depth })
    }
}

/// A message as received.
#[derive(Debug, Clone)]
pub struct RawSample {
    /// Header and CDR.
    pub cdr: Vec<u8>,
    /// When the publisher sent it \[ns since the epoch\], if it said so.
    pub source_time_ns: Option<i64>,
}

/// A publisher or subscription that discovery has told of.
#[derive(Debug, Clone)]
pub struct RemoteEndpoint {
    /// ROS name of its topic.
    pub topic: String,
    /// ROS type name.
    pub type_name: String,
    /// What it offers or asks for.
    pub qos: RawQos,
    /// Where it receives.
    pub addresses: Vec<SocketAddr>,
}

/// CDR content without its header, as RustDDS wants it.
struct Content {
    header: [u8; HEADER_LEN],
    bytes: Bytes,
}

/// Adapter for one byte order: `BIG` is what a writer declares; a reader takes both.
struct RawAdapter<const BIG: bool>;

#[derive(Clone)]
struct RawDecoder;

impl<const BIG: bool> DeserializerAdapter<Content> for RawAdapter<BIG> {
    type Error = std::io::Error;
    type Decoded = Content;

    fn supported_encodings() -> &'static [RepresentationIdentifier] {
        &[RepresentationIdentifier::CDR_LE, RepresentationIdentifier::CDR_BE]
    }

    fn transform_decoded(decoded: Content) -> Content {
        decoded
    }
}

impl<const BIG: bool> DefaultDecoder<Content> for RawAdapter<BIG> {
    type Decoder = RawDecoder;
    const DECODER: RawDecoder = RawDecoder;
}

impl Decode<'_, Content> for RawDecoder {
    type Error = std::io::Error;

    fn decode_bytes(self, bytes: &[u8], encoding: RepresentationIdentifier) -> Result<Content, std::io::Error> {
        let little = u8::from(encoding == RepresentationIdentifier::CDR_LE);
        Ok(Content { header: [0, little, 0, 0], bytes: Bytes::copy_from_slice(bytes) })
    }
}

impl<const BIG: bool> SerializerAdapter<Content> for RawAdapter<BIG> {
    type Error = std::io::Error;

    fn output_encoding() -> RepresentationIdentifier {
        if BIG { RepresentationIdentifier::CDR_BE } else { RepresentationIdentifier::CDR_LE }
    }

    fn to_bytes(value: &Content) -> Result<Bytes, std::io::Error> {
        Ok(value.bytes.clone())
    }
}

enum Writer {
    Little(DataWriter<Content, RawAdapter<false>>),
    Big(DataWriter<Content, RawAdapter<true>>),
}

impl Session {
    /// A publisher of messages of a type known by name. The topic's name is remapped as any other. `unacknowledged` is
    /// how many messages may be under way to reliable volatile subscriptions.
    ///
    /// # Errors
    /// [`SessionError`] for a name or type that ROS does not allow, or where the middleware refuses.
    pub fn publish_raw(
        &mut self,
        topic: &str,
        type_name: &str,
        qos: RawQos,
        unacknowledged: usize,
        big_endian: bool,
    ) -> Result<RawPublisher, SessionError> {
        let name = self.names.topic(topic)?;
        let fail = |e: rustdds::dds::CreateError| SessionError::middleware(format!("publisher of {name}"), e);
        let mut policies = qos.policies();
        if qos.reliable && !qos.transient_local {
            // The writer itself makes a further sample wait until one was acknowledged.
            let most = i32::try_from(unacknowledged).unwrap_or(i32::MAX);
            policies = policies.resource_limits(ResourceLimits {
                max_samples: most,
                max_instances: most,
                max_samples_per_instance: most,
            });
        }
        let policies = policies.build();
        let dds_topic = self.raw_topic(&name, type_name, &policies)?;
        let publisher = self.context.domain_participant().create_publisher(&policies).map_err(fail)?;
        let writer = if big_endian {
            Writer::Big(publisher.create_datawriter_no_key(&dds_topic, None).map_err(fail)?)
        } else {
            Writer::Little(publisher.create_datawriter_no_key(&dds_topic, None).map_err(fail)?)
        };
        let guid = match &writer {
            Writer::Little(writer) => writer.guid(),
            Writer::Big(writer) => writer.guid(),
        };
        Ok(RawPublisher { writer, reliable: qos.reliable, audience: self.audience_of(guid, &name) })
    }

    /// The messages of a topic of a type known by name.
    ///
    /// # Errors
    /// As for [`Self::publish_raw`].
    pub fn subscribe_raw(
        &mut self,
        topic: &str,
        type_name: &str,
        qos: RawQos,
    ) -> Result<mpsc::Receiver<RawSample>, SessionError> {
        let name = self.names.topic(topic)?;
        let fail = |e: rustdds::dds::CreateError| SessionError::middleware(format!("subscription of {name}"), e);
        let policies = qos.policies().build();
        let dds_topic = self.raw_topic(&name, type_name, &policies)?;
        let subscriber = self.context.domain_participant().create_subscriber(&policies).map_err(fail)?;
        let reader: SimpleDataReader<Content, RawAdapter<false>> =
            subscriber.create_simple_datareader_no_key(&dds_topic, None).map_err(fail)?;
        // So that a publisher that offers less is warned of by name.
        self.endpoints.opened(reader.guid(), &name);
        // As for a topic of the cell: what is left in the middleware is lost when its publisher ends.
        let waiting = if qos.reliable { qos.depth.max(CHANNEL_DEPTH) } else { CHANNEL_DEPTH };
        let (mut sender, receiver) = mpsc::channel(waiting);
        self.spawn(async move {
            let mut samples = Box::pin(reader.as_async_stream());
            while let Some(sample) = samples.next().await {
                match sample {
                    Ok(sample) => {
                        let source_time_ns = sample.source_timestamp().map(nanoseconds);
                        let content = sample.into_value();
                        let cdr = [&content.header[..], &content.bytes].concat();
                        if sender.send(RawSample { cdr, source_time_ns }).await.is_err() {
                            break;
                        }
                    }
                    Err(e) => log::warn!("a message on {name} cannot be read: {e}"),
                }
            }
        });
        Ok(receiver)
    }

    /// The ROS topics that other processes publish now.
    pub fn remote_publishers(&self) -> Vec<RemoteEndpoint> {
        let participant = self.context.domain_participant();
        let own = participant.guid().prefix;
        let writers = participant.discovered_writers();
        let others = writers.into_iter().filter(|w| w.writer_proxy.remote_writer_guid.prefix != own);
        others
            .filter_map(|writer| {
                let data = &writer.publication_topic_data;
                endpoint(&data.topic_name, &data.type_name, &data.qos(), Vec::new())
            })
            .collect()
    }

    /// The ROS topics that other processes subscribe now.
    pub fn remote_subscriptions(&self) -> Vec<RemoteEndpoint> {
        let participant = self.context.domain_participant();
        let own = participant.guid().prefix;
        let readers = participant.discovered_readers();
        let others = readers.into_iter().filter(|r| r.reader_proxy.remote_reader_guid.prefix != own);
        others
            .filter_map(|reader| {
                let data = &reader.subscription_topic_data;
                let addresses = reader.reader_proxy.unicast_locator_list.iter().map(|l| SocketAddr::from(*l)).collect();
                endpoint(data.topic_name(), data.type_name(), &data.qos(), addresses)
            })
            .collect()
    }

    /// The DDS domain of the process.
    pub fn domain_id(&self) -> u16 {
        self.context.domain_id()
    }

    fn raw_topic(&self, name: &str, type_name: &str, qos: &QosPolicies) -> Result<rustdds::Topic, SessionError> {
        let dds_type = dds_type_name(type_name).ok_or_else(|| {
            SessionError::middleware(
                format!("topic {name}"),
                format!("'{type_name}' is not of the form package/msg/Type"),
            )
        })?;
        self.context
            .domain_participant()
            .create_topic(format!("{TOPIC_PREFIX}{name}"), dds_type, qos, TopicKind::NoKey)
            .map_err(|e| SessionError::middleware(format!("topic {name}"), e))
    }
}

fn endpoint(dds_name: &str, dds_type: &str, qos: &QosPolicies, addresses: Vec<SocketAddr>) -> Option<RemoteEndpoint> {
    Some(RemoteEndpoint {
        topic: dds_name.strip_prefix(TOPIC_PREFIX).filter(|rest| rest.starts_with('/'))?.to_owned(),
        type_name: ros_type_name(dds_type)?,
        qos: RawQos::of(qos),
        addresses,
    })
}

/// A DDS time in nanoseconds since the epoch.
fn nanoseconds(time: Timestamp) -> i64 {
    const NANOSECONDS: i128 = 1_000_000_000;
    // 32.32 fixed point, seconds since the epoch.
    i64::try_from((i128::from(time.to_ticks()) * NANOSECONDS) >> 32).unwrap_or(i64::MAX)
}

/// Publishes messages of one topic as they are.
pub struct RawPublisher {
    writer: Writer,
    /// Whether it repeats what a reliable subscription missed.
    pub reliable: bool,
    audience: Audience,
}

/// What came of sending a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Sent {
    /// It is on its way.
    Yes,
    /// Its byte order is not the one this publisher was opened with, or it has no CDR header.
    Unfit,
    /// Nobody took the messages before it within the time allowed.
    Stalled,
}

impl RawPublisher {
    /// Who listens.
    pub fn audience(&self) -> &Audience {
        &self.audience
    }

    /// Sends a message, once few enough are under way to reliable volatile subscriptions (see [`Session::publish_raw`]).
    ///
    /// # Errors
    /// The middleware refuses.
    pub async fn send(&self, cdr: &Bytes, patience: Duration) -> Result<Sent, SessionError> {
        let unfit = cdr.len() < HEADER_LEN
            || cdr[0] != 0
            || match self.writer {
                Writer::Little(_) => cdr[1] != 1,
                Writer::Big(_) => cdr[1] != 0,
            };
        if unfit {
            return Ok(Sent::Unfit);
        }
        match &self.writer {
            Writer::Little(writer) => send(writer, cdr, patience).await,
            Writer::Big(writer) => send(writer, cdr, patience).await,
        }
    }

    /// Waits until every reliable subscription has acknowledged everything; `false` when that takes longer than allowed.
    pub async fn acknowledged(&self, patience: Duration) -> bool {
        let wait = async {
            let result = match &self.writer {
                Writer::Little(writer) => writer.async_wait_for_acknowledgments().await,
                Writer::Big(writer) => writer.async_wait_for_acknowledgments().await,
            };
            result.unwrap_or(false)
        };
        smol::future::or(wait, async {
            smol::Timer::after(patience).await;
            false
        })
        .await
    }
}

/// How often a full writer is asked again. It wakes its waiter itself; this bounds the wait where it doesn't.
const RETRY: Duration = Duration::from_millis(20);

async fn send<const BIG: bool>(
    writer: &DataWriter<Content, RawAdapter<BIG>>,
    cdr: &Bytes,
    patience: Duration,
) -> Result<Sent, SessionError> {
    let begun = std::time::Instant::now();
    loop {
        let content = Content { header: [0; HEADER_LEN], bytes: cdr.slice(HEADER_LEN..) };
        let written = futures::select! {
            result = writer.async_write(content, Some(Timestamp::now())).fuse() => Some(result),
            _ = FutureExt::fuse(smol::Timer::after(RETRY)) => None,
        };
        match written {
            Some(Ok(())) => return Ok(Sent::Yes),
            Some(Err(WriteError::WouldBlock { .. })) => {
                smol::Timer::after(Duration::from_micros(100)).await;
            }
            Some(Err(e)) => return Err(SessionError::middleware("writing a message", reason(&e))),
            None => {}
        }
        if begun.elapsed() > patience {
            return Ok(Sent::Stalled);
        }
    }
}

/// The error without the message that could not be written.
fn reason(error: &WriteError<Content>) -> String {
    match error {
        WriteError::Serialization { reason, .. }
        | WriteError::Poisoned { reason, .. }
        | WriteError::Internal { reason } => reason.clone(),
        WriteError::Io(e) => e.to_string(),
        WriteError::WouldBlock { .. } => "no room".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn type_names_go_both_ways() {
        let dds = dds_type_name("sensor_msgs/msg/Image");
        assert_eq!(dds.as_deref(), Some("sensor_msgs::msg::dds_::Image_"));
        assert_eq!(ros_type_name("sensor_msgs::msg::dds_::Image_").as_deref(), Some("sensor_msgs/msg/Image"));
        assert_eq!(dds_type_name("std_msgs/String").as_deref(), Some("std_msgs::msg::dds_::String_"));
        for bad in ["", "Image", "a/b/c", "a b/msg/C", "/msg/X", "x/msg/"] {
            assert_eq!(dds_type_name(bad), None, "{bad}");
        }
        for bad in ["", "std_srvs::srv::dds_::Trigger_Request_", "x::msg::dds_::Y"] {
            assert_eq!(ros_type_name(bad), None, "{bad}");
        }
    }

    #[test]
    fn dds_times_become_nanoseconds() {
        assert_eq!(nanoseconds(Timestamp::from_ticks((3 << 32) + (1 << 31))), 3_500_000_000);
    }
}
