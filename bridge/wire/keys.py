"""Topics, zenoh keys and encodings.

A topic ``/standin/joint_states`` travels on the key ``standin/joint_states`` and the encoding
names its type: ``application/cdr;sensor_msgs/msg/JointState``. rmw_zenoh puts domain, type and
type hash into the key instead (``0/chatter/std_msgs::msg::dds_::String_/RIHS01_...``) and sends
no encoding; such keys are read as the topic ``/chatter``.
"""

import re

from bridge.wire.errors import BadTopicError

_ROS_KEY = re.compile(
    r"^\d+/(?P<topic>.+)/(?P<type>[^/]+)/(RIHS01_[0-9a-f]{64}|TypeHashNotSupported)$"
)
_FORBIDDEN = re.compile(r"[*$?#]")
_CDR, _JSON = "application/cdr", "application/json"
_ENCODINGS = {_CDR: "cdr", _JSON: "json"}


def key_from_topic(topic: str) -> str:
    """Drop the leading slash.

    Raises:
        BadTopicError: When the name cannot be a zenoh key.
    """
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


def topic_from_key(key: str) -> tuple[str, str]:
    """Return the topic of a key, and the ROS type name when the key carries one (else "")."""
    ros = _ROS_KEY.match(key)
    if ros is None:
        return "/" + key, ""
    return "/" + ros["topic"], _ros_type(ros["type"])


def _ros_type(dds_name: str) -> str:
    """Turn ``std_msgs::msg::dds_::String_`` into ``std_msgs/msg/String``."""
    parts = [part for part in dds_name.split("::") if part != "dds_"]
    return "/".join(parts).removesuffix("_")


def encoding_of(type_name: str, message_encoding: str) -> str:
    """Name a type in a zenoh encoding."""
    kind = next((k for k, name in _ENCODINGS.items() if name == message_encoding), _CDR)
    return f"{kind};{type_name}" if type_name else kind


def parse_encoding(encoding: str) -> tuple[str, str]:
    """Split a zenoh encoding into (type name, MCAP message encoding); "" where unknown."""
    kind, _, type_name = encoding.partition(";")
    return type_name, _ENCODINGS.get(kind, "")
