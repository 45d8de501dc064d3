//! Feature node: pieces in, their shapes out.

pub mod convert;
pub mod params;

use std::sync::Arc;

use futures::{Sink, SinkExt, Stream, StreamExt};
use isthmus::Extractor;
use jigsaw_msgs::msg::{PieceFeatures, PieceImage};

use crate::capture::params::threads;
use crate::ros::health::Health;
use crate::ros::params::Parameters;
use crate::ros::process::{ProcessError, Program, Work};
use crate::ros::session::Session;
use convert::PieceImageError;

/// The program of this node.
pub const PROGRAM: Program = Program {
    name: "feature_node",
    about: "Finds border, Euclidean skeleton and isthmuses of jigsaw pieces.\n\n\
            Topic in:   pieces/image (jigsaw_msgs/PieceImage)\n\
            Topics out: pieces/features (jigsaw_msgs/PieceFeatures),\n            \
            pieces/overlay (sensor_msgs/Image, while someone listens)",
    parameters: params::PARAMETERS,
};

/// Opens the node and gives its loop.
///
/// # Errors
/// A name that is no name; a refusal of the middleware.
pub fn open(
    session: Session,
    pieces: impl Stream<Item = PieceImage> + Unpin + 'static,
    features: impl Sink<PieceFeatures> + Unpin + 'static,
) -> Result<Work, ProcessError> {
    let (parameters, health) = (Arc::clone(&session.parameters), Arc::clone(&session.health));
    Ok(Box::pin(async move {
        run(pieces, features, parameters, health).await;
        drop(session);
        Ok(())
    }))
}

/// The node's loop. Ends with the pieces.
pub async fn run(
    pieces: impl Stream<Item = PieceImage> + Unpin,
    mut features: impl Sink<PieceFeatures> + Unpin,
    parameters: Arc<Parameters>,
    health: Arc<Health>,
) {
    let threads = threads(&parameters, &params::THREADS);
    let mut extracted = pieces.map(|piece| smol::unblock(move || extract(piece))).buffered(threads);
    while let Some(result) = extracted.next().await {
        match result {
            Ok(message) => {
                health.received();
                health.state("analysing pieces");
                log::debug!("piece {}: {} isthmuses", message.id, message.isthmuses.len());
                if features.send(message).await.is_ok() {
                    health.published();
                }
            }
            Err(refusal) => health.refuse(refusal.kind(), &refusal.to_string()),
        }
    }
}

/// The work on one piece that is done beside the loop.
fn extract(mut piece: PieceImage) -> Result<PieceFeatures, PieceImageError> {
    let cutout = convert::cutout(&mut piece)?;
    let features = Extractor::default()
        .extract(&cutout)
        .map_err(|e| PieceImageError::Shape { id: piece.id.clone(), reason: e.to_string() })?;
    Ok(convert::features_message(&piece, &features))
}
