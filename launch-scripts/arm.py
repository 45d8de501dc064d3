#!/usr/bin/env python3
"""The arm's side of the cell, to begin your own with: waits for the complete assembly and tells every motion.

    python3 launch-scripts/arm.py --ros-args -p puzzle_x:=0.15 -p puzzle_y:=-0.1 -p puzzle_yaw:=0.0

The parameters say where on the table the bottom left corner of the puzzle is to lie [m, rad]. Each line tells where a
piece is picked up and where it is put down: x and y of its centroid and its heading, in the table frame, in an order in
which each piece comes beside one that lies there already. An arm moves in `move` instead. As soon as it does, the
camera sees it and what it carries, so the capture node is deactivated before; activate it for the next puzzle, and
call `reset`.

Needs rclpy and jigsaw_msgs: a ROS 2 workspace, or the environment that tests/setup_venv.sh makes.
"""

import cmath
import json

import rclpy
from jigsaw_msgs.msg import Assembly
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.exceptions import InvalidParameterTypeException
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy

LATCHED = QoSProfile(depth=1, reliability=QoSReliabilityPolicy.RELIABLE, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)


class Arm(Node):
    """Knows the topic `assembly` and the lifecycle of the capture node, nothing else of the cell."""

    def __init__(self):
        super().__init__("arm")
        x, y, yaw = (self.declare_parameter(f"puzzle_{name}", 0.0).value for name in ("x", "y", "yaw"))
        self.table_from_puzzle = complex(x, y), cmath.exp(1j * yaw)
        self.assembly = None
        self.create_subscription(Assembly, "assembly", self.take, LATCHED)
        self.capture = self.create_client(ChangeState, "capture_node/change_state")

    def take(self, assembly):
        """Keeps the first assembly that is complete."""
        if self.assembly is None and assembly.state == Assembly.COMPLETE:
            self.assembly = assembly

    def run(self):
        """Waits for the puzzle, stops the camera's part of the cell, and moves all pieces."""
        while self.assembly is None:
            rclpy.spin_once(self)
        self.capture.wait_for_service()
        deactivate = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_DEACTIVATE))
        answer = self.capture.call_async(deactivate)
        rclpy.spin_until_future_complete(self, answer)
        if not answer.result().success:
            raise SystemExit("arm: the capture node can't be deactivated: is it active?")
        for piece in in_order(self.assembly):
            self.move(piece.id, planar(piece.observed), self.on_table(planar(piece.goal)))

    def on_table(self, pose):
        """A pose in the puzzle, on the table."""
        (corner, yaw), (position, heading) = self.table_from_puzzle, pose
        return corner + yaw * position, yaw * heading

    def move(self, piece, pick, place):
        """Moves a piece from one pose on the table to another; here it only tells."""
        line = {"piece": piece}
        for what, (position, heading) in (("pick", pick), ("place", place)):
            line[what] = {"x": position.real, "y": position.imag, "yaw": cmath.phase(heading)}
        print(json.dumps(line), flush=True)


def planar(pose):
    """Position and heading of a pose in the plane, as complex numbers: x and y; cosine and sine."""
    return complex(pose.position.x, pose.position.y), complex(pose.orientation.w, pose.orientation.z) ** 2


def in_order(assembly):
    """The pieces, from the one nearest to the puzzle's origin on; each further one mates with one before it."""
    left = {piece.id: piece for piece in assembly.pieces}
    beside = {name: set() for name in left}
    for mating in assembly.matings:
        beside[mating.positive_piece].add(mating.negative_piece)
        beside[mating.negative_piece].add(mating.positive_piece)
    reached = set()
    while left:
        near = min(reached & left.keys() or left, key=lambda name: abs(planar(left[name].goal)[0]))
        reached |= beside[near]
        yield left.pop(near)


def main():
    """Runs the node until all is told, or it is interrupted."""
    rclpy.init()
    try:
        Arm().run()
    except InvalidParameterTypeException as refusal:
        raise SystemExit(f"arm: {refusal}") from None
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
