//! A managed node: the states and transitions of `rcl_lifecycle`, with their services, so that `ros2 lifecycle` and a
//! lifecycle manager can drive it.
//!
//! ```text
//! unconfigured ── configure ──▶ inactive ── activate ──▶ active
//!              ◀── cleanup ───           ◀─ deactivate ─
//! any of the three ── shutdown ──▶ finalized
//! ```
//!
//! | transition | what a node does |
//! | --- | --- |
//! | configure | checks what its parameters name (a folder, say); where that is not there it stays unconfigured |
//! | activate | works on its inputs |
//! | deactivate | leaves camera frames be, lets pieces wait (they are latched), refuses calls and goals |
//! | cleanup | forgets what it has seen |
//! | shutdown | does nothing any more; the process lives on until it gets a signal |
//!
//! A node starts by itself (configure, activate) unless its parameter `autostart` is false. Parameters, diagnostics and the
//! clock are there in every state.

use std::sync::Arc;

use futures::channel::{mpsc, oneshot};
use futures::{SinkExt, StreamExt};
use jigsaw_msgs::lifecycle_msgs::msg::{State, Transition, TransitionDescription, TransitionEvent};
use jigsaw_msgs::lifecycle_msgs::srv::{
    ChangeState, ChangeStateResponse, GetAvailableStates, GetAvailableStatesResponse, GetAvailableTransitions,
    GetAvailableTransitionsResponse, GetState, GetStateResponse,
};

use super::activity::Activity;
use super::clock::Clock;
use super::exit::ProcessError;
use super::health::{Health, shown};
use super::node_params::AUTOSTART;
use super::session::Session;
use super::topics::TRANSITION_EVENT;

/// The wish that a node's loop forget what it has seen; to be answered when it has.
pub type Forget = oneshot::Sender<()>;

/// How the work of a transition ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Outcome {
    Success,
    Failure,
    Error,
}

/// Labels of the states, in the order in which `rcl_lifecycle` registers them.
const STATES: [(u8, &str); 11] = [
    (State::PRIMARY_STATE_UNKNOWN, "unknown"),
    (State::PRIMARY_STATE_UNCONFIGURED, "unconfigured"),
    (State::PRIMARY_STATE_INACTIVE, "inactive"),
    (State::PRIMARY_STATE_ACTIVE, "active"),
    (State::PRIMARY_STATE_FINALIZED, "finalized"),
    (State::TRANSITION_STATE_CONFIGURING, "configuring"),
    (State::TRANSITION_STATE_CLEANINGUP, "cleaningup"),
    (State::TRANSITION_STATE_SHUTTINGDOWN, "shuttingdown"),
    (State::TRANSITION_STATE_ACTIVATING, "activating"),
    (State::TRANSITION_STATE_DEACTIVATING, "deactivating"),
    (State::TRANSITION_STATE_ERRORPROCESSING, "errorprocessing"),
];

/// A transition: id, label, from, to.
type Step = (u8, &'static str, u8, u8);

const SUCCESS: &str = "transition_success";
const FAILURE: &str = "transition_failure";
const ERROR: &str = "transition_error";

/// All transitions, in the order in which `rcl_lifecycle` registers them.
const STEPS: [Step; 25] = {
    use State as S;
    use Transition as T;
    const UNCONFIGURED: u8 = State::PRIMARY_STATE_UNCONFIGURED;
    const INACTIVE: u8 = State::PRIMARY_STATE_INACTIVE;
    const ACTIVE: u8 = State::PRIMARY_STATE_ACTIVE;
    const FINALIZED: u8 = State::PRIMARY_STATE_FINALIZED;
    const PROCESSING: u8 = State::TRANSITION_STATE_ERRORPROCESSING;
    [
        (T::TRANSITION_CONFIGURE, "configure", UNCONFIGURED, S::TRANSITION_STATE_CONFIGURING),
        (T::TRANSITION_ON_CONFIGURE_SUCCESS, SUCCESS, S::TRANSITION_STATE_CONFIGURING, INACTIVE),
        (T::TRANSITION_ON_CONFIGURE_FAILURE, FAILURE, S::TRANSITION_STATE_CONFIGURING, UNCONFIGURED),
        (T::TRANSITION_ON_CONFIGURE_ERROR, ERROR, S::TRANSITION_STATE_CONFIGURING, PROCESSING),
        (T::TRANSITION_CLEANUP, "cleanup", INACTIVE, S::TRANSITION_STATE_CLEANINGUP),
        (T::TRANSITION_ON_CLEANUP_SUCCESS, SUCCESS, S::TRANSITION_STATE_CLEANINGUP, UNCONFIGURED),
        (T::TRANSITION_ON_CLEANUP_FAILURE, FAILURE, S::TRANSITION_STATE_CLEANINGUP, INACTIVE),
        (T::TRANSITION_ON_CLEANUP_ERROR, ERROR, S::TRANSITION_STATE_CLEANINGUP, PROCESSING),
        (T::TRANSITION_ACTIVATE, "activate", INACTIVE, S::TRANSITION_STATE_ACTIVATING),
        (T::TRANSITION_ON_ACTIVATE_SUCCESS, SUCCESS, S::TRANSITION_STATE_ACTIVATING, ACTIVE),
        (T::TRANSITION_ON_ACTIVATE_FAILURE, FAILURE, S::TRANSITION_STATE_ACTIVATING, INACTIVE),
        (T::TRANSITION_ON_ACTIVATE_ERROR, ERROR, S::TRANSITION_STATE_ACTIVATING, PROCESSING),
        (T::TRANSITION_DEACTIVATE, "deactivate", ACTIVE, S::TRANSITION_STATE_DEACTIVATING),
        (T::TRANSITION_ON_DEACTIVATE_SUCCESS, SUCCESS, S::TRANSITION_STATE_DEACTIVATING, INACTIVE),
        (T::TRANSITION_ON_DEACTIVATE_FAILURE, FAILURE, S::TRANSITION_STATE_DEACTIVATING, ACTIVE),
        (T::TRANSITION_ON_DEACTIVATE_ERROR, ERROR, S::TRANSITION_STATE_DEACTIVATING, PROCESSING),
        (T::TRANSITION_UNCONFIGURED_SHUTDOWN, "shutdown", UNCONFIGURED, S::TRANSITION_STATE_SHUTTINGDOWN),
        (T::TRANSITION_INACTIVE_SHUTDOWN, "shutdown", INACTIVE, S::TRANSITION_STATE_SHUTTINGDOWN),
        (T::TRANSITION_ACTIVE_SHUTDOWN, "shutdown", ACTIVE, S::TRANSITION_STATE_SHUTTINGDOWN),
        (T::TRANSITION_ON_SHUTDOWN_SUCCESS, SUCCESS, S::TRANSITION_STATE_SHUTTINGDOWN, FINALIZED),
        (T::TRANSITION_ON_SHUTDOWN_FAILURE, FAILURE, S::TRANSITION_STATE_SHUTTINGDOWN, FINALIZED),
        (T::TRANSITION_ON_SHUTDOWN_ERROR, ERROR, S::TRANSITION_STATE_SHUTTINGDOWN, PROCESSING),
        (T::TRANSITION_ON_ERROR_SUCCESS, SUCCESS, PROCESSING, UNCONFIGURED),
        (T::TRANSITION_ON_ERROR_FAILURE, FAILURE, PROCESSING, FINALIZED),
        (T::TRANSITION_ON_ERROR_ERROR, ERROR, PROCESSING, FINALIZED),
    ]
};

fn state(id: u8) -> State {
    let label = STATES.iter().find(|(known, _)| *known == id).map_or("unknown", |(_, label)| label);
    State { id, label: label.to_owned() }
}

fn transition((id, label, ..): &Step) -> Transition {
    Transition { id: *id, label: (*label).to_owned() }
}

fn description(step: &Step) -> TransitionDescription {
    TransitionDescription { transition: transition(step), start_state: state(step.2), goal_state: state(step.3) }
}

/// The state a node is in, and which way it can go.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Machine(u8);

impl Machine {
    fn steps(self) -> impl Iterator<Item = &'static Step> {
        STEPS.iter().filter(move |(_, _, from, _)| *from == self.0)
    }

    /// The transition that is asked for, if there is one from here. A label goes before the id, which a caller leaves
    /// at zero then.
    fn asked(self, wanted: &Transition) -> Option<&'static Step> {
        if wanted.label.is_empty() {
            self.steps().find(|(id, ..)| *id == wanted.id)
        } else {
            self.steps().find(|(_, label, ..)| *label == wanted.label)
        }
    }

    /// The transition from a state in which work is done, after the work.
    fn ended(self, outcome: Outcome) -> Option<&'static Step> {
        let wanted = match outcome {
            Outcome::Success => SUCCESS,
            Outcome::Failure => FAILURE,
            Outcome::Error => ERROR,
        };
        self.steps().find(|(_, label, ..)| *label == wanted)
    }
}

/// Looks whether what the parameters name is there.
type Check = Box<dyn Fn() -> Result<(), String>>;

/// What carries out the transitions of a node.
struct Manager {
    machine: Machine,
    activity: Activity,
    health: Arc<Health>,
    clock: Clock,
    check: Check,
    forget: mpsc::Sender<Forget>,
    events: mpsc::Sender<TransitionEvent>,
    /// Steps made of which nobody has been told.
    untold: Vec<TransitionEvent>,
}

/// The way up of a node that starts by itself.
const START: [u8; 2] = [Transition::TRANSITION_CONFIGURE, Transition::TRANSITION_ACTIVATE];

impl Manager {
    /// Goes all the way up, at once: nothing that comes from outside finds the node half way. Those who listen are told
    /// later, by [`Self::tell`].
    fn start(&mut self) {
        for id in START {
            let Some(step) = self.machine.asked(&Transition { id, label: String::new() }) else { return };
            self.go(step);
            let outcome = self.work(id);
            if let Some(step) = self.machine.ended(outcome) {
                self.go(step);
            }
        }
    }

    /// Makes a transition with all that follows from it; whether its work went well.
    async fn change(&mut self, wanted: &Transition) -> bool {
        let Some(step) = self.machine.asked(wanted) else {
            let State { label, .. } = state(self.machine.0);
            let (id, wanted) = (wanted.id, shown(&wanted.label));
            self.health.refuse("transition", &format!("no transition '{wanted}' (id {id}) from the state {label}"));
            return false;
        };
        self.go(step);
        // Before the work, which may take its time.
        self.tell().await;
        let outcome = if step.0 == Transition::TRANSITION_CLEANUP { self.clean_up().await } else { self.work(step.0) };
        if let Some(step) = self.machine.ended(outcome) {
            self.go(step);
        }
        if self.machine.0 == State::TRANSITION_STATE_ERRORPROCESSING {
            // A node that can still forget is as good as new.
            self.activity.set(false);
            let outcome = if self.forget().await { Outcome::Success } else { Outcome::Failure };
            if let Some(step) = self.machine.ended(outcome) {
                self.go(step);
            }
        }
        self.tell().await;
        outcome == Outcome::Success
    }

    fn go(&mut self, step: &Step) {
        let (_, _, from, to) = *step;
        self.machine = Machine(to);
        let goal_state = state(to);
        self.health.lifecycle(&goal_state.label);
        let now = self.clock.now();
        const NANOS: u64 = 1_000_000_000;
        let timestamp = u64::try_from(now.sec).unwrap_or_default() * NANOS + u64::from(now.nanosec);
        self.untold.push(TransitionEvent {
            timestamp,
            transition: transition(step),
            start_state: state(from),
            goal_state,
        });
    }

    /// Tells those who listen of the steps made.
    async fn tell(&mut self) {
        for event in self.untold.drain(..) {
            // A closed output is that of a process that ends.
            let _ = self.events.send(event).await;
        }
    }

    /// The work of a transition, but for cleaning up.
    fn work(&mut self, transition: u8) -> Outcome {
        match transition {
            Transition::TRANSITION_CONFIGURE => match (self.check)() {
                Ok(()) => Outcome::Success,
                Err(reason) => {
                    self.health.warn("configure", &reason);
                    Outcome::Failure
                }
            },
            Transition::TRANSITION_ACTIVATE => {
                self.activity.set(true);
                Outcome::Success
            }
            _ => {
                self.activity.set(false);
                Outcome::Success
            }
        }
    }

    async fn clean_up(&mut self) -> Outcome {
        if self.forget().await { Outcome::Success } else { Outcome::Error }
    }

    /// Lets the node's loop forget; false where the loop has ended.
    async fn forget(&mut self) -> bool {
        let (forget, forgotten) = oneshot::channel();
        self.forget.send(forget).await.is_ok() && forgotten.await.is_ok()
    }
}

impl Session {
    /// Makes this a managed node, and starts it unless `autostart` says otherwise. `check` looks whether what the
    /// parameters name is there. The node's loop asks [`Session::activity`] whether it may work, and takes the
    /// wishes to forget from the stream that is given back.
    ///
    /// # Errors
    /// What `check` says, of a node that starts by itself; a refusal of the middleware.
    pub fn manage(
        &mut self,
        check: impl Fn() -> Result<(), String> + 'static,
    ) -> Result<mpsc::Receiver<Forget>, ProcessError> {
        let autostart = self.parameters.bool(&AUTOSTART);
        if autostart {
            check().map_err(ProcessError::Configuration)?;
        }
        let mut changes = self.serve::<ChangeState>("~/change_state")?;
        let mut states = self.serve::<GetState>("~/get_state")?;
        let mut all_states = self.serve::<GetAvailableStates>("~/get_available_states")?;
        let mut transitions = self.serve::<GetAvailableTransitions>("~/get_available_transitions")?;
        let mut graphs = self.serve::<GetAvailableTransitions>("~/get_transition_graph")?;
        let (events, _) = self.publish(&TRANSITION_EVENT)?;
        let (forget, wishes) = mpsc::channel(0);
        let mut manager = Manager {
            machine: Machine(State::PRIMARY_STATE_UNCONFIGURED),
            activity: self.activity.clone(),
            health: Arc::clone(&self.health),
            clock: self.clock.clone(),
            check: Box::new(check),
            forget,
            events,
            untold: Vec::new(),
        };
        self.health.lifecycle("unconfigured");
        if autostart {
            // Before anything runs that takes a call, a goal or a frame.
            manager.start();
        }
        self.spawn(async move {
            manager.tell().await;
            // A caller that has gone is no concern of the node.
            loop {
                futures::select! {
                    call = changes.next() => match call {
                        Some(call) => {
                            let success = manager.change(&call.request.transition).await;
                            let _ = call.reply.send(ChangeStateResponse { success });
                        }
                        None => break,
                    },
                    call = states.next() => if let Some(call) = call {
                        let _ = call.reply.send(GetStateResponse { current_state: state(manager.machine.0) });
                    },
                    call = all_states.next() => if let Some(call) = call {
                        let available_states = STATES.iter().map(|(id, _)| state(*id)).collect();
                        let _ = call.reply.send(GetAvailableStatesResponse { available_states });
                    },
                    call = transitions.next() => if let Some(call) = call {
                        let available_transitions = manager.machine.steps().map(description).collect();
                        let _ = call.reply.send(GetAvailableTransitionsResponse { available_transitions });
                    },
                    call = graphs.next() => if let Some(call) = call {
                        let available_transitions = STEPS.iter().map(description).collect();
                        let _ = call.reply.send(GetAvailableTransitionsResponse { available_transitions });
                    },
                }
            }
        });
        Ok(wishes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn labelled(label: &str) -> Transition {
        Transition { id: 0, label: label.to_owned() }
    }

    fn manager(
        check: impl Fn() -> Result<(), String> + 'static,
    ) -> (Manager, mpsc::Receiver<Forget>, mpsc::Receiver<TransitionEvent>) {
        let (forget, wishes) = mpsc::channel(0);
        let (events, told) = mpsc::channel(100);
        let manager = Manager {
            machine: Machine(State::PRIMARY_STATE_UNCONFIGURED),
            activity: Activity::default(),
            health: Arc::new(Health::new("/n")),
            clock: Clock::default(),
            check: Box::new(check),
            forget,
            events,
            untold: Vec::new(),
        };
        (manager, wishes, told)
    }

    fn told(mut events: mpsc::Receiver<TransitionEvent>) -> Vec<String> {
        std::iter::from_fn(|| events.try_recv().ok()).map(|event| event.goal_state.label).collect()
    }

    #[test]
    fn every_step_leads_from_a_state_to_a_state_and_every_work_can_end_in_three_ways() {
        let known = |id: u8| STATES.iter().any(|(state, _)| *state == id);
        assert!(STEPS.iter().all(|&(_, _, from, to)| known(from) && known(to)));
        for (state, label) in STATES.iter().filter(|(state, _)| *state >= State::TRANSITION_STATE_CONFIGURING) {
            for outcome in [Outcome::Success, Outcome::Failure, Outcome::Error] {
                assert!(Machine(*state).ended(outcome).is_some(), "{label}: {outcome:?}");
            }
        }
        let mut ids: Vec<u8> = STEPS.iter().map(|step| step.0).collect();
        ids.sort_unstable();
        ids.dedup();
        assert_eq!(ids.len(), STEPS.len());
    }

    #[test]
    fn a_transition_is_found_by_id_or_by_label_from_the_states_that_have_it_alone() {
        let machine = Machine(State::PRIMARY_STATE_INACTIVE);
        let by_id = Transition { id: Transition::TRANSITION_ACTIVATE, label: String::new() };
        assert_eq!(machine.asked(&by_id), machine.asked(&labelled("activate")));
        assert!(machine.asked(&labelled("activate")).is_some());
        assert!(machine.asked(&labelled("configure")).is_none());
        assert!(machine.asked(&Transition { id: Transition::TRANSITION_ACTIVE_SHUTDOWN, ..by_id }).is_none());
        assert_eq!(Machine(State::PRIMARY_STATE_FINALIZED).steps().count(), 0);
    }

    #[test]
    fn a_node_goes_up_and_down_and_tells_of_every_step() {
        let (mut manager, mut wishes, events) = manager(|| Ok(()));
        let activity = manager.activity.clone();
        smol::block_on(async {
            assert!(manager.change(&labelled("configure")).await && !activity.is_active());
            assert!(manager.change(&labelled("activate")).await && activity.is_active());
            assert!(!manager.change(&labelled("cleanup")).await, "an active node is not cleaned up");
            assert!(manager.change(&labelled("deactivate")).await && !activity.is_active());
            let forgetful = async { wishes.next().await.unwrap().send(()).unwrap() };
            let cleanup = labelled("cleanup");
            assert!(futures::join!(manager.change(&cleanup), forgetful).0);
            assert!(manager.change(&labelled("shutdown")).await);
        });
        let expected = [
            "configuring",
            "inactive",
            "activating",
            "active",
            "deactivating",
            "inactive",
            "cleaningup",
            "unconfigured",
            "shuttingdown",
            "finalized",
        ];
        assert_eq!(told(events), expected);
    }

    #[test]
    fn a_node_that_starts_is_active_before_anything_else_runs() {
        let (mut manager, _wishes, events) = manager(|| Ok(()));
        manager.start();
        assert!(manager.activity.is_active());
        smol::block_on(manager.tell());
        assert_eq!(told(events), ["configuring", "inactive", "activating", "active"]);
    }

    #[test]
    fn a_configuration_that_fails_leaves_the_node_unconfigured() {
        let (mut manager, _wishes, events) = manager(|| Err("no such folder".to_owned()));
        assert!(!smol::block_on(manager.change(&labelled("configure"))));
        assert_eq!(told(events), ["configuring", "unconfigured"]);
    }

    #[test]
    fn an_error_is_processed_and_what_cannot_be_mended_is_finalized() {
        let (mut manager, wishes, events) = manager(|| Ok(()));
        drop(wishes);
        smol::block_on(async {
            assert!(manager.change(&labelled("configure")).await);
            assert!(!manager.change(&labelled("cleanup")).await);
        });
        assert_eq!(told(events), ["configuring", "inactive", "cleaningup", "errorprocessing", "finalized"]);
    }
}
