"""Topics, zenoh keys and encodings.

A topic ``/standin/joint_states`` travels on the key ``standin/joint_states`` and the encoding
names its type: ``application/cdr;sensor_msgs/msg/JointState``. rmw_zenoh puts domain, type and
type hash into the key instead (``0/chatter/std_msgs::msg::dds_::String_/RIHS01_...``) and sends
no encoding; such keys are read as the topic ``/chatter``.
"""

import re
from functools import lru_cache
from typing import NamedTuple

from bridge.wire.errors import BadTopicError

_ROS_KEY = re.compile(
    r"^\d+/(?P<topic>.+)/(?P<type>[^/]+)/(?P<hash>RIHS01_[0-9a-f]{64}|TypeHashNotSupported)$"
)
_FORBIDDEN = re.compile(r"[*$?#]")
_BYTES = "zenoh/bytes"
"""What zenoh itself says of a message without an encoding."""
_ENCODINGS = {
    f"application/{name}": name
    for name in ("cdr", "json", "protobuf", "cbor", "msgpack", "flatbuffer", "ros1")
}
"""MCAP's message encodings, by the zenoh encoding that stands for each."""
_SYNONYMS = {"text/json": "json", "application/x-protobuf": "protobuf"}
NO_HASH = "TypeHashNotSupported"
"""What ROS 2 Humble writes where later releases write a hash."""


class NamedKey(NamedTuple):
    """What a zenoh key says about its messages."""

    topic: str
    type_name: str
    """ROS type; "" for a key that does not carry one."""
    type_hash: str
    """RIHS01 hash; "" for a key that does not carry one."""


def key_from_topic(topic: str) -> str:
    """Drop the leading slash."""
    if not topic.startswith("/"):
        raise BadTopicError(topic=topic, found="it does not start with a slash")
    key = topic[1:]
    if "" in key.split("/"):
        raise BadTopicError(topic=topic, found="it has an empty part")
    if _FORBIDDEN.search(key):
        raise BadTopicError(topic=topic, found="it holds one of * $ ? #")
    if key.startswith("@"):
        raise BadTopicError(topic=topic, found="keys that start with @ belong to zenoh")
    return key


@lru_cache(maxsize=4096)
def read_key(key: str) -> NamedKey:
    """Tell the topic of a key, and type and hash when it is one of rmw_zenoh."""
    ros = _ROS_KEY.match(key)
    if ros is None:
        return NamedKey("/" + key, "", "")
    type_hash = "" if ros["hash"] == NO_HASH else ros["hash"]
    return NamedKey("/" + ros["topic"], ros_type(ros["type"]), type_hash)


def ros_type(dds_name: str) -> str:
    """Turn ``std_msgs::msg::dds_::String_`` into ``std_msgs/msg/String``."""
    parts = [part for part in dds_name.split("::") if part != "dds_"]
    return "/".join(parts).removesuffix("_")


def encoding_of(type_name: str, message_encoding: str) -> str:
    """Name a type in a zenoh encoding."""
    kind = f"application/{message_encoding}"
    if kind not in _ENCODINGS:
        kind = _BYTES
    return f"{kind};{type_name}" if type_name else kind


@lru_cache(maxsize=4096)
def parse_encoding(encoding: str) -> tuple[str, str]:
    """Split a zenoh encoding into (type name, MCAP message encoding); "" where unknown."""
    kind, _, type_name = encoding.partition(";")
    return type_name, _ENCODINGS.get(kind) or _SYNONYMS.get(kind, "")
