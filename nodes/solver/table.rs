//! The pieces on the table, and the state of the solution: what the node's loop does to them.

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use futures::SinkExt;
use futures::channel::{mpsc, oneshot};
use jigsaw::{Assembly, Piece, Solver};
use jigsaw_msgs::action::{Assemble, AssembleFeedback, AssembleResult};
use jigsaw_msgs::msg::{Assembly as AssemblyMessage, PieceFeatures};
use jigsaw_msgs::std_msgs::msg::Empty;
use jigsaw_msgs::std_srvs::srv::{Trigger, TriggerResponse};
use jigsaw_msgs::tf2_msgs::msg::TFMessage;
use jigsaw_msgs::visualization_msgs::msg::MarkerArray;

use super::convert::{self, FeaturesError, Naming, Sighting, Solution};
use super::journal::{Journal, JournalError};
use super::params;
use super::worker::{Done, Job};
use crate::ros::actions::{Goal, GoalEnd};
use crate::ros::activity::Activity;
use crate::ros::health::Health;
use crate::ros::params::Parameters;
use crate::ros::session::{Call, Settings};

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
    /// What is to be drawn; [`super::draw`] takes it from there.
    pub solutions: mpsc::UnboundedSender<Arc<Solution>>,
    /// Where the pieces taken in are kept, if anywhere.
    pub journal: Option<Journal>,
}

/// Where a piece comes from.
pub(super) enum Origin {
    Topic,
    /// Which has it already.
    Journal,
}

/// The pieces on the table, and the state of the solution.
pub(super) struct Table {
    outputs: Outputs,
    parameters: Arc<Parameters>,
    health: Arc<Health>,
    pub(super) activity: Activity,
    /// None at first, after a reset, and while the worker has it.
    solver: Option<Solver>,
    /// Pieces that the solver does not have yet.
    incoming: Vec<Piece>,
    /// All pieces by name, with a fingerprint of the message they came in.
    pub(super) sightings: HashMap<String, (u64, Sighting)>,
    /// When to solve next, if there is a reason to.
    pub(super) due: Option<Instant>,
    /// Pieces that wait to be solved together.
    settling: Settling,
    /// Whether the solution under way is of no use any more.
    abandoned: Arc<AtomicBool>,
    /// Callers that wait for the next solution.
    pub(super) waiting: Vec<Call<Trigger>>,
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
    pub(super) fn new(outputs: Outputs, settings: Settings) -> Self {
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
    pub(super) fn pursue(&mut self, goal: Goal<Assemble>) -> oneshot::Receiver<()> {
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

    pub(super) fn deadline(&self) -> Option<Instant> {
        self.goal.as_ref().and_then(|goal| goal.deadline)
    }

    pub(super) fn end_overdue_goal(&mut self, now: Instant) {
        if self.deadline().is_some_and(|deadline| deadline <= now) {
            self.end_goal(GoalEnd::Aborted);
        }
    }

    pub(super) fn end_goal(&mut self, end: GoalEnd) {
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
    pub(super) fn recall(&mut self) {
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
    pub(super) fn take(&mut self, message: &PieceFeatures, origin: &Origin) {
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
    pub(super) fn work(&mut self) -> Job {
        self.due = None;
        self.settling = Settling::default();
        self.abandoned = Arc::default();
        self.health.state("solving");
        Job {
            solver: self.solver.take(),
            params: params::solver_params(&self.parameters),
            incoming: std::mem::take(&mut self.incoming),
            abandoned: Arc::clone(&self.abandoned),
            generation: self.generation,
        }
    }

    /// Takes the worker's results over and publishes them.
    pub(super) async fn publish(&mut self, done: Done) {
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
        let (placed, seen) = (message.pieces.len(), solution.pieces.len() - solution.assembly.earlier.len());
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
    pub(super) async fn reset(&mut self) {
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

/// Answers a call.
pub(super) fn answer(call: Call<Trigger>, response: TriggerResponse) {
    // The caller may have gone; that is no concern of the node.
    let _ = call.reply.send(response);
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
}
