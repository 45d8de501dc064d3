//! Joining a domain one process after the other.
//!
//! **For the sake of Fast DDS.** Fast DDS (3.2, the usual middleware of ROS 2) keeps announcements of endpoints that it can't use yet, because an
//! earlier one of the same participant is missing, in one list for all participants, ordered by number within a
//! participant and by time between them. RustDDS puts no time on its announcements, and where such are waiting of *two*
//! participants the order breaks: what fills the gap is put behind later numbers, not found there, and forgotten for
//! good although it is acknowledged. An rclpy node that starts together with several of our processes would never see
//! some of their topics, services or names. Announcements wait only of a participant that is met while it opens its
//! endpoints. So the processes of a host open theirs one after the other.
//!
//! **For the sake of DDS Security.** RustDDS 0.15 reads the handshakes of all participants through a history of one message, and each
//! participant sends its own to all, again and again in one go. Where several join together each overwrites what the
//! others said, on a busy machine in the same order every second until they give up after ten, and the two never hear each
//! other. Of one that joins alone at least one handshake gets through at
//! a time. So a secured process has its turn until all whom it met have let it in.

use std::fs::{File, OpenOptions, TryLockError};
use std::time::{Duration, Instant};

/// How long a turn lasts beyond the opening of the endpoints: until those who were met meanwhile have asked for what
/// they missed and got it. RustDDS answers after 5 ms, 8 kB at a time every 10 ms; a node announces about 12 kB.
const ECHO: Duration = Duration::from_millis(100);

/// How long is waited for the turn: some processes' turns. Then it is taken all the same, for the one who has it may be
/// stopped.
const PATIENCE: Duration = Duration::from_secs(3);

/// The same where processes are secured; less than a loop may stand still (`watchdog`).
const SECURED_PATIENCE: Duration = Duration::from_secs(20);

/// How long a secured process waits to be met: by then the others have heard its announcement and answered with theirs, on a
/// busy machine as well.
const ENCOUNTER: Duration = Duration::from_millis(500);

/// How long it waits to be let in: RustDDS sends a handshake ten times, every second.
const HANDSHAKES: Duration = Duration::from_secs(12);

/// How often is looked whether the turn has come.
const LOOK: Duration = Duration::from_millis(5);

/// The turn of this process among those of its host in its domain; given back when this is dropped.
#[derive(Debug)]
pub(crate) struct Turn {
    lock: Option<File>,
}

impl Turn {
    /// Waits for the turn. Where it does not come, or the system knows no such lock, there is none, and nothing is lost
    /// but certainty.
    pub(crate) fn take(domain: u16, secured: bool) -> Self {
        let path = std::env::temp_dir().join(format!("jigsaw_cell_domain_{domain}.turn"));
        // A file of another user can be locked as well; it need only be readable.
        let file = File::open(&path).or_else(|_| OpenOptions::new().append(true).create(true).open(&path));
        let file = match file {
            Ok(file) => file,
            Err(e) => {
                log::debug!("endpoints are opened without waiting for other processes: {}: {e}", path.display());
                return Self { lock: None };
            }
        };
        let end = Instant::now() + if secured { SECURED_PATIENCE } else { PATIENCE };
        loop {
            match file.try_lock() {
                Ok(()) => return Self { lock: Some(file) },
                Err(TryLockError::WouldBlock) if Instant::now() < end => std::thread::sleep(LOOK),
                Err(_) => return Self { lock: None },
            }
        }
    }

    /// To be called when the endpoints are open: gives the turn back when others may join. `handshakes` tells, where the process
    /// is secured, with how many participants it is shaking hands.
    pub(crate) async fn done(self, handshakes: Option<impl Fn() -> usize>) {
        if self.lock.is_none() {
            return;
        }
        if let Some(handshakes) = handshakes {
            let end = Instant::now() + HANDSHAKES;
            smol::Timer::after(ENCOUNTER).await;
            while handshakes() > 0 && Instant::now() < end {
                smol::Timer::after(LOOK).await;
            }
        }
        smol::Timer::after(ECHO).await;
    }
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use super::*;
    use crate::ros::watchdog;

    /// Domains that no test runs a node in.
    const DOMAIN: u16 = 231;
    const SECURED_DOMAIN: u16 = 232;

    /// When the next one had its turn, after the first was done; both are secured where handshakes are counted.
    fn next_turn(domain: u16, handshakes: Option<impl Fn() -> usize>) -> Duration {
        let secured = handshakes.is_some();
        let first = Turn::take(domain, secured);
        assert!(first.lock.is_some());
        let next = std::thread::spawn(move || {
            let turn = Turn::take(domain, secured);
            (turn.lock.is_some(), Instant::now())
        });
        let opened = Instant::now();
        smol::block_on(first.done(handshakes));
        let (has, taken) = next.join().expect("the thread ends");
        assert!(has, "the turn was not given back");
        taken - opened
    }

    #[test]
    fn a_turn_is_given_on() {
        assert!(next_turn(DOMAIN, None::<fn() -> usize>) >= ECHO);
    }

    #[test]
    fn a_secured_turn_lasts_until_all_have_let_it_in() {
        let left = Cell::new(5_usize);
        let handshakes = || left.replace(left.get().saturating_sub(1));
        assert!(next_turn(SECURED_DOMAIN, Some(handshakes)) >= ENCOUNTER);
        assert_eq!(left.get(), 0);
    }

    #[test]
    fn waiting_for_the_turn_is_not_taken_for_standing_still() {
        assert!(PATIENCE.max(SECURED_PATIENCE) < watchdog::PATIENCE);
    }
}
