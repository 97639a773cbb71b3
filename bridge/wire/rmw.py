"""What rmw_zenoh tells about a ROS 2 graph: one liveliness token for each endpoint.

The token's key is, in rmw_zenoh's own words (docs/design.md of ros2/rmw_zenoh),
``@ros2_lv/<domain>/<session>/<node id>/<entity id>/<kind>/<enclave>/<namespace>/<node>`` and, for
all but nodes, ``/<topic>/<type>/<type hash>/<qos>``; slashes inside a name are written as ``%``.
Later releases may append parts; they are ignored.
"""

from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

from bridge.wire import keys

TOKENS = "@ros2_lv/**"
"""Key expression of all tokens of all domains."""
_PREFIX = "@ros2_lv"
_NODE_PARTS, _TOPIC_PARTS = 9, 13
_QOS_FIELDS = 3
_MAX_DIGITS = 9


class EntityKind(Enum):
    """What a token stands for."""

    NODE = "NN"
    PUBLISHER = "MP"
    SUBSCRIPTION = "MS"
    SERVICE = "SS"
    CLIENT = "SC"


class RosQos(NamedTuple):
    """The part of an endpoint's quality of service that matters to a recorder."""

    reliable: bool = True
    transient_local: bool = False
    """Late subscribers get the last messages: /tf_static, /robot_description, maps."""
    depth: int = 42
    """How many; 42 is rmw_zenoh's default. With keep_all history it is only what was asked for."""
    keep_all: bool = False


DEFAULT_QOS = RosQos()


@dataclass(frozen=True, kw_only=True)
class RosEndpoint:
    """A node, publisher, subscription, service or client of a ROS 2 graph."""

    kind: EntityKind
    domain: int
    session: str
    """zenoh id of the process."""
    node: str
    """With its namespace, as ROS prints it: ``/arm/driver``."""
    topic: str = ""
    """Topic or service, with its leading slash; "" for a node."""
    dds_type: str = ""
    """As in keys: ``std_msgs::msg::dds_::String_``."""
    type_hash: str = ""
    """RIHS01 hash, or TypeHashNotSupported from older releases."""
    qos: RosQos = DEFAULT_QOS

    @property
    def type_name(self) -> str:
        """As people write it: ``std_msgs/msg/String``."""
        return keys.ros_type(self.dds_type)

    @property
    def key(self) -> str:
        """The zenoh key its messages travel on."""
        return f"{self.domain}{self.topic}/{self.dds_type}/{self.type_hash}"


def parse_token(key: str) -> RosEndpoint | None:
    """Read the key of a liveliness token; None for anything that is not one of rmw_zenoh."""
    parts = key.split("/")
    if len(parts) < _NODE_PARTS or parts[0] != _PREFIX or "" in parts:
        return None
    if any(sign in key for sign in "*$?#"):  # would widen the questions asked about it
        return None
    _, domain, session, _, _, kind_name, _, namespace, node = parts[:_NODE_PARTS]
    kinds = {kind.value: kind for kind in EntityKind}
    kind = kinds.get(kind_name)
    if kind is None or not (domain.isascii() and domain.isdigit()):
        return None
    full_name = f"{_name(namespace).rstrip('/')}/{_name(node)}"
    if kind is EntityKind.NODE:
        return RosEndpoint(kind=kind, domain=int(domain), session=session, node=full_name)
    if len(parts) < _TOPIC_PARTS:
        return None
    topic, dds_type, type_hash, qos_text = parts[_NODE_PARTS:_TOPIC_PARTS]
    qos = parse_qos(qos_text)
    if qos is None or not _name(topic).startswith("/"):
        return None
    return RosEndpoint(
        kind=kind,
        domain=int(domain),
        session=session,
        node=full_name,
        topic=_name(topic),
        dds_type=dds_type,
        type_hash=type_hash,
        qos=qos,
    )


def _name(mangled: str) -> str:
    return mangled.replace("%", "/")


def parse_qos(text: str) -> RosQos | None:
    """Read ``<reliability>:<durability>:<history>,<depth>:...``; an empty field is the default.

    The numbers are those of ``rmw/types.h``: reliability 2 is best effort, durability 1 transient
    local, history 2 keep all.
    """
    fields = text.split(":")
    if len(fields) < _QOS_FIELDS:
        return None
    history, _, depth = fields[2].partition(",")
    numbers = [fields[0], fields[1], history, depth]
    if any(each and not _is_number(each) for each in numbers):
        return None
    return RosQos(
        reliable=fields[0] != "2",
        transient_local=fields[1] == "1",
        depth=int(depth) if depth else DEFAULT_QOS.depth,
        keep_all=history == "2",
    )


def _is_number(text: str) -> bool:
    return text.isascii() and text.isdigit() and len(text) <= _MAX_DIGITS
