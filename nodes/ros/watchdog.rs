//! Watchdogs: whether the process still hears, and whether its loop still goes round. Where one does not, the process ends, so
//! that whoever started it starts it again.
//!
//! **Deaf**: SIGSTOP and SIGCONT interrupt the polls of RustDDS, after which one of its threads ends for good and the node
//! lives on deaf. The loop itself looks whether these threads still live, and counts its looks.
//!
//! **Stalled**: a call of the middleware may not return. A thread of its own looks whether that count goes up.

use std::sync::Weak;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

/// How often a watchdog looks.
pub(super) const PERIOD: Duration = Duration::from_millis(500);

/// How many looks the process's loop may stand still: long beyond any work that is done in it, opening the middleware on
/// a busy machine included. Looks and not seconds, so that a process that was stopped is not taken for one that hangs.
const LOOKS: u32 = 60;

/// How long the process's loop may stand still.
pub(super) const PATIENCE: Duration = PERIOD.saturating_mul(LOOKS);

/// Beginning of the names of RustDDS's threads.
const MIDDLEWARE_THREADS: &str = "RustDDS";

/// Counts the rounds of the process's loop, in which it runs; gives the name of the first thread of the middleware that has
/// ended.
pub(super) async fn ended_thread(rounds: &AtomicU64) -> String {
    let mut known = middleware_threads();
    loop {
        smol::Timer::after(PERIOD).await;
        rounds.fetch_add(1, Ordering::Relaxed);
        let alive = middleware_threads();
        if let Some((_, name)) = known.iter().find(|thread| !alive.contains(thread)) {
            return name.clone();
        }
        known = alive;
    }
}

/// Looks, with pauses of a [`PERIOD`], at the rounds of the process's loop until it stands still; false where it has ended.
pub(super) fn stands_still(rounds: &Weak<AtomicU64>, mut pause: impl FnMut()) -> bool {
    let (mut last, mut looks) = (0, 0);
    while let Some(rounds) = rounds.upgrade() {
        let now = rounds.load(Ordering::Relaxed);
        looks = if now == last { looks + 1 } else { 0 };
        last = now;
        if looks > LOOKS {
            return true;
        }
        drop(rounds);
        pause();
    }
    false
}

/// Number and name of the threads of the middleware in this process; empty where the system doesn't tell.
fn middleware_threads() -> Vec<(String, String)> {
    let Ok(tasks) = std::fs::read_dir("/proc/self/task") else { return Vec::new() };
    tasks
        .flatten()
        .filter_map(|task| {
            let name = std::fs::read_to_string(task.path().join("comm")).ok()?;
            let number = task.file_name().to_string_lossy().into_owned();
            name.starts_with(MIDDLEWARE_THREADS).then(|| (number, name.trim_end().to_owned()))
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;

    #[test]
    fn a_loop_that_stands_still_is_told_when_its_time_is_up() {
        for going in [0, 1, 100] {
            let rounds = Arc::new(AtomicU64::new(0));
            let mut pauses = 0;
            let still = stands_still(&Arc::downgrade(&rounds), || {
                pauses += 1;
                if pauses <= going {
                    rounds.fetch_add(1, Ordering::Relaxed);
                }
            });
            // The look that finds the last round is the first of those that find no other.
            let expected = LOOKS + if going > 0 { going + 1 } else { 0 };
            assert_eq!((still, pauses), (true, expected));
        }
        assert_eq!(PATIENCE, Duration::from_secs(30));
    }

    #[test]
    fn a_loop_that_is_slow_and_then_ends_has_not_stood_still() {
        let mut rounds = Some(Arc::new(AtomicU64::new(1)));
        let watched = rounds.iter().map(Arc::downgrade).next().unwrap_or_default();
        let mut pauses = 0;
        let still = stands_still(&watched, || {
            pauses += 1;
            if pauses % LOOKS == 0 {
                rounds.iter().for_each(|rounds| rounds.store(pauses.into(), Ordering::Relaxed));
            }
            rounds.take_if(|_| pauses == 10 * LOOKS);
        });
        assert_eq!((still, pauses), (false, 10 * LOOKS));
    }
}
