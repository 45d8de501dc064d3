"""The Rust message types against those that the standard generators made from the same files, and against the wheels.

`transcode` (an example of the crate jigsaw_msgs) decodes bytes into a Rust type and answers with their meaning as JSON,
and with the bytes that Rust makes of it.
"""

import array
import importlib
import json
import math
import random
import struct
from pathlib import Path

import numpy
import pytest
from ament_index_python.packages import get_package_share_directory
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.typesys import get_types_from_msg

CDR_HEADER = bytes([0, 1, 0, 0])  # plain CDR, little endian
SEED = 1990
ROUNDS = 5  # random values tried for each type


def python_class(full_name):
    """The Python class of a name such as std_srvs/srv/Trigger_Request."""
    package, kind, name = full_name.split("/")
    name, _, part = name.partition("_")
    cls = getattr(importlib.import_module(f"{package}.{kind}"), name)
    return getattr(cls, part) if part else cls


def random_text(rng, longest=12):
    return "".join(rng.choice("abcÄöß_/0 漢") for _ in range(rng.randrange(longest)))


def random_value(rng, ty):
    """A value of a field type in the notation of get_fields_and_field_types()."""
    if ty.startswith("sequence<"):
        inner = ty[len("sequence<") : -1]
        inner, _, bound = inner.partition(", ")
        return [random_value(rng, inner) for _ in range(rng.randrange((int(bound) if bound else 3) + 1))]
    if ty.endswith("]"):
        inner, _, size = ty[:-1].rpartition("[")
        return [random_value(rng, inner) for _ in range(int(size))]
    if "/" in ty:
        package, name = ty.split("/")
        return random_message(rng, f"{package}/msg/{name}")
    if ty == "boolean":
        return rng.random() < 0.5
    if ty == "string":
        return random_text(rng)
    if ty == "octet":
        return bytes([rng.randrange(256)])
    if ty == "float":
        return struct.unpack("f", struct.pack("f", rng.uniform(-1e6, 1e6)))[0]
    if ty == "double":
        return rng.uniform(-1e12, 1e12)
    bits = int(ty.lstrip("uint"))
    low, high = (0, 2**bits - 1) if ty.startswith("u") else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
    return rng.choice([low, high, rng.randint(low, high)])


def random_message(rng, full_name):
    message = python_class(full_name)()
    for name, ty in message.get_fields_and_field_types().items():
        setattr(message, name, random_value(rng, ty))
    return message


def meaning(value):
    """A message or a field as the JSON that serde makes of it."""
    if hasattr(value, "get_fields_and_field_types"):
        fields = value.get_fields_and_field_types()
        if not fields:
            return {"structure_needs_at_least_one_member": 0}
        return {name: meaning(getattr(value, name)) for name in fields}
    if isinstance(value, bytes):
        return value[0]
    if isinstance(value, (list, tuple, array.array, numpy.ndarray)):
        return [meaning(element) for element in value]
    return value.item() if hasattr(value, "item") else value


def same(rust, python):
    """Equal; single precision floats may be written with fewer digits."""
    if isinstance(rust, dict):
        return rust.keys() == python.keys() and all(same(rust[key], python[key]) for key in rust)
    if isinstance(rust, list):
        return len(rust) == len(python) and all(map(same, rust, python))
    if isinstance(rust, float):
        return math.isclose(rust, python, rel_tol=1e-7)
    return type(rust) is type(python) and rust == python


@pytest.fixture(scope="module")
def type_names(transcode):
    return transcode.types()


def test_same_bytes_mean_the_same_in_rust_and_in_rclpy(transcode, type_names):
    rng = random.Random(SEED)
    assert len(type_names) > 60
    for full_name in type_names:
        cls = python_class(full_name)
        for message in [cls(), *(random_message(rng, full_name) for _ in range(ROUNDS))]:
            data = serialize_message(message)
            assert data[:4] == CDR_HEADER
            answer = transcode.ask(full_name, data[4:])
            assert "error" not in answer, f"{full_name}: {answer['error']}"
            # rclpy sends some bytes more at the end, and its padding bytes are arbitrary, so bytes can't be compared.
            assert answer["consumed"] == len(answer["cdr"]) // 2 <= len(data) - 4, full_name
            assert same(answer["message"], meaning(message)), full_name
            assert deserialize_message(CDR_HEADER + bytes.fromhex(answer["cdr"]), cls) == message, full_name


def test_defaults_are_the_same(transcode, type_names):
    for full_name in type_names:
        assert same(transcode.ask(full_name)["message"], meaning(python_class(full_name)())), full_name


def test_type_hashes_are_those_of_rosidl(transcode, type_names):
    for full_name in type_names:
        package, kind, name = full_name.split("/")
        description = Path(get_package_share_directory(package), kind, name.split("_")[0] + ".json")
        hashes = {
            entry["type_name"]: entry["hash_string"] for entry in json.loads(description.read_text())["type_hashes"]
        }
        assert transcode.ask(full_name)["hash"] == hashes[full_name], full_name


def test_definitions_parse_elsewhere_and_hold_the_constants_of_the_wheels(transcode, type_names):
    for full_name in type_names:
        package, kind, name = full_name.split("/")
        ours = get_types_from_msg(transcode.ask(full_name)["definition"], full_name)
        if kind != "msg":
            continue
        installed = Path(get_package_share_directory(package), kind, f"{name}.msg").read_text()
        theirs = get_types_from_msg(installed, full_name)
        constants, fields = ours[full_name]
        assert sorted(constants) == sorted(theirs[full_name][0]), full_name
        assert fields == theirs[full_name][1], full_name


def test_services_and_actions_have_their_python_side():
    from jigsaw_msgs.action import Assemble
    from std_srvs.srv import Trigger

    assert set(Assemble.Feedback.get_fields_and_field_types()) == {"pieces_seen", "matings", "best"}
    assert set(Trigger.Response.get_fields_and_field_types()) == {"success", "message"}


def test_bytes_cut_short_are_refused(transcode):
    from jigsaw_msgs.msg import Assembly

    data = serialize_message(random_message(random.Random(SEED), "jigsaw_msgs/msg/Assembly"))[4:]
    whole = transcode.ask("jigsaw_msgs/msg/Assembly", data)["consumed"]
    for length in range(0, whole, 7):
        assert "error" in transcode.ask("jigsaw_msgs/msg/Assembly", data[:length]), length
    assert Assembly.COMPLETE == 2
