//! Feature node: pieces in, their shapes out.

pub mod convert;
pub mod params;
pub mod share;

use futures::channel::mpsc;
use futures::{Sink, SinkExt, Stream, StreamExt};
use isthmus::Extractor;
use jigsaw_msgs::msg::{PieceFeatures, PieceImage};
use jigsaw_msgs::sensor_msgs::msg::Image;

use crate::fields::image_message;
use crate::picture::{InspectionStyle, inspection};
use crate::ros::activity::WhileInactive;
use crate::ros::discovery::Audience;
use crate::ros::exit::ProcessError;
use crate::ros::lifecycle::Forget;
use crate::ros::process::{Program, Work};
use crate::ros::session::{CHANNEL_DEPTH, Session, Settings};
use crate::ros::topics;
use convert::PieceImageError;

/// The program of this node.
pub const PROGRAM: Program = Program {
    name: "feature_node",
    about: "Finds border, Euclidean skeleton and isthmuses of jigsaw pieces.\n\n\
            Topics in:  pieces/image (jigsaw_msgs/PieceImage), pieces/reset (std_msgs/Empty),\n            \
            pieces/forgotten (jigsaw_msgs/PiecesForgotten)\n\
            Topics out: pieces/features (jigsaw_msgs/PieceFeatures), pieces/forgotten,\n            \
            pieces/overlay (sensor_msgs/Image, while someone listens)",
    parameters: params::PARAMETERS,
};

/// How a piece is drawn on `pieces/overlay`: as large as it was seen, without plots, so that drawing keeps up.
const OVERLAY_STYLE: InspectionStyle = InspectionStyle { piece_side: 500.0, plots: false };

/// Where pictures of the shape analysis go, while someone listens.
pub struct Overlays {
    /// The pictures; what doesn't fit is left out.
    pub images: mpsc::Sender<Image>,
    /// Whether someone listens.
    pub wanted: Box<dyn Fn() -> bool>,
}

impl Overlays {
    fn new(images: mpsc::Sender<Image>, audience: Audience) -> Self {
        Self { images, wanted: Box::new(move || audience.count() > 0) }
    }
}

/// Opens the node with its own topics, sharing the pieces with other feature nodes if it is told to, and gives its loop.
///
/// # Errors
/// As for [`open`].
pub fn open_with_topics(mut session: Session) -> Result<Work, ProcessError> {
    let pieces = session.subscribe_kept(&topics::PIECE_IMAGE)?.map(|(piece, _)| piece);
    let (features, audience, forgetting) = session.publish_kept(&topics::PIECE_FEATURES)?;
    let resets = session.subscribe(&topics::PIECES_RESET)?.inspect(move |_| forgetting.forget());
    if !session.parameters.bool(&params::SHARE) {
        session.spawn(resets.for_each(|_| std::future::ready(())));
        return open(session, pieces, features);
    }
    let heard = session.subscribe_kept(&topics::PIECE_FEATURES)?;
    let others = session.writers_of(&topics::PIECE_FEATURES)?;
    let (work, mine) = mpsc::channel(CHANNEL_DEPTH);
    let streams = share::Streams { pieces, heard, resets, work, results: features.clone() };
    session.spawn(share::run(share::Share::new(audience.writer()), streams, others));
    open(session, mine, features)
}

/// Opens the node and gives its loop.
///
/// # Errors
/// A name that is no name; a refusal of the middleware.
pub fn open(
    mut session: Session,
    pieces: impl Stream<Item = PieceImage> + Unpin + 'static,
    features: impl Sink<PieceFeatures> + Unpin + 'static,
) -> Result<Work, ProcessError> {
    let (images, audience) = session.publish(&topics::OVERLAY)?;
    let overlays = Overlays::new(images, audience);
    let settings = session.settings();
    let pieces = session.activity.gate(pieces, WhileInactive::Hold);
    let forgets = session.manage(|| Ok(()))?;
    // There is nothing to forget: each piece is looked at on its own.
    session.spawn(forgets.for_each(|forget: Forget| {
        let _ = forget.send(());
        std::future::ready(())
    }));
    Ok(Box::pin(async move {
        run(pieces, features, overlays, settings).await;
        drop(session);
        Ok(())
    }))
}

/// The node's loop. Ends with the pieces.
pub async fn run(
    pieces: impl Stream<Item = PieceImage> + Unpin,
    mut features: impl Sink<PieceFeatures> + Unpin,
    mut overlays: Overlays,
    settings: Settings,
) {
    let Settings { parameters, health, activity } = settings;
    let threads = parameters.threads(&params::THREADS);
    let wanted = overlays.wanted;
    let mut extracted = pieces
        .map(|piece| {
            let draw = wanted();
            smol::unblock(move || extract(piece, draw))
        })
        .buffered(threads);
    while let Some(result) = extracted.next().await {
        match result {
            Ok((message, overlay)) => {
                health.received();
                health.state("analysing pieces");
                log::debug!("piece {}: {} isthmuses", message.id, message.isthmuses.len());
                // The work on it may have begun before the node was told to stop.
                activity.active().await;
                if features.send(message).await.is_ok() {
                    health.published();
                }
                if let Some(overlay) = overlay {
                    // A listener that is behind misses one.
                    let _ = overlays.images.try_send(overlay);
                }
            }
            Err(refusal) => health.refuse(refusal.kind(), &refusal.to_string()),
        }
    }
}

/// The work on one piece that is done beside the loop.
fn extract(mut piece: PieceImage, draw: bool) -> Result<(PieceFeatures, Option<Image>), PieceImageError> {
    let cutout = convert::cutout(&mut piece)?;
    let features = Extractor::default()
        .extract(&cutout)
        .map_err(|e| PieceImageError::Shape { id: piece.id.clone(), reason: e.to_string() })?;
    let overlay = draw.then(|| {
        let picture = inspection(&piece.id, &piece.source, &cutout, &features, OVERLAY_STYLE);
        image_message(piece.header.clone(), picture)
    });
    Ok((convert::features_message(&piece, &features), overlay))
}
