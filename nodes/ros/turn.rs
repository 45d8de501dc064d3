//! Opening endpoints one process after the other.
//!
//! Fast DDS (3.2, the usual middleware of ROS 2) keeps announcements of endpoints that it can't use yet, because an
//! earlier one of the same participant is missing, in one list for all participants, ordered by number within a
//! participant and by time between them. RustDDS puts no time on its announcements, and where such are waiting of *two*
//! participants the order breaks: what fills the gap is put behind later numbers, not found there, and forgotten for
//! good although it is acknowledged. An rclpy node that starts together with several of our processes would never see
//! some of their topics, services or names. Announcements wait only of a participant that is met while it opens its
//! endpoints. So the processes of a host open theirs one after the other.

use std::fs::{File, OpenOptions, TryLockError};
use std::time::{Duration, Instant};

/// How long a turn lasts beyond the opening of the endpoints: until those who were met meanwhile have asked for what
/// they missed and got it. RustDDS answers after 5 ms, 8 kB at a time every 10 ms; a node announces about 12 kB.
const ECHO: Duration = Duration::from_millis(100);

/// How long is waited for the turn: some processes' turns. Then it is taken all the same, for the one who has it may be
/// stopped.
const PATIENCE: Duration = Duration::from_secs(3);

/// How often is looked whether the turn has come.
const LOOK: Duration = Duration::from_millis(5);

/// The turn of this process among those of its host in its domain; given back [`ECHO`] after [`Self::done`], or when
/// this is dropped.
#[derive(Debug)]
pub(super) struct Turn {
    lock: Option<File>,
}

impl Turn {
    /// Waits for the turn. Where it does not come, or the system knows no such lock, there is none, and nothing is lost
    /// but certainty.
    pub(super) fn take(domain: u16) -> Self {
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
        let end = Instant::now() + PATIENCE;
        loop {
            match file.try_lock() {
                Ok(()) => return Self { lock: Some(file) },
                Err(TryLockError::WouldBlock) if Instant::now() < end => std::thread::sleep(LOOK),
                Err(_) => return Self { lock: None },
            }
        }
    }

    /// Says that the endpoints are open.
    pub(super) async fn done(self) {
        if self.lock.is_some() {
            smol::Timer::after(ECHO).await;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A domain that no test runs a node in.
    const DOMAIN: u16 = 231;

    #[test]
    fn a_turn_is_given_on() {
        let first = Turn::take(DOMAIN);
        assert!(first.lock.is_some());
        let next = std::thread::spawn(|| {
            let turn = Turn::take(DOMAIN);
            (turn.lock.is_some(), Instant::now())
        });
        let opened = Instant::now();
        smol::block_on(first.done());
        let (has, taken) = next.join().expect("the thread ends");
        assert!(has && taken >= opened + ECHO, "the turn was taken {:?} after the endpoints were open", taken - opened);
    }
}
