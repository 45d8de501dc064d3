//! Solver node: shapes in, the assembly and the poses of the pieces out.
//!
//! Pieces are taken in as they come. When none has come for a short while (`settle_time`), the puzzle is solved in a
//! worker thread; pieces that come meanwhile are taken in after it. Every solution is published, also a partial one, but
//! for one that nobody waits for any more: the last piece of the puzzle, or a reset, puts an end to the solution under
//! way. Other pieces don't, or a puzzle whose pieces come faster than it is solved would show no assembly before the end.

pub mod convert;
pub mod journal;
pub mod params;

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use futures::channel::{mpsc, oneshot};
use futures::future::{Fuse, FusedFuture};
use futures::{FutureExt, SinkExt, Stream, StreamExt, pin_mut};
use jigsaw::{Assembly, Budget, Params, Piece, Solver, SolverError};
use jigsaw_msgs::action::{Assemble, AssembleFeedback, AssembleResult};
use jigsaw_msgs::msg::{Assembly as AssemblyMessage, PieceFeatures};
use jigsaw_msgs::sensor_msgs::msg::Image;
use jigsaw_msgs::std_msgs::msg::Empty;
use jigsaw_msgs::std_srvs::srv::{Trigger, TriggerResponse};
use jigsaw_msgs::tf2_msgs::msg::TFMessage;
use jigsaw_msgs::visualization_msgs::msg::MarkerArray;

use crate::ros::actions::{Goal, GoalEnd};
use crate::ros::activity::{Activity, WhileInactive, inactive};
use crate::ros::exit::ProcessError;
use crate::ros::health::Health;
use crate::ros::lifecycle::Forget;
use crate::ros::params::Parameters;
use crate::ros::process::{Program, Work};
use crate::ros::session::{Call, Session, Settings};
use crate::ros::topics;
use convert::{FeaturesError, Naming, Sighting, Solution};
use journal::{Journal, JournalError};

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

/// Where the results go.
#[derive(Debug, Clone)]
pub struct Outputs {
    /// The assembly.
    pub assembly: mpsc::Sender<AssemblyMessage>,
    /// The poses.
    pub transforms: mpsc::Sender<TFMessage>,
    /// The outlines.
    pub markers: mpsc::Sender<MarkerArray>,
    /// What the other nodes are told when all pieces are forgotten.
    pub resets: mpsc::Sender<Empty>,
    /// What is to be drawn; [`draw`] takes it from there.
    pub solutions: mpsc::UnboundedSender<Arc<Solution>>,
    /// Where the pieces taken in are kept, if anywhere.
    pub journal: Option<Journal>,
}

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
            solving.set(smol::unblock(table.work()).fuse());
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

fn answer(call: Call<Trigger>, response: TriggerResponse) {
    // The caller may have gone; that is no concern of the node.
    let _ = call.reply.send(response);
}

/// Waits until no piece has come for the settle time.
#[derive(Debug, Default)]
struct Settling {
    /// When the first of the pieces that wait came.
    since: Option<Instant>,
}

impl Settling {
    /// How many times the settle time a piece waits at most: pieces that keep coming must not put the solution off for ever.
    const MOST: u32 = 4;

    /// When to solve, after a piece has come now.
    fn due(&mut self, now: Instant, settle_time: Duration) -> Instant {
        let since = *self.since.get_or_insert(now);
        (now + settle_time).min(since + settle_time * Self::MOST)
    }
}

/// The time that a solution may take, and whether it is wanted still.
struct Allowance {
    begin: Instant,
    /// \[s\]; 0 for no limit.
    seconds: f64,
    abandoned: Arc<AtomicBool>,
}

impl Allowance {
    fn is_abandoned(&self) -> bool {
        self.abandoned.load(Ordering::Relaxed)
    }
}

impl Budget for Allowance {
    fn spent(&self) -> f64 {
        match self.seconds {
            _ if self.is_abandoned() => f64::INFINITY,
            limit if limit > 0.0 => self.begin.elapsed().as_secs_f64() / limit,
            _ => 0.0,
        }
    }
}

/// What one run of the worker gives back.
struct Done {
    solver: Option<Solver>,
    /// None where it was abandoned.
    assembly: Option<Assembly>,
    /// Pieces the solver did not take, with its reasons.
    refused: Vec<(String, String)>,
    generation: u64,
    seconds: f64,
}

/// A solver with these parameters, and the pieces that it must be given again where they have changed.
fn with_params(solver: Option<Solver>, params: Params) -> Result<(Solver, Vec<Piece>), SolverError> {
    match solver {
        Some(solver) if *solver.params() == params => Ok((solver, Vec::new())),
        other => {
            let kept = other.map(|solver| solver.pieces().to_vec()).unwrap_or_default();
            Ok((Solver::new(params)?, kept))
        }
    }
}

/// Where a piece comes from.
enum Origin {
    Topic,
    /// Which has it already.
    Journal,
}

/// The pieces on the table, and the state of the solution.
struct Table {
    outputs: Outputs,
    parameters: Arc<Parameters>,
    health: Arc<Health>,
    activity: Activity,
    /// None at first, after a reset, and while the worker has it.
    solver: Option<Solver>,
    /// Pieces that the solver does not have yet.
    incoming: Vec<Piece>,
    /// All pieces by name, with a fingerprint of the message they came in.
    sightings: HashMap<String, (u64, Sighting)>,
    /// When to solve next, if there is a reason to.
    due: Option<Instant>,
    /// Pieces that wait to be solved together.
    settling: Settling,
    /// Whether the solution under way is of no use any more.
    abandoned: Arc<AtomicBool>,
    /// Callers that wait for the next solution.
    waiting: Vec<Call<Trigger>>,
    /// Counts resets: what a worker began before one is of no use after it.
    generation: u64,
    /// The transforms published last.
    transforms: TFMessage,
    /// The assembly published last.
    best: AssemblyMessage,
    /// The goal that is pursued, if any.
    goal: Option<Pursuit>,
}

/// A goal of `assemble` while it is pursued.
struct Pursuit {
    expected_pieces: usize,
    deadline: Option<Instant>,
    feedback: mpsc::Sender<AssembleFeedback>,
    finish: oneshot::Sender<(GoalEnd, AssembleResult)>,
}

impl Table {
    fn new(outputs: Outputs, settings: Settings) -> Self {
        let Settings { parameters, health, activity } = settings;
        Self {
            outputs,
            parameters,
            health,
            activity,
            solver: None,
            incoming: Vec::new(),
            sightings: HashMap::new(),
            due: None,
            settling: Settling::default(),
            abandoned: Arc::default(),
            waiting: Vec::new(),
            generation: 0,
            transforms: TFMessage::default(),
            best: AssemblyMessage::default(),
            goal: None,
        }
    }

    /// Begins to pursue a goal; resolves when its client calls it off.
    fn pursue(&mut self, goal: AssembleGoal) -> oneshot::Receiver<()> {
        let now = Instant::now();
        self.goal = Some(Pursuit {
            expected_pieces: usize::try_from(goal.goal.expected_pieces).unwrap_or(usize::MAX),
            // One that breaks the rules was rejected already.
            deadline: convert::budget(&goal.goal).ok().flatten().and_then(|budget| now.checked_add(budget)),
            feedback: goal.feedback,
            finish: goal.finish,
        });
        // A solution under the goal's own number of pieces, and the first feedback with it.
        self.due = Some(now);
        goal.cancelled
    }

    fn deadline(&self) -> Option<Instant> {
        self.goal.as_ref().and_then(|goal| goal.deadline)
    }

    fn end_overdue_goal(&mut self, now: Instant) {
        if self.deadline().is_some_and(|deadline| deadline <= now) {
            self.end_goal(GoalEnd::Aborted);
        }
    }

    fn end_goal(&mut self, end: GoalEnd) {
        if let Some(goal) = self.goal.take() {
            let result = AssembleResult { complete: end == GoalEnd::Succeeded, assembly: self.best.clone() };
            // The client may have gone; that is no concern of the node.
            let _ = goal.finish.send((end, result));
            // What was published last goes by the number of a goal that nobody pursues any more.
            if end != GoalEnd::Succeeded && goal.expected_pieces > 0 && !self.sightings.is_empty() {
                self.due = Some(Instant::now());
            }
        }
    }

    /// Takes in the pieces that the journal has kept.
    fn recall(&mut self) {
        let Some(journal) = self.outputs.journal.clone() else { return };
        match journal.pieces() {
            Ok((pieces, faults)) => {
                if !pieces.is_empty() {
                    log::info!("{} pieces were kept in the journal", pieces.len());
                }
                faults.iter().for_each(|fault| self.health.refuse("journal", &fault.to_string()));
                pieces.iter().for_each(|piece| self.take(piece, &Origin::Journal));
            }
            Err(fault) => self.health.warn("journal", &fault.to_string()),
        }
    }

    /// Does something to the journal, if there is one. Where that fails the node works on without.
    fn keep_journal(&self, action: impl FnOnce(&Journal) -> Result<(), JournalError>) {
        if let Some(Err(fault)) = self.outputs.journal.as_ref().map(action) {
            self.health.warn("journal", &fault.to_string());
        }
    }

    /// Takes a piece in, or refuses it.
    fn take(&mut self, message: &PieceFeatures, origin: &Origin) {
        match self.admit(message) {
            Ok(true) => {
                if matches!(origin, Origin::Topic) {
                    self.keep_journal(|journal| journal.keep(message));
                }
                self.health.received();
                self.health.figure("pieces", self.sightings.len());
                self.due = Some(self.due_with_piece(Instant::now()));
            }
            Ok(false) => log::debug!("piece {} came again", message.id),
            Err(refusal) => self.health.refuse(refusal.kind(), &refusal.to_string()),
        }
    }

    /// When to solve, after a piece has come now.
    fn due_with_piece(&mut self, now: Instant) -> Instant {
        // With the last piece there is nothing to wait for, and a solution without it is of no use.
        if self.sightings.len() == self.expected_pieces() {
            self.abandoned.store(true, Ordering::Relaxed);
            return now;
        }
        self.settling.due(now, Duration::from_secs_f64(self.parameters.double(&params::SETTLE_TIME)))
    }

    /// Whether the piece is new. The same message again (of a latched topic, or of a node that was started again) is not,
    /// nor is a piece that still lies where it was seen before.
    fn admit(&mut self, message: &PieceFeatures) -> Result<bool, FeaturesError> {
        let (piece, sighting) = convert::piece(message)?;
        let scale = self.sightings.values().next().map(|(_, other)| other.table.metres_per_pixel);
        convert::check_scale(&piece.id, sighting.table.metres_per_pixel, scale)?;
        let fingerprint = convert::fingerprint(message);
        if let Some((known, _)) = self.sightings.get(&piece.id) {
            return if *known == fingerprint { Ok(false) } else { Err(FeaturesError::DuplicateId(piece.id)) };
        }
        if let Some((known, _)) = self.sightings.iter().find(|(_, (_, other))| sighting.is_same_place(other)) {
            log::info!("piece {} is piece {known}, which still lies there", piece.id);
            return Ok(false);
        }
        let most = params::count(&self.parameters, &params::MAXIMUM_PIECES);
        if self.sightings.len() >= most {
            return Err(FeaturesError::Full { id: piece.id, most });
        }
        let kept: usize = self.sightings.values().map(|(_, other)| other.border_in_image.len()).sum();
        let points = kept + sighting.border_in_image.len();
        if points > convert::MAX_POINTS_KEPT {
            return Err(FeaturesError::Points { id: piece.id, points });
        }
        self.sightings.insert(piece.id.clone(), (fingerprint, sighting));
        self.incoming.push(piece);
        Ok(true)
    }

    /// The next run of the worker: takes in what has come, and solves.
    fn work(&mut self) -> impl FnOnce() -> Done + Send + 'static {
        self.due = None;
        self.settling = Settling::default();
        self.abandoned = Arc::default();
        self.health.state("solving");
        let params = params::solver_params(&self.parameters);
        let abandoned = Arc::clone(&self.abandoned);
        let solver = self.solver.take();
        let incoming = std::mem::take(&mut self.incoming);
        let generation = self.generation;
        move || {
            let allowance = Allowance { begin: Instant::now(), seconds: params.time_budget, abandoned };
            let mut refused = Vec::new();
            let mut solved = None;
            match with_params(solver, params) {
                Ok((mut solver, kept)) => {
                    for piece in kept.into_iter().chain(incoming) {
                        let id = piece.id.clone();
                        if let Err(e) = solver.insert(piece) {
                            refused.push((id, e.to_string()));
                        }
                    }
                    let assembly = solver.solve_within(&allowance);
                    solved = Some((solver, assembly));
                }
                Err(e) => refused.extend(incoming.into_iter().map(|piece| (piece.id, e.to_string()))),
            }
            let (solver, assembly) = solved.unzip();
            let assembly = (!allowance.is_abandoned()).then(|| assembly.unwrap_or_default());
            Done { solver, assembly, refused, generation, seconds: allowance.begin.elapsed().as_secs_f64() }
        }
    }

    /// Takes the worker's results over and publishes them.
    async fn publish(&mut self, done: Done) {
        if done.generation != self.generation {
            return;
        }
        for (id, reason) in done.refused {
            self.sightings.remove(&id);
            self.keep_journal(|journal| journal.forget(&id));
            let refusal = FeaturesError::Solver(reason);
            self.health.refuse(refusal.kind(), &refusal.to_string());
        }
        let pieces = done.solver.as_ref().map(|solver| solver.pieces().to_vec()).unwrap_or_default();
        let sightings = pieces.iter().filter_map(|p| self.sightings.get(&p.id).map(|(_, s)| s.clone())).collect();
        self.solver = done.solver;
        let Some(assembly) = done.assembly else { return };
        if !self.activity.is_active() {
            // The node was told to stop while it solved; it solves again when it is told to go on.
            self.due = Some(Instant::now());
            return;
        }
        self.health.figure("solve_seconds", format!("{:.4}", done.seconds));
        self.send(Solution { pieces, sightings, assembly, naming: self.naming() }).await;
    }

    async fn publish_empty(&mut self) {
        let solution = Solution {
            pieces: Vec::new(),
            sightings: Vec::new(),
            assembly: Assembly::default(),
            naming: self.naming(),
        };
        self.send(solution).await;
    }

    fn naming(&self) -> Naming {
        Naming {
            table_frame: self.parameters.text(&params::TABLE_FRAME),
            puzzle_frame: self.parameters.text(&params::PUZZLE_FRAME),
            expected_pieces: self.expected_pieces(),
        }
    }

    /// Pieces of the whole puzzle, by the goal or the parameter; 0 if not known.
    fn expected_pieces(&self) -> usize {
        match &self.goal {
            Some(goal) if goal.expected_pieces > 0 => goal.expected_pieces,
            _ => params::count(&self.parameters, &params::EXPECTED_PIECES),
        }
    }

    async fn send(&mut self, solution: Solution) {
        let message = solution.assembly_message();
        let (placed, seen) = (message.pieces.len(), solution.pieces.len());
        let state = match message.state {
            AssemblyMessage::COMPLETE => "complete",
            AssemblyMessage::PARTIAL => "partial",
            _ => "collecting",
        };
        let summary = format!("{state}: {placed} of {seen} pieces placed, {} matings", message.matings.len());
        self.health.state(&summary);
        self.health.figure("placed", placed);
        self.health.figure("matings", message.matings.len());
        self.health.published();
        // Poses before the assembly: who acts on the assembly finds the transforms there.
        let transforms = solution.transforms_message();
        if transforms != self.transforms {
            self.transforms = transforms.clone();
            let _ = self.outputs.transforms.send(transforms).await;
        }
        self.best = message.clone();
        if let Some(goal) = &mut self.goal {
            let feedback = AssembleFeedback {
                pieces_seen: u32::try_from(seen).unwrap_or(u32::MAX),
                matings: u32::try_from(message.matings.len()).unwrap_or(u32::MAX),
                best: message.clone(),
            };
            // A client that is behind gets the next one.
            let _ = goal.feedback.try_send(feedback);
        }
        if message.state == AssemblyMessage::COMPLETE {
            self.end_goal(GoalEnd::Succeeded);
        }
        // A closed output is that of a process that ends.
        let _ = self.outputs.assembly.send(message).await;
        // Off with what an arm waits for, before the rest is made.
        smol::future::yield_now().await;
        log::info!("{summary}");
        let _ = self.outputs.markers.send(solution.markers_message()).await;
        let _ = self.outputs.solutions.unbounded_send(Arc::new(solution));
        for call in self.waiting.drain(..) {
            answer(call, TriggerResponse { success: true, message: summary.clone() });
        }
    }

    /// Forgets all pieces, here and upstream: what is in view from now on is new.
    async fn reset(&mut self) {
        self.generation += 1;
        self.abandoned.store(true, Ordering::Relaxed);
        self.incoming.clear();
        self.sightings.clear();
        self.due = None;
        self.settling = Settling::default();
        self.solver = None;
        self.keep_journal(Journal::forget_all);
        self.health.figure("pieces", 0);
        let _ = self.outputs.resets.send(Empty::default()).await;
        // What is latched must not speak of pieces that are forgotten.
        self.publish_empty().await;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pieces_that_come_together_are_solved_together_and_none_waits_for_ever() {
        let (begin, settle_time) = (Instant::now(), Duration::from_millis(10));
        let mut settling = Settling::default();
        assert_eq!(settling.due(begin, settle_time), begin + settle_time);
        let next = begin + settle_time / 2;
        assert_eq!(settling.due(next, settle_time), next + settle_time);
        let stream = (0..100).map(|k| begin + k * settle_time / 2);
        let latest = stream.map(|now| settling.due(now, settle_time)).max();
        assert_eq!(latest, Some(begin + Settling::MOST * settle_time));
    }

    #[test]
    fn a_solution_that_nobody_waits_for_has_no_time_left() {
        let abandoned = Arc::new(AtomicBool::new(false));
        let allowance = |seconds| Allowance { begin: Instant::now(), seconds, abandoned: Arc::clone(&abandoned) };
        let (unlimited, limited) = (allowance(0.0), allowance(3600.0));
        assert!(unlimited.spent() == 0.0 && limited.spent() < 0.5);
        abandoned.store(true, Ordering::Relaxed);
        assert!(unlimited.spent() >= 1.0 && limited.spent() >= 1.0);
    }
}
