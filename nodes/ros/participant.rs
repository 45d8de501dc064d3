//! The DDS participant of a process: how it joins its domain, and leaves it.
//!
//! All nodes of a process share one. It is opened on the interfaces and for the hosts that parameters or environment name,
//! secured where the environment says so, in its [turn](super::mends::turn), and says [farewell](super::mends::farewell) when it has gone.

use std::net::{IpAddr, Ipv4Addr};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::time::Duration;

use ros2_client::Context;
use rustdds::{DomainParticipant, DomainParticipantBuilder, RTPSEntity};

use super::arguments::ArgsError;
use super::discovery::Endpoints;
use super::exit::ProcessError;
use super::mends::farewell::Farewell;
use super::mends::peers::Courier;
use super::mends::turn::Turn;
use super::node_params::{NETWORK_INTERFACES, STATIC_PEERS};
use super::params::Parameters;
use super::security;
use super::session::SessionError;

/// How long the middleware may take to end; what it has not done by then is left to the end of the process.
const MIDDLEWARE_PATIENCE: Duration = Duration::from_secs(5);

/// A participant that has joined its domain.
pub(super) struct Participant {
    /// The middleware's own.
    pub(super) participant: DomainParticipant,
    /// The client library's view of it.
    pub(super) context: Context,
    /// Whether what it sends is encrypted.
    pub(super) secured: bool,
    /// Held until all of its endpoints are known.
    turn: Option<Turn>,
    farewell: Farewell,
}

impl Participant {
    /// Joins the domain that the environment names, with these parameters and, where the environment wants it, secured by this
    /// enclave.
    ///
    /// # Errors
    /// A bad value of the environment; what the system or the middleware refuses.
    pub(super) fn join(parameters: &Parameters, enclave: Option<&str>) -> Result<Self, ProcessError> {
        let environment = |variable: &'static str| std::env::var(variable).ok();
        let domain = domain_id(environment("ROS_DOMAIN_ID").as_deref())?;
        let mut builder = DomainParticipantBuilder::new(domain);
        let addresses = interfaces(parameters, environment)?;
        if !addresses.is_empty() {
            log::debug!("network interfaces: {addresses:?}");
            builder = builder.with_only_networks(addresses.iter().copied());
        }
        let enclave = security::enclave(enclave, environment)?;
        let secured = enclave.is_some();
        if let Some(enclave) = enclave {
            builder = security::secure(builder, &enclave);
        }
        let peers = static_peers(parameters, environment("ROS_STATIC_PEERS"))?;
        let system = |e: std::io::Error| ProcessError::System { what: "listening to discovery", reason: e.to_string() };
        // Opened before the participant, so that its first announcement is heard.
        let courier = if peers.is_empty() { None } else { Some(Courier::open(domain, &addresses).map_err(system)?) };
        let turn = Some(Turn::take(domain, secured));
        let refused = |e: &dyn std::fmt::Display| SessionError::middleware(format!("DDS domain {domain}"), e);
        let participant = builder.build().map_err(|e| refused(&e))?;
        if let Some(courier) = courier {
            log::debug!("static peers: {peers:?}");
            courier.serve(participant.guid(), peers.clone()).map_err(system)?;
        }
        let farewell = Farewell::of(participant.guid(), domain, addresses, peers);
        let context = Context::from_domain_participant(participant.clone()).map_err(|e| refused(&e))?;
        Ok(Self { participant, context, secured, turn, farewell })
    }

    /// To be awaited once all endpoints are open: lets other processes have their turn.
    pub(super) fn let_others_join(&mut self, endpoints: Endpoints) -> impl Future<Output = ()> + use<> {
        let turn = self.turn.take();
        let handshakes = self.secured.then_some(move || endpoints.handshakes());
        async move {
            if let Some(turn) = turn {
                turn.done(handshakes).await;
            }
        }
    }

    /// Leaves the domain: ends the middleware's threads, waiting for them with a limit, and says farewell when nothing is left
    /// that could announce itself once more.
    pub(super) fn leave(self) {
        let Self { participant, context, secured, turn, farewell } = self;
        let (gone, ended) = mpsc::channel::<()>();
        let dropping = std::thread::Builder::new()
            .name("take down".to_owned())
            .spawn(move || drop((participant, context, turn, gone)));
        if dropping.is_ok() && ended.recv_timeout(MIDDLEWARE_PATIENCE) == Err(RecvTimeoutError::Timeout) {
            log::warn!("the middleware has not ended after {} s and is left to itself", MIDDLEWARE_PATIENCE.as_secs());
        }
        say_farewell(&farewell, secured);
    }

    /// Leaves a domain with a middleware of which a thread is dead: it can't be taken down in order, its drop would wait for the dead
    /// thread.
    pub(super) fn leave_as_it_is(&self) {
        say_farewell(&self.farewell, self.secured);
    }
}

/// What can't be signed is not said of a secured participant.
fn say_farewell(farewell: &Farewell, secured: bool) {
    if let Some(Err(e)) = (!secured).then(|| farewell.say()) {
        log::debug!("nobody was told of the end: {e}");
    }
}

/// The DDS domain that `ROS_DOMAIN_ID` names, 0 where it is not set.
///
/// # Errors
/// [`ArgsError::Environment`] for anything but a whole number of 0 to 232, the range for which the ports of RTPS exist.
fn domain_id(variable: Option<&str>) -> Result<u16, ArgsError> {
    const LAST_DOMAIN: u16 = 232;
    match variable.map(str::trim) {
        None | Some("") => Ok(0),
        Some(text) => text.parse().ok().filter(|&id| id <= LAST_DOMAIN).ok_or_else(|| ArgsError::Environment {
            variable: "ROS_DOMAIN_ID",
            value: text.to_owned(),
            rule: "must be a whole number of 0 to 232",
        }),
    }
}

/// The addresses that the parameter or the environment restricts the middleware to; none for no restriction.
fn interfaces(
    parameters: &Parameters,
    environment: impl Fn(&'static str) -> Option<String>,
) -> Result<Vec<IpAddr>, ArgsError> {
    let loopback = vec![IpAddr::from([127, 0, 0, 1])];
    let given: Vec<IpAddr> =
        parameters.texts(&NETWORK_INTERFACES).iter().filter_map(|text| text.parse().ok()).collect();
    if !given.is_empty() {
        return Ok(given);
    }
    if environment("ROS_LOCALHOST_ONLY").as_deref() == Some("1") {
        return Ok(loopback);
    }
    match environment("ROS_AUTOMATIC_DISCOVERY_RANGE").as_deref() {
        None | Some("" | "SUBNET" | "SYSTEM_DEFAULT") => Ok(Vec::new()),
        Some("LOCALHOST" | "OFF") => Ok(loopback),
        Some(other) => Err(ArgsError::Environment {
            variable: "ROS_AUTOMATIC_DISCOVERY_RANGE",
            value: other.to_owned(),
            rule: "must be one of SUBNET, LOCALHOST, OFF, SYSTEM_DEFAULT",
        }),
    }
}

/// The hosts to announce this process to, of the parameter or the environment.
fn static_peers(parameters: &Parameters, environment: Option<String>) -> Result<Vec<Ipv4Addr>, ArgsError> {
    let given: Vec<Ipv4Addr> = parameters.texts(&STATIC_PEERS).iter().filter_map(|text| text.parse().ok()).collect();
    if !given.is_empty() {
        return Ok(given);
    }
    let texts = environment.unwrap_or_default();
    let texts = texts.split(';').map(str::trim).filter(|text| !text.is_empty());
    texts
        .map(|text| {
            text.parse().map_err(|_| ArgsError::Environment {
                variable: "ROS_STATIC_PEERS",
                value: text.to_owned(),
                rule: "must be IPv4 addresses, separated by ';'",
            })
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_domain_is_a_number_in_range() {
        assert_eq!(domain_id(None).unwrap(), 0);
        assert_eq!(domain_id(Some("42")).unwrap(), 42);
        for bad in ["233", "-1", "x", "1.5"] {
            assert!(domain_id(Some(bad)).unwrap_err().to_string().contains(bad));
        }
    }
}
