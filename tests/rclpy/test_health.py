"""What a node tells of itself: /diagnostics, /rosout, /parameter_events, and the time it goes by."""

import socket
import time

import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus
from rcl_interfaces.msg import Log, Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Image
from std_srvs.srv import Trigger

from bench import BEST_EFFORT, METRES_PER_PIXEL, SCALE, Arm, Camera, Monitor, image_message, stamped_frames

NODES = ("capture_node", "feature_node", "solver_node")
FLOOD = 50  # refused frames, sent as fast as they go
THROTTLE = 5.0  # seconds between two lines of a kind


def test_diagnostics_in_the_standard_form(launcher, ros, generate):
    launcher.cell(*SCALE)
    monitor, arm = Monitor(ros), Arm(ros)
    Camera(ros).show_puzzle(generate(2, 3, 5))
    arm.complete(6)
    for name in NODES:
        status, values = monitor.status(name, lambda status, values: int(values["received"]) >= 6)
        assert status.level == DiagnosticStatus.OK and status.hardware_id == socket.gethostname()
        assert values["lifecycle"] == "active" and status.message == values["state"] != ""
        assert int(values["published"]) >= 1 and values["refused"] == "0" and values["last_error"] == ""
        assert float(values["received_per_second"]) >= 0 and float(values["published_per_second"]) >= 0
    _, values = monitor.status("solver_node", lambda status, values: values.get("placed") == "6")
    assert values["pieces"] == "6" and int(values["matings"]) >= 5 and float(values["solve_seconds"]) > 0


def test_a_flood_of_refusals_is_one_line_and_a_count(launcher, ros):
    launcher.start("capture_node")
    monitor = Monitor(ros)
    camera = monitor.node.create_publisher(Image, "image", BEST_EFFORT)
    ros.until(lambda: camera.get_subscription_count() > 0, "listener on image")
    monitor.status("capture_node")
    bad = Image(width=8, height=8, step=3, encoding="mono8", data=bytes(64))
    begun = time.monotonic()
    ros.until_repeated(
        lambda: [camera.publish(bad) for _ in range(FLOOD)],
        lambda: int(monitor.values("capture_node")["refused"]) >= FLOOD,
        f"{FLOOD} refusals",
    )
    status, values = monitor.status("capture_node")
    assert status.level == DiagnosticStatus.WARN and "step 3" in status.message
    assert values["refused.step"] == values["refused"] and "step 3" in values["last_error"]
    warnings = ros.until(lambda: [line for line in monitor.lines if "step 3" in line.msg], "line on /rosout")
    most = 1 + (time.monotonic() - begun) / THROTTLE
    assert len(warnings) <= most, f"{len(warnings)} lines of a kind, one in {THROTTLE} s"
    assert warnings[0].name == "capture_node" and warnings[0].level == Log.WARN


def set_parameter(ros, node, target, name, **value):
    client = node.create_client(SetParameters, f"/{target}/set_parameters")
    request = SetParameters.Request(parameters=[Parameter(name=name, value=ParameterValue(**value))])
    (result,) = ros.call(client, request).results
    return result


def test_changes_of_parameters_are_told_and_refusals_counted(launcher, ros):
    launcher.start("solver_node")
    monitor = Monitor(ros)
    monitor.status("solver_node")
    whole = {"type": ParameterType.PARAMETER_INTEGER}

    def change():
        assert set_parameter(ros, monitor.node, "solver_node", "expected_pieces", integer_value=24, **whole).successful

    def told():
        return [e for e in monitor.events if e.node == "/solver_node" and e.changed_parameters]

    (changed,) = ros.until_repeated(change, told, "event of the change")[-1].changed_parameters
    assert (changed.name, changed.value.integer_value) == ("expected_pieces", 24)
    assert not set_parameter(ros, monitor.node, "solver_node", "expected_pieces", integer_value=-1, **whole).successful
    monitor.status("solver_node", lambda status, values: values.get("refused.parameter") == "1")


def test_parameters_take_effect_while_the_cell_runs(launcher, ros, generate):
    launcher.cell(*SCALE)
    arm = Arm(ros)
    Camera(ros).show_puzzle(generate(2, 3, 5))
    arm.complete(6)

    def change(name, condition, what, **value):
        arm.assemblies.clear()
        assert set_parameter(ros, arm.node, "solver_node", name, **value).successful
        return ros.until(lambda: [a for a in arm.assemblies if condition(a)], what)[-1]

    whole = ParameterType.PARAMETER_INTEGER
    change("expected_pieces", lambda a: a.state == a.PARTIAL, "partial assembly", type=whole, integer_value=7)
    change("expected_pieces", lambda a: a.state == a.COMPLETE, "complete assembly", type=whole, integer_value=6)
    standard = arm.assemblies[-1]
    paper = change(
        "policy", lambda a: a.table != standard.table, "other candidates",
        type=ParameterType.PARAMETER_STRING, string_value="paper",
    )  # fmt: skip
    assert paper.table.pairs >= standard.table.pairs


def test_the_scale_can_be_changed_while_frames_come(launcher, ros, generate):
    launcher.cell(*SCALE)
    camera = Camera(ros)
    first, second = list(stamped_frames(generate(2, 3, 5)))[:2]
    (before,) = camera.show(image_message(*first[1:]))
    double = {"type": ParameterType.PARAMETER_DOUBLE, "double_value": 2 * METRES_PER_PIXEL}
    assert set_parameter(ros, camera.node, "capture_node", "metres_per_pixel", **double).successful
    (after,) = camera.show(image_message(*second[1:]))
    assert (before.metres_per_pixel, after.metres_per_pixel) == (METRES_PER_PIXEL, 2 * METRES_PER_PIXEL)


def test_pieces_beyond_the_most_are_refused_from_the_moment_it_is_set(launcher, ros, generate):
    launcher.cell(*SCALE)
    monitor = Monitor(ros)
    most = {"type": ParameterType.PARAMETER_INTEGER, "integer_value": 4}
    assert set_parameter(ros, monitor.node, "solver_node", "maximum_pieces", **most).successful
    Camera(ros).show_puzzle(generate(2, 3, 5))
    _, values = monitor.status("solver_node", lambda status, values: values.get("refused.maximum_pieces") == "2")
    assert values["pieces"] == "4" and "maximum_pieces" in values["last_error"]


@pytest.mark.parametrize("name", NODES)
def test_time_comes_from_the_clock_under_use_sim_time(launcher, ros, name):
    launcher.start(name, "--ros-args", "-p", "use_sim_time:=true")
    monitor = Monitor(ros)
    clock = monitor.node.create_publisher(Clock, "/clock", 10)
    ros.until(lambda: clock.get_subscription_count() > 0, "listener on /clock")
    shown = Time(sec=123, nanosec=456)

    def ticked():
        clock.publish(Clock(clock=shown))
        return shown in monitor.stamps.get(name, [])

    ros.until(ticked, "stamp of the clock")
    bad = Clock(clock=Time(sec=-1, nanosec=4_000_000_000))
    ros.until_repeated(lambda: clock.publish(bad), lambda: monitor.refused(name, "clock"), "refusal of a time")
    assert all(stamp in (Time(), shown) for stamp in monitor.stamps[name])
    off = {"type": ParameterType.PARAMETER_BOOL, "bool_value": False}
    assert set_parameter(ros, monitor.node, name, "use_sim_time", **off).successful
    ros.until(lambda: monitor.stamps[name][-1].sec > 1_000_000_000, "stamp of the system")


def test_a_service_answers_many_at_once(launcher, ros):
    launcher.start("solver_node")
    # More than fit the queue of one client: it gets its own answers alone.
    clients = [ros.node(f"caller_{k}").create_client(Trigger, "solve") for k in range(5)]
    for client in clients:
        ros.until(client.service_is_ready, "service")
    futures = [client.call_async(Trigger.Request()) for client in clients for _ in range(4)]
    ros.until(lambda: all(future.done() for future in futures), "20 answers")
    assert all(future.result().success for future in futures)
