//! Answers of services that do not fit a datagram, sent so that the client can read them.
//!
//! What does not fit the datagrams of its way (some 1.4 kB, unless both ends know the loopback interface alone) goes in
//! fragments (RTPS 8.3.8.3). An answer names its request in the inline quality of service of each fragment, and before that list
//! RustDDS 0.15 writes a byte too many, so that no client can read it. So such an answer is sent once more from here, in the
//! name of its writer and under its number: for the client it is a message like any other, which it acknowledges, and what it could
//! not read it has passed over. What is lost on the way is not asked for here, so all of it is sent several times.
//!
//! What RustDDS sends whole must not be sent from here: Fast DDS notes in the content of a message which of its fragments are still
//! missing, and such notes stay in it where the whole message comes between them. So which way RustDDS goes is told as it does
//! (`Writer::max_unfragmented_serialized_payload`, which it keeps to itself), by what the interfaces on the way carry.

use std::net::{IpAddr, Ipv4Addr, SocketAddr, UdpSocket};
use std::time::Duration;

use netdev::Interface;
use rustdds::discovery::ReaderProxy;
use rustdds::{DomainParticipant, GUID, SampleIdentity};

/// Bytes of an answer that every datagram holds beside all that goes with it.
pub(crate) const FRAGMENT: u16 = 1024;

/// What an interface carries, in bytes, that tells nothing of it, or none on the way: an Ethernet frame.
const USUAL_MTU: usize = 1500;
/// Bytes of a datagram, as RustDDS counts them, that go with the content of a message: headers of IP, UDP and RTPS, heartbeat, and
/// head of the submessage.
const BESIDE: usize = 48 + 32 + 48;

/// What stands before the content: encoding (CDR, little endian) and options.
const ENCODING: [u8; 4] = [0, 1, 0, 0];

/// Pauses before an answer is sent, and sent again.
const PAUSES: [Duration; 3] = [Duration::ZERO, Duration::from_millis(50), Duration::from_millis(500)];

/// Numbers under which a message names the request that it answers: that of the standard, and what Fast DDS had before.
const RELATED: [u16; 2] = [0x0083, 0x800f];

/// Sends an answer that RustDDS fragments to the readers of the client, several times, from a thread beside.
pub(crate) fn send(participant: &DomainParticipant, answer: SampleIdentity, request: SampleIdentity, content: Vec<u8>) {
    let known = participant.discovered_readers();
    let addresses = |reader: &ReaderProxy| -> Vec<SocketAddr> {
        reader.unicast_locator_list.iter().filter(|l| l.is_udp()).map(|l| SocketAddr::from(*l)).collect()
    };
    let named = request.writer_guid.entity_id.kind().is_reader();
    let is_of_client =
        |guid: GUID| guid.prefix == request.writer_guid.prefix && (!named || guid == request.writer_guid);
    let clients: Vec<_> = known.iter().filter(|r| is_of_client(r.reader_proxy.remote_reader_guid)).collect();
    let readers: Vec<(GUID, Vec<SocketAddr>)> =
        clients.iter().map(|r| (r.reader_proxy.remote_reader_guid, addresses(&r.reader_proxy))).collect();
    let on_the_way: Vec<IpAddr> = if named {
        readers.iter().flat_map(|(_, addresses)| addresses).map(SocketAddr::ip).collect()
    } else {
        // The answer goes to all readers of the topic as to the one that takes least.
        let topics: Vec<&String> = clients.iter().map(|r| r.subscription_topic_data.topic_name()).collect();
        let of_topic = known.iter().filter(|r| topics.contains(&r.subscription_topic_data.topic_name()));
        of_topic.flat_map(|r| addresses(&r.reader_proxy)).map(|address| address.ip()).collect()
    };
    smol::unblock(move || {
        if ENCODING.len() + content.len() <= most_whole(&netdev::get_interfaces(), &on_the_way) {
            return;
        }
        let parcels: Vec<_> =
            readers.into_iter().map(|(guid, to)| (to, fragments(answer, guid, request, &content))).collect();
        let Ok(socket) = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0)) else { return };
        for pause in PAUSES {
            std::thread::sleep(pause);
            for (addresses, messages) in &parcels {
                let addresses = || addresses.iter().filter(|a| a.is_ipv4());
                for (message, address) in messages.iter().flat_map(|m| addresses().map(move |a| (m, a))) {
                    // An address that can't be reached from here is one of several.
                    let _ = socket.send_to(message, address);
                }
            }
        }
    })
    .detach();
}

/// Most bytes of content that RustDDS sends to these addresses in one piece: what fits the narrowest way.
fn most_whole(interfaces: &[Interface], addresses: &[IpAddr]) -> usize {
    let mtu = |address: &IpAddr| {
        let IpAddr::V4(address) = address else { return USUAL_MTU };
        let beside = interfaces.iter().filter(|i| i.ipv4.iter().any(|net| net.contains(address)));
        beside.filter_map(|i| i.mtu).map(|mtu| mtu as usize).next().unwrap_or(USUAL_MTU)
    };
    addresses.iter().map(mtu).min().unwrap_or(USUAL_MTU).saturating_sub(BESIDE)
}

/// RTPS messages (9.4) of one fragment each: header, INFO_DST, DATA_FRAG with inline quality of service.
fn fragments(answer: SampleIdentity, reader: GUID, request: SampleIdentity, content: &[u8]) -> Vec<Vec<u8>> {
    let (writer, reader) = (answer.writer_guid.to_bytes(), reader.to_bytes());
    let payload = [&ENCODING, content].concat();
    let mut list = Vec::new();
    for number in RELATED {
        list.extend(number.to_le_bytes());
        list.extend(24_u16.to_le_bytes());
        list.extend(request.writer_guid.to_bytes());
        list.extend(number_bytes(request.sequence_number.into()));
    }
    list.extend([1, 0, 0, 0]);
    let pieces = payload.chunks(FRAGMENT.into()).zip(1_u32..);
    pieces
        .map(|(piece, k)| {
            let mut body = vec![0, 0, 28, 0];
            body.extend(&reader[12..]);
            body.extend(&writer[12..]);
            body.extend(number_bytes(answer.sequence_number.into()));
            body.extend(k.to_le_bytes());
            body.extend(1_u16.to_le_bytes());
            body.extend(FRAGMENT.to_le_bytes());
            body.extend(u32::try_from(payload.len()).unwrap_or(u32::MAX).to_le_bytes());
            body.extend(&list);
            body.extend(piece);
            let mut message = vec![b'R', b'T', b'P', b'S', 2, 3, 1, 18];
            message.extend(&writer[..12]);
            message.extend([0x0e, 1, 12, 0]);
            message.extend(&reader[..12]);
            message.extend([0x16, 0b11]);
            message.extend(u16::try_from(body.len()).unwrap_or_default().to_le_bytes());
            message.extend(body);
            message
        })
        .collect()
}

/// A number of a message: its high half, then its low one.
fn number_bytes(number: i64) -> [u8; 8] {
    let [a, b, c, d, high @ ..] = number.to_le_bytes();
    let [e, f, g, h] = high;
    [e, f, g, h, a, b, c, d]
}

#[cfg(test)]
mod tests {
    use rustdds::SequenceNumber;

    use super::*;

    #[test]
    fn what_fits_the_narrowest_way_goes_whole() {
        let mut lo = Interface::dummy();
        lo.ipv4 = vec!["127.0.0.1/8".parse().unwrap()];
        lo.mtu = Some(65536);
        let mut wide = Interface::dummy();
        wide.ipv4 = vec!["10.1.0.7/16".parse().unwrap()];
        wide.mtu = Some(9000);
        let interfaces = [lo, wide];
        let most = |addresses: &[[u8; 4]]| {
            most_whole(&interfaces, &addresses.iter().map(|a| IpAddr::from(*a)).collect::<Vec<_>>())
        };
        assert_eq!(most(&[[127, 0, 0, 1]]), 65536 - BESIDE);
        assert_eq!(most(&[[127, 0, 0, 1], [10, 1, 2, 3]]), 9000 - BESIDE);
        assert_eq!(most(&[[10, 1, 2, 3], [192, 168, 0, 1]]), USUAL_MTU - BESIDE);
        assert_eq!(most(&[]), USUAL_MTU - BESIDE);
    }

    #[test]
    fn the_fragments_are_the_answer() {
        let content: Vec<u8> = (0..3000).map(|k| (k % 251) as u8).collect();
        let id = |k: u8, number: i64| SampleIdentity {
            writer_guid: GUID::from_bytes([k; 16]),
            sequence_number: SequenceNumber::from(number),
        };
        let messages = fragments(id(7, (1 << 32) + 5), GUID::from_bytes([9; 16]), id(9, 3), &content);
        let mut payload: Vec<u8> = Vec::new();
        for (message, k) in messages.iter().zip(1_u32..) {
            assert_eq!((&message[8..20], &message[24..36]), (&[7; 12][..], &[9; 12][..]));
            // What follows the head of the last submessage is as long as the head says.
            assert_eq!(usize::from(u16::from_le_bytes([message[38], message[39]])), message.len() - 40);
            assert_eq!(message[52..60], [1, 0, 0, 0, 5, 0, 0, 0], "the number of the answer");
            assert_eq!(message[60..64], k.to_le_bytes());
            // The list begins where it says, and its parameters are as long as they say.
            let mut list = &message[44 + usize::from(message[42])..];
            while let [id, high, length, _, rest @ ..] = list {
                let (value, rest) = rest.split_at(usize::from(*length).min(rest.len()));
                list = rest;
                if (*id, *high) == (1, 0) {
                    break;
                }
                assert_eq!(value, [&[9; 16][..], &[0, 0, 0, 0, 3, 0, 0, 0]].concat());
            }
            payload.extend(list);
        }
        assert_eq!(payload, [&ENCODING[..], &content[..]].concat());
    }
}
