//! Saying that this process leaves, so that others need not wait for its lease (50 s) to be over.
//!
//! Until they know, they list its topics and call its services, and reliable writers keep what it has not acknowledged.
//! RustDDS says farewell when a participant is dropped, but not so that Fast DDS takes it: that wants the participant by
//! its key hash (RTPS 9.6.4.8) beside the status *disposed and unregistered* (9.6.4.9). So it is said once more here,
//! where announcements go: by multicast on each interface, and to static peers by unicast. It can't be signed, so a
//! secured process leaves it be.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};

use rustdds::GUID;
use socket2::{Domain, Protocol, Socket, Type};

use super::peers::{self, DISCOVERY_GROUP};

/// Number of the message: behind all announcements, which come every 10 s, so that none of them that is late is taken for
/// the newer one.
const LAST: u32 = i32::MAX as u32;

/// What it takes to say farewell when the participant is no more.
#[derive(Debug)]
pub(crate) struct Farewell {
    message: Vec<u8>,
    domain: u16,
    interfaces: Vec<IpAddr>,
    peers: Vec<Ipv4Addr>,
}

impl Farewell {
    /// Of this participant, on these interfaces (all if there are none) and to these peers.
    pub(crate) fn of(participant: GUID, domain: u16, interfaces: Vec<IpAddr>, peers: Vec<Ipv4Addr>) -> Self {
        Self { message: message(&participant.to_bytes()), domain, interfaces, peers }
    }

    /// Says it, once, to whoever can be reached.
    ///
    /// # Errors
    /// The system's, where there is no socket to be had.
    pub(crate) fn say(&self) -> std::io::Result<()> {
        let socket = Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::UDP))?;
        let group = peers::discovery_multicast(self.domain);
        for interface in peers::multicast_addresses(&self.interfaces) {
            // An interface that takes no multicast has nobody to be told.
            let _ = socket
                .set_multicast_if_v4(&interface)
                .and_then(|()| socket.send_to(&self.message, &SocketAddr::from((DISCOVERY_GROUP, group)).into()));
        }
        for peer in &self.peers {
            for port in peers::discovery_unicast(self.domain) {
                let _ = socket.send_to(&self.message, &SocketAddr::from((*peer, port)).into());
            }
        }
        Ok(())
    }
}

/// An RTPS message (9.4): header, and DATA without content from the writer of announcements (9.3.1.3) to their readers,
/// which tells of the participant's key hash and status.
fn message(participant: &[u8; 16]) -> Vec<u8> {
    const BODY: u16 = 52;
    let mut message = Vec::with_capacity(76);
    message.extend([b'R', b'T', b'P', b'S', 2, 3, 1, 18]);
    message.extend(&participant[..12]);
    // DATA, little endian, with inline quality of service and no content; no further flags, and where that begins.
    message.extend([0x15, 0b11]);
    message.extend(BODY.to_le_bytes());
    message.extend([0, 0, 16, 0]);
    message.extend([0, 1, 0, 0xc7]);
    message.extend([0, 1, 0, 0xc2]);
    message.extend(0_i32.to_le_bytes());
    message.extend(LAST.to_le_bytes());
    // Key hash; status, in this order of bytes always; end of the list.
    message.extend([0x70, 0, 16, 0]);
    message.extend(participant);
    message.extend([0x71, 0, 4, 0, 0, 0, 0, 0b11]);
    message.extend([1, 0, 0, 0]);
    message
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_message_is_data_about_the_end_of_the_participant() {
        let participant = [7, 7, 7, 7, 7, 7, 7, 7, 7, 7, 7, 7, 0, 0, 1, 0xc1];
        let message = message(&participant);
        assert_eq!(message[8..20], participant[..12]);
        // The submessage is the last, and as long as its head says.
        assert_eq!(usize::from(u16::from_le_bytes([message[22], message[23]])), message.len() - 24);
        // Its parameters begin where it says, and are as long as they say.
        let mut parameters = &message[28 + usize::from(message[26])..];
        let mut seen = Vec::new();
        while let [id, _, length, _, rest @ ..] = parameters {
            let (value, rest) = rest.split_at(usize::from(*length));
            seen.push((*id, value));
            parameters = rest;
        }
        assert_eq!(seen, [(0x70, &participant[..]), (0x71, &[0, 0, 0, 3][..]), (1, &[][..])]);
    }
}
