//! Asking a client's writer for the request that came before it was known.
//!
//! A client that calls a service as soon as it has found it may be quicker than discovery on this side: its request
//! comes from a writer that is not known yet and is dropped. A reader that meets a writer asks what it has missed.
//! RustDDS asks by an ACKNACK from number 1 on that lists nothing (RTPS 8.3.8.1). Fast DDS takes only one from number 0
//! on for that question, and sends the request again with its next heartbeat, 3 s later. So here that writer is asked
//! for its first message by name; the request of a command-line tool, which calls once and ends, is the first. Later
//! ones come with the heartbeat, as before.

use std::net::{IpAddr, Ipv4Addr, SocketAddr, UdpSocket};

use rustdds::{DomainParticipant, GUID, RTPSEntity};

/// How the prefixes of Fast DDS's participants begin: with the number of its vendor (RTPS 9.3.1.5).
const FAST_DDS: [u8; 2] = [1, 15];

/// How long a prefix is; the four bytes of the entity follow.
const PREFIX: usize = 12;

/// Asks the writer for its first message, in the name of the reader.
///
/// # Errors
/// The system's.
pub(crate) fn ask(participant: &DomainParticipant, reader: GUID, writer: GUID) -> std::io::Result<()> {
    if !writer.to_bytes().starts_with(&FAST_DDS) || reader.prefix != participant.guid().prefix {
        return Ok(());
    }
    let known = participant.discovered_writers();
    let Some(proxy) = known.iter().map(|known| &known.writer_proxy).find(|proxy| proxy.remote_writer_guid == writer)
    else {
        return Ok(());
    };
    let question = question(&reader.to_bytes(), &writer.to_bytes());
    let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))?;
    for locator in proxy.unicast_locator_list.iter().filter(|locator| locator.is_udp()) {
        let address = SocketAddr::from(*locator);
        if matches!(address.ip(), IpAddr::V4(_)) {
            socket.send_to(&question, address)?;
        }
    }
    Ok(())
}

/// An RTPS message (9.4): header, INFO_DST, ACKNACK of the first message, to be answered. Its count is one more than
/// that of RustDDS's own question, which has been put already.
fn question(reader: &[u8; 16], writer: &[u8; 16]) -> Vec<u8> {
    let (own, reader) = reader.split_at(PREFIX);
    let (other, writer) = writer.split_at(PREFIX);
    let mut message = Vec::with_capacity(68);
    message.extend([b'R', b'T', b'P', b'S', 2, 3, 1, 18]);
    message.extend(own);
    message.extend([0x0e, 1, 12, 0]);
    message.extend(other);
    message.extend([0x06, 1, 28, 0]);
    message.extend(reader);
    message.extend(writer);
    // The set of numbers: base (high, low), how many bits, the first of them set.
    for word in [0u32, 1, 1, 1 << 31, 1] {
        message.extend(word.to_le_bytes());
    }
    message
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_question_is_an_acknack_of_the_first_message() {
        let (reader, writer) = ([7; 16], [9; 16]);
        let message = question(&reader, &writer);
        assert_eq!(&message[8..20], &[7; 12]);
        assert_eq!(&message[20..24], &[0x0e, 1, 12, 0]);
        assert_eq!(&message[24..36], &[9; 12]);
        // What follows the head of the last submessage is as long as the head says.
        assert_eq!(message[36..40], [0x06, 1, message.len() as u8 - 40, 0]);
        assert_eq!((&message[40..44], &message[44..48]), (&[7; 4][..], &[9; 4][..]));
        assert_eq!(message[48..], [0, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0x80, 1, 0, 0, 0]);
    }
}
