//! Actions: goals as a stream, each with the way back for feedback and result.
//!
//! One goal at a time: another one is rejected while the first is executing, because a cell has one table.

use std::sync::Arc;
use std::time::Duration;

use futures::channel::{mpsc, oneshot};
use futures::{FutureExt, SinkExt, StreamExt};
use jigsaw_msgs::Action;
use ros2_client::action::{ActionServerQosPolicies, ExecutingGoalHandle, GoalEndStatus, GoalId};
use ros2_client::{ActionTypeName, AsyncActionServer, ServiceMapping};

use super::health::Health;
use super::session::{CHANNEL_DEPTH, Session, SessionError, Wire, dds_name};
use super::topics::{FEEDBACK_QOS, SERVICE_QOS, STATUS_QOS};

/// How long a result is kept for a client that has not asked for it; clients ask when the goal is accepted.
const RESULT_PATIENCE: Duration = Duration::from_secs(5);

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
pub struct Goal<G, A: Action> {
    /// What the client wants.
    pub goal: G,
    /// How far it is; what doesn't fit is left out.
    pub feedback: mpsc::Sender<A::Feedback>,
    /// How it ended; a goal that is dropped counts as aborted.
    pub finish: oneshot::Sender<(GoalEnd, A::Result)>,
    /// Resolves when the client calls the goal off.
    pub cancelled: oneshot::Receiver<()>,
}

impl Session {
    /// The goals of an action. `G` is the goal in a form that can be copied, with the fields of `A::Goal` in their
    /// order, which the client library asks for.
    ///
    /// # Errors
    /// [`SessionError`] for a bad name, or where the middleware refuses.
    pub fn act<A, G>(&mut self, action: &str) -> Result<mpsc::Receiver<Goal<G, A>>, SessionError>
    where
        A: Action + 'static,
        G: ros2_client::Message + Copy + 'static,
    {
        let name = self.names.service(action)?;
        let qos = ActionServerQosPolicies {
            goal_service: SERVICE_QOS,
            result_service: SERVICE_QOS,
            cancel_service: SERVICE_QOS,
            feedback_publisher: FEEDBACK_QOS,
            status_publisher: STATUS_QOS,
        };
        let server = self
            .node
            .create_action_server::<G, Wire<A::Result>, Wire<A::Feedback>>(
                ServiceMapping::Enhanced,
                &dds_name(&name)?,
                &ActionTypeName::new(A::PACKAGE, A::NAME),
                qos,
            )
            .map_err(|e| SessionError::middleware(format!("action {name}"), e))?;
        let (mut sender, receiver) = mpsc::channel(CHANNEL_DEPTH);
        let server = Server::<G, A> { server: AsyncActionServer::new(server), health: Arc::clone(&self.health), name };
        self.spawn(async move {
            while let Some((goal, handle)) = server.next_goal().await {
                let (feedback, feedbacks) = mpsc::channel(CHANNEL_DEPTH);
                let (finish, finished) = oneshot::channel();
                let (cancel, cancelled) = oneshot::channel();
                if sender.send(Goal { goal, feedback, finish, cancelled }).await.is_err() {
                    break;
                }
                let end = server.attend(handle, feedbacks, finished, cancel).await;
                server.end(handle, end).await;
            }
        });
        Ok(receiver)
    }
}

type Inner<G, A> = AsyncActionServer<G, Wire<<A as Action>::Result>, Wire<<A as Action>::Feedback>>;

struct Server<G, A>
where
    A: Action,
    G: ros2_client::Message + Copy,
{
    server: Inner<G, A>,
    health: Arc<Health>,
    name: String,
}

impl<G, A> Server<G, A>
where
    A: Action + 'static,
    G: ros2_client::Message + Copy + 'static,
{
    /// Waits for a goal and accepts it.
    async fn next_goal(&self) -> Option<(G, ExecutingGoalHandle<G>)> {
        loop {
            let request = futures::select! {
                goal = self.server.receive_new_goal().fuse() => goal,
                cancel = self.server.receive_cancel_request().fuse() => {
                    if let Ok(cancel) = cancel {
                        self.warn(self.server.respond_to_cancel_requests(&cancel, std::iter::empty()).await);
                    }
                    continue;
                }
            };
            let new = match request {
                Ok(new) => new,
                Err(e) => {
                    self.health.refuse("undecodable", &format!("goal of {} can't be decoded: {e}", self.name));
                    continue;
                }
            };
            let Some(goal) = self.server.get_new_goal(new) else { continue };
            let Ok(accepted) = self.server.accept_goal(new).await else { continue };
            if let Ok(executing) = self.server.start_executing_goal(accepted).await {
                return Some((goal, executing));
            }
        }
    }

    /// Passes feedback on and cancellation in until the goal has ended.
    async fn attend(
        &self,
        handle: ExecutingGoalHandle<G>,
        mut feedbacks: mpsc::Receiver<A::Feedback>,
        mut finished: oneshot::Receiver<(GoalEnd, A::Result)>,
        cancel: oneshot::Sender<()>,
    ) -> (GoalEnd, A::Result) {
        let mut cancel = Some(cancel);
        loop {
            futures::select! {
                feedback = feedbacks.next() => if let Some(feedback) = feedback {
                    // Once it is being called off the library takes no more feedback.
                    let _ = self.server.publish_feedback(handle, Wire(feedback)).await;
                },
                end = finished => return end.unwrap_or((GoalEnd::Aborted, A::Result::default())),
                request = self.server.receive_cancel_request().fuse() => if let Ok(request) = request {
                    let own: Option<GoalId> = request.contains_goal(&handle.goal_id()).then(|| handle.goal_id());
                    self.warn(self.server.respond_to_cancel_requests(&request, own.into_iter()).await);
                    if let (Some(_), Some(cancel)) = (own, cancel.take()) {
                        // The node may just have finished: then there is nothing to call off.
                        let _ = cancel.send(());
                    }
                },
                goal = self.server.receive_new_goal().fuse() => if let Ok(goal) = goal {
                    log::warn!("{}: a goal is rejected while another one is executing", self.name);
                    let _ = self.server.reject_goal(goal).await;
                },
            }
        }
    }

    async fn end(&self, handle: ExecutingGoalHandle<G>, (end, result): (GoalEnd, A::Result)) {
        let status = match end {
            GoalEnd::Succeeded => GoalEndStatus::Succeeded,
            GoalEnd::Aborted => GoalEndStatus::Aborted,
            GoalEnd::Cancelled => GoalEndStatus::Canceled,
        };
        let sent = self.server.send_result_response(handle, status, Wire(result));
        futures::select! {
            sent = Box::pin(sent).fuse() => if sent.is_err() {
                self.health.warn("write", &format!("the result of {} was not sent", self.name));
            },
            _ = FutureExt::fuse(smol::Timer::after(RESULT_PATIENCE)) => {
                log::warn!("{}: nobody asked for the result", self.name);
                let _ = self.server.abort_executing_goal(handle).await;
            }
        }
    }

    fn warn<E: std::fmt::Display>(&self, result: Result<(), E>) {
        if let Err(e) = result {
            self.health.warn("write", &format!("the answer of {} was not written: {e}", self.name));
        }
    }
}
