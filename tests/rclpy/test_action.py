"""The action `assemble`, from a client of rclpy."""

import os

import pytest
import rclpy
from action_msgs.msg import GoalStatus, GoalStatusArray
from action_msgs.srv import CancelGoal
from builtin_interfaces.msg import Duration
from jigsaw_msgs.action import Assemble
from jigsaw_msgs.msg import Assembly, PieceFeatures
from rclpy.action import ActionClient
from unique_identifier_msgs.msg import UUID

from bench import SCALE, Arm, Camera
from conftest import LATCHED

ACKNOWLEDGEMENT = rclpy.duration.Duration(seconds=0.1)  # for which nothing else is done


class Client:
    """A client of the action; keeps the feedback of all its goals."""

    def __init__(self, ros, name="client"):
        self.ros = ros
        self.node = ros.node(name)
        self.client = ActionClient(self.node, Assemble, "assemble")
        self.feedback = []

    def send(self, **goal):
        """Sends a goal as soon as there is a server."""
        self.ros.until(self.client.server_is_ready, "action server")
        sent = self.client.send_goal_async(
            Assemble.Goal(**goal), feedback_callback=lambda message: self.feedback.append(message.feedback)
        )
        return self.ros.result(sent, "answer to the goal")

    def end(self, handle):
        response = self.ros.result(handle.get_result_async(), "result", 60)
        return response.status, response.result

    def cancel(self, handle):
        return self.ros.result(handle.cancel_goal_async(), "answer to the cancellation")


@pytest.fixture
def client(ros):
    client = Client(ros)
    yield client
    client.client.destroy()


def test_a_goal_is_reached_with_feedback_on_the_way(launcher, ros, generate, client):
    launcher.cell(*SCALE)
    puzzle = generate(2, 3, 5)
    handle = client.send(expected_pieces=6)
    assert handle.accepted
    Camera(ros).show_puzzle(puzzle)
    status, result = client.end(handle)
    assert status == GoalStatus.STATUS_SUCCEEDED and result.complete
    assert result.assembly.state == Assembly.COMPLETE and len(result.assembly.pieces) == 6
    ros.until(lambda: client.feedback and client.feedback[-1].pieces_seen == 6, "feedback of the last piece")
    seen = [feedback.pieces_seen for feedback in client.feedback]
    assert seen == sorted(seen)
    assert len(client.feedback[-1].best.pieces) == 6 and client.feedback[-1].matings >= 5

    # Whoever asks again, or later, gets the same; the next goal is reached at once.
    # Often: an answer that comes in two ways at once is rarely put together wrongly.
    assert all(client.end(handle)[1] == result for _ in range(200))
    again = client.send(expected_pieces=6)
    assert again.accepted and client.end(again)[0] == GoalStatus.STATUS_SUCCEEDED


def test_a_goal_that_waits_for_a_node_to_start_is_accepted(launcher, ros, client, tmp_path):
    """A client may find the server, and ask, before the node has begun to work. The node is kept from that by a file of
    its journal that nobody has written yet."""
    journal = tmp_path / "journal"
    journal.mkdir()
    slow = journal / "slow.piece"
    os.mkfifo(slow)
    solver = launcher.start("solver_node", "--ros-args", "-p", f"journal:={journal}")
    # The node acknowledges what it has got. It meets the endpoints of a participant in the order in which they were
    # made, and takes its messages in the order in which they were sent: so it knows the client, and then has the goal.
    pieces = client.node.create_publisher(PieceFeatures, "pieces/features", LATCHED)

    def reached():
        ros.until(lambda: pieces.get_subscription_count(), "solver node")
        pieces.publish(PieceFeatures())
        ros.until(lambda: pieces.wait_for_all_acked(ACKNOWLEDGEMENT), "acknowledgement")

    reached()
    ros.until(client.client.server_is_ready, "action server")
    sent = client.client.send_goal_async(Assemble.Goal(expected_pieces=5))
    reached()
    assert "journal" not in solver.text(), "the node has read its journal already"
    slow.write_bytes(b"no piece")
    handle = ros.result(sent, "answer to the goal")
    assert handle.accepted
    assert client.cancel(handle).return_code == CancelGoal.Response.ERROR_NONE


def test_a_goal_ends_with_its_time(launcher, client):
    launcher.start("solver_node")
    handle = client.send(expected_pieces=5, time_budget=Duration(sec=1))
    assert handle.accepted
    status, result = client.end(handle)
    assert status == GoalStatus.STATUS_ABORTED
    assert not result.complete and not result.assembly.pieces


def test_a_goal_is_called_off(launcher, client):
    launcher.start("solver_node")
    handle = client.send(expected_pieces=5)
    assert handle.accepted
    answer = client.cancel(handle)
    assert answer.return_code == CancelGoal.Response.ERROR_NONE
    assert [info.goal_id for info in answer.goals_canceling] == [handle.goal_id]
    assert client.end(handle)[0] == GoalStatus.STATUS_CANCELED
    assert client.cancel(handle).return_code == CancelGoal.Response.ERROR_GOAL_TERMINATED
    handle.goal_id.uuid[0] ^= 1
    assert client.cancel(handle).return_code == CancelGoal.Response.ERROR_UNKNOWN_GOAL_ID


def test_a_goal_that_was_called_off_does_not_say_what_is_complete(launcher, ros, generate, client):
    launcher.cell(*SCALE)
    arm = Arm(ros)
    Camera(ros).show_puzzle(generate(2, 3, 5))
    arm.complete(6)
    handle = client.send(expected_pieces=7)
    assert handle.accepted
    ros.until(lambda: arm.assemblies[-1].state == Assembly.PARTIAL, "assembly that is partial by the goal's number")
    assert client.cancel(handle).return_code == CancelGoal.Response.ERROR_NONE
    arm.complete(6)


def test_one_goal_at_a_time(launcher, ros, client):
    solver = launcher.start("solver_node")
    other = Client(ros, "other_client")
    statuses = []
    client.node.create_subscription(GoalStatusArray, "/assemble/_action/status", statuses.append, LATCHED)
    ros.until(other.client.server_is_ready, "action server")
    first = client.send(expected_pieces=2)
    assert first.accepted
    assert client.cancel(first).return_code == CancelGoal.Response.ERROR_NONE
    assert client.end(first)[0] == GoalStatus.STATUS_CANCELED
    # Two at the same time: one of them is taken.
    both = [
        ros_client.client.send_goal_async(Assemble.Goal(expected_pieces=number))
        for number, ros_client in ((3, client), (4, other))
    ]
    handles = [ros.result(sent, "answer to the goal") for sent in both]
    assert sorted(handle.accepted for handle in handles) == [False, True]
    # One more while it executes.
    assert not other.send(expected_pieces=4).accepted
    assert "another one is executing" in solver.text()
    (taken,) = [handle for handle in handles if handle.accepted]
    (owner,) = [owner for owner, handle in zip((client, other), handles, strict=True) if handle is taken]
    assert owner.cancel(taken).return_code == CancelGoal.Response.ERROR_NONE
    assert owner.end(taken)[0] == GoalStatus.STATUS_CANCELED
    # Now there is room for the next.
    handle = other.send(expected_pieces=4)
    assert handle.accepted
    assert other.cancel(handle).return_code == CancelGoal.Response.ERROR_NONE

    def states():
        return {tuple(one.goal_info.goal_id.uuid): one.status for array in statuses for one in array.status_list}

    ros.until(lambda: list(states().values()) == [GoalStatus.STATUS_CANCELED] * 3, "status of all goals")
    other.client.destroy()


def test_nonsense_is_rejected(launcher, ros, client):
    solver = launcher.start("solver_node")
    for budget in (Duration(sec=-1), Duration(nanosec=1_000_000_000)):
        assert not client.send(time_budget=budget).accepted
        assert "time_budget" in solver.text()
    service = client.node.create_client(Assemble.Impl.GetResultService, "/assemble/_action/get_result")
    stranger = Assemble.Impl.GetResultService.Request(goal_id=UUID(uuid=[7] * 16))
    assert ros.call(service, stranger).status == GoalStatus.STATUS_UNKNOWN
