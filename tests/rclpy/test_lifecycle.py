"""Managed nodes: driven through their lifecycle as `ros2 lifecycle` and a lifecycle manager do, beside a lifecycle node
of rclpy, which has its states and transitions from rcl_lifecycle itself."""

import numpy
import pytest
from builtin_interfaces.msg import Time
from jigsaw_msgs.action import Assemble
from jigsaw_msgs.msg import Assembly
from lifecycle_msgs.msg import State, Transition, TransitionEvent
from lifecycle_msgs.srv import ChangeState, GetAvailableStates, GetAvailableTransitions, GetState
from PIL import Image as Picture
from rclpy.action import ActionClient
from rclpy.lifecycle import LifecycleNode
from std_srvs.srv import Trigger

from bench import SCALE, Arm, Camera, check_assembly, image_message, stamped_frames

NODES = ("capture_node", "feature_node", "solver_node")
MANAGED = ("-p", "autostart:=false")

# Up, down and up again, with transitions in between that are not allowed where they are asked for.
JOURNEY = (
    Transition(label="activate"),
    Transition(label="configure"),
    Transition(id=Transition.TRANSITION_CLEANUP),
    Transition(id=Transition.TRANSITION_CONFIGURE),
    Transition(id=Transition.TRANSITION_ACTIVATE, label="cleanup"),  # the label goes before the id
    Transition(label="configure"),
    Transition(id=Transition.TRANSITION_ACTIVATE),
    Transition(id=Transition.TRANSITION_ACTIVATE),
    Transition(id=Transition.TRANSITION_ON_CONFIGURE_SUCCESS),
    Transition(label="deactivate"),
    Transition(id=200),
    Transition(label="no such thing"),
    Transition(id=Transition.TRANSITION_ACTIVATE),
    Transition(label="shutdown"),
    Transition(label="configure"),
)


class Managed:
    """The lifecycle services of a node, and what it tells of its transitions."""

    def __init__(self, ros, name):
        self.ros, self.name = ros, name
        self.node = ros.node(f"manages_{name}")
        self.clients = {}
        self.events = []
        self.node.create_subscription(TransitionEvent, f"/{name}/transition_event", self.events.append, 10)

    def call(self, service_type, service, **request):
        client = self.clients.setdefault(service, self.node.create_client(service_type, f"/{self.name}/{service}"))
        return self.ros.call(client, service_type.Request(**request))

    def change(self, transition):
        return self.call(ChangeState, "change_state", transition=transition).success

    def await_events(self):
        """Goes to and fro until that is heard: events are not latched, so those that come before the two ends of the
        topic have met are lost."""
        self.ros.until_repeated(lambda: self.to("configure", "cleanup"), lambda: self.events, f"event of {self.name}")

    def services(self):
        """The services that the graph knows in the node's name, with their types."""
        own = f"/{self.name}/"

        def known():
            return {name: kinds for name, kinds in self.node.get_service_names_and_types() if name.startswith(own)}

        return self.ros.until(lambda: f"{own}get_state" in known() and known(), f"services of {self.name}")

    def to(self, *labels):
        for label in labels:
            assert self.change(Transition(label=label)), f"{self.name}: {label}"

    def state(self):
        return self.call(GetState, "get_state").current_state

    def states(self):
        return self.call(GetAvailableStates, "get_available_states").available_states

    def transitions(self):
        return self.call(GetAvailableTransitions, "get_available_transitions").available_transitions

    def graph(self):
        return self.call(GetAvailableTransitions, "get_transition_graph").available_transitions


@pytest.mark.parametrize("name", NODES)
def test_states_and_transitions_are_those_of_rcl(launcher, ros, name):
    launcher.start(name, "--ros-args", *MANAGED)
    ros.adopt(LifecycleNode("oracle", context=ros.context))
    ours, oracle = Managed(ros, name), Managed(ros, "oracle")
    assert ours.states() == oracle.states()
    assert ours.graph() == oracle.graph()
    assert ours.state() == oracle.state() == State(id=State.PRIMARY_STATE_UNCONFIGURED, label="unconfigured")
    for node in (ours, oracle):
        node.await_events()
    steps = 0
    for transition in JOURNEY:
        changed = oracle.change(transition)
        assert ours.change(transition) == changed, transition
        steps += changed
        assert ours.state() == oracle.state(), transition
        assert ours.transitions() == oracle.transitions(), transition
    assert ours.state().id == State.PRIMARY_STATE_FINALIZED

    def way(node):
        """The events of the journey, without those of the beginning: two of each step that was taken."""
        return [(event.start_state.label, event.goal_state.label) for event in node.events][-2 * steps :]

    for node in (ours, oracle):
        ros.until(lambda node=node: way(node)[-1][1] == "finalized", f"last event of {node.name}")
    assert len(way(ours)) == 2 * steps
    assert way(ours) == way(oracle)


def test_a_plain_start_is_active_and_is_found_as_a_managed_node(launcher, ros):
    launcher.cell()
    for name in NODES:
        managed = Managed(ros, name)
        assert managed.state().label == "active"
        # `ros2 lifecycle nodes` takes for a managed node what has this service.
        services = managed.services()
        assert services[f"/{name}/get_state"] == ["lifecycle_msgs/srv/GetState"]


def test_a_manager_brings_the_cell_up_and_down(launcher, ros, generate):
    """As Nav2's lifecycle manager: every node configured, then activated, in order, and back."""
    launcher.cell(*SCALE, *MANAGED)
    managed = {name: Managed(ros, name) for name in ("solver_node", "feature_node", "capture_node")}
    puzzle = generate(2, 3, 5)
    camera, arm = Camera(ros), Arm(ros)
    ros.until(lambda: camera.publisher.get_subscription_count() > 0, "listener on image")
    frames = [image_message(grey, stamp) for _, grey, stamp in stamped_frames(puzzle)]

    def show_in_vain(message):
        camera.publisher.publish(message)
        for node in managed.values():  # each answer is later than the frame
            node.state()
        assert not camera.features and not any(assembly.pieces for assembly in arm.assemblies)

    show_in_vain(frames[0])
    for node in managed.values():
        node.to("configure")
    show_in_vain(frames[1])
    for node in managed.values():
        node.to("activate")
    truth = camera.show_puzzle(puzzle)
    check_assembly(arm, truth, arm.complete(6))

    # At rest nothing is taken in, and calls and goals are refused.
    for node in reversed(managed.values()):
        node.to("deactivate")
    seen = len(arm.assemblies)
    for name in ("capture", "solve", "reset"):
        answer = ros.call(arm.node.create_client(Trigger, name), Trigger.Request())
        assert not answer.success and "not active" in answer.message, name
    client = ActionClient(arm.node, Assemble, "assemble")
    ros.until(client.server_is_ready, "action server")
    assert not ros.result(client.send_goal_async(Assemble.Goal()), "answer to the goal").accepted
    assert len(arm.assemblies) == seen
    client.destroy()

    # What was seen is remembered over a rest, and forgotten by a cleanup.
    managed["solver_node"].to("activate")
    answer = ros.call(arm.node.create_client(Trigger, "solve"), Trigger.Request())
    assert answer.success and "6 of 6" in answer.message
    managed["solver_node"].to("deactivate", "cleanup")
    ros.until(lambda: not arm.assemblies[-1].pieces, "empty assembly")
    assert arm.assemblies[-1].state == Assembly.COLLECTING


def test_pieces_wait_for_a_feature_node_at_rest(launcher, ros, generate):
    launcher.start("capture_node")
    launcher.start("feature_node")
    feature = Managed(ros, "feature_node")
    feature.to("deactivate")
    camera = Camera(ros)
    capture = camera.node.create_client(Trigger, "capture")
    with Picture.open(generate(2, 3, 5).frames[0]) as picture:
        message = image_message(numpy.asarray(picture.convert("L")), Time(sec=1))

    def taken():
        return ros.call(capture, Trigger.Request()).success

    camera.show(message, seen=taken)
    assert not camera.features, "the feature node rests"
    feature.to("activate")
    ros.until(lambda: camera.features.get(1), "features of the piece that waited")


def test_a_configuration_that_fails_can_be_tried_again(launcher, ros, generate, tmp_path):
    folder = tmp_path / "frames"
    node = launcher.start("capture_node", "--ros-args", "-p", f"source:={folder}", *MANAGED)
    capture = Managed(ros, "capture_node")
    assert not capture.change(Transition(label="configure"))
    assert capture.state().label == "unconfigured"
    assert str(folder) in node.text() and "source" in node.text()
    folder.symlink_to(generate(2, 3, 5).folder)
    camera = Camera(ros)
    launcher.start("feature_node")
    capture.to("configure", "activate")
    ros.until(lambda: sum(map(len, camera.features.values())) == 6, "features of all pictures")
