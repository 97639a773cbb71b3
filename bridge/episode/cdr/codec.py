"""ROS 2 CDR (XCDR1; written little endian, read in both orders) of the types this project knows.

The layout is the business of rosbags; here its messages are plain dicts. ``uint8[]`` is a
memoryview; numeric arrays are NumPy arrays; times are dicts.
"""

import re
import struct
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np
from rosbags.serde import SerdeError

from bridge.clock import NS_PER_S
from bridge.episode.schema import ROS_TYPES, ros_types
from bridge.errors import BridgeError

ORIGIN = 4
"""Length of the encapsulation header; alignment counts from its end."""

Buffer = bytes | bytearray | memoryview
Message = dict[str, Any]

OTHER_CDR = {2: "a parameter list (PL_CDR)", 3: "a parameter list (PL_CDR)"} | dict.fromkeys(
    range(6, 12), "CDR version 2"
)
"""Encapsulations of XTypes that ROS does not use, by the second byte."""
ENCAPSULATION_LE = b"\x00\x01\x00\x00"


class MalformedMessageError(BridgeError):
    """The bytes are not a CDR message of the stated type."""

    def __init__(
        self,
        *,
        type_name: str,
        found: str,
        hint: str = "The publisher sends another type or broken CDR.",
    ) -> None:
        """Remember the type that was expected."""
        self.type_name = type_name
        super().__init__(f"not a valid {type_name}: {found}. {hint}")


def encode(type_name: str, message: Mapping[str, Any]) -> bytes:
    """Serialise a message; fields left out take their ROS default (0, empty)."""
    made = _made(type_name, message)
    return bytes(ros_types().serialize_cdr(made, type_name, little_endian=True))


def _made(type_name: str, message: Mapping[str, Any]) -> Any:
    store = ros_types()
    fields = store.fielddefs[type_name][1]
    return store.types[type_name](*(_value(field, message.get(name)) for name, field in fields))


def _value(field: tuple[int, Any], value: Any) -> Any:
    """What rosbags takes for a field: of one type, or an array (of some length) or sequence."""
    kind, about = field
    if kind == _NAME:
        return _made(about, value or {})
    if kind == _BASE:
        return value if value is not None else "" if about[0] == "string" else 0
    (kind, about), length = about
    if kind == _NAME:
        return [_made(about, item) for item in value or ()]
    if about[0] == "string":
        return list(value or ())
    if isinstance(value, Buffer):
        return np.frombuffer(value, about[0])
    return np.asarray([0] * length if value is None else value, about[0])


_BASE, _NAME = 1, 2
"""Kinds of fields as rosbags numbers them."""


def decode(type_name: str, data: Buffer) -> Message:
    """Read a message into dicts; bytes behind its last field are passed over.

    Arrays look into ``data`` and are not copied. What is made is never larger than a fixed multiple
    of ``data``, whatever lengths it claims.

    Raises:
        KeyError: When the type is none of ``ROS_TYPES``.
    """
    if type_name not in ROS_TYPES:
        raise KeyError(type_name)
    refuse_other_cdr(type_name, data)
    if len(data) < ORIGIN or data[1] not in (0, 1):
        found = f"{len(data)} bytes without a CDR encapsulation header"
        raise MalformedMessageError(type_name=type_name, found=found)
    store = ros_types()
    known = store.get_msgdef(type_name)
    read = known.deserialize_cdr_le if data[1] else known.deserialize_cdr_be
    try:
        message, _ = read(memoryview(data)[ORIGIN:], 0, known.cls, store)
    except (SerdeError, struct.error, ValueError) as error:
        raise MalformedMessageError(type_name=type_name, found=str(error)) from error
    plain: Message = _plain(message)
    return plain


def _plain(value: Any) -> Any:
    if hasattr(value, "__msgtype__"):
        fields = ros_types().fielddefs[value.__msgtype__][1]
        return {name: _plain(getattr(value, name)) for name, _ in fields}
    if isinstance(value, list):
        return [_plain(item) for item in value]
    if isinstance(value, np.ndarray) and value.dtype == np.uint8:
        return value.data
    return value


def refuse_other_cdr(type_name: str, data: Buffer) -> None:
    """Name an encapsulation of XTypes that is not ROS's; any other bytes pass."""
    if len(data) >= ORIGIN and not data[0] and data[1] in OTHER_CDR:
        found = f"{OTHER_CDR[data[1]]} (header 00 {data[1]:02x}) cannot be read"
        hint = "Have the publisher send plain CDR of version 1."
        raise MalformedMessageError(type_name=type_name, found=found, hint=hint)


_FIRST_IS_HEADER = re.compile(rb"(?:\s*(?:#[^\n]*)?\n)*\s*std_msgs/(?:msg/)?Header\s+header\b")
_STAMPS = {"<": struct.Struct("<iI"), ">": struct.Struct(">iI")}


@lru_cache(maxsize=1024)
def begins_with_header(definition: bytes) -> bool:
    """Say whether the first field of a ``ros2msg`` definition is a header."""
    return _FIRST_IS_HEADER.match(definition) is not None


def header_stamp(data: Buffer) -> tuple[int, int] | None:
    """Read seconds and nanoseconds of the header a message begins with; None for no time."""
    if len(data) < ORIGIN + 8 or data[1] not in (0, 1):
        return None
    sec, nanosec = _STAMPS["<" if data[1] else ">"].unpack_from(data, ORIGIN)
    return None if sec < 0 or nanosec >= NS_PER_S else (sec, nanosec)


def with_header_stamp(data: Buffer, sec: int, nanosec: int) -> bytes:
    """Put another time into the header a message begins with."""
    out = bytearray(data)
    _STAMPS["<" if data[1] else ">"].pack_into(out, ORIGIN, sec, nanosec)
    return bytes(out)
