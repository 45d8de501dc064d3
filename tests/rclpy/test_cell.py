"""The three nodes as processes, between a camera and an arm that are rclpy nodes."""

import json

import numpy
import pytest
from builtin_interfaces.msg import Time
from jigsaw_msgs.msg import Assembly
from PIL import Image as Picture
from rclpy.qos import QoSDurabilityPolicy, QoSReliabilityPolicy
from sensor_msgs.msg import CompressedImage, Image
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import Marker, MarkerArray

from bench import (
    AGAIN,
    RELIABLE,
    SCALE,
    Arm,
    Camera,
    Monitor,
    check_assembly,
    compressed_message,
    image_message,
)
from conftest import Harness

PERIOD = 0.1  # seconds between two frames of a camera that runs on


def test_from_camera_to_a_late_arm(launcher, ros, domain, generate):
    launcher.cell(*SCALE)
    puzzle = generate(4, 6, 11)
    camera = Camera(ros)
    early = Arm(ros, name="early_arm")
    truth = camera.show_puzzle(puzzle, arm=early)
    early.complete(24)
    assert any(len(assembly.pieces) < 24 for assembly in early.assemblies), "partial assemblies come first"

    # An arm that comes up when all is done, in a participant of its own, gets everything from the latched topics.
    late = Harness(domain)
    try:
        arm = Arm(late)
        assembly = arm.complete(24)
        check_assembly(arm, truth, assembly)
        assert assembly.header.stamp.sec == 24, "the stamp of the newest piece"
        assert assembly.table.pairs > assembly.table.after_overlap >= len(assembly.matings) > 0

        picture = late.first(Image, "assembly/image")
        assert picture.width * picture.height > 0 and len(picture.data) == picture.step * picture.height
        # A latched writer may still hold an older sample beside the newest for some seconds: the newest comes last.
        arrays = late.latest(arm.node, MarkerArray, "assembly/markers")
        late.until(lambda: any(len(outlines_of(array)) == 24 for array in arrays), "outlines of all pieces")
        outlines = outlines_of(arrays[-1])
        assert len(outlines) == 24
        assert all(m.header.frame_id == "puzzle" and len(m.points) > 50 for m in outlines)
    finally:
        late.close()


def outlines_of(array):
    """The outlines among markers."""
    return [m for m in array.markers if m.type == Marker.LINE_STRIP and m.action == Marker.ADD]


def test_composed_cell(launcher, ros, generate):
    launcher.start("jigsaw", "cell", "--ros-args", *SCALE)
    puzzle = generate(2, 3, 5)
    camera = Camera(ros)
    arm = Arm(ros)
    truth = camera.show_puzzle_to_composed_cell(puzzle, arm)
    check_assembly(arm, truth, arm.complete(6))


@pytest.mark.parametrize("composed", [False, True], ids=["processes", "composed"])
def test_watch_writes_what_is_on_dds(launcher, ros, generate, tmp_path, composed):
    """A composed cell keeps the shapes to itself, without which nothing can be said in pixels."""
    source = f"capture_node:source:={generate(2, 3, 5).folder}"
    if composed:
        launcher.start("jigsaw", "cell", "--ros-args", "-p", source)
    else:
        launcher.cell("-p", source)
    Arm(ros).complete(6)
    code, said = launcher.run("jigsaw", "watch", "--out", tmp_path, "--timeout", 60)
    assert "6/6 pieces placed" in said
    written = json.loads((tmp_path / "assembly.json").read_text())["pieces"]
    assert (code, len(written)) == ((1, 0) if composed else (0, 6))
    assert ("lacks 6 pieces" in said) == composed


def test_png_frames_namespace_and_remaps(launcher, ros, generate):
    launcher.cell(*SCALE, "-r", "__ns:=/lab", "-r", "image/compressed:=/overhead/compressed", "-r", "assembly:=/result")
    puzzle = generate(2, 3, 5)
    camera = Camera(ros, "/overhead/compressed", compressed=True, features="/lab/pieces/features")
    arm, monitor = Arm(ros, assembly="/result"), Monitor(ros)
    truth = camera.show_puzzle(puzzle, make=compressed_message)
    check_assembly(arm, truth, arm.complete(6))

    names = {name for name, namespace in camera.node.get_node_names_and_namespaces() if namespace == "/lab"}
    assert names == {"capture_node", "feature_node", "solver_node"}
    loggers = {f"lab.{name}" for name in names}
    ros.until(lambda: {line.name for line in monitor.lines} == loggers, "lines of all loggers on /rosout")
    topics = dict(camera.node.get_topic_names_and_types())
    assert topics["/result"] == ["jigsaw_msgs/msg/Assembly"]
    assert topics["/lab/pieces/image"] == ["jigsaw_msgs/msg/PieceImage"]
    assert "/assembly" not in topics and "/lab/assembly" not in topics


def test_frames_from_a_folder(launcher, ros, generate):
    puzzle = generate(2, 3, 5)
    launcher.start("feature_node")
    launcher.start("solver_node")
    launcher.start("capture_node", "--ros-args", "-p", f"source:={puzzle.folder}")
    arm = Arm(ros)
    assembly = arm.complete(6)
    assert sorted(piece.source for piece in assembly.pieces) == sorted(frame.name for frame in puzzle.frames)
    assert {piece.id for piece in assembly.pieces} == {piece["id"] for piece in puzzle.truth["pieces"]}

    # Taking the same pictures again changes nothing.
    capture = arm.node.create_client(Trigger, "capture")
    answer = ros.call(capture, Trigger.Request())
    assert answer.success, answer.message
    assert len(arm.complete(6).pieces) == 6


@pytest.mark.parametrize("encoding", ["mono8", "rgb8", "bgr8", "mono16"])
def test_encodings(launcher, ros, generate, encoding):
    launcher.start("capture_node")
    launcher.start("feature_node")
    piece = generate(2, 3, 5).truth["pieces"][0]
    grey = numpy.asarray(Picture.open(generate(2, 3, 5).folder / piece["source"]).convert("L"))
    (features,) = Camera(ros).show(image_message(grey, Time(sec=1), encoding))
    mouths = [isthmus for isthmus in features.isthmuses if isthmus.polarity == isthmus.NEGATIVE and isthmus.salient]
    assert len(mouths) == sum(side["kind"] == "blank" for side in piece["sides"])
    assert (features.frame_width_px, features.frame_height_px) == (grey.shape[1], grey.shape[0])


def test_bad_frames_change_nothing(launcher, ros, generate):
    capture, *_ = launcher.cell(*SCALE)
    puzzle = generate(2, 3, 5)
    camera, monitor = Camera(ros), Monitor(ros)
    arm = Arm(ros)
    truth = camera.show_puzzle(puzzle)
    arm.complete(6)

    grey = numpy.full((64, 64), 200, numpy.uint8)
    empty = image_message(grey, Time(sec=101))
    short = image_message(grey, Time(sec=102))
    short.data = short.data[:100]
    narrow = image_message(grey, Time(sec=103))
    narrow.step = 10
    strange = image_message(grey, Time(sec=104))
    strange.encoding = "smell8"
    nothing = Image()
    for message, kind in (
        (empty, "no_piece"),
        (short, "data"),
        (narrow, "step"),
        (strange, "encoding"),
        (nothing, "size"),
    ):
        before = monitor.refused("capture_node", kind)
        ros.until_repeated(
            lambda message=message: camera.publisher.publish(message),
            lambda kind=kind, before=before: monitor.refused("capture_node", kind) > before,
            f"refusal by {kind}",
        )

    # One more good frame goes all the way.
    with Picture.open(puzzle.folder / puzzle.truth["pieces"][0]["source"]) as picture:
        grey = numpy.asarray(picture.convert("L"))
    camera.show(image_message(grey[::-1], Time(sec=200)))
    assert not camera.features.keys() & {0, 101, 102, 103, 104}
    for rule in ("step", "smell8"):
        assert rule in capture.text(), f"no warning names {rule}"
    assert "panicked" not in capture.text()
    assert {piece.id for piece in arm.assemblies[-1].pieces} >= set(truth)


def test_reset_and_solve(launcher, ros, generate):
    launcher.cell(*SCALE)
    puzzle = generate(2, 3, 5)
    camera = Camera(ros)
    arm = Arm(ros)
    camera.show_puzzle(puzzle)
    before = arm.complete(6)

    answer = ros.call(arm.node.create_client(Trigger, "reset"), Trigger.Request())
    assert answer.success, answer.message
    emptied = ros.until(lambda: arm.assemblies[-1] if not arm.assemblies[-1].pieces else None, "empty assembly")
    assert emptied.state == Assembly.COLLECTING and not emptied.matings and not emptied.unplaced
    # Whoever comes late is not told of pieces that are gone; what a latched topic still holds of before comes first.
    transforms = ros.latest(ros.node("late"), TFMessage, "/tf_static")
    ros.until(lambda: transforms and not transforms[-1].transforms, "word that there are no transforms")

    camera.features.clear()
    again = camera.show_puzzle(puzzle)
    answer = ros.call(arm.node.create_client(Trigger, "solve"), Trigger.Request())
    assert answer.success, answer.message
    after = arm.complete(6)
    check_assembly(arm, again, after)
    assert sorted(piece.id for piece in after.pieces) == sorted(piece.id for piece in before.pieces)


class LiveCamera:
    """Shows the same table over and over, each frame with a stamp of its own, until it is shown another one."""

    def __init__(self, ros, table):
        self.ros, self.number = ros, 0
        self.node = ros.node("live_camera")
        self.publisher = self.node.create_publisher(CompressedImage, "image/compressed", RELIABLE)
        self.look_at(table)
        self.node.create_timer(PERIOD, self.show)

    def look_at(self, table):
        with Picture.open(table) as picture:
            self.message = compressed_message(numpy.asarray(picture.convert("L")), Time())

    def show(self):
        self.number += 1
        self.message.header.stamp = Time(sec=self.number)
        self.publisher.publish(self.message)


@pytest.mark.parametrize("composed", [False, True], ids=["processes", "composed"])
def test_reset_begins_anew_with_what_the_camera_sees(launcher, ros, generate, composed):
    if composed:
        launcher.start("jigsaw", "cell", "--ros-args", *SCALE)
    else:
        launcher.cell(*SCALE)
    six = generate(2, 3, 5, "--pieces-per-frame", "6")
    four = generate(2, 2, 7, "--pieces-per-frame", "4")
    camera, arm = LiveCamera(ros, six.frames[0]), Arm(ros)
    reset = arm.node.create_client(Trigger, "reset")

    def ids():
        return {piece.id for piece in arm.assemblies[-1].pieces}

    # What lies there still comes back by itself, as new.
    arm.complete(6)
    before = ids()
    assert ros.call(reset, Trigger.Request()).success
    ros.until(lambda: len(ids()) == 6 and not ids() & before, "assembly of the pieces that lie there still")
    arm.complete(6)

    # What was taken away does not.
    before = ids()
    camera.look_at(four.frames[0])
    ros.until(lambda: len(ids() | set(arm.assemblies[-1].unplaced)) == 10, "assembly with the pieces of both tables")
    assert ros.call(reset, Trigger.Request()).success
    ros.until(lambda: len(ids()) == 4, "assembly of the second table")
    assert not arm.complete(4).unplaced and not ids() & before


def test_what_was_there_before_a_reset_does_not_come_back_with_a_node(launcher, ros, generate):
    """Pieces are latched: a node that starts again hears those since the reset, and no others."""
    _, feature, solver = launcher.cell(*SCALE)
    camera, arm = Camera(ros), Arm(ros)
    camera.show_puzzle(generate(2, 3, 5))
    arm.complete(6)
    assert ros.call(arm.node.create_client(Trigger, "reset"), Trigger.Request()).success
    ros.until(lambda: not arm.assemblies[-1].pieces, "empty assembly")

    def known_since():
        return {name for a in arm.assemblies for name in [piece.id for piece in a.pieces] + list(a.unplaced)}

    # Nothing has come since: the node begins with nothing.
    arm.assemblies.clear()
    solver = launcher.kill_and_start_again(solver)
    truth = camera.show_puzzle(generate(2, 2, 7), first_second=101)
    check_assembly(arm, truth, arm.complete(4))
    assert known_since() == set(truth)

    # It begins with what has come; so does one that hears it from a feature node that has begun anew as well.
    for feature_too in (False, True):
        arm.assemblies.clear()
        arm.transforms.clear()
        if feature_too:
            launcher.kill_and_start_again(feature)
        solver = launcher.kill_and_start_again(solver)
        check_assembly(arm, truth, arm.complete(4))
        assert known_since() == set(truth)


def test_piece_twice_in_the_frame_order_or_not_gives_the_same(launcher, ros, generate):
    """A camera that runs on shows every piece again and again; each is counted once."""
    launcher.cell(*SCALE)
    puzzle = generate(2, 3, 5)
    camera, monitor = Camera(ros), Monitor(ros)
    arm = Arm(ros)
    truth = camera.show_puzzle(puzzle)
    first = arm.complete(6)
    again = []
    for second, piece in enumerate(reversed(puzzle.truth["pieces"]), start=101):
        with Picture.open(puzzle.folder / piece["source"]) as picture:
            again.append(image_message(numpy.asarray(picture.convert("L")), Time(sec=second)))
    taken = int(monitor.status("capture_node")[1]["received"])
    ros.until_repeated(
        lambda: [camera.publisher.publish(message) for message in again],
        lambda: int(monitor.values("capture_node")["received"]) >= taken + len(again),
        "count of frames that were taken once more",
        AGAIN,
    )
    answer = ros.call(arm.node.create_client(Trigger, "solve"), Trigger.Request())
    assert answer.success, answer.message
    last = arm.complete(6)
    assert {piece.id for piece in last.pieces} == set(truth)
    assert [piece.goal for piece in last.pieces] == [piece.goal for piece in first.pieces]


def test_nodes_end_cleanly_while_frames_come(launcher, ros, generate):
    nodes = launcher.cell(*SCALE)
    camera = Camera(ros)
    publisher = camera.publisher
    ros.until(lambda: publisher.get_subscription_count() > 0, "capture node")
    with Picture.open(generate(2, 3, 5).frames[0]) as picture:
        message = image_message(numpy.asarray(picture.convert("L")), Time(sec=1))
    for _ in range(20):
        publisher.publish(message)
    for node in nodes:
        assert node.stop() == 0, node.text()


def test_bad_start_up_is_one_line_and_exit_code_2(launcher):
    for arguments in (
        ["--ros-args", "-p", "metres_per_pixel:=-1.0"],
        ["--ros-args", "-p", "no_such_parameter:=1"],
        ["--ros-args", "-p", "source:=/no/such/folder"],
        ["--ros-args", "--params-file", "/no/such/file.yaml"],
        ["--ros-args", "-r", "no rule"],
        ["--no-such-option"],
    ):
        code, text = launcher.run("capture_node", *arguments)
        lines = [line for line in text.splitlines() if line.strip()]
        assert code == 2, f"{arguments}: exit code {code}\n{text}"
        assert len(lines) == 1, f"{arguments}: {text}"


def test_quality_of_service_of_the_contract(launcher, ros):
    launcher.cell()
    node = ros.node("looker")

    def publishers(topic):
        return ros.until(lambda: node.get_publishers_info_by_topic(topic), f"publisher of {topic}")

    for topic in ("/assembly", "/tf_static", "/pieces/features", "/assembly/image", "/assembly/markers"):
        (info,) = publishers(topic)
        assert info.qos_profile.durability == QoSDurabilityPolicy.TRANSIENT_LOCAL, topic
        assert info.qos_profile.reliability == QoSReliabilityPolicy.RELIABLE, topic
    (info,) = ros.until(lambda: node.get_subscriptions_info_by_topic("/image"), "subscription of /image")
    assert info.qos_profile.reliability == QoSReliabilityPolicy.BEST_EFFORT
