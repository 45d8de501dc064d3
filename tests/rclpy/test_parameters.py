"""Parameters of the nodes, through the standard services, from rclpy."""

import os
import subprocess
import sys

import pytest
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    GetParameterTypes,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)

from conftest import EVENT_TIMEOUT

NODES = ("capture_node", "feature_node", "solver_node")

PARAMETERS_FILE = """
/**:
  ros__parameters:
    use_sim_time: false
capture_node:
  ros__parameters:
    metres_per_pixel: 0.0003
"""


class Remote:
    """The parameter services of a node."""

    def __init__(self, ros, node):
        self.ros, self.name = ros, node
        self.node = ros.node(f"asks_{node}")

    def call(self, service_type, service, **request):
        client = self.node.create_client(service_type, f"/{self.name}/{service}")
        return self.ros.call(client, service_type.Request(**request))

    def names(self):
        return list(self.call(ListParameters, "list_parameters").result.names)

    def describe(self, names):
        return self.call(DescribeParameters, "describe_parameters", names=names).descriptors

    def get(self, *names):
        return self.call(GetParameters, "get_parameters", names=list(names)).values

    def set(self, **values):
        parameters = [Parameter(name=name, value=value) for name, value in values.items()]
        return self.call(SetParameters, "set_parameters", parameters=parameters).results


def double(value):
    return ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=value)


def text(value):
    return ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=value)


@pytest.mark.parametrize("node", NODES)
def test_every_parameter_is_listed_described_and_has_a_value(launcher, ros, node):
    launcher.start(node)
    remote = Remote(ros, node)
    names = remote.names()
    assert len(names) == len(set(names)) > 0
    descriptors = remote.describe(names)
    values = remote.get(*names)
    kinds = remote.call(GetParameterTypes, "get_parameter_types", names=names).types
    for name, descriptor, value, kind in zip(names, descriptors, values, kinds, strict=True):
        assert descriptor.name == name
        assert descriptor.description, f"{name} has no description"
        assert descriptor.type == value.type == kind != ParameterType.PARAMETER_NOT_SET, name
        for bounds, current in (
            (descriptor.floating_point_range, value.double_value),
            (descriptor.integer_range, value.integer_value),
        ):
            assert all(b.from_value <= current <= b.to_value for b in bounds), name


def test_a_value_is_set_and_a_bad_one_is_refused_with_the_reason(launcher, ros):
    launcher.start("capture_node")
    remote = Remote(ros, "capture_node")

    (result,) = remote.set(metres_per_pixel=double(0.0005))
    assert result.successful, result.reason
    assert remote.get("metres_per_pixel")[0].double_value == 0.0005

    refusals = {
        "out of range": {"metres_per_pixel": double(-1.0)},
        "not a number": {"metres_per_pixel": double(float("nan"))},
        "of another type": {"metres_per_pixel": text("fine")},
        "read-only": {"source": text("/elsewhere")},
        "unknown": {"no_such_parameter": double(1.0)},
        "taken away": {"metres_per_pixel": ParameterValue()},
    }
    for what, values in refusals.items():
        (result,) = remote.set(**values)
        assert not result.successful, what
        (name,) = values
        assert name in result.reason, f"{what}: {result.reason!r} does not name {name}"
    assert remote.get("metres_per_pixel")[0].double_value == 0.0005, "the old value stays"


def test_several_values_are_set_together_or_not_at_all(launcher, ros):
    launcher.start("capture_node")
    remote = Remote(ros, "capture_node")
    before = remote.get("metres_per_pixel")[0].double_value
    parameters = [
        Parameter(name="metres_per_pixel", value=double(0.0007)),
        Parameter(name="no_such_parameter", value=double(1.0)),
    ]
    answer = remote.call(SetParametersAtomically, "set_parameters_atomically", parameters=parameters)
    assert not answer.result.successful
    assert remote.get("metres_per_pixel")[0].double_value == before


def test_values_from_the_command_line_and_a_file(launcher, ros, tmp_path):
    file = tmp_path / "cell.param.yaml"
    file.write_text(PARAMETERS_FILE)
    launcher.start("capture_node", "--ros-args", "--params-file", file)
    assert Remote(ros, "capture_node").get("metres_per_pixel")[0].double_value == 0.0003

    launcher.start("capture_node", "--ros-args", "-r", "__node:=other", "-p", "metres_per_pixel:=0.0004")
    assert Remote(ros, "other").get("metres_per_pixel")[0].double_value == 0.0004


# A client that knows every interface of this host, as one without a profile does: answers come to it in the datagrams
# of a network.
CLIENT = """
import sys
import rclpy
from lifecycle_msgs.srv import GetAvailableTransitions
from rcl_interfaces.srv import DescribeParameters, ListParameters

rclpy.init(domain_id=int(sys.argv[1]))
node = rclpy.create_node("client")

def call(service, name, **request):
    client = node.create_client(service, f"/solver_node/{name}")
    client.wait_for_service()
    future = client.call_async(service.Request(**request))
    rclpy.spin_until_future_complete(node, future)
    return future.result()

names = call(ListParameters, "list_parameters").result.names
described = call(DescribeParameters, "describe_parameters", names=names).descriptors
assert [one.name for one in described] == names and all(one.description for one in described)
assert len(call(GetAvailableTransitions, "get_transition_graph").available_transitions) > 20
"""


def test_answers_larger_than_a_datagram_reach_a_client_on_any_interface(launcher, domain):
    launcher.start("solver_node")
    environment = {k: v for k, v in os.environ.items() if k != "FASTDDS_DEFAULT_PROFILES_FILE"}
    environment |= {"FASTDDS_BUILTIN_TRANSPORTS": "UDPv4", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    subprocess.run([sys.executable, "-c", CLIENT, str(domain)], env=environment, timeout=EVENT_TIMEOUT, check=True)
