//! What the kernel holds for the readers on this host, so that best-effort readers lose nothing at full speed.
//!
//! A best-effort reader acknowledges nothing, and over loopback nothing slows the sender: once the socket buffer of the
//! reader's process is full, the kernel drops datagrams. On Linux the fill of every UDP socket of this network namespace
//! stands in `/proc/net/udp`; the player sends its next message when the sockets of its domain are empty. So at most two
//! messages lie in a buffer (one that was just sent, and one that the writer had still queued), whatever the rate. The
//! same table counts the datagrams dropped, so a loss is noticed and told.
//!
//! Readers on other hosts and systems without that table are out of sight; they are spared by a limit on the rate.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::time::{Duration, Instant};

/// The tables of UDP sockets.
const TABLES: [&str; 2] = ["/proc/net/udp", "/proc/net/udp6"];

/// How long to sleep between two looks: about what a reader takes for a datagram.
const LOOK_PERIOD: Duration = Duration::from_micros(200);

/// A socket that stays filled this long belongs to a process that is stopped or deaf; it is not waited for again.
const PATIENCE: Duration = Duration::from_secs(1);

/// First port of domain 0, and the number of ports of a domain, by the RTPS specification (9.6.1.1).
const PORT_BASE: u32 = 7400;
const PORTS_PER_DOMAIN: u32 = 250;

/// Bytes a second to readers out of sight: a quarter of what a gigabit network carries.
const BLIND_BYTES_PER_SECOND: f64 = 30.0e6;

/// A socket as the table shows it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Socket {
    port: u16,
    inode: u64,
    queued_bytes: u64,
    drops: u64,
}

/// Watches the sockets of one DDS domain on this host.
#[derive(Debug)]
pub(super) struct ReaderQueues {
    ports: Range<u32>,
    extra_ports: BTreeSet<u16>,
    /// Sockets that do not empty.
    stuck: BTreeSet<u64>,
    drops_at_start: BTreeMap<u64, u64>,
}

impl ReaderQueues {
    /// Watches the ports of a domain from now on.
    pub(super) fn new(domain_id: u16) -> Self {
        let first = PORT_BASE + PORTS_PER_DOMAIN * u32::from(domain_id);
        let mut queues = Self {
            ports: first..first + PORTS_PER_DOMAIN,
            extra_ports: BTreeSet::new(),
            stuck: BTreeSet::new(),
            drops_at_start: BTreeMap::new(),
        };
        queues.drops_at_start = queues.sockets().iter().map(|s| (s.inode, s.drops)).collect();
        queues
    }

    /// Adds ports outside the usual ones, as a reader may announce them.
    pub(super) fn watch(&mut self, ports: impl IntoIterator<Item = u16>) {
        self.extra_ports.extend(ports);
    }

    /// Whether the system shows its sockets at all.
    pub(super) fn visible() -> bool {
        std::fs::metadata(TABLES[0]).is_ok()
    }

    fn sockets(&self) -> Vec<Socket> {
        TABLES
            .iter()
            .filter_map(|table| std::fs::read_to_string(table).ok())
            .flat_map(|text| text.lines().skip(1).filter_map(parse_line).collect::<Vec<_>>())
            .filter(|s| self.ports.contains(&u32::from(s.port)) || self.extra_ports.contains(&s.port))
            .collect()
    }

    /// Waits until every socket watched is empty.
    pub(super) async fn empty(&mut self) {
        let begun = Instant::now();
        loop {
            let filled: Vec<Socket> =
                self.sockets().into_iter().filter(|s| s.queued_bytes > 0 && !self.stuck.contains(&s.inode)).collect();
            if filled.is_empty() {
                return;
            }
            if begun.elapsed() > PATIENCE {
                for socket in filled {
                    log::warn!("the process with UDP port {} does not read; it is not waited for", socket.port);
                    self.stuck.insert(socket.inode);
                }
                return;
            }
            smol::Timer::after(LOOK_PERIOD).await;
        }
    }

    /// Datagrams that the kernel has dropped since the watch began, by port.
    pub(super) fn drops(&self) -> Vec<(u16, u64)> {
        self.sockets()
            .iter()
            .map(|s| (s.port, s.drops.saturating_sub(self.drops_at_start.get(&s.inode).copied().unwrap_or(0))))
            .filter(|(_, drops)| *drops > 0)
            .collect()
    }
}

/// How long a message of `bytes` keeps the line to readers out of sight busy.
pub(super) fn blind_pause(bytes: usize) -> Duration {
    Duration::from_secs_f64(bytes as f64 / BLIND_BYTES_PER_SECOND)
}

/// Reads a line such as `  42: 00000000:1CF2 00000000:0000 07 00000000:00000000 00:00000000 00000000  0  0 12345 2 … 0`:
/// local address and port, …, transmit and receive queue, …, inode, references, pointer, drops.
fn parse_line(line: &str) -> Option<Socket> {
    let fields: Vec<&str> = line.split_ascii_whitespace().collect();
    let (_, port) = fields.get(1)?.rsplit_once(':')?;
    let (_, queued) = fields.get(4)?.split_once(':')?;
    Some(Socket {
        port: u16::from_str_radix(port, 16).ok()?,
        queued_bytes: u64::from_str_radix(queued, 16).ok()?,
        inode: fields.get(9)?.parse().ok()?,
        drops: fields.get(12)?.parse().ok()?,
    })
}

#[cfg(test)]
mod tests {
    use std::net::UdpSocket;

    use super::*;

    #[test]
    fn a_line_of_the_table_is_understood() {
        let line = " 1421: 00000000:44FD 00000000:0000 07 00000000:0001A300 00:00000000 00000000     0        0 \
                    98765 2 0000000000000000 17";
        assert_eq!(parse_line(line), Some(Socket { port: 17661, inode: 98765, queued_bytes: 0x1a300, drops: 17 }));
        assert_eq!(parse_line("  sl  local_address rem_address"), None);
    }

    #[test]
    fn a_filled_socket_is_waited_for() -> std::io::Result<()> {
        if !ReaderQueues::visible() {
            println!("skipped: this system does not show its sockets");
            return Ok(());
        }
        let reader = UdpSocket::bind("127.0.0.1:0")?;
        let mut queues = ReaderQueues::new(232);
        queues.watch([reader.local_addr()?.port()]);
        UdpSocket::bind("127.0.0.1:0")?.send_to(&[0; 1000], reader.local_addr()?)?;
        assert!(queues.sockets().iter().any(|s| s.queued_bytes > 0));
        let emptied = smol::block_on(smol::future::zip(
            async {
                queues.empty().await;
                Instant::now()
            },
            async {
                smol::Timer::after(LOOK_PERIOD).await;
                let read = Instant::now();
                reader.recv(&mut [0; 2000]).map(|_| read)
            },
        ));
        assert!(emptied.0 >= emptied.1?);
        assert!(queues.stuck.is_empty());
        Ok(())
    }
}
