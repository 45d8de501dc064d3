"""The launch file, without `launch` (which is not on PyPI): stand-ins record what it asks for, and that is started as
`launch_ros` would start it."""

import importlib.util
import sys
import types

import pytest
import yaml

from bench import METRES_PER_PIXEL, Arm, Camera, check_assembly
from conftest import ROOT


class Recorded:
    """Keeps the arguments it was made with."""

    def __init__(self, *arguments, **options):
        self.arguments, self.options = arguments, options


class Substitution(Recorded):
    """A launch configuration; its text comes from the declared arguments."""

    def text(self, values):
        return values[self.arguments[0]]


def resolved(value, values):
    """What a substitution, a list of parts or a parameter value of launch comes to."""
    if isinstance(value, Substitution):
        return value.text(values)
    if isinstance(value, (list, tuple)):
        return "".join(resolved(part, values) for part in value)
    if isinstance(value, Recorded):  # a ParameterValue
        text, kind = resolved(value.arguments[0], values), value.options["value_type"]
        return text == "true" if kind is bool else kind(text)
    return value


@pytest.fixture
def description(monkeypatch):
    """The launch description, as a list of what the file put into it."""
    names = {
        "launch": {"LaunchDescription": list},
        "launch.actions": {"DeclareLaunchArgument": Recorded},
        "launch.substitutions": {"LaunchConfiguration": Substitution},
        "launch_ros": {},
        "launch_ros.actions": {"Node": type("Node", (Recorded,), {})},
        "launch_ros.parameter_descriptions": {"ParameterValue": Recorded},
    }
    for name, content in names.items():
        module = types.ModuleType(name)
        module.__dict__.update(content)
        monkeypatch.setitem(sys.modules, name, module)
    spec = importlib.util.spec_from_file_location("jigsaw_launch", ROOT / "launch-scripts" / "jigsaw.launch.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.generate_launch_description()


def command(node, values, folder):
    """Executable and ROS arguments, as launch_ros passes them."""
    options = node.options
    arguments = ["--ros-args", "-r", f"__node:={options['name']}"]
    if namespace := resolved(options["namespace"], values):
        arguments += ["-r", f"__ns:=/{namespace.lstrip('/')}"]
    for number, parameters in enumerate(options["parameters"]):
        if isinstance(parameters, dict):
            # As launch_ros: a file that addresses every node.
            content = {name: resolved(value, values) for name, value in parameters.items()}
            file = folder / f"{options['name']}_{number}.yaml"
            file.write_text(yaml.safe_dump({"/**": {"ros__parameters": content}}))
            parameters = file
        arguments += ["--params-file", str(parameters)]
    for source, target in options["remappings"]:
        arguments += ["-r", f"{source}:={resolved(target, values)}"]
    return options["executable"], arguments


def test_the_launch_file_starts_a_cell_that_works(launcher, ros, generate, description, tmp_path):
    declared = [one for one in description if "default_value" in one.options]
    nodes = [one for one in description if "executable" in one.options]
    assert all(one.options["description"] for one in declared)
    values = {one.arguments[0]: one.options["default_value"] for one in declared}
    given = {"namespace": "lab", "image": "/camera/frames", "metres_per_pixel": str(METRES_PER_PIXEL)}
    assert given.keys() <= values.keys()
    values |= given
    assert {node.options["package"] for node in nodes} == {"jigsaw_nodes"}
    assert all(node.options["respawn"] for node in nodes)
    for node in nodes:
        executable, arguments = command(node, values, tmp_path)
        launcher.start(executable, *arguments)
    camera = Camera(ros, "/camera/frames", features="/lab/pieces/features")
    arm = Arm(ros, assembly="/lab/assembly")
    truth = camera.show_puzzle(generate(2, 3, 5))
    check_assembly(arm, truth, arm.complete(6))


def test_the_launch_file_names_parameters_that_the_nodes_have(description):
    """A name in a file for every node is passed over where a node doesn't know it, so a slip would not show above."""
    for node in (one for one in description if "executable" in one.options):
        file, given = node.options["parameters"]
        (known,) = yaml.safe_load(open(file)).values()
        assert given.keys() <= known["ros__parameters"].keys(), node.options["name"]
