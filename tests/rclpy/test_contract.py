"""What the contract says and no other test looks at: pictures of the analysis, frames with several pieces, names of
coordinate frames, and what each parameter does when it is set while the cell runs."""

import numpy
import pytest
from builtin_interfaces.msg import Time
from jigsaw_msgs.msg import Assembly, PieceFeatures, PieceImage
from PIL import Image as Picture
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.duration import Duration
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CompressedImage, Image
from std_srvs.srv import Trigger

from bench import (
    AGAIN,
    BEST_EFFORT,
    LATCHED_PIECES,
    RELIABLE,
    SCALE,
    Arm,
    Camera,
    Monitor,
    check_assembly,
    compressed_message,
    image_message,
)

BURST = 400  # compressed frames: sent and acknowledged far sooner than they are decoded
SHIFT = 1  # pixels by which a piece is moved that counts as lying still: far less than 3 % of its area


def grey(path):
    with Picture.open(path) as picture:
        return numpy.asarray(picture.convert("L"))


class Settings:
    """Sets parameters of a node, and says what they have to be."""

    def __init__(self, ros, target):
        self.ros = ros
        self.client = ros.node(f"sets_{target}").create_client(SetParameters, f"/{target}/set_parameters")

    def set(self, name, value):
        kinds = {int: ("integer_value", ParameterType.PARAMETER_INTEGER), float: ("double_value", 3)}
        field, kind = kinds[type(value)]
        changed = Parameter(name=name, value=ParameterValue(type=kind, **{field: value}))
        (result,) = self.ros.call(self.client, SetParameters.Request(parameters=[changed])).results
        assert result.successful, result.reason


def test_overlays_come_while_someone_listens(launcher, ros, generate):
    launcher.start("capture_node")
    launcher.start("feature_node")
    camera = Camera(ros)
    message = image_message(grey(generate(2, 3, 5).frames[0]), Time(sec=7, nanosec=8))
    camera.show(message)
    overlays = ros.latest(ros.node("viewer"), Image, "pieces/overlay", RELIABLE)
    # The same frame gives the same piece again.
    ros.until_repeated(lambda: camera.publisher.publish(message), lambda: overlays, "overlay")
    picture = overlays[-1]
    assert picture.header == message.header
    assert picture.encoding == "rgb8" and len(picture.data) == picture.step * picture.height
    pixels = numpy.asarray(picture.data).reshape(picture.height, picture.width, 3)
    assert (pixels.max(axis=2) > pixels.min(axis=2)).any(), "skeleton and isthmuses are drawn in colour"


def test_pieces_of_one_frame_are_numbered_in_reading_order_and_shown_again_on_demand(launcher, ros, generate):
    launcher.start("capture_node")
    launcher.start("feature_node")
    frames = [grey(path) for path in generate(2, 3, 5).frames[:4]]
    table = numpy.vstack([numpy.hstack(frames[:2]), numpy.hstack(frames[2:])])
    camera = Camera(ros)
    images = ros.latest(ros.node("looker"), PieceImage, "pieces/image", LATCHED_PIECES)
    camera.show(image_message(table, Time(sec=5)), seen=lambda: len(camera.features.get(5, [])) >= 4)
    pieces = {features.id: features for features in camera.features[5]}
    names = [f"5_000000000_{k}" for k in range(4)]
    assert sorted(pieces) == names
    corners = [(pieces[name].aoi_y_px, pieces[name].aoi_x_px) for name in names]
    assert corners == sorted(corners)
    for name in names:
        piece = pieces[name]
        assert piece.source == "/image"
        assert (piece.frame_width_px, piece.frame_height_px) == (table.shape[1], table.shape[0])
        assert min(piece.border_x_px) >= piece.aoi_x_px - 1
        assert max(piece.border_x_px) <= piece.aoi_x_px + piece.aoi_width_px

    ros.until(lambda: len(images) >= 4, "images of all pieces")
    before = len(images)
    answer = ros.call(camera.node.create_client(Trigger, "capture"), Trigger.Request())
    assert answer.success, answer.message
    ros.until(lambda: len(images) >= before + 4, "images of all pieces once more")
    assert sorted(image.id for image in images[before : before + 4]) == names


@pytest.mark.parametrize(
    "offered", [LATCHED_PIECES, QoSProfile(depth=10), BEST_EFFORT], ids=["latched", "volatile", "effort"]
)
def test_publishers_of_pieces_are_heard_whatever_they_offer(launcher, ros, generate, offered):
    launcher.start("capture_node", "--ros-args", *SCALE)
    launcher.start("feature_node")
    images = ros.latest(ros.node("keeps_images"), PieceImage, "pieces/image", LATCHED_PIECES)
    camera = Camera(ros)
    truth = camera.show_puzzle(generate(2, 3, 5))
    ros.until(lambda: len(images) == len(truth), "images of all pieces")

    # Nodes of the cell between nodes of others.
    launcher.start("feature_node", "--ros-args", "-r", "__ns:=/a")
    launcher.start("solver_node", "--ros-args", "-r", "__ns:=/b")
    stranger, arm = ros.node("stranger"), Arm(ros, "/b/assembly")
    to_features = stranger.create_publisher(PieceImage, "/a/pieces/image", offered)
    to_solver = stranger.create_publisher(PieceFeatures, "/b/pieces/features", offered)
    features = ros.latest(stranger, PieceFeatures, "/a/pieces/features", LATCHED_PIECES)
    ros.until(lambda: to_features.get_subscription_count() and to_solver.get_subscription_count(), "listeners")
    ros.until_repeated(
        lambda: [to_features.publish(image) for image in images],
        lambda: {one.id for one in features} == set(truth),
        "features of all pieces",
        AGAIN,
    )
    ros.until_repeated(
        lambda: [to_solver.publish(one) for [one] in camera.features.values()],
        lambda: arm.assemblies and arm.assemblies[-1].state == Assembly.COMPLETE,
        "complete assembly",
        AGAIN,
    )
    check_assembly(arm, truth, arm.complete(len(truth)))


@pytest.mark.parametrize("offered", [LATCHED_PIECES, RELIABLE, BEST_EFFORT], ids=["latched", "reliable", "effort"])
def test_compressed_cameras_are_heard_whatever_they_offer(launcher, ros, generate, offered):
    launcher.start("capture_node")
    launcher.start("feature_node")
    camera = Camera(ros, "image/compressed", compressed=True, offered=offered)
    [features] = camera.show(compressed_message(grey(generate(2, 3, 5).frames[0]), Time(sec=1)))
    assert features.source == "/image/compressed"


def test_a_camera_that_sends_its_frames_raw_and_compressed_shows_each_piece_once(launcher, ros, generate):
    """As image transports do. The border of a piece differs a little between the two."""
    launcher.start("capture_node")
    launcher.start("feature_node")
    shown, other = (grey(path) for path in generate(2, 3, 5).frames[:2])
    camera, monitor = Camera(ros), Monitor(ros)
    compressed = camera.node.create_publisher(CompressedImage, "image/compressed", RELIABLE)
    camera.show(image_message(shown, Time(sec=1)))
    ros.until(lambda: compressed.get_subscription_count() > 0, "listener on image/compressed")
    taken = int(monitor.status("capture_node")[1]["received"])
    stamps = [Time(sec=1), Time(sec=2)]
    for stamp in stamps:
        compressed.publish(compressed_message(shown, stamp, "jpeg"))
    ros.until(
        lambda: int(monitor.values("capture_node")["received"]) >= taken + len(stamps), "count of compressed frames"
    )
    camera.show(image_message(other, Time(sec=3)))
    assert {second: len(pieces) for second, pieces in camera.features.items()} == {1: 1, 3: 1}


def test_names_of_coordinate_frames_and_jpeg(launcher, ros, generate):
    launcher.cell(*SCALE, "-p", "solver_node:table_frame:=light_table", "-p", "solver_node:puzzle_frame:=tray")
    camera = Camera(ros, "image/compressed", compressed=True)
    arm = Arm(ros)
    truth = camera.show_puzzle(generate(2, 3, 5), make=compressed_message, file_format="jpeg")
    check_assembly(arm, truth, arm.complete(6), table="light_table", puzzle="tray")


@pytest.fixture
def solved(launcher, ros, generate):
    """A solved puzzle whose joints are nearly alike, so that some doubt is left; the arm that heard of it, and the
    settings of the solver."""
    launcher.cell(*SCALE)
    arm = Arm(ros)
    Camera(ros).show_puzzle(generate(2, 3, 2, "--similarity", "0.98", "--noise", "8", "--blur", "2"))
    arm.complete(6)
    return arm, Settings(ros, "solver_node")


def next_assembly(ros, arm, change, condition, what):
    """The first assembly after a change for which the condition holds."""
    known = len(arm.assemblies)
    change()
    return ros.until(lambda: [a for a in arm.assemblies[known:] if condition(a)], what)[0]


def test_time_budget_takes_effect(ros, solved):
    arm, settings = solved
    hurried = next_assembly(
        ros, arm, lambda: settings.set("time_budget", 1e-6), lambda a: a.state != Assembly.COMPLETE, "hurried assembly"
    )
    assert len(hurried.pieces) + len(hurried.unplaced) == 6 and hurried.unplaced
    next_assembly(
        ros, arm, lambda: settings.set("time_budget", 0.0), lambda a: a.state == Assembly.COMPLETE, "whole assembly"
    )


def test_candidates_take_effect(ros, solved):
    arm, settings = solved
    many = arm.assemblies[-1].table
    few = next_assembly(ros, arm, lambda: settings.set("candidates", 1), lambda a: a.table != many, "other table").table
    assert (few.positive, few.negative, few.pairs) == (many.positive, many.negative, many.pairs)
    # One of each mouth, and what a second look at those left open brings up.
    assert 0 < few.after_correlation < many.after_correlation


def test_minimum_confidence_takes_effect(ros, solved):
    arm, settings = solved
    confidences = [piece.confidence for piece in arm.assemblies[-1].pieces]
    enough = (min(confidences) + max(confidences)) / 2
    assert min(confidences) < enough, "some pieces are surer than others"
    strict = next_assembly(
        ros, arm, lambda: settings.set("minimum_confidence", enough), lambda a: a.unplaced, "assembly of the sure"
    )
    assert all(one.confidence >= enough for one in [*strict.pieces, *strict.matings])


def test_same_place_overlap_takes_effect(launcher, ros, generate):
    launcher.start("capture_node")
    launcher.start("feature_node")
    camera, monitor = Camera(ros), Monitor(ros)
    picture = grey(generate(2, 3, 5).frames[0])
    camera.show(image_message(picture, Time(sec=1)))
    moved = numpy.roll(picture, SHIFT, axis=1)
    taken = int(monitor.status("capture_node")[1]["received"])
    ros.until_repeated(
        lambda: camera.publisher.publish(image_message(moved, Time(sec=2))),
        lambda: int(monitor.values("capture_node")["received"]) > taken,
        "count of the frame with the moved piece",
        AGAIN,
    )
    Settings(ros, "capture_node").set("same_place_overlap", 1.0)
    camera.show(image_message(numpy.roll(picture, 2 * SHIFT, axis=1), Time(sec=3)))
    assert 2 not in camera.features, "it lies where it lay"


def test_frames_outlive_a_camera_that_leaves(launcher, ros, generate):
    launcher.start("capture_node")
    monitor, node = Monitor(ros), ros.node("camera")
    camera = node.create_publisher(CompressedImage, "image/compressed", QoSProfile(depth=BURST))
    ros.until(lambda: camera.get_subscription_count() > 0, "listener on image/compressed")
    monitor.status("capture_node")
    frames = [compressed_message(grey(path), Time()) for path in generate(2, 3, 5).frames]
    for second in range(BURST):
        message = frames[second % len(frames)]
        message.header.stamp.sec = second
        camera.publish(message)
    assert camera.wait_for_all_acked(Duration(seconds=60))
    # It leaves while most of them wait to be decoded.
    monitor.status("capture_node", lambda status, values: int(values["received"]) > 0)
    node.destroy_publisher(camera)
    monitor.status("capture_node", lambda status, values: int(values["received"]) == BURST)
