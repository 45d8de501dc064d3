//! Whether a node works now, as its loop and its streams see it; who decides is [`super::lifecycle`].

use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use futures::channel::{mpsc, oneshot};
use futures::{Stream, StreamExt, stream};
use jigsaw_msgs::std_srvs::srv::TriggerResponse;

/// Whether a node works now: what its loop asks, and waits for.
#[derive(Debug, Clone, Default)]
pub struct Activity(Arc<Mutex<Switch>>);

#[derive(Debug, Default)]
struct Switch {
    active: bool,
    waiting: Vec<oneshot::Sender<()>>,
    watchers: Vec<mpsc::Sender<()>>,
}

/// What becomes of a message that comes while a node is not active.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WhileInactive {
    /// It is left out: a camera frame tells of that moment alone.
    Drop,
    /// It waits, in the middleware's cache: a piece is sent once.
    Hold,
}

/// The answer to a call that comes while the node does not work.
pub(crate) fn inactive() -> TriggerResponse {
    TriggerResponse { success: false, message: "the node is not active".to_owned() }
}

impl Activity {
    /// That of a node which always works, as in tests and in tools.
    pub fn always() -> Self {
        let activity = Self::default();
        activity.set(true);
        activity
    }

    fn switch(&self) -> MutexGuard<'_, Switch> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether the node works now.
    pub fn is_active(&self) -> bool {
        self.switch().active
    }

    /// Resolves when the node works: at once if it does already.
    pub async fn active(&self) {
        loop {
            let (waiting, begun) = oneshot::channel();
            {
                let mut switch = self.switch();
                if switch.active {
                    return;
                }
                switch.waiting.retain(|waiting| !waiting.is_canceled());
                switch.waiting.push(waiting);
            }
            // Whoever waits is woken, and looks again.
            let _ = begun.await;
        }
    }

    /// Gives something whenever the node begins or stops to work.
    pub fn changes(&self) -> mpsc::Receiver<()> {
        let (watcher, changes) = mpsc::channel(0);
        self.switch().watchers.push(watcher);
        changes
    }

    pub(super) fn set(&self, active: bool) {
        let mut switch = self.switch();
        if switch.active != active {
            switch.active = active;
            // One that is full has a change to look at already.
            switch.watchers.retain_mut(|watcher| watcher.try_send(()).is_ok() || !watcher.is_closed());
        }
        if active {
            switch.waiting.drain(..).for_each(|waiting| {
                // One that has stopped to wait is no concern of the node.
                let _ = waiting.send(());
            });
        }
    }

    /// The stream while the node works.
    pub fn gate<S: Stream + Unpin + 'static>(
        &self,
        stream: S,
        otherwise: WhileInactive,
    ) -> Pin<Box<dyn Stream<Item = S::Item>>> {
        let activity = self.clone();
        match otherwise {
            WhileInactive::Drop => Box::pin(stream.filter(move |_| std::future::ready(activity.is_active()))),
            WhileInactive::Hold => Box::pin(stream::unfold((stream, activity), |(mut stream, activity)| async move {
                activity.active().await;
                let item = stream.next().await?;
                // It may have come after the node had stopped.
                activity.active().await;
                Some((item, (stream, activity)))
            })),
        }
    }
}

#[cfg(test)]
mod tests {
    use futures::FutureExt;

    use super::*;

    #[test]
    fn a_gate_holds_or_drops_while_the_node_is_inactive() {
        let activity = Activity::default();
        let mut held = activity.gate(stream::iter([1, 2]), WhileInactive::Hold);
        let mut dropped = activity.gate(stream::iter([1, 2]), WhileInactive::Drop);
        assert_eq!(held.next().now_or_never(), None);
        assert_eq!(dropped.next().now_or_never(), Some(None));
        let mut changes = activity.changes();
        activity.set(true);
        assert_eq!(held.next().now_or_never(), Some(Some(1)));
        assert!(changes.try_recv().is_ok() && changes.try_recv().is_err());
        activity.set(false);
        assert_eq!(held.next().now_or_never(), None);
        activity.set(true);
        assert_eq!(smol::block_on(held.collect::<Vec<_>>()), [2]);
    }
}
