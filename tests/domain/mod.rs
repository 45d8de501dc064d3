//! DDS domains for tests, so that those that run at the same time, of this checkout or another, don't hear one another.

use std::net::UdpSocket;
use std::sync::Mutex;

/// Above about 100 the ports of a domain reach into those that Linux gives out.
const LAST: u16 = 99;

/// RTPS: the discovery port of the first participant of a domain, and what lies between those of two domains.
const FIRST_PORT: u16 = 7410;
const PORTS_PER_DOMAIN: u16 = 250;

/// The domains that this process has taken.
static TAKEN: Mutex<Vec<u16>> = Mutex::new(Vec::new());

/// A domain in which nobody is, and that no other test of this process takes.
pub(crate) fn free() -> u16 {
    let mut taken = TAKEN.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
    let first = (std::process::id() % u32::from(LAST)) as u16;
    let is_free = |domain: &u16| {
        !taken.contains(domain) && UdpSocket::bind(("0.0.0.0", FIRST_PORT + PORTS_PER_DOMAIN * domain)).is_ok()
    };
    let found = (0..LAST).map(|k| 1 + (first + k) % LAST).find(is_free);
    let Some(domain) = found else { panic!("every DDS domain is in use") };
    taken.push(domain);
    domain
}
