"""ROS 2 CDR (XCDR1; written little endian, read in both orders) of ``ros2_definitions``.

Messages are plain dicts. ``uint8[]`` is a memoryview; numeric arrays are NumPy arrays; times are
dicts.
Layout: OMG DDS-XTypes 1.3, section 7.4.3: every primitive is aligned to its size, counted from
the end of the 4-byte encapsulation header.
"""

import re
import struct
from collections.abc import Mapping
from functools import cache, lru_cache
from typing import Any, NamedTuple

import numpy as np

from bridge.clock import NS_PER_S
from bridge.episode.schema import DEFINITIONS, full_name
from bridge.errors import BridgeError

PRIMITIVES = {
    "bool": "?",
    "int8": "b",
    "uint8": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}
ORIGIN = 4
"""Length of the encapsulation header; alignment counts from its end."""

Buffer = bytes | bytearray | memoryview
Message = dict[str, Any]


class Field(NamedTuple):
    """One field of a message."""

    name: str
    type_name: str
    length: int | None
    """None: one value; 0: sequence; n: fixed array of n."""


@cache
def fields_of(type_name: str) -> tuple[Field, ...]:
    """Return the fields of a type; KeyError for one that is not in ``ros2_definitions``."""
    fields = []
    for line in DEFINITIONS[type_name].splitlines():
        type_text, name = line.split()
        base, _, array = type_text.partition("[")
        count = None if not array else int(array[:-1] or 0)
        if "/" in base:
            base = full_name(base)
        fields.append(Field(name, base, count))
    return tuple(fields)


_LAYOUTS = {order + code: struct.Struct(order + code) for order in "<>" for code in "?bBhHiIqQfd"}


def _read(type_name: str, data: memoryview, at: int, order: str) -> tuple[Message, int]:
    """Read a message at a position; returns the position behind it."""
    message: Message = {}
    for field in fields_of(type_name):
        name, kind, length = field
        if length is None:
            message[name], at = _read_value(kind, data, at, order)
        elif kind in PRIMITIVES:
            message[name], at = _read_array(field, data, at, order)
        else:
            if not length:
                length, at = _count(data, at, order, _least_bytes(kind))
            message[name] = items = []
            for _ in range(length):
                item, at = _read_value(kind, data, at, order)
                items.append(item)
    return message, at


def _read_value(kind: str, data: memoryview, at: int, order: str) -> tuple[Any, int]:
    code = PRIMITIVES.get(kind)
    if code is not None:
        layout = _LAYOUTS[order + code]
        at += (ORIGIN - at) % layout.size
        return layout.unpack_from(data, at)[0], at + layout.size
    if kind == "string":
        length, at = _count(data, at, order, 1)
        return str(data[at : at + length], "utf-8").rstrip("\0"), at + length
    return _read(kind, data, at, order)


def _read_array(field: Field, data: memoryview, at: int, order: str) -> tuple[Any, int]:
    code, length = PRIMITIVES[field.type_name], field.length or 0
    size = _LAYOUTS[order + code].size
    if not length:
        length, at = _count(data, at, order, size)
    if length:  # an empty sequence is not padded
        at += (ORIGIN - at) % size
    end = at + length * size
    if end > len(data):
        raise ValueError(f"array of {length} x {field.type_name} runs past the end")
    if code == "B":
        return data[at:end], end
    return np.frombuffer(data[at:end], order + code), end


def _count(data: memoryview, at: int, order: str, item_bytes: int) -> tuple[int, int]:
    """Read a sequence's length, refusing one that cannot fit into the rest of the message."""
    at += -at % 4
    (length,) = _LAYOUTS[order + "I"].unpack_from(data, at)
    if length * item_bytes > len(data) - at - 4:
        raise ValueError(f"{length} items of {item_bytes} bytes or more run past the end")
    return length, at + 4


@cache
def _least_bytes(type_name: str) -> int:
    """The fewest bytes one value can take, padding left out: no count can promise more."""
    if type_name == "string":
        return 4
    if type_name in PRIMITIVES:
        return struct.calcsize("<" + PRIMITIVES[type_name])
    return sum(
        4 if field.length == 0 else _least_bytes(field.type_name) * (field.length or 1)
        for field in fields_of(type_name)
    )


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
    out = bytearray()
    _write(out, type_name, message)
    return ENCAPSULATION_LE + bytes(out)


def _align(out: bytearray, size: int) -> None:
    out.extend(b"\0" * (-len(out) % size))


def _write(out: bytearray, type_name: str, message: Mapping[str, Any]) -> None:
    for field in fields_of(type_name):
        value = message.get(field.name)
        if field.length is None:
            _write_value(out, field.type_name, value)
        elif field.type_name in PRIMITIVES:
            _write_array(out, field, value)
        else:
            items = [] if value is None else value
            _align(out, 4)
            out.extend(struct.pack("<I", len(items)))
            for item in items:
                _write_value(out, field.type_name, item)


def _write_array(out: bytearray, field: Field, value: Any) -> None:
    code = PRIMITIVES[field.type_name]
    if isinstance(value, bytes | bytearray | memoryview):
        raw, length = bytes(value), len(value)
    else:
        array = np.asarray([0] * (field.length or 0) if value is None else value)
        raw, length = array.astype("<" + code).tobytes(), array.size
    if field.length:
        if length != field.length:
            raise ValueError(f"{field.name} needs {field.length} values, got {length}")
    else:
        _align(out, 4)
        out.extend(struct.pack("<I", length))
    if length:
        _align(out, struct.calcsize(code))
        out.extend(raw)


def _write_value(out: bytearray, type_name: str, value: Any) -> None:
    if type_name == "string":
        raw = (value or "").encode() + b"\0"
        _align(out, 4)
        out.extend(struct.pack("<I", len(raw)))
        out.extend(raw)
    elif type_name in PRIMITIVES:
        code = PRIMITIVES[type_name]
        _align(out, struct.calcsize(code))
        out.extend(struct.pack("<" + code, 0 if value is None else value))
    else:
        _write(out, type_name, value or {})


def decode(type_name: str, data: Buffer) -> Message:
    """Read a message into dicts; bytes behind its last field are passed over.

    Arrays look into ``data``, in its byte order, and are not copied. What is made is never larger
    than a fixed multiple of ``data``, whatever lengths it claims.

    Raises:
        KeyError: When the type is none of ``ros2_definitions``.
    """
    order = _byte_order(type_name, data)
    try:
        return _read(type_name, memoryview(data), ORIGIN, order)[0]
    except (struct.error, ValueError) as error:
        raise MalformedMessageError(type_name=type_name, found=str(error)) from error


def _byte_order(type_name: str, data: Buffer) -> str:
    refuse_other_cdr(type_name, data)
    if len(data) < ORIGIN or data[1] not in (0, 1):
        found = f"{len(data)} bytes without a CDR encapsulation header"
        raise MalformedMessageError(type_name=type_name, found=found)
    return "<" if data[1] == 1 else ">"


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
