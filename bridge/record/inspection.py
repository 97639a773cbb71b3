"""Looks whether a message is what its type says. Recording never depends on the answer.

Only what is cheap is looked at: the structure of the message, an image's size against its bytes,
the first and last bytes of a JPEG. ``robot-gst check`` decodes everything afterwards.
"""

import json
from collections.abc import Callable
from enum import StrEnum
from functools import lru_cache

from bridge.clock import join_ns
from bridge.episode import schema
from bridge.episode.cdr import codec
from bridge.episode.cdr.images import check_image, image_header
from bridge.episode.cdr.messages import CameraInfo
from bridge.episode.topics import type_of_topic

_JPEG_START, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
IMAGE_STARTS = (_JPEG_START, b"\x89P", b"RI", b"II", b"MM", b"BM")
"""Of JPEG, PNG, WebP, TIFF and BMP."""
_TAIL_BYTES = 64
"""Cameras may pad a JPEG behind its end mark."""


class MessageState(StrEnum):
    """What is known about one message."""

    GOOD = "good"
    UNDECODABLE = "undecodable"
    NEWER_VERSION = "newer_version"
    UNKNOWN_TYPE = "unknown_type"


GOOD = MessageState.GOOD


def resolve_type(topic: str, type_name: str) -> str:
    """Trust the publisher's type name; without one, go by the topic."""
    return type_name or type_of_topic(topic) or ""


@lru_cache(maxsize=4096)
def inspector(type_name: str, encoding: str, topic: str = "") -> Callable[[bytes], MessageState]:
    """Return the check for the messages of one type; of topics of the contract it asks more."""
    known = schema.schema_for(type_name) if type_name else None
    if known is None:
        return lambda data: MessageState.UNKNOWN_TYPE
    if encoding not in ("", known.message_encoding):
        return lambda data: MessageState.UNDECODABLE
    if known.message_encoding == "cdr":
        return lambda data: _inspect_cdr(topic, type_name, data)
    version = int(json.loads(known.data).get("version", 1))
    return lambda data: _inspect_json(version, data)


def stamp_reader(record: schema.Schema | None) -> Callable[[bytes], int | None] | None:
    """Return what reads the time in a message itself, or None for types without one.

    For messages that came without an attachment: ``header.stamp`` of a ROS 2 type.
    """
    if record is not None and record.schema_encoding == "ros2msg":
        return _header_stamp_ns if codec.begins_with_header(record.data) else None
    return None


def _header_stamp_ns(data: bytes) -> int | None:
    """A stamp of 0 was never set."""
    stamp = codec.header_stamp(data)
    return None if stamp is None else join_ns(*stamp) or None


def _read(topic: str, type_name: str, data: bytes) -> codec.Message:
    if type_name == schema.IMAGE:
        check_image(topic, image_header(data))
        return {}
    if type_name == schema.CAMERA_INFO and type_of_topic(topic):
        CameraInfo.from_cdr(data)
    return codec.decode(type_name, data)


def _inspect_cdr(topic: str, type_name: str, data: bytes) -> MessageState:
    try:
        message = _read(topic, type_name, data)
    except codec.MalformedMessageError:
        return MessageState.UNDECODABLE
    if type_name == schema.COMPRESSED_IMAGE:
        image = message["data"]
        is_cut = image[:2] == _JPEG_START and _JPEG_END not in bytes(image[-_TAIL_BYTES:])
        is_known = image[:2] in IMAGE_STARTS or "compressedDepth" in message["format"]
        return GOOD if is_known and not is_cut else MessageState.UNDECODABLE
    return GOOD


def why_unreadable(topic: str, type_name: str, data: bytes) -> str:
    """Say what is wrong with a message that was found undecodable."""
    try:
        if type_name in schema.ROS_TYPES:
            _read(topic, type_name, data)
    except codec.MalformedMessageError as error:
        return str(error)
    return f"not what {type_name} says"


def _inspect_json(newest: int, data: bytes) -> MessageState:
    try:
        record = json.loads(data)
    except (ValueError, RecursionError):
        return MessageState.UNDECODABLE
    version = record.get("schema_version", 1) if isinstance(record, dict) else None
    if not isinstance(version, int):
        return MessageState.UNDECODABLE
    return MessageState.NEWER_VERSION if version > newest else GOOD
