"""ROS 2 CDR (XCDR1, little endian) for the messages of ``ros2_definitions``.

Messages are plain dicts. ``uint8[]`` is bytes; numeric arrays are NumPy arrays; times are dicts.
Layout: OMG DDS-XTypes 1.3, section 7.4.3: every primitive is aligned to its size, counted from
the end of the 4-byte encapsulation header.
"""

import struct
from collections.abc import Mapping
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from bridge.episode.ros2_definitions import DEFINITIONS, full_name
from bridge.errors import BridgeError

ENCAPSULATION_LE = b"\x00\x01\x00\x00"
_PRIMITIVES = {
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

Message = dict[str, Any]


class MalformedMessageError(BridgeError):
    """The bytes are not a CDR message of the stated type."""

    def __init__(self, *, type_name: str, found: str) -> None:
        """Remember the type that was expected."""
        self.type_name = type_name
        super().__init__(
            f"not a valid {type_name}: {found}. The publisher sends another type or broken CDR."
        )


class _Field(NamedTuple):
    name: str
    type_name: str
    length: int | None  # None: one value; 0: sequence; n: fixed array of n


@cache
def _fields(type_name: str) -> tuple[_Field, ...]:
    fields = []
    for line in DEFINITIONS[type_name].splitlines():
        type_text, name = line.split()
        base, _, array = type_text.partition("[")
        count = None if not array else int(array[:-1] or 0)
        if "/" in base:
            base = full_name(base)
        fields.append(_Field(name, base, count))
    return tuple(fields)


def encode(type_name: str, message: Mapping[str, Any]) -> bytes:
    """Serialise a message; fields left out take their ROS default (0, empty)."""
    out = bytearray()
    _write(out, type_name, message)
    return ENCAPSULATION_LE + bytes(out)


def _align(out: bytearray, size: int) -> None:
    out.extend(b"\0" * (-len(out) % size))


def _write(out: bytearray, type_name: str, message: Mapping[str, Any]) -> None:
    for field in _fields(type_name):
        value = message.get(field.name)
        if field.length is None:
            _write_value(out, field.type_name, value)
        elif field.type_name in _PRIMITIVES:
            _write_array(out, field, value)
        else:
            items = [] if value is None else value
            _align(out, 4)
            out.extend(struct.pack("<I", len(items)))
            for item in items:
                _write_value(out, field.type_name, item)


def _write_array(out: bytearray, field: _Field, value: Any) -> None:
    code = _PRIMITIVES[field.type_name]
    if isinstance(value, bytes | bytearray | memoryview):
        raw, length = bytes(value), len(value)
    else:
        array = np.asarray([0] * (field.length or 0) if value is None else value)
        raw, length = array.astype("<" + code).tobytes(), array.size
    if field.length:
        if length != field.length:
            message = f"{field.name} needs {field.length} values, got {length}"
            raise ValueError(message)
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
    elif type_name in _PRIMITIVES:
        code = _PRIMITIVES[type_name]
        _align(out, struct.calcsize(code))
        out.extend(struct.pack("<" + code, value or 0))
    else:
        _write(out, type_name, value or {})


def decode(type_name: str, data: bytes) -> Message:
    """Read a message; raises ``MalformedMessageError`` when the bytes do not fit the type."""
    if len(data) < 4 or data[1] not in (0, 1):
        found = f"{len(data)} bytes without a CDR encapsulation header"
        raise MalformedMessageError(type_name=type_name, found=found)
    reader = _Reader(memoryview(data)[4:], "<" if data[1] == 1 else ">")
    try:
        return reader.message(type_name)
    except (struct.error, ValueError, UnicodeDecodeError) as error:
        raise MalformedMessageError(type_name=type_name, found=str(error)) from error


class _Reader:
    def __init__(self, data: memoryview, order: str) -> None:
        self.data = data
        self.order = order
        self.at = 0

    def message(self, type_name: str) -> Message:
        return {field.name: self.field(field) for field in _fields(type_name)}

    def field(self, field: _Field) -> Any:
        if field.length is None:
            return self.value(field.type_name)
        length = field.length or self.value("uint32")
        if field.type_name in _PRIMITIVES:
            return self.array(field.type_name, length)
        if length > len(self.data) - self.at:  # each item takes at least one byte
            message = f"sequence of {length} items in {len(self.data)} bytes"
            raise ValueError(message)
        return [self.value(field.type_name) for _ in range(length)]

    def array(self, type_name: str, length: int) -> Any:
        code = _PRIMITIVES[type_name]
        size = struct.calcsize(code)
        if length:
            self.at += -self.at % size
        end = self.at + length * size
        if end > len(self.data):
            message = f"array of {length} x {type_name} runs past the end"
            raise ValueError(message)
        raw = self.data[self.at : end]
        self.at = end
        if type_name == "uint8":
            return bytes(raw)
        return np.frombuffer(raw, dtype=self.order + code)

    def value(self, type_name: str) -> Any:
        if type_name == "string":
            length = self.value("uint32")
            if self.at + length > len(self.data):
                message = f"string of {length} bytes runs past the end"
                raise ValueError(message)
            raw = bytes(self.data[self.at : self.at + length])
            self.at += length
            return raw.rstrip(b"\0").decode()
        if type_name in _PRIMITIVES:
            code = _PRIMITIVES[type_name]
            self.at += -self.at % struct.calcsize(code)
            (value,) = struct.unpack_from(self.order + code, self.data, self.at)
            self.at += struct.calcsize(code)
            return value
        return self.message(type_name)
