"""Messages of strangers on every input: refused by field and rule, counted, and nothing else changes. And floods."""

import copy
import math
import os
import time
from pathlib import Path

import numpy
import pytest
from builtin_interfaces.msg import Time
from jigsaw_msgs.msg import PieceFeatures, PieceImage
from PIL import Image as Picture
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CompressedImage, Image

from bench import (
    BEST_EFFORT,
    LATCHED_PIECES,
    METRES_PER_PIXEL,
    RELIABLE,
    SCALE,
    Arm,
    Camera,
    Monitor,
    check_assembly,
    image_message,
)

FLOOD_SECONDS = float(os.environ.get("JIGSAW_FLOOD_SECONDS", "5"))  # the long run takes 60
FLOOD_RATE = 1000  # messages a second on each input
FLOOD_GROWTH = 100e6  # bytes that a node may take beyond what it had before


def with_field(message, path, value):
    """A copy of a message with one field changed."""
    changed = copy.deepcopy(message)
    *way, last = path.split(".")
    part = changed
    for name in way:
        part = part[int(name)] if name.isdigit() else getattr(part, name)
    if last.isdigit():
        part[int(last)] = value
    else:
        setattr(part, last, value)
    return changed


# Field, value, and the kind under which /diagnostics counts it.
IMAGE = [
    ("width", 0, "size"),
    ("height", 2**32 - 1, "size"),
    ("step", 3, "step"),
    ("step", 2**32 - 1, "data"),
    ("encoding", "smell8", "encoding"),
    ("data", b"", "data"),
    ("header.stamp", Time(sec=-1), "header.stamp.sec"),
    ("header.stamp", Time(sec=9, nanosec=2**32 - 1), "header.stamp.nanosec"),
    ("header.frame_id", "x" * 5000, "header.frame_id"),
]
COMPRESSED = [
    ("data", b"no picture", "undecodable_picture"),
    ("data", b"", "undecodable_picture"),
    ("header.stamp", Time(sec=-1), "header.stamp.sec"),
]
PIECE_IMAGE = [
    ("id", "a/b", "id"),
    ("id", "", "id"),
    ("source", "x" * 5000, "source"),
    ("header.stamp", Time(nanosec=2**32 - 1), "header.stamp.nanosec"),
    ("frame_width_px", 0, "frame_width_px"),
    ("metres_per_pixel", math.nan, "metres_per_pixel"),
    ("metres_per_pixel", -1.0, "metres_per_pixel"),
    ("aoi_x_px", -(2**31), "aoi_x_px"),
    ("aoi_width_px", 2**32 - 1, "aoi_width_px"),
    ("piece_level", math.inf, "piece_level"),
    ("noise_level", math.nan, "noise_level"),
    ("image.width", 2**32 - 1, "image.width"),
    ("image.step", 1, "image.step"),
    ("image.data", b"", "image.data length"),
    ("image.encoding", "rgb8", "image.encoding"),
]
PIECE_FEATURES = [
    ("id", "a/b", "id"),
    ("id", "piece 1", "id"),
    ("header.stamp", Time(sec=-5), "header.stamp.sec"),
    ("frame_height_px", 2**32 - 1, "frame_height_px"),
    ("metres_per_pixel", math.inf, "metres_per_pixel"),
    ("metres_per_pixel", 10 * METRES_PER_PIXEL, "metres_per_pixel"),
    ("noise_px", -1.0, "noise_px"),
    ("border_x_px", [0.0], "border_y_px length"),
    ("border_x_px.0", math.nan, "border_x_px, border_y_px"),
    ("border_length_px", 1e30, "border_length_px"),
    ("isthmuses.0.polarity", 7, "isthmuses.polarity"),
    ("isthmuses.0.width_px", math.nan, "isthmuses.width_px"),
    ("isthmuses.0.path_length_px", -1.0, "isthmuses.path_length_px"),
]


# What the line says where it does not repeat the kind.
SAID = {"undecodable_picture": "not a picture", "duplicate_id": "another piece of this id"}


@pytest.fixture
def cell(launcher, ros, generate):
    """A cell that has assembled a puzzle, with what it saw on the way."""

    class Cell:
        nodes = launcher.cell(*SCALE)
        puzzle = generate(2, 3, 5)
        monitor = Monitor(ros)
        camera, arm = Camera(ros), Arm(ros)
        stranger = ros.node("stranger")

        def __init__(self):
            self.images = []
            self.stranger.create_subscription(PieceImage, "pieces/image", self.images.append, LATCHED_PIECES)
            self.truth = self.camera.show_puzzle(self.puzzle)
            self.assembly = self.arm.complete(6)
            ros.until(lambda: len(self.images) >= 6, "images of all pieces")

        def publisher(self, message_type, topic, qos):
            publisher = self.stranger.create_publisher(message_type, topic, qos)
            ros.until(lambda: publisher.get_subscription_count() > 0, f"listener on {topic}")
            return publisher

        def unchanged(self):
            """The assembly is what it was, and a piece that is shown again is known."""
            assert self.arm.assemblies[-1] == self.assembly
            check_assembly(self.arm, self.truth, self.arm.assemblies[-1])
            assert all("panicked" not in node.text() and node.child.poll() is None for node in self.nodes)

    return Cell()


def refused(ros, cell, node, publisher, good, cases):
    """Publishes each case until it is counted under its kind; nothing else is counted."""
    for path, value, kind in cases:
        before = cell.monitor.refused(node, kind)
        bad = with_field(good, path, value)
        ros.until_repeated(
            lambda bad=bad: publisher.publish(bad),
            lambda kind=kind, before=before: cell.monitor.refused(node, kind) > before,
            f"count of {path} = {value!r:.60} as {kind} by {node}",
            2.5,
        )
        text = next(n for n in cell.nodes if n.name == node).text()
        word = SAID.get(kind, kind.removesuffix(" length").split(",")[0].split(".")[-1])
        assert word in text, f"no line names {word}"


def test_on_the_camera_topics(ros, cell):
    with Picture.open(cell.puzzle.frames[0]) as picture:
        good = image_message(numpy.asarray(picture.convert("L")), Time(sec=1))
    refused(ros, cell, "capture_node", cell.publisher(Image, "image", BEST_EFFORT), good, IMAGE)
    compressed = CompressedImage(header=good.header, format="png", data=b"")
    topic = cell.publisher(CompressedImage, "image/compressed", RELIABLE)
    refused(ros, cell, "capture_node", topic, compressed, COMPRESSED)
    cell.unchanged()


def test_on_the_pieces(ros, cell):
    publisher = cell.publisher(PieceImage, "pieces/image", LATCHED_PIECES)
    refused(ros, cell, "feature_node", publisher, cell.images[0], PIECE_IMAGE)
    cell.unchanged()


def test_on_the_features(ros, cell):
    publisher = cell.publisher(PieceFeatures, "pieces/features", LATCHED_PIECES)
    first, second = (one[0] for one in list(cell.camera.features.values())[:2])
    refused(ros, cell, "solver_node", publisher, with_field(first, "id", "stranger"), PIECE_FEATURES)
    # Another piece under a known name.
    refused(ros, cell, "solver_node", publisher, second, [("id", first.id, "duplicate_id")])
    # The same message again, an old one, and one before that: no offence, and no news.
    publisher.publish(first)
    publisher.publish(second)
    cell.unchanged()


def resident(node):
    """Bytes of memory that a process has now."""
    fields = Path(f"/proc/{node.child.pid}/statm").read_text().split()
    return int(fields[1]) * os.sysconf("SC_PAGE_SIZE")


def test_a_flood_on_every_input_is_survived(ros, cell):
    """Nonsense and known pieces, as fast as the rate says, on all inputs; then the cell works on as before."""
    publishers = [
        (cell.publisher(Image, "image", BEST_EFFORT), Image(width=8, height=8, step=3, data=bytes(64))),
        (cell.publisher(CompressedImage, "image/compressed", BEST_EFFORT), CompressedImage(data=b"no picture")),
        (cell.publisher(PieceImage, "pieces/image", LATCHED_PIECES), PieceImage(id="a/b")),
        (cell.publisher(PieceFeatures, "pieces/features", LATCHED_PIECES), PieceFeatures(id="a/b")),
        (cell.publisher(Clock, "/clock", RELIABLE), Clock(clock=Time(nanosec=2**32 - 1))),
    ]
    before = {node.name: resident(node) for node in cell.nodes}
    most = dict(before)
    start = time.monotonic()
    sent = 0
    while (elapsed := time.monotonic() - start) < FLOOD_SECONDS:
        while sent < elapsed * FLOOD_RATE:
            for publisher, message in publishers:
                publisher.publish(message)
            sent += 1
        ros.executor.spin_once(timeout_sec=0.001)
        most = {node.name: max(most[node.name], resident(node)) for node in cell.nodes}
    print(f"{sent / FLOOD_SECONDS:.0f} messages/s on each input; most memory {most}, before {before}")
    for node in cell.nodes:
        cell.monitor.status(node.name, lambda status, values: int(values["refused"]) > 0)
    for node in cell.nodes:
        assert most[node.name] - before[node.name] < FLOOD_GROWTH, f"{node.name} took {most[node.name]} bytes"
        warnings = [line for line in node.text().splitlines() if line.startswith("[WARN]")]
        assert len(warnings) < 40 + 10 * FLOOD_SECONDS, f"{node.name}: {len(warnings)} lines"

    # Recovered: a new piece goes all the way through.
    with Picture.open(cell.puzzle.frames[0]) as picture:
        turned = numpy.asarray(picture.convert("L"))[::-1]
    cell.camera.show(image_message(turned, Time(sec=500)))
    cell.arm.ros.until(lambda: cell.arm.knows("500_000000000"), "the solver's word on a new piece")
    assert {piece.id for piece in cell.arm.assemblies[-1].pieces} >= set(cell.truth)
