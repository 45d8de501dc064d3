"""A second DDS: CycloneDDS, by its own Python binding, reads what the cell latches."""

import pytest
from jigsaw_msgs.msg import Assembly
from rosbags.typesys import get_types_from_msg

from bench import SCALE, Camera, agree, by_child, check_assembly
from conftest import LATCHED
from cyclone import Cyclone, idl_type

TIMEOUT = 30.0  # seconds, between two samples of a topic


class CycloneArm:
    """As `bench.Arm`, on CycloneDDS: waits for the complete assembly with a stamp, and for its transforms."""

    def __init__(self, domain, transcode, stamp):
        cyclone = Cyclone(domain)

        def latched(topic, full_name, wanted):
            definition = transcode.ask(full_name)["definition"]
            idl = idl_type(full_name, get_types_from_msg(definition, full_name))
            return cyclone.latched(topic, idl, TIMEOUT, wanted)

        def is_newest(assembly):
            found = assembly.header.stamp
            complete = assembly.state == Assembly.COMPLETE
            return complete and (found.sec, found.nanosec) == (stamp.sec, stamp.nanosec)

        def are_its(message):
            return agree(by_child(message), self.assembly)

        self.assembly = latched("/assembly", "jigsaw_msgs/msg/Assembly", is_newest)
        self.transforms = by_child(latched("/tf_static", "tf2_msgs/msg/TFMessage", are_its))

    def frames(self, piece_id):
        return self.transforms[f"piece_{piece_id}"], self.transforms[f"piece_{piece_id}_goal"]


def test_assembly_and_transforms_of_a_late_joiner(launcher, ros, domain, generate, transcode):
    launcher.cell(*SCALE)
    truth = Camera(ros).show_puzzle(generate(2, 3, 5))
    latest = []
    node = ros.node("watcher")
    node.create_subscription(Assembly, "assembly", latest.append, LATCHED)
    ros.until(lambda: latest and latest[-1].state == Assembly.COMPLETE and len(latest[-1].pieces) == 6, "assembly")

    arm = CycloneArm(domain, transcode, latest[-1].header.stamp)
    assert [piece.id for piece in arm.assembly.pieces] == [piece.id for piece in latest[-1].pieces]
    assert arm.assembly.table.pairs == latest[-1].table.pairs
    assert arm.assembly.matings[0].correlation == pytest.approx(latest[-1].matings[0].correlation)
    check_assembly(arm, truth, arm.assembly)
