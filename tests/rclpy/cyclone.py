"""ROS messages for CycloneDDS's own Python binding, which knows nothing of ROS: IDL types made from the message
definitions at run time."""

from dataclasses import dataclass
from types import new_class

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct, types
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration
from rosbags.interfaces import Nodetype

LOOPBACK = """<CycloneDDS><Domain Id="any"><General>
  <Interfaces><NetworkInterface name="lo" multicast="true"/></Interfaces>
  <AllowMulticast>true</AllowMulticast><MaxMessageSize>65500B</MaxMessageSize>
</General></Domain></CycloneDDS>"""

PRIMITIVES = {
    "bool": bool, "byte": types.uint8, "char": types.uint8, "octet": types.uint8,
    "int8": types.int8, "int16": types.int16, "int32": types.int32, "int64": types.int64,
    "uint8": types.uint8, "uint16": types.uint16, "uint32": types.uint32, "uint64": types.uint64,
    "float32": types.float32, "float64": types.float64, "string": str,
}  # fmt: skip


def idl_type(full_name, definitions):
    """The IDL structure of a message, and of all that it contains; `definitions` is what rosbags makes of its text."""
    made = {}

    def structure(name):
        if name not in made:
            package, kind, short = name.split("/")
            fields = {field: of(description) for field, description in definitions[name][1]}
            dds_name = f"{package}::{kind}::dds_::{short}_"
            cls = new_class(
                short, (IdlStruct,), {"typename": dds_name}, lambda space: space.update(__annotations__=fields)
            )
            made[name] = dataclass(cls)
        return made[name]

    def of(description):
        node, detail = description
        if node == Nodetype.BASE:
            return PRIMITIVES[detail[0]]
        if node == Nodetype.NAME:
            return structure(detail)
        element, size = detail
        if node == Nodetype.ARRAY:
            return types.array[of(element), size]
        return types.sequence[of(element), size] if size else types.sequence[of(element)]

    return structure(full_name)


class Cyclone:
    """A CycloneDDS participant in a domain, on the loopback interface."""

    def __init__(self, domain):
        self.domain = Domain(domain, LOOPBACK)
        self.participant = DomainParticipant(domain)

    def latched(self, topic, idl, timeout, wanted):
        """The first sample of a latched ROS topic that is `wanted`: older ones may come ahead of the newest."""
        qos = Qos(
            Policy.Reliability.Reliable(duration(seconds=1)),
            Policy.Durability.TransientLocal,
            Policy.History.KeepLast(1),
        )
        reader = DataReader(self.participant, Topic(self.participant, f"rt{topic}", idl), qos)
        sample = next(filter(wanted, reader.take_iter(timeout=duration(seconds=timeout))), None)
        assert sample is not None, f"nothing more on {topic} for {timeout} s, and none of what came is the one wanted"
        return sample
