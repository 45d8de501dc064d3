//! Solver node: shapes in, the assembly and the poses of the pieces out.
//!
//! Pieces are taken in as they come. When none has come for a short while (`settle_time`), the puzzle is solved in a
//! worker thread; pieces that come meanwhile are taken in after it. Every solution is published, also a partial one, but
//! for one that nobody waits for any more: the last piece of the puzzle, or a reset, puts an end to the solution under
//! way. Other pieces don't, or a puzzle whose pieces come faster than it is solved would show no assembly before the end.

pub mod convert;
pub mod journal;
pub mod params;
mod table;
mod worker;

use std::sync::Arc;
use std::time::{Duration, Instant};

use futures::channel::mpsc;
use futures::future::{Fuse, FusedFuture};
use futures::{FutureExt, SinkExt, Stream, StreamExt, pin_mut};
use jigsaw_msgs::action::Assemble;
use jigsaw_msgs::msg::PieceFeatures;
use jigsaw_msgs::sensor_msgs::msg::Image;
use jigsaw_msgs::std_msgs::msg::Empty;
use jigsaw_msgs::std_srvs::srv::{Trigger, TriggerResponse};

use crate::ros::actions::{Goal, GoalEnd};
use crate::ros::activity::{WhileInactive, inactive};
use crate::ros::exit::ProcessError;
use crate::ros::lifecycle::Forget;
use crate::ros::process::{Program, Work};
use crate::ros::session::{Call, Session, Settings};
use crate::ros::topics;
use convert::Solution;
use journal::Journal;
pub use table::Outputs;
use table::{Origin, Table, answer};

/// The program of this node.
pub const PROGRAM: Program = Program {
    name: "solver_node",
    about: "Assembles jigsaw puzzles by shape.\n\n\
            Topics in:  pieces/features (jigsaw_msgs/PieceFeatures), pieces/forgotten (jigsaw_msgs/PiecesForgotten)\n\
            Topics out: assembly (jigsaw_msgs/Assembly), /tf_static, assembly/image (sensor_msgs/Image),\n            \
            assembly/markers (visualization_msgs/MarkerArray), pieces/reset (std_msgs/Empty)\n\
            Services:   reset (std_srvs/Trigger): begin anew with the pieces in view; solve (std_srvs/Trigger): solve now\n\
            Action:     assemble (jigsaw_msgs/action/Assemble)",
    parameters: params::PARAMETERS,
};

/// A goal of the action `assemble`.
pub type AssembleGoal = Goal<Assemble>;

/// How often is looked whether someone has begun to listen to the pictures.
const AUDIENCE_PERIOD: Duration = Duration::from_millis(500);

/// Draws the latest solution while someone listens. Ends with the solutions.
pub async fn draw(
    solutions: impl Stream<Item = Arc<Solution>> + Unpin,
    mut images: mpsc::Sender<Image>,
    wanted: impl Fn() -> bool,
) {
    let mut solutions = solutions.fuse();
    let mut latest = None;
    loop {
        let mut tick = FutureExt::fuse(smol::Timer::after(AUDIENCE_PERIOD));
        futures::select! {
            solution = solutions.next() => match solution {
                Some(solution) => latest = Some(solution),
                None => break,
            },
            _ = tick => {}
        }
        // What came while the last one was drawn: only the newest is of use.
        while let Some(Some(solution)) = solutions.next().now_or_never() {
            latest = Some(solution);
        }
        if wanted()
            && let Some(solution) = latest.take()
            && images.send(smol::unblock(move || solution.image_message()).await).await.is_err()
        {
            break;
        }
    }
}

/// Opens the node with its own topics and gives its loop.
///
/// # Errors
/// As for [`open`].
pub fn open_with_topics(mut session: Session) -> Result<Work, ProcessError> {
    let features = session.subscribe_kept(&topics::PIECE_FEATURES)?.map(|(piece, _)| piece);
    let (resets, _) = session.publish(&topics::PIECES_RESET)?;
    open(session, features, resets)
}

/// Opens the topics and services of the node and gives its loop, which takes the shapes from `features` and tells
/// `told` when it has forgotten them.
///
/// # Errors
/// A name that is no name; a refusal of the middleware.
pub fn open(
    mut session: Session,
    features: impl Stream<Item = PieceFeatures> + Unpin + 'static,
    told: mpsc::Sender<Empty>,
) -> Result<Work, ProcessError> {
    let journal = params::journal_folder(&session.parameters)
        .map(|folder| Journal::open(&folder))
        .transpose()
        .map_err(|e| ProcessError::Configuration(format!("parameter '{}': {e}", params::JOURNAL.name)))?;
    let resets = session.serve::<Trigger>(topics::RESET_SERVICE)?;
    let solves = session.serve::<Trigger>(topics::SOLVE_SERVICE)?;
    // Drawing never holds up solving.
    let (to_draw, solutions) = mpsc::unbounded();
    let activity = session.activity.clone();
    let goals = session.act::<Assemble>(topics::ASSEMBLE_ACTION, move |goal| {
        convert::budget(goal).map_err(|e| e.to_string())?;
        if activity.is_active() { Ok(()) } else { Err("the node is not active".to_owned()) }
    })?;
    let outputs = Outputs {
        assembly: session.publish(&topics::ASSEMBLY)?.0,
        transforms: session.publish(&topics::TF_STATIC)?.0,
        markers: session.publish(&topics::ASSEMBLY_MARKERS)?.0,
        resets: told,
        solutions: to_draw,
        journal,
    };
    let (images, audience) = session.publish(&topics::ASSEMBLY_IMAGE)?;
    session.spawn(draw(solutions, images, move || audience.count() > 0));
    let settings = session.settings();
    let features = session.activity.gate(features, WhileInactive::Hold);
    let forgets = session.manage(|| Ok(()))?;
    Ok(Box::pin(async move {
        run(features, Requests { resets, solves, goals, forgets }, outputs, settings).await;
        drop(session);
        Ok(())
    }))
}

/// What others may ask for.
#[derive(Debug)]
pub struct Requests<R, S, G, F> {
    /// Calls of `reset`.
    pub resets: R,
    /// Calls of `solve`.
    pub solves: S,
    /// Goals of `assemble`, one at a time.
    pub goals: G,
    /// Wishes to forget all pieces.
    pub forgets: F,
}

/// The node's loop. Begins with the pieces of the journal. Ends, after a last solution, when shapes and requests have ended.
pub async fn run(
    features: impl Stream<Item = PieceFeatures> + Unpin,
    requests: Requests<
        impl Stream<Item = Call<Trigger>> + Unpin,
        impl Stream<Item = Call<Trigger>> + Unpin,
        impl Stream<Item = AssembleGoal> + Unpin,
        impl Stream<Item = Forget> + Unpin,
    >,
    outputs: Outputs,
    settings: Settings,
) {
    let mut changes = settings.parameters.changes();
    let mut switches = settings.activity.changes();
    let mut table = Table::new(outputs, settings);
    table.recall();
    let mut features = features.fuse();
    let (mut resets, mut solves, mut goals) = (requests.resets.fuse(), requests.solves.fuse(), requests.goals.fuse());
    let mut forgets = requests.forgets.fuse();
    let solving = Fuse::terminated();
    let cancelled = Fuse::terminated();
    pin_mut!(solving, cancelled);
    loop {
        let idle = solving.is_terminated();
        let asked = resets.is_done() && solves.is_done() && goals.is_done() && forgets.is_done();
        let ended = features.is_done() && asked;
        if idle && ended && table.due.is_none() {
            break;
        }
        let now = Instant::now();
        table.end_overdue_goal(now);
        let ready = idle && table.activity.is_active();
        if ready && table.due.is_some_and(|due| due <= now) {
            let job = table.work();
            solving.set(smol::unblock(move || job.run()).fuse());
            continue;
        }
        let next = table.due.filter(|_| ready).into_iter().chain(table.deadline()).min();
        let mut alarm = FutureExt::fuse(next.map_or_else(smol::Timer::never, smol::Timer::at));
        futures::select! {
            message = features.next() => if let Some(message) = message {
                table.take(&message, &Origin::Topic);
            },
            _ = alarm => {}
            done = solving => table.publish(done).await,
            call = resets.next() => if let Some(call) = call {
                if table.activity.is_active() {
                    table.reset().await;
                    answer(call, TriggerResponse { success: true, message: "all pieces are forgotten".to_owned() });
                } else {
                    answer(call, inactive());
                }
            },
            call = solves.next() => if let Some(call) = call {
                if table.activity.is_active() {
                    table.waiting.push(call);
                    table.due = Some(Instant::now());
                } else {
                    answer(call, inactive());
                }
            },
            forget = forgets.next() => if let Some(forget) = forget {
                table.reset().await;
                let _ = forget.send(());
            },
            _ = switches.next() => if !table.activity.is_active() {
                table.end_goal(GoalEnd::Aborted);
                table.waiting.drain(..).for_each(|call| answer(call, inactive()));
            },
            goal = goals.next() => if let Some(goal) = goal {
                cancelled.set(table.pursue(goal).fuse());
            },
            called_off = cancelled => if called_off.is_ok() {
                table.end_goal(GoalEnd::Cancelled);
            },
            change = changes.next() => if change.is_some() && !table.sightings.is_empty() {
                table.due = Some(Instant::now());
            },
        }
    }
}
