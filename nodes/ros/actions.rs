//! Actions: goals as a stream, each with the way back for feedback and result.
//!
//! The states of a goal, the answers and what is published on `status` are those of `rcl_action`. One goal at a time:
//! another one is rejected while the first is executing, because a cell has one table. A result is kept for some
//! seconds, for clients that ask late, and given to every client that asks.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use futures::channel::{mpsc, oneshot};
use futures::future::Fuse;
use futures::{FutureExt, SinkExt, StreamExt, pin_mut};
use jigsaw_msgs::action_msgs::msg::{GoalInfo, GoalStatus, GoalStatusArray};
use jigsaw_msgs::action_msgs::srv::{CancelGoalRequest, CancelGoalResponse};
use jigsaw_msgs::builtin_interfaces::msg::Time;
use jigsaw_msgs::unique_identifier_msgs::msg::UUID;
use jigsaw_msgs::{Action, Message};
use rustdds::{QosPolicies, TopicKind};
use serde::{Deserialize, Serialize};

use super::clock::Clock;
use super::health::Health;
use super::session::{CHANNEL_DEPTH, Session, SessionError};
use super::topics::{FEEDBACK_QOS, STATUS_QOS};

/// How long a result is kept, as `rcl_action` does.
const RESULT_KEPT: Duration = Duration::from_secs(10);

/// Most goals that are remembered; beyond, the oldest that is over is forgotten early, so that memory stays bounded.
const MOST_KEPT: usize = 64;

/// How a goal ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum GoalEnd {
    /// As was wished.
    Succeeded,
    /// Not as was wished.
    Aborted,
    /// The client has called it off.
    Cancelled,
}

/// A goal, accepted and to be worked on.
#[derive(Debug)]
pub struct Goal<A: Action> {
    /// What the client wants.
    pub goal: A::Goal,
    /// How far it is; what doesn't fit is left out.
    pub feedback: mpsc::Sender<A::Feedback>,
    /// How it ended; a goal that is dropped counts as aborted.
    pub finish: oneshot::Sender<(GoalEnd, A::Result)>,
    /// Resolves when the client calls the goal off.
    pub cancelled: oneshot::Receiver<()>,
}

// The structures around goal, result and feedback that the rosidl generators add to an action.

#[derive(Debug, Serialize, Deserialize)]
#[serde(bound = "")]
struct SendGoalRequest<G: Message> {
    goal_id: UUID,
    goal: G,
}

#[derive(Debug, Serialize, Deserialize)]
struct SendGoalResponse {
    accepted: bool,
    stamp: Time,
}

#[derive(Debug, Serialize, Deserialize)]
struct GetResultRequest {
    goal_id: UUID,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(bound = "")]
struct GetResultResponse<R: Message> {
    status: i8,
    result: R,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(bound = "")]
struct FeedbackMessage<F: Message> {
    goal_id: UUID,
    feedback: F,
}

impl Session {
    /// The goals of an action that `admit` has nothing against.
    ///
    /// # Errors
    /// [`SessionError`] for a bad name, or where the middleware refuses.
    pub fn act<A: Action + 'static>(
        &mut self,
        action: &str,
        admit: impl Fn(&A::Goal) -> Result<(), String> + 'static,
    ) -> Result<mpsc::Receiver<Goal<A>>, SessionError> {
        let name = self.names.service(action)?;
        let base = format!("{name}/_action");
        let type_of = |part: &str| format!("{}::action::dds_::{}_{part}_", A::PACKAGE, A::NAME);
        let service = |part: &str| ["Request", "Response"].map(|end| type_of(&format!("{part}_{end}")));
        let cancel = ["Request", "Response"].map(|end| format!("action_msgs::srv::dds_::CancelGoal_{end}_"));
        let asks = Asks {
            goals: self.open_server(&format!("{base}/send_goal"), service("SendGoal"), |ask, reply| (ask, reply))?,
            cancels: self.open_server(&format!("{base}/cancel_goal"), cancel, |ask, reply| (ask, reply))?,
            results: self
                .open_server(&format!("{base}/get_result"), service("GetResult"), |ask, reply| (ask, reply))?,
        };
        let fail = |e: rustdds::dds::CreateError| SessionError::middleware(format!("action {name}"), e);
        let participant = self.context.domain_participant();
        let feedback = participant
            .create_topic(
                format!("rt{base}/feedback"),
                type_of("FeedbackMessage"),
                &QosPolicies::from(FEEDBACK_QOS),
                TopicKind::NoKey,
            )
            .map_err(fail)?;
        let status = participant
            .create_topic(
                format!("rt{base}/status"),
                GoalStatusArray::TYPE.dds_name.to_owned(),
                &QosPolicies::from(STATUS_QOS),
                TopicKind::NoKey,
            )
            .map_err(fail)?;
        let library = |e: ros2_client::CreateError| SessionError::middleware(format!("action {name}"), e);
        let feedback = self.node.borrow_mut().create_publisher(&feedback, None).map_err(library)?;
        let statuses = self.node.borrow_mut().create_publisher(&status, None).map_err(library)?;
        let (goals, receiver) = mpsc::channel(CHANNEL_DEPTH);
        let server = Server::<A> {
            feedback,
            statuses,
            goals,
            health: Arc::clone(&self.health),
            clock: self.clock.clone(),
            name,
            kept: Ledger::default(),
            running: None,
        };
        self.spawn(server.attend(asks, admit));
        Ok(receiver)
    }
}

type Ask<Req, Resp> = mpsc::Receiver<(Req, oneshot::Sender<Resp>)>;

/// What clients ask for.
struct Asks<A: Action> {
    goals: Ask<SendGoalRequest<A::Goal>, SendGoalResponse>,
    cancels: Ask<CancelGoalRequest, CancelGoalResponse>,
    results: Ask<GetResultRequest, GetResultResponse<A::Result>>,
}

/// A goal that was accepted.
struct Kept<R: Message> {
    stamp: Time,
    status: i8,
    /// When the goal was over, and its result.
    end: Option<(Instant, R)>,
    /// Who waits for the result.
    waiting: Vec<oneshot::Sender<GetResultResponse<R>>>,
}

/// The goals that are or were executing, by id, with the rules of `rcl_action`.
struct Ledger<R: Message>(BTreeMap<[u8; 16], Kept<R>>);

impl<R: Message> Default for Ledger<R> {
    fn default() -> Self {
        Self(BTreeMap::new())
    }
}

impl<R: Message> Ledger<R> {
    fn accept(&mut self, id: [u8; 16], stamp: Time) {
        if self.0.len() >= MOST_KEPT {
            let oldest = self.0.iter().filter_map(|(id, kept)| Some((kept.end.as_ref()?.0, *id))).min();
            oldest.and_then(|(_, id)| self.0.remove(&id));
        }
        let kept = Kept { stamp, status: GoalStatus::STATUS_EXECUTING, end: None, waiting: Vec::new() };
        self.0.insert(id, kept);
    }

    /// Puts the goals that a client wants to be called off into the state for it, and says which.
    fn cancel(&mut self, wanted: &GoalInfo) -> CancelGoalResponse {
        let (all_ids, all_times) = (wanted.goal_id == UUID::default(), wanted.stamp == Time::default());
        let time = |stamp: &Time| (stamp.sec, stamp.nanosec);
        let mut goals_canceling = Vec::new();
        for (id, kept) in &mut self.0 {
            let by_id = wanted.goal_id.uuid == *id;
            let by_time = if all_times { all_ids } else { time(&kept.stamp) <= time(&wanted.stamp) };
            if (by_id || by_time) && kept.status == GoalStatus::STATUS_EXECUTING {
                kept.status = GoalStatus::STATUS_CANCELING;
                goals_canceling.push(GoalInfo { goal_id: UUID { uuid: *id }, stamp: kept.stamp.clone() });
            }
        }
        let return_code = match self.0.get(&wanted.goal_id.uuid) {
            _ if !goals_canceling.is_empty() => CancelGoalResponse::ERROR_NONE,
            None if all_ids => CancelGoalResponse::ERROR_REJECTED,
            None => CancelGoalResponse::ERROR_UNKNOWN_GOAL_ID,
            Some(_) => CancelGoalResponse::ERROR_GOAL_TERMINATED,
        };
        CancelGoalResponse { return_code, goals_canceling }
    }

    /// Gives the result, now or when it is there. An unknown goal has the status unknown.
    fn ask(&mut self, id: &[u8; 16], reply: oneshot::Sender<GetResultResponse<R>>) {
        match self.0.get_mut(id) {
            Some(kept) => match &kept.end {
                Some((_, result)) => answer(reply, kept.status, result.clone()),
                None => kept.waiting.push(reply),
            },
            None => answer(reply, GoalStatus::STATUS_UNKNOWN, R::default()),
        }
    }

    fn end(&mut self, id: &[u8; 16], status: i8, result: R, now: Instant) {
        if let Some(kept) = self.0.get_mut(id) {
            kept.status = status;
            kept.waiting.drain(..).for_each(|reply| answer(reply, status, result.clone()));
            kept.end = Some((now, result));
        }
    }

    /// Forgets the goals that have been over for long enough; whether there were any.
    fn expire(&mut self, now: Instant) -> bool {
        let before = self.0.len();
        self.0.retain(|_, kept| kept.end.as_ref().is_none_or(|(end, _)| now.duration_since(*end) < RESULT_KEPT));
        self.0.len() < before
    }

    fn next_expiry(&self) -> Option<Instant> {
        self.0.values().filter_map(|kept| Some(kept.end.as_ref()?.0 + RESULT_KEPT)).min()
    }

    fn statuses(&self) -> GoalStatusArray {
        let status = |(id, kept): (&[u8; 16], &Kept<R>)| GoalStatus {
            goal_info: GoalInfo { goal_id: UUID { uuid: *id }, stamp: kept.stamp.clone() },
            status: kept.status,
        };
        GoalStatusArray { status_list: self.0.iter().map(status).collect() }
    }
}

fn answer<R: Message>(reply: oneshot::Sender<GetResultResponse<R>>, status: i8, result: R) {
    // A client that has gone is no concern of the server.
    let _ = reply.send(GetResultResponse { status, result });
}

/// The goal that is executing.
struct Running {
    id: [u8; 16],
    /// Tells the node that the goal is called off; taken when it has been.
    cancel: Option<oneshot::Sender<()>>,
}

struct Server<A: Action> {
    feedback: ros2_client::Publisher<FeedbackMessage<A::Feedback>>,
    statuses: ros2_client::Publisher<GoalStatusArray>,
    goals: mpsc::Sender<Goal<A>>,
    health: Arc<Health>,
    clock: Clock,
    name: String,
    kept: Ledger<A::Result>,
    running: Option<Running>,
}

impl<A: Action> Server<A> {
    async fn attend(mut self, mut asks: Asks<A>, admit: impl Fn(&A::Goal) -> Result<(), String>) {
        let finished = Fuse::terminated();
        pin_mut!(finished);
        let (_, mut feedbacks) = mpsc::channel(0);
        loop {
            let expiry = self.kept.next_expiry();
            let mut alarm = FutureExt::fuse(expiry.map_or_else(smol::Timer::never, smol::Timer::at));
            futures::select! {
                ask = asks.goals.next() => {
                    let Some((SendGoalRequest { goal_id, goal }, reply)) = ask else { break };
                    let stamp = self.clock.now();
                    let refusal = self.refusal(&goal_id, admit(&goal));
                    let accepted = refusal.is_none();
                    if let Some(reason) = refusal {
                        self.health.refuse("goal", &format!("goal of {} rejected: {reason}", self.name));
                    } else {
                        let (finish, end) = oneshot::channel();
                        let (cancel, cancelled) = oneshot::channel();
                        let (feedback, receiver) = mpsc::channel(CHANNEL_DEPTH);
                        self.kept.accept(goal_id.uuid, stamp.clone());
                        self.running = Some(Running { id: goal_id.uuid, cancel: Some(cancel) });
                        feedbacks = receiver;
                        finished.set(end.fuse());
                        if self.goals.send(Goal { goal, feedback, finish, cancelled }).await.is_err() {
                            break;
                        }
                    }
                    let _ = reply.send(SendGoalResponse { accepted, stamp });
                    if accepted {
                        self.tell().await;
                    }
                },
                ask = asks.cancels.next() => {
                    let Some((request, reply)) = ask else { break };
                    let response = self.kept.cancel(&request.goal_info);
                    let changed = !response.goals_canceling.is_empty();
                    // One goal executes at a time, so this is the one.
                    if changed && let Some(cancel) = self.running.as_mut().and_then(|running| running.cancel.take()) {
                        // The node may just have finished: then there is nothing to call off.
                        let _ = cancel.send(());
                    }
                    let _ = reply.send(response);
                    if changed {
                        self.tell().await;
                    }
                },
                ask = asks.results.next() => {
                    let Some((request, reply)) = ask else { break };
                    self.kept.ask(&request.goal_id.uuid, reply);
                },
                feedback = feedbacks.select_next_some() => self.feed_back(feedback).await,
                end = finished => {
                    // What the node had to say comes before the end.
                    while let Ok(feedback) = feedbacks.try_recv() {
                        self.feed_back(feedback).await;
                    }
                    self.finish(end.ok()).await;
                },
                _ = alarm => if self.kept.expire(Instant::now()) {
                    self.tell().await;
                },
            }
        }
    }

    async fn feed_back(&self, feedback: A::Feedback) {
        let Some(running) = &self.running else { return };
        let message = FeedbackMessage { goal_id: UUID { uuid: running.id }, feedback };
        if self.feedback.async_publish(message).await.is_err() {
            self.health.warn("write", &format!("feedback of {} was not written", self.name));
        }
    }

    /// Why a goal is rejected, if it is.
    fn refusal(&self, id: &UUID, admitted: Result<(), String>) -> Option<String> {
        if self.kept.0.contains_key(&id.uuid) {
            Some("its id is that of a known goal".to_owned())
        } else if self.running.is_some() {
            Some("another one is executing".to_owned())
        } else {
            admitted.err()
        }
    }

    async fn finish(&mut self, end: Option<(GoalEnd, A::Result)>) {
        let Some(running) = self.running.take() else { return };
        let (end, result) = end.unwrap_or_else(|| (GoalEnd::Aborted, A::Result::default()));
        let status = match end {
            GoalEnd::Succeeded => GoalStatus::STATUS_SUCCEEDED,
            GoalEnd::Aborted => GoalStatus::STATUS_ABORTED,
            GoalEnd::Cancelled => GoalStatus::STATUS_CANCELED,
        };
        self.kept.end(&running.id, status, result, Instant::now());
        self.tell().await;
    }

    async fn tell(&self) {
        if self.statuses.async_publish(self.kept.statuses()).await.is_err() {
            self.health.warn("write", &format!("the status of {} was not written", self.name));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use jigsaw_msgs::action::AssembleResult;

    fn ledger() -> Ledger<AssembleResult> {
        let mut ledger = Ledger::default();
        ledger.accept([1; 16], Time { sec: 5, nanosec: 0 });
        ledger
    }

    fn wanted(id: u8, sec: i32) -> GoalInfo {
        GoalInfo { goal_id: UUID { uuid: [id; 16] }, stamp: Time { sec, nanosec: 0 } }
    }

    #[test]
    fn goals_are_called_off_by_id_by_time_or_all_of_them() {
        for (id, sec, code) in [
            (1, 0, CancelGoalResponse::ERROR_NONE),
            (0, 0, CancelGoalResponse::ERROR_NONE),
            (0, 5, CancelGoalResponse::ERROR_NONE),
            (2, 5, CancelGoalResponse::ERROR_NONE),
            (0, 4, CancelGoalResponse::ERROR_REJECTED),
            (2, 0, CancelGoalResponse::ERROR_UNKNOWN_GOAL_ID),
            (2, 4, CancelGoalResponse::ERROR_UNKNOWN_GOAL_ID),
        ] {
            let mut ledger = ledger();
            let response = ledger.cancel(&wanted(id, sec));
            assert_eq!(response.return_code, code, "id {id}, time {sec}");
            let cancelling = ledger.0[&[1; 16]].status == GoalStatus::STATUS_CANCELING;
            assert_eq!(cancelling, code == CancelGoalResponse::ERROR_NONE);
            assert_eq!(response.goals_canceling.len(), usize::from(cancelling));
        }
        let mut over = ledger();
        over.end(&[1; 16], GoalStatus::STATUS_SUCCEEDED, AssembleResult::default(), Instant::now());
        assert_eq!(over.cancel(&wanted(1, 0)).return_code, CancelGoalResponse::ERROR_GOAL_TERMINATED);
    }

    #[test]
    fn every_client_gets_the_result_early_or_late_until_it_is_forgotten() {
        let mut ledger = ledger();
        let ask = |ledger: &mut Ledger<AssembleResult>| {
            let (reply, answer) = oneshot::channel();
            ledger.ask(&[1; 16], reply);
            answer
        };
        let mut early = ask(&mut ledger);
        assert!(early.try_recv().unwrap().is_none());
        let now = Instant::now();
        ledger.end(&[1; 16], GoalStatus::STATUS_ABORTED, AssembleResult::default(), now);
        for mut asked in [early, ask(&mut ledger), ask(&mut ledger)] {
            assert_eq!(asked.try_recv().unwrap().unwrap().status, GoalStatus::STATUS_ABORTED);
        }
        assert!(!ledger.expire(now) && ledger.expire(now + RESULT_KEPT));
        assert_eq!(ask(&mut ledger).try_recv().unwrap().unwrap().status, GoalStatus::STATUS_UNKNOWN);
    }

    #[test]
    fn goals_without_end_take_no_memory_without_end() {
        let mut ledger = Ledger::<AssembleResult>::default();
        for n in 0..1000_u32 {
            let mut id = [0; 16];
            id[..4].copy_from_slice(&n.to_le_bytes());
            ledger.accept(id, Time::default());
            ledger.end(&id, GoalStatus::STATUS_SUCCEEDED, AssembleResult::default(), Instant::now());
        }
        assert!(ledger.0.len() <= MOST_KEPT);
    }
}
