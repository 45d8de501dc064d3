//! Every topic and service of the cell: message type, relative name and quality of service, once.

use std::marker::PhantomData;
use std::time::Duration;

use jigsaw_msgs::diagnostic_msgs::msg::DiagnosticArray;
use jigsaw_msgs::lifecycle_msgs::msg::TransitionEvent;
use jigsaw_msgs::msg::{Assembly, PieceFeatures, PieceImage, PiecesForgotten};
use jigsaw_msgs::rosgraph_msgs::msg::Clock;
use jigsaw_msgs::sensor_msgs::msg::{CompressedImage, Image};
use jigsaw_msgs::std_msgs::msg::Empty;
use jigsaw_msgs::tf2_msgs::msg::TFMessage;
use jigsaw_msgs::visualization_msgs::msg::MarkerArray;
use ros2_client::QosProfile;
use ros2_client::qos::{Durability, History, WhenFull};

/// Prefix of the DDS names of ROS topics.
pub(super) const TOPIC_PREFIX: &str = "rt";

/// A topic.
#[derive(Debug)]
pub struct Topic<M> {
    /// Name, relative to the namespace of the node unless it begins with `/`.
    pub name: &'static str,
    /// Quality of service of both ends.
    pub qos: QosProfile,
    message: PhantomData<fn() -> M>,
}

impl<M> Topic<M> {
    const fn new(name: &'static str, qos: QosProfile) -> Self {
        Self { name, qos, message: PhantomData }
    }
}

/// How long a write may wait where the reader is behind before it counts as failed: long enough for a hiccup of a
/// reader, short enough that a node still ends in time.
const WRITE_PATIENCE: WhenFull = WhenFull::Wait(Duration::from_millis(500));

/// Pieces that are kept for a node that comes (back) later: the largest common puzzle has 1000.
const PIECES_KEPT: usize = 1024;

/// Camera frames: best effort, because a reliable stream of large frames stalls for seconds where one is lost.
const CAMERA: QosProfile = QosProfile::subscription_default().history(History::KeepLast { depth: 30 });

const RELIABLE: QosProfile = QosProfile::publisher_default().reliability_reliable(WRITE_PATIENCE);

const LATCHED: QosProfile = RELIABLE.durability(Durability::TransientLocal).history(History::KeepLast { depth: 1 });

const LATCHED_PIECES: QosProfile =
    RELIABLE.durability(Durability::TransientLocal).history(History::KeepLast { depth: PIECES_KEPT });

/// Frames of the camera.
pub const IMAGE: Topic<Image> = Topic::new("image", CAMERA);

/// Frames of the camera as PNG or JPEG; small enough to be sent reliably, as recorded runs do.
pub const IMAGE_COMPRESSED: Topic<CompressedImage> =
    Topic::new("image/compressed", RELIABLE.history(History::KeepLast { depth: 1000 }));

/// Pieces cut out of frames. Latched, so that a feature node that was restarted sees all of them.
pub const PIECE_IMAGE: Topic<PieceImage> = Topic::new("pieces/image", LATCHED_PIECES);

/// Shapes of pieces.
pub const PIECE_FEATURES: Topic<PieceFeatures> = Topic::new("pieces/features", LATCHED_PIECES);

/// The solver has forgotten all pieces: those that are in view are new.
pub const PIECES_RESET: Topic<Empty> = Topic::new("pieces/reset", RELIABLE.history(History::KeepLast { depth: 10 }));

/// What of the latched pieces a node has forgotten.
pub const PIECES_FORGOTTEN: Topic<PiecesForgotten> = Topic::new("pieces/forgotten", LATCHED);

/// Pictures of the shape analysis.
pub const OVERLAY: Topic<Image> = Topic::new("pieces/overlay", RELIABLE.history(History::KeepLast { depth: 10 }));

/// The puzzle as far as it is solved.
pub const ASSEMBLY: Topic<Assembly> = Topic::new("assembly", LATCHED);

/// Picture of the puzzle as far as it is solved.
pub const ASSEMBLY_IMAGE: Topic<Image> = Topic::new("assembly/image", LATCHED);

/// Outlines of the pieces in place, for RViz.
pub const ASSEMBLY_MARKERS: Topic<MarkerArray> = Topic::new("assembly/markers", LATCHED);

/// Where the pieces lie and where they belong. tf2 reads it from this absolute name.
pub const TF_STATIC: Topic<TFMessage> = Topic::new("/tf_static", LATCHED);

/// State of the nodes.
pub const DIAGNOSTICS: Topic<DiagnosticArray> =
    Topic::new("/diagnostics", RELIABLE.history(History::KeepLast { depth: 10 }));

/// Steps of the lifecycle of a node.
pub const TRANSITION_EVENT: Topic<TransitionEvent> =
    Topic::new("~/transition_event", RELIABLE.history(History::KeepLast { depth: 10 }));

/// Simulated time.
pub const CLOCK: Topic<Clock> = Topic::new("/clock", QosProfile::subscription_default());

/// Service of the capture node: take the pieces in view (again).
pub const CAPTURE_SERVICE: &str = "capture";

/// Service of the solver node: forget all pieces, and begin anew with those in view.
pub const RESET_SERVICE: &str = "reset";

/// Service of the solver node: solve now.
pub const SOLVE_SERVICE: &str = "solve";

/// Action of the solver node: assemble until the puzzle is complete or the time is up.
pub const ASSEMBLE_ACTION: &str = "assemble";

/// Quality of service of both ends of all services: ten times the usual depth, so that a burst of calls loses none.
pub const SERVICE_QOS: QosProfile = RELIABLE.history(History::KeepLast { depth: 100 });

/// Quality of service of the feedback of actions.
pub const FEEDBACK_QOS: QosProfile = RELIABLE.history(History::KeepLast { depth: 10 });

/// Quality of service of the status of actions.
pub const STATUS_QOS: QosProfile = LATCHED;
