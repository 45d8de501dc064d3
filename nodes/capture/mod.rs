//! Capture node: frames in, pieces out.
//!
//! A frame is decoded and cut into pieces in worker threads, some frames at a time, in order; [`known`] names the
//! pieces and leaves out those seen before; the rest is published. A frame that can't be used is refused with one
//! (throttled) line and counted, and the next one is taken.

pub mod convert;
pub mod cut;
pub mod known;
pub mod params;
pub mod source;

use std::path::PathBuf;
use std::sync::Arc;

use futures::channel::mpsc;
use futures::stream::{self, LocalBoxStream};
use futures::{Sink, SinkExt, Stream, StreamExt};
use isthmus::mask::{Cutout, Segmenter};
use jigsaw_msgs::msg::PieceImage;
use jigsaw_msgs::std_msgs::msg::Empty;
use jigsaw_msgs::std_srvs::srv::{Trigger, TriggerResponse};

use crate::ros::activity::{WhileInactive, inactive};
use crate::ros::exit::ProcessError;
use crate::ros::health::Health;
use crate::ros::lifecycle::Forget;
use crate::ros::params::Parameters;
use crate::ros::process::{Program, Work};
use crate::ros::session::{Call, Session, SessionError, Settings};
use crate::ros::topics;
use convert::{FrameError, FrameHead};
use cut::Pixels;
use known::{FrameName, Known};
use source::Frame;

/// The program of this node.
pub const PROGRAM: Program = Program {
    name: "capture_node",
    about: "Cuts camera frames into jigsaw pieces.\n\n\
            Topics in:  image (sensor_msgs/Image), image/compressed (sensor_msgs/CompressedImage),\n            \
            pieces/reset (std_msgs/Empty)\n\
            Topics out: pieces/image (jigsaw_msgs/PieceImage), pieces/forgotten (jigsaw_msgs/PiecesForgotten)\n\
            Service:    capture (std_srvs/Trigger): take the pieces in view, or the folder, again",
    parameters: params::PARAMETERS,
};

/// A frame after the workers.
struct Seen {
    name: FrameName,
    content: u64,
    head: FrameHead,
    cutouts: Vec<Cutout>,
    /// What is wrong with the frame, in words.
    left_out: Vec<String>,
}

/// Opens the node with its own topics and gives its loop.
///
/// # Errors
/// As for [`open`].
pub fn open_with_topics(mut session: Session) -> Result<Work, ProcessError> {
    let (pieces, _, forgetting) = session.publish_kept(&topics::PIECE_IMAGE)?;
    let resets = session.subscribe(&topics::PIECES_RESET)?.inspect(move |_| forgetting.forget());
    open(session, resets, pieces)
}

/// Opens the topics and services of the node and gives its loop, which sends the pieces to `pieces`, and those in view
/// anew after each of the `resets`.
///
/// # Errors
/// An empty or missing folder; a name that is no name; a refusal of the middleware.
pub fn open(
    mut session: Session,
    resets: impl Stream<Item = Empty> + Unpin + 'static,
    pieces: impl Sink<PieceImage> + Unpin + 'static,
) -> Result<Work, ProcessError> {
    let settings = session.settings();
    let calls = session.serve::<Trigger>(topics::CAPTURE_SERVICE)?;
    let folder = params::source_folder(&session.parameters);
    let frames: LocalBoxStream<'static, Frame> = match folder.clone() {
        Some(folder) => session.activity.gate(folder_frames(folder, &settings), WhileInactive::Hold),
        None => {
            let name = |topic| session.names().topic(topic).map_err(SessionError::from);
            let (raw_name, compressed_name) = (name(topics::IMAGE.name)?, name(topics::IMAGE_COMPRESSED.name)?);
            let raw = session.subscribe(&topics::IMAGE)?;
            let compressed = session.subscribe_to_all(&topics::IMAGE_COMPRESSED)?;
            let frames = stream::select(
                raw.map(move |image| Frame::Raw(raw_name.clone(), image)),
                compressed.map(move |image| Frame::Compressed(compressed_name.clone(), image)),
            );
            session.activity.gate(frames, WhileInactive::Drop)
        }
    };
    let forgets = session.manage(move || match &folder {
        Some(folder) => {
            source::pictures(folder).map(drop).map_err(|e| format!("parameter '{}': {e}", params::SOURCE.name))
        }
        None => Ok(()),
    })?;
    Ok(Box::pin(async move {
        // The session is kept: its topics and services end with it.
        run(frames, Requests { calls, forgets, resets }, pieces, settings).await;
        drop(session);
        Ok(())
    }))
}

/// The pictures of a folder, listed when they are first asked for.
fn folder_frames(folder: PathBuf, settings: &Settings) -> impl Stream<Item = Frame> + Unpin + 'static {
    let health = Arc::clone(&settings.health);
    let listed = stream::once(async move {
        let files = match source::pictures(&folder) {
            Ok(files) => {
                log::info!("{} pictures in {}", files.len(), folder.display());
                files
            }
            Err(e) => {
                health.warn("folder", &e.to_string());
                Vec::new()
            }
        };
        stream::iter(files.into_iter().map(Frame::File))
    });
    Box::pin(listed.flatten())
}

/// What others may ask for.
#[derive(Debug)]
pub struct Requests<C, F, R> {
    /// Calls of `capture`.
    pub calls: C,
    /// Wishes to forget the pieces seen so far.
    pub forgets: F,
    /// The solver has forgotten them: those that are still in view are new.
    pub resets: R,
}

/// The node's loop. Ends when frames and requests have ended.
pub async fn run(
    frames: impl Stream<Item = Frame> + Unpin,
    requests: Requests<
        impl Stream<Item = Call<Trigger>> + Unpin,
        impl Stream<Item = Forget> + Unpin,
        impl Stream<Item = Empty> + Unpin,
    >,
    mut pieces: impl Sink<PieceImage> + Unpin,
    settings: Settings,
) {
    let Settings { parameters, health, activity } = settings;
    let threads = parameters.threads(&params::THREADS);
    // Files that a call wants read again come in beside the frames.
    let (again, more) = mpsc::unbounded();
    let mut again = Some(again);
    let mut seen = stream::select(frames, more).map(|frame| smol::unblock(move || cut_out(frame))).buffered(threads);
    let (mut calls, mut forgets, mut resets) = (requests.calls.fuse(), requests.forgets.fuse(), requests.resets.fuse());
    let mut known = Known::default();
    let mut latest: Vec<PieceImage> = Vec::new();
    loop {
        futures::select! {
            frame = seen.next() => match frame {
                // It was under way when the node was told to stop.
                Some(Ok(_)) if !activity.is_active() => {}
                Some(Ok(frame)) => {
                    health.received();
                    latest = name_pieces(&mut known, frame, &parameters, &health, &mut pieces).await;
                }
                Some(Err(refusal)) => health.refuse(refusal.kind(), &refusal.to_string()),
                None => break,
            },
            call = calls.next() => match call {
                Some(call) => {
                    let answer = match (params::source_folder(&parameters), &again) {
                        _ if !activity.is_active() => inactive(),
                        (Some(folder), Some(again)) => reread(&folder, again),
                        _ => publish_again(&latest, &health, &mut pieces).await,
                    };
                    // The caller may have gone; that is no concern of the node.
                    let _ = call.reply.send(answer);
                }
                None => again = None,
            },
            forget = forgets.next() => if let Some(forget) = forget {
                known = Known::default();
                latest.clear();
                let _ = forget.send(());
            },
            // What the camera shows next comes as new; a service that shows the latest frame again still can.
            reset = resets.next() => if reset.is_some() {
                known = Known::default();
            },
            complete => break,
        }
    }
}

/// Names the pieces of a frame, publishes the new ones, and gives all of them for the `capture` service.
async fn name_pieces(
    known: &mut Known,
    frame: Seen,
    parameters: &Parameters,
    health: &Health,
    pieces: &mut (impl Sink<PieceImage> + Unpin),
) -> Vec<PieceImage> {
    let overlap = parameters.double(&params::SAME_PLACE_OVERLAP);
    let metres_per_pixel = parameters.double(&params::METRES_PER_PIXEL);
    for what in &frame.left_out {
        health.warn("left out", &format!("{}: {what}", frame.name.source()));
    }
    let admissions = known.admit(&frame.name, frame.content, &frame.cutouts, overlap);
    let mut all = Vec::with_capacity(admissions.len());
    for (admission, cutout) in admissions.into_iter().zip(frame.cutouts) {
        let piece = convert::piece_message(admission.id, &frame.head, cutout, metres_per_pixel);
        if admission.publish {
            log::debug!("piece {} in {}", piece.id, piece.source);
            send(piece.clone(), health, pieces).await;
        }
        all.push(piece);
    }
    health.state("taking frames");
    all
}

async fn send(piece: PieceImage, health: &Health, pieces: &mut (impl Sink<PieceImage> + Unpin)) {
    if pieces.send(piece).await.is_ok() {
        health.published();
    }
}

async fn publish_again(
    latest: &[PieceImage],
    health: &Health,
    pieces: &mut (impl Sink<PieceImage> + Unpin),
) -> TriggerResponse {
    for piece in latest {
        send(piece.clone(), health, pieces).await;
    }
    match latest.len() {
        0 => TriggerResponse { success: false, message: "no frame with a piece has come in yet".to_owned() },
        n => TriggerResponse { success: true, message: format!("{n} pieces of the latest frame published again") },
    }
}

fn reread(folder: &std::path::Path, again: &mpsc::UnboundedSender<Frame>) -> TriggerResponse {
    match source::pictures(folder) {
        Ok(files) => {
            let message = format!("{} pictures of {} are read again", files.len(), folder.display());
            let sent = files.into_iter().all(|file| again.unbounded_send(Frame::File(file)).is_ok());
            TriggerResponse { success: sent, message }
        }
        Err(e) => TriggerResponse { success: false, message: e.to_string() },
    }
}

/// The work on one frame that is done beside the loop: reading and segmentation.
fn cut_out(frame: Frame) -> Result<Seen, FrameError> {
    let picture = convert::picture(frame)?;
    let source = picture.name.source().to_owned();
    let (width, height) = (picture.pixels.width(), picture.pixels.height());
    let segmentation = Pixels::from(picture.pixels)
        .cut(&mut Segmenter::default())
        .map_err(|reason| FrameError::NoPiece { source_name: source.clone(), reason })?;
    Ok(Seen {
        left_out: cut::left_out(&segmentation),
        name: picture.name,
        content: picture.content,
        head: FrameHead { header: picture.header, source, width, height },
        cutouts: segmentation.cutouts,
    })
}
