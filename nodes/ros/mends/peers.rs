//! Discovery without multicast: announcing this process to given hosts.
//!
//! RustDDS announces a participant by multicast only and knows no list of peers. But it takes an announcement in on its
//! unicast discovery port as well. So the announcements that it multicasts are heard here, on this host, where multicast
//! comes back to its sender whatever the network does with it, and are sent on to each peer. Which port a participant of
//! the peer listens on is given by the RTPS specification (9.6.1.1) for the first, the second and so on of its host; each of
//! the first [`PARTICIPANTS`] is tried.
//!
//! A participant is spoken to by multicast if it says that it listens there. Three things keep it from saying so:
//! what its announcements say of multicast is taken out on the way (and addresses that mean nothing on another host);
//! so is that it takes announcements in, for a peer that is RustDDS as well would answer with its own as it is; and its
//! readers, which tell for themselves where they listen, have no multicast: the port for it is kept from them while the
//! participant opens.
//!
//! Both hosts must name each other: an announcement introduces only its sender. Other implementations' lists of initial
//! peers (Fast DDS, Cyclone DDS) work together with this.

use std::io::ErrorKind;
use std::net::{IpAddr, Ipv4Addr, SocketAddr, UdpSocket};
use std::time::{Duration, Instant};

use rustdds::GUID;
use socket2::{Domain, Protocol, Socket, Type};

/// Where participants announce themselves (RTPS 9.6.1.4.1).
pub(crate) const DISCOVERY_GROUP: Ipv4Addr = Ipv4Addr::new(239, 255, 0, 1);

/// Ports of the RTPS specification (9.6.1.1): base, gain of the domain, offsets of user multicast and of discovery
/// unicast, gain of the participant.
const PORT_BASE: u16 = 7400;
const DOMAIN_GAIN: u16 = 250;
const USER_MULTICAST_OFFSET: u16 = 1;
const UNICAST_OFFSET: u16 = 10;
const PARTICIPANT_GAIN: u16 = 2;

/// Participants of a peer that are announced to: more than the nodes of a cell, a bag player and some tools on one host.
pub const PARTICIPANTS: u16 = 16;

/// How often the last announcement is repeated, so that a peer that starts later, or lost it, need not wait for the next
/// (RustDDS: 10 s).
const REPEAT: Duration = Duration::from_secs(2);

/// How long another process may open its participant at the same time, and how often it is looked whether it has.
const OPENING: Duration = Duration::from_secs(5);
const LOOK_PERIOD: Duration = Duration::from_millis(5);

/// Most bytes of a datagram.
const MOST_BYTES: usize = 65536;

/// Where the prefix of the sender stands in an RTPS message, and where its header ends (9.4.4).
const PREFIX: std::ops::Range<usize> = 8..20;
const HEADER_LENGTH: usize = 20;

/// A submessage that carries data (9.4.5.3), its flags of byte order and inline quality of service, the writer of
/// announcements (9.3.1.3), what stands before its content, the heads of a list and of its entries, and a list's end
/// (9.4.2.11).
const DATA: u8 = 0x15;
const LITTLE_ENDIAN: u8 = 1;
const INLINE_QOS: u8 = 2;
const ANNOUNCER: [u8; 4] = [0, 1, 0, 0xc2];
const BEFORE_CONTENT: usize = 20;
const LIST_HEAD: usize = 4;
const LIST_ENTRY_HEAD: usize = 4;
const SENTINEL: u16 = 1;

/// Parameters of an announcement (9.6.2.2): where multicast, and where unicast is listened to.
const MULTICAST_LOCATORS: [u16; 2] = [0x33, 0x48];
const UNICAST_LOCATORS: [u16; 2] = [0x31, 0x32];

/// Parameter of an announcement that lists the participant's endpoints as bits (9.3.2.12), and the bit of the one that takes
/// announcements in.
const ENDPOINTS: u16 = 0x58;
const PARTICIPANT_DETECTOR: u32 = 1 << 1;

/// Where the IPv4 address stands in a locator, behind kind, port and twelve zeros.
const LOCATOR_ADDRESS: std::ops::Range<usize> = 20..24;

/// The port of [`DISCOVERY_GROUP`] in a domain.
pub(crate) fn discovery_multicast(domain: u16) -> u16 {
    PORT_BASE + DOMAIN_GAIN * domain
}

/// The ports on which the first participants of a host listen to discovery in a domain.
pub(crate) fn discovery_unicast(domain: u16) -> impl Iterator<Item = u16> + Clone {
    let first = PORT_BASE + DOMAIN_GAIN * domain + UNICAST_OFFSET;
    (0..PARTICIPANTS).map(move |k| first + PARTICIPANT_GAIN * k)
}

/// Hears the announcements made on this host. To be opened before the participant.
#[derive(Debug)]
pub struct Courier {
    socket: UdpSocket,
    domain: u16,
    /// Keeps the participant from listening to user multicast for as long as it opens.
    user_multicast: Socket,
}

impl Courier {
    /// Begins to listen, on the interfaces with these addresses; on all if there are none.
    ///
    /// # Errors
    /// The system's; [`ErrorKind::AddrInUse`] where a process does not share the port of user multicast.
    pub fn open(domain: u16, interfaces: &[IpAddr]) -> std::io::Result<Self> {
        let socket = Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::UDP))?;
        // Participants of this host listen there, too.
        socket.set_reuse_address(true)?;
        #[cfg(unix)]
        socket.set_reuse_port(true)?;
        let port = discovery_multicast(domain);
        socket.bind(&SocketAddr::from((Ipv4Addr::UNSPECIFIED, port)).into())?;
        let joined = multicast_addresses(interfaces)
            .into_iter()
            .filter(|interface| socket.join_multicast_v4(&DISCOVERY_GROUP, interface).is_ok())
            .count();
        if joined == 0 {
            return Err(std::io::Error::new(ErrorKind::AddrNotAvailable, "no interface of this host takes multicast"));
        }
        socket.set_read_timeout(Some(REPEAT))?;
        Ok(Self { socket: socket.into(), domain, user_multicast: keep_user_multicast(domain)? })
    }

    /// Sends the announcements of this participant to the peers for as long as the process lives.
    ///
    /// # Errors
    /// The system's, where no thread can be started.
    pub fn serve(self, participant: GUID, peers: Vec<Ipv4Addr>) -> std::io::Result<()> {
        let prefix = participant.to_bytes();
        let ports = discovery_unicast(self.domain);
        // This host hears the announcement itself.
        let own = multicast_addresses(&[]);
        let peers = peers.into_iter().filter(|peer| !own.contains(peer));
        let targets: Vec<SocketAddr> =
            peers.flat_map(|peer| ports.clone().map(move |port| SocketAddr::from((peer, port)))).collect();
        drop(self.user_multicast);
        let announcements = self.socket;
        let work = move || run(&announcements, &prefix[..12], &targets);
        std::thread::Builder::new().name("static peers".to_owned()).spawn(work)?;
        Ok(())
    }
}

/// Takes the port of user multicast for this socket alone.
fn keep_user_multicast(domain: u16) -> std::io::Result<Socket> {
    let socket = Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::UDP))?;
    let address = SocketAddr::from((Ipv4Addr::UNSPECIFIED, PORT_BASE + DOMAIN_GAIN * domain + USER_MULTICAST_OFFSET));
    // It goes beside sockets that share the port, and then lets none beside it.
    socket.set_reuse_address(true)?;
    let begun = Instant::now();
    while let Err(error) = socket.bind(&address.into()) {
        if error.kind() != ErrorKind::AddrInUse || begun.elapsed() > OPENING {
            return Err(error);
        }
        std::thread::sleep(LOOK_PERIOD);
    }
    socket.set_reuse_address(false)?;
    Ok(socket)
}

fn run(socket: &UdpSocket, prefix: &[u8], targets: &[SocketAddr]) {
    let mut latest: Vec<u8> = Vec::new();
    let mut sent = Instant::now();
    let mut buffer = vec![0; MOST_BYTES];
    loop {
        let heard = match socket.recv(&mut buffer) {
            // Other participants, and other talk of this one, come to the group as well.
            Ok(bytes) => Some(&buffer[..bytes]).filter(|m| m.get(PREFIX) == Some(prefix)).and_then(for_peers),
            Err(e) if matches!(e.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted) => None,
            Err(e) => {
                log::warn!("static peers: discovery is no longer heard: {e}");
                return;
            }
        };
        let fresh = heard.is_some();
        latest = heard.unwrap_or(latest);
        if !latest.is_empty() && (fresh || sent.elapsed() >= REPEAT) {
            for target in targets {
                // A peer that is not there now may be there the next time.
                let _ = socket.send_to(&latest, target);
            }
            sent = Instant::now();
        }
    }
}

/// The announcement of a participant as a peer is to hear it; `None` for any other message.
fn for_peers(message: &[u8]) -> Option<Vec<u8>> {
    let mut out = message.get(..HEADER_LENGTH)?.to_vec();
    let mut rest = message.get(HEADER_LENGTH..)?;
    let mut found = false;
    while let [kind, flags, low, high, after @ ..] = rest {
        let little = flags & LITTLE_ENDIAN != 0;
        // Length 0 means: up to the end.
        let length = match number([*low, *high], little) {
            0 => after.len(),
            length => usize::from(length),
        };
        let mut body = after.get(..length)?.to_vec();
        rest = &after[length..];
        if *kind == DATA && flags & INLINE_QOS == 0 && body.get(8..12) == Some(&ANNOUNCER) {
            body = announcement_for_peers(&body)?;
            found = true;
        }
        let length = u16::try_from(body.len()).ok()?;
        out.extend([*kind, *flags]);
        out.extend(if little { length.to_le_bytes() } else { length.to_be_bytes() });
        out.extend(body);
    }
    found.then_some(out)
}

fn number(bytes: [u8; 2], little: bool) -> u16 {
    if little { u16::from_le_bytes(bytes) } else { u16::from_be_bytes(bytes) }
}

/// The body of a submessage with an announcement, without the locators that are of no use on another host and without the
/// wish for announcements.
fn announcement_for_peers(body: &[u8]) -> Option<Vec<u8>> {
    let list = BEFORE_CONTENT + LIST_HEAD;
    let mut out = body.get(..list)?.to_vec();
    // The list has a byte order of its own: 0x0003 is little endian, 0x0002 big endian.
    let little = body[BEFORE_CONTENT + 1] == 3;
    let mut rest = &body[list..];
    while let [a, b, low, high, after @ ..] = rest {
        let (id, length) = (number([*a, *b], little), usize::from(number([*low, *high], little)));
        if id == SENTINEL {
            out.extend(rest);
            return Some(out);
        }
        let value = after.get(..length)?;
        let is_loopback =
            value.get(LOCATOR_ADDRESS).is_some_and(|address| address[0] == Ipv4Addr::LOCALHOST.octets()[0]);
        match (id, value) {
            (ENDPOINTS, &[a, b, c, d]) => {
                out.extend(&rest[..LIST_ENTRY_HEAD]);
                let bytes = [a, b, c, d];
                out.extend(if little {
                    (u32::from_le_bytes(bytes) & !PARTICIPANT_DETECTOR).to_le_bytes()
                } else {
                    (u32::from_be_bytes(bytes) & !PARTICIPANT_DETECTOR).to_be_bytes()
                });
            }
            _ if MULTICAST_LOCATORS.contains(&id) || UNICAST_LOCATORS.contains(&id) && is_loopback => {}
            _ => out.extend(&rest[..LIST_ENTRY_HEAD + length]),
        }
        rest = &after[length..];
    }
    None
}

/// The IPv4 addresses among these, or those of all interfaces.
pub(crate) fn multicast_addresses(given: &[IpAddr]) -> Vec<Ipv4Addr> {
    if !given.is_empty() {
        return given.iter().filter_map(|a| if let IpAddr::V4(a) = a { Some(*a) } else { None }).collect();
    }
    let Ok(interfaces) = nix::ifaddrs::getifaddrs() else { return Vec::new() };
    interfaces.filter_map(|i| i.address.and_then(|a| a.as_sockaddr_in().map(|a| a.ip()))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const SENTINEL_BYTES: [u8; 4] = [1, 0, 0, 0];

    fn locator(id: u16, address: [u8; 4]) -> Vec<u8> {
        let [low, high] = id.to_le_bytes();
        [&[low, high, 24, 0, 1, 0, 0, 0, 0xf2, 0x1c, 0, 0][..], &[0; 12], &address].concat()
    }

    fn endpoints(bits: u32) -> Vec<u8> {
        [&ENDPOINTS.to_le_bytes()[..], &[4, 0], &bits.to_le_bytes()].concat()
    }

    fn message(writer: [u8; 4], parameters: &[Vec<u8>]) -> Vec<u8> {
        let header = [b"RTPS".as_slice(), &[2, 3, 1, 0x12], &[7; 12]].concat();
        let timestamp = [0x09, 1, 8, 0, 0, 0, 0, 0, 0, 0, 0, 0];
        let list = [&[0, 3, 0, 0], &parameters.concat()[..], &SENTINEL_BYTES].concat();
        let body = [&[0, 0, 16, 0, 0, 0, 0, 0], &writer[..], &[0; 8], &list].concat();
        [&header[..], &timestamp, &[DATA, 5, body.len() as u8, 0], &body].concat()
    }

    #[test]
    fn peers_hear_of_no_multicast_no_loopback_and_no_wish_for_announcements() {
        let (here, there) = ([127, 0, 0, 1], [10, 0, 0, 5]);
        let group = DISCOVERY_GROUP.octets();
        let told = [locator(0x32, here), locator(0x32, there), locator(0x33, group), locator(0x31, there)];
        let heard = for_peers(&message(ANNOUNCER, &[&told[..], &[locator(0x48, group), endpoints(0xc3f)]].concat()));
        assert_eq!(heard, Some(message(ANNOUNCER, &[locator(0x32, there), locator(0x31, there), endpoints(0xc3d)])));
    }

    #[test]
    fn announcements_are_told_from_other_talk_and_damage() {
        let whole = message(ANNOUNCER, &[locator(0x33, DISCOVERY_GROUP.octets())]);
        assert!(for_peers(&whole).is_some());
        assert_eq!(for_peers(&message([0, 0, 3, 0xc2], &[])), None);
        // A message that is cut, at any byte, is no announcement.
        assert!((0..whole.len()).all(|cut| for_peers(&whole[..cut]).is_none()));
    }
}
