"""Bags between this project and the readers and writers of others: rosbags, mcap-ros2-support, rclpy."""

import io
import json

import numpy as np
import pytest
from geometry_msgs.msg import Twist
from jigsaw_msgs.msg import Assembly, PiecePose
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from PIL import Image as Picture
from rclpy.serialization import deserialize_message
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import CompressedImage

from bench import BEST_EFFORT
from conftest import ROOT

MESSAGES = 20
SEED = 24
TOPIC = "/image/compressed"
TYPE = "sensor_msgs/msg/CompressedImage"
STORE = get_typestore(Stores.ROS2_JAZZY)
PADDING = [bytes(n) for n in range(4)]  # RTPS fills messages up to a multiple of 4 bytes
INFINITE = QosTime(9223372036, 854775807)


def picture(seed):
    """A PNG that is large enough to travel in fragments."""
    pixels = np.random.default_rng(seed).integers(0, 256, (200, 200), dtype=np.uint8)
    out = io.BytesIO()
    Picture.fromarray(pixels).save(out, "PNG")
    return np.frombuffer(out.getvalue(), dtype=np.uint8)


def frames():
    header, time, image = (STORE.types[t] for t in ("std_msgs/msg/Header", "builtin_interfaces/msg/Time", TYPE))
    return [image(header(time(i, 7), "camera"), "png", picture(SEED + i)) for i in range(MESSAGES)]


def write_with_rosbags(path, plugin, version, reliability=QosReliability.RELIABLE):
    qos = Qos(
        QosHistory.KEEP_LAST, 10, reliability, QosDurability.VOLATILE, INFINITE, INFINITE,
        QosLiveliness.AUTOMATIC, INFINITE, False,
    )  # fmt: skip
    with Writer(path, version=version, storage_plugin=plugin) as writer:
        connection = writer.add_connection(TOPIC, TYPE, typestore=STORE, offered_qos_profiles=[qos])
        for i, frame in enumerate(frames()):
            writer.write(connection, 10_000_000 * i, STORE.serialize_cdr(frame, TYPE))


def read_with_rosbags(path):
    with Reader(path) as reader:
        return [(c.topic, c.msgtype, bytes(data)) for c, _, data in reader.messages(reader.connections)]


def read_with_mcap_ros2(path):
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return [(channel.topic, message) for _, channel, _, message in reader.iter_decoded_messages()]


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3], ids=lambda p: p.name)
@pytest.mark.parametrize("version", [8, 9])
@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_bag_of_rosbags_is_played_and_recorded(launcher, tmp_path, plugin, version, storage):
    source, copy = tmp_path / "source", tmp_path / "copy"
    write_with_rosbags(source, plugin, version)
    recorder = launcher.start(
        "jigsaw", "bag", "record", copy, "--topics", TOPIC, "--max-messages", MESSAGES, "--storage", storage
    )
    code, text = launcher.run("jigsaw", "bag", "play", source, "--rate", 0)
    assert code == 0, text
    assert recorder.wait() == 0, recorder.text()

    for got, sent in zip(read_with_rosbags(copy), read_with_rosbags(source), strict=True):
        assert got[:2] == sent[:2]
        assert got[2].startswith(sent[2]) and got[2][len(sent[2]) :] in PADDING
    with Reader(copy) as reader:
        assert reader.message_count == MESSAGES
        (connection,) = reader.connections
        assert "MSG: std_msgs/Header" in connection.msgdef.data
        assert connection.digest == STORE.hash_rihs01(TYPE)
        (qos,) = connection.ext.offered_qos_profiles
        assert (qos.reliability, qos.durability) == (QosReliability.RELIABLE, QosDurability.VOLATILE)
    if storage == "mcap":
        for (topic, got), sent in zip(read_with_mcap_ros2(copy / "copy_0.mcap"), frames(), strict=True):
            assert (topic, got.header.stamp.sec, got.format) == (TOPIC, sent.header.stamp.sec, "png")
            assert bytes(got.data) == sent.data.tobytes()


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3], ids=lambda p: p.name)
def test_rclpy_gets_every_message_of_a_bag(launcher, ros, tmp_path, plugin):
    source = tmp_path / "source"
    write_with_rosbags(source, plugin, 9, QosReliability.BEST_EFFORT)
    got = ros.latest(ros.node("camera_user"), CompressedImage, TOPIC, qos=MESSAGES)
    player = launcher.start("jigsaw", "bag", "play", source, "--rate", 0)
    ros.until(lambda: len(got) == MESSAGES, f"{MESSAGES} messages")
    assert player.wait() == 0, player.text()
    for message, sent in zip(got, frames(), strict=True):
        assert (message.header.stamp.sec, message.header.stamp.nanosec) == (sent.header.stamp.sec, 7)
        assert message.data.tobytes() == sent.data.tobytes()


def test_topics_of_any_type_are_recorded_from_rclpy(launcher, ros, tmp_path):
    """Among them one that the recorder was not built with, under a name that ROS does not advise but lets pass."""
    bag = tmp_path / "bag"
    assembly = Assembly(state=Assembly.PARTIAL, pieces=[PiecePose(id="a", confidence=0.5)], unplaced=["b"])
    twist = Twist()
    twist.angular.z = 0.25
    sent = {"/assembly": assembly, "/robot__1/cmd_vel": twist}
    node = ros.node("talker")
    publishers = {topic: node.create_publisher(type(message), topic, MESSAGES) for topic, message in sent.items()}
    recorder = launcher.start("jigsaw", "bag", "record", bag, "--topics", *sent)
    ros.until(lambda: all(p.get_subscription_count() for p in publishers.values()), "recorder on every topic")
    for topic, publisher in publishers.items():
        for _ in range(MESSAGES):
            publisher.publish(sent[topic])
        assert publisher.wait_for_all_acked()
    assert recorder.stop() == 0, recorder.text()

    recorded = read_with_rosbags(bag)
    assert len(recorded) == MESSAGES * len(sent)
    for topic, msgtype, data in recorded:
        assert msgtype.endswith(f"/msg/{type(sent[topic]).__name__}")
        assert deserialize_message(data, type(sent[topic])) == sent[topic]


def test_a_publisher_that_a_recorder_does_not_hear_is_named(launcher, ros, tmp_path):
    """A recorder asks for what is offered when it meets a topic, as that of ROS does."""
    first = ros.node("first").create_publisher(Twist, "/cmd_vel", MESSAGES)
    recorder = launcher.start("jigsaw", "bag", "record", tmp_path / "bag", "--topics", "/cmd_vel")
    ros.until(lambda: first.get_subscription_count(), "recorder")
    ros.node("second").create_publisher(Twist, "/cmd_vel", BEST_EFFORT)
    ros.until(lambda: "publisher on /cmd_vel does not match" in recorder.text(), "warning")


@pytest.mark.parametrize("name", ["puzzle24", "puzzle6"])
def test_bags_of_the_project_open_elsewhere(name):
    folder = ROOT / "bags" / name
    frames = {piece["frame"] for piece in json.loads((folder / "truth.json").read_text())["pieces"]}
    raw = read_with_rosbags(folder)
    assert len(raw) == len(frames)
    decoded = read_with_mcap_ros2(folder / f"{name}_0.mcap")
    for (topic, message), (_, msgtype, cdr) in zip(decoded, raw, strict=True):
        assert (topic, msgtype, message.header.frame_id) == (TOPIC, TYPE, "camera")
        assert bytes(message.data) == STORE.deserialize_cdr(cdr, msgtype).data.tobytes()
        image = Picture.open(io.BytesIO(bytes(message.data)))
        assert image.format == "PNG" and image.mode == "L"
        image.load()
