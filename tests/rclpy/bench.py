"""What stands at both ends of the cell: a camera that publishes the frames of a puzzle, and an arm that reads where
each piece lies and where it goes. Both are plain rclpy nodes that know the contract alone."""

import cmath
import io
import math
from dataclasses import dataclass

import numpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from jigsaw_msgs.msg import Assembly, PieceFeatures
from PIL import Image as Picture
from rcl_interfaces.msg import Log, ParameterEvent
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy
from sensor_msgs.msg import CompressedImage, Image
from tf2_msgs.msg import TFMessage

METRES_PER_PIXEL = 0.00025  # not the default, so that a forgotten scale shows
SCALE = ("-p", f"capture_node:metres_per_pixel:={METRES_PER_PIXEL}")  # arguments of a cell

POSITION_TOLERANCE_PX = 0.5  # of a piece's goal, after one rigid motion of the whole puzzle
SIGHTING_TOLERANCE_PX = 1.0  # of a piece's centroid where it lies: the generator's blur and the kerf move it a little
ANGLE_TOLERANCE = 0.005  # [rad], half a pixel at the rim of a piece

AGAIN = 5.0  # seconds until a frame is shown again of which nothing was heard

LATCHED_PIECES = QoSProfile(
    depth=1000, reliability=QoSReliabilityPolicy.RELIABLE, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL
)
BEST_EFFORT = QoSProfile(depth=5, reliability=QoSReliabilityPolicy.BEST_EFFORT)
RELIABLE = QoSProfile(depth=100, reliability=QoSReliabilityPolicy.RELIABLE)

ENCODINGS = {
    "mono8": lambda grey: grey,
    "rgb8": lambda grey: numpy.repeat(grey[:, :, None], 3, axis=2),
    "bgr8": lambda grey: numpy.repeat(grey[:, :, None], 3, axis=2),
    "mono16": lambda grey: grey.astype(numpy.uint16) * 257,
}


def image_message(grey, stamp, encoding="mono8"):
    """A grey picture as sensor_msgs/Image."""
    pixels = numpy.ascontiguousarray(ENCODINGS[encoding](grey))
    message = Image(height=grey.shape[0], width=grey.shape[1], encoding=encoding)
    message.header.frame_id = "camera"
    message.header.stamp = stamp
    message.step = pixels.strides[0]
    message.data.frombytes(pixels.tobytes())
    return message


def compressed_message(grey, stamp, file_format="png"):
    """A grey picture as sensor_msgs/CompressedImage."""
    out = io.BytesIO()
    Picture.fromarray(grey).save(out, file_format)
    message = CompressedImage(format=file_format)
    message.header.frame_id = "camera"
    message.header.stamp = stamp
    message.data.frombytes(out.getvalue())
    return message


class Camera:
    """Publishes each frame with a stamp of its own until the cell has told of it, as best effort may lose one;
    compressed frames, which are reliable, once."""

    def __init__(self, ros, topic="image", compressed=False, features="pieces/features", offered=RELIABLE):
        self.ros = ros
        self.node = ros.node("camera")
        self.sent_once = compressed and offered != BEST_EFFORT
        if compressed:
            self.publisher = self.node.create_publisher(CompressedImage, topic, offered)
        else:
            self.publisher = self.node.create_publisher(Image, topic, BEST_EFFORT)
        self.features = {}  # by the stamp's seconds
        self.node.create_subscription(PieceFeatures, features, self.take, LATCHED_PIECES)

    def take(self, features):
        self.features.setdefault(features.header.stamp.sec, []).append(features)

    def listened_to(self):
        """Waits until the capture node listens."""
        self.ros.until(lambda: self.publisher.get_subscription_count() > 0, f"listener on {self.publisher.topic_name}")

    def show(self, message, seen=None):
        """Publishes until the features of the frame come back (or `seen` gives something true); gives them."""
        second = message.header.stamp.sec
        seen = seen or (lambda: self.features.get(second))
        self.listened_to()
        period = math.inf if self.sent_once else AGAIN
        return self.ros.until_repeated(lambda: self.publisher.publish(message), seen, f"sign of frame {second}", period)

    def show_puzzle(self, puzzle, make=image_message, arm=None, first_second=1, **options):
        """Shows every frame; gives the truth of each piece by the id that the cell gave it. Where an arm is given, it
        has heard of each piece before the next one is shown."""
        truth = {}
        for piece, grey, stamp in stamped_frames(puzzle, first_second):
            features = self.show(make(grey, stamp, **options))
            assert len(features) == 1, f"{piece['source']} holds one piece, the cell saw {len(features)}"
            assert features[0].header.frame_id == "camera"
            assert features[0].header.stamp.nanosec == stamp.nanosec
            truth[features[0].id] = TruePiece(piece, grey.shape[1], grey.shape[0])
            if arm:
                name = features[0].id
                self.ros.until(lambda name=name: arm.knows(name), f"assembly that knows {name}")
        return truth

    def show_puzzle_to_composed_cell(self, puzzle, arm):
        """As `show_puzzle`, where the features stay inside a process: the assembly tells which pieces were seen."""
        truth = {}
        for piece, grey, stamp in stamped_frames(puzzle):
            name = f"{stamp.sec}_{stamp.nanosec:09}"
            self.show(image_message(grey, stamp), seen=lambda name=name: arm.knows(name))
            truth[name] = TruePiece(piece, grey.shape[1], grey.shape[0])
        return truth


def stamped_frames(puzzle, first_second=1):
    """Every piece of a puzzle with its frame and a stamp of its own."""
    for second, piece in enumerate(puzzle.truth["pieces"], start=first_second):
        with Picture.open(puzzle.folder / piece["source"]) as picture:
            yield piece, numpy.asarray(picture.convert("L")), Time(sec=second, nanosec=500)


@dataclass
class TruePiece:
    """What truth.json says of a piece, in the axes of the cell's frames: complex numbers, x right, y up, metres."""

    piece: dict
    width: int
    height: int

    @property
    def on_table(self):
        """The centroid, from the centre of the frame."""
        x, y = self.piece["centroid"]
        centre = complex((self.width - 1) / 2, (self.height - 1) / 2)
        return (complex(x, y) - centre).conjugate() * METRES_PER_PIXEL

    @property
    def in_puzzle(self):
        """The centroid where it belongs."""
        pose = self.piece["puzzle_from_image"]
        turned = cmath.exp(1j * pose["theta"]) * complex(*self.piece["centroid"])
        return (turned + complex(pose["x"], pose["y"])).conjugate() * METRES_PER_PIXEL

    @property
    def turn(self):
        """The rotation from the table to the puzzle, as a unit number."""
        return cmath.exp(-1j * self.piece["puzzle_from_image"]["theta"])


def planar(transform_or_pose):
    """Position and heading of a transform or a pose that has to lie in the plane."""
    position = getattr(transform_or_pose, "translation", None) or transform_or_pose.position
    rotation = getattr(transform_or_pose, "rotation", None) or transform_or_pose.orientation
    assert position.z == 0 and rotation.x == 0 and rotation.y == 0
    assert abs(rotation.z**2 + rotation.w**2 - 1) < 1e-9
    return complex(position.x, position.y), complex(rotation.w, rotation.z) ** 2


class Monitor:
    """The latest status of every node, and all log lines."""

    def __init__(self, ros):
        self.ros = ros
        self.node = ros.node("monitor")
        self.latest, self.stamps, self.lines, self.events = {}, {}, [], []
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self.take, 10)
        self.node.create_subscription(Log, "/rosout", self.lines.append, LATCHED_PIECES)
        self.node.create_subscription(ParameterEvent, "/parameter_events", self.events.append, 10)

    def take(self, array):
        for status in array.status:
            self.latest[status.name] = status
            self.stamps.setdefault(status.name, []).append(array.header.stamp)

    def values(self, name):
        """The latest values of a node, by their keys."""
        status = self.latest.get(name)
        return {value.key: value.value for value in status.values} if status else {}

    def status(self, name, condition=lambda status, values: True):
        """Waits for a status for which the condition holds; gives it and its values."""

        def found():
            values = self.values(name)
            return (self.latest[name], values) if values and condition(self.latest[name], values) else None

        return self.ros.until(found, f"status of {name}")

    def refused(self, name, kind):
        """How many inputs of this kind a node says to have refused."""
        return int(self.values(name).get(f"refused.{kind}", "0"))


class Arm:
    """Reads /tf_static and the assembly, as a pick-and-place arm does, at whatever time it comes up."""

    def __init__(self, ros, assembly="assembly", name="arm"):
        self.ros = ros
        self.node = ros.node(name)
        self.assemblies = []
        self.transforms = {}  # by child frame
        qos = QoSProfile(
            depth=1, reliability=QoSReliabilityPolicy.RELIABLE, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL
        )
        self.node.create_subscription(Assembly, assembly, self.assemblies.append, qos)
        self.node.create_subscription(TFMessage, "/tf_static", self.take, qos)

    def take(self, message):
        self.transforms.update(by_child(message))

    def knows(self, name):
        """Whether some assembly so far has heard of a piece, placed or not."""
        return any(name in assembly.unplaced or name in {p.id for p in assembly.pieces} for assembly in self.assemblies)

    def complete(self, pieces, timeout=60):
        """Waits for the complete assembly and its transforms; gives the assembly."""

        def done():
            latest = self.assemblies[-1] if self.assemblies else None
            if latest is None or latest.state != Assembly.COMPLETE or len(latest.pieces) != pieces:
                return None
            return latest if agree(self.transforms, latest) else None

        return self.ros.until(done, f"complete assembly of {pieces} pieces", timeout)

    def frames(self, piece_id):
        """The two frames of a piece: as it lies and as it belongs."""
        return self.transforms[f"piece_{piece_id}"], self.transforms[f"piece_{piece_id}_goal"]


def by_child(message):
    """The transforms of a message by their child frame."""
    return {transform.child_frame_id: transform for transform in message.transforms}


def agree(transforms, assembly):
    """Whether these are the transforms of an assembly, which comes on a topic of its own: sooner, or later."""

    def is_at(child, pose):
        return child in transforms and planar(transforms[child].transform) == pytest_approx(planar(pose))

    return all(
        is_at(f"piece_{piece.id}", piece.observed) and is_at(f"piece_{piece.id}_goal", piece.goal)
        for piece in assembly.pieces
    )


def check_assembly(arm, truth, assembly, table="table", puzzle="puzzle"):
    """Compares every motion of the arm with the truth."""
    assert assembly.header.frame_id == puzzle
    assert assembly.table_frame == table
    assert {piece.id for piece in assembly.pieces} == set(truth)
    assert not assembly.unplaced
    goals = {}
    for piece in assembly.pieces:
        observed, goal = arm.frames(piece.id)
        assert (observed.header.frame_id, goal.header.frame_id) == (table, puzzle)
        assert planar(observed.transform) == pytest_approx(planar(piece.observed))
        assert planar(goal.transform) == pytest_approx(planar(piece.goal))
        assert piece.component == 0
        assert 0 < piece.confidence <= 1

        place, heading = planar(observed.transform)
        assert heading == 1, "a piece's axes are those of its image"
        assert abs(place - truth[piece.id].on_table) < SIGHTING_TOLERANCE_PX * METRES_PER_PIXEL
        goals[piece.id] = planar(goal.transform)

    # The cell may lay the puzzle down turned: one rigid motion of the whole is fitted first.
    ids = sorted(goals)
    found = numpy.array([goals[i][0] for i in ids])
    true = numpy.array([truth[i].in_puzzle for i in ids])
    turn = numpy.vdot(true - true.mean(), found - found.mean())
    turn /= abs(turn)
    distance = abs(found - found.mean() - turn * (true - true.mean()))
    assert distance.max() < POSITION_TOLERANCE_PX * METRES_PER_PIXEL, distance / METRES_PER_PIXEL
    for i in ids:
        error = abs(cmath.phase(goals[i][1] / (turn * truth[i].turn)))
        assert error < ANGLE_TOLERANCE, f"{i} is turned by {error} rad"

    # A puzzle with straight sides has its corner in the origin: the pieces lie to the right of it and above.
    assert found.real.min() > 0 and found.imag.min() > 0

    # Every mating is one of two true neighbours.
    neighbours = {
        frozenset((piece["id"], side["neighbour"]))
        for piece in (known.piece for known in truth.values())
        for side in piece["sides"]
        if side["neighbour"]
    }
    name = {i: known.piece["id"] for i, known in truth.items()}
    mated = {frozenset((name[m.positive_piece], name[m.negative_piece])) for m in assembly.matings}
    assert mated <= neighbours
    assert len(mated) >= len(truth) - 1


def pytest_approx(pair):
    """The position to a nanometre, the heading to a nanoradian: the same pose told twice."""
    import pytest

    return pytest.approx(pair, abs=1e-9)
