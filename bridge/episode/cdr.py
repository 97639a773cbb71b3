"""ROS 2 CDR (XCDR1; written little endian, read in both orders) of ``ros2_definitions``.

Messages are plain dicts. ``uint8[]`` is bytes; numeric arrays are NumPy arrays; times are dicts.
Layout: OMG DDS-XTypes 1.3, section 7.4.3: every primitive is aligned to its size, counted from
the end of the 4-byte encapsulation header.
"""

import struct
from collections.abc import Mapping
from typing import Any

import numpy as np

from bridge.episode.cdr_plan import (
    ORIGIN,
    PRIMITIVES,
    Buffer,
    Field,
    Message,
    fields_of,
    reader_of,
    walker_of,
)
from bridge.errors import BridgeError

ENCAPSULATION_LE = b"\x00\x01\x00\x00"


class MalformedMessageError(BridgeError):
    """The bytes are not a CDR message of the stated type."""

    def __init__(self, *, type_name: str, found: str) -> None:
        """Remember the type that was expected."""
        self.type_name = type_name
        super().__init__(
            f"not a valid {type_name}: {found}. The publisher sends another type or broken CDR."
        )


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
    elif type_name in PRIMITIVES:
        code = PRIMITIVES[type_name]
        _align(out, struct.calcsize(code))
        out.extend(struct.pack("<" + code, 0 if value is None else value))
    else:
        _write(out, type_name, value or {})


def decode(type_name: str, data: Buffer) -> Message:
    """Read a message into dicts; bytes behind its last field are passed over.

    Numeric arrays look into ``data``, in its byte order; nothing but ``uint8[]`` is copied. What
    is made is never larger than a fixed multiple of ``data``, whatever lengths it claims.

    Raises:
        MalformedMessageError: When the bytes do not fit the type.
        KeyError: When the type is none of ``ros2_definitions``.
    """
    order = _byte_order(type_name, data)
    message: Message = {}
    at = ORIGIN
    try:
        for part in reader_of(type_name, order):
            at = part(data, at, message)
    except (struct.error, ValueError) as error:
        raise MalformedMessageError(type_name=type_name, found=str(error)) from error
    return message


def validate(type_name: str, data: Buffer) -> None:
    """Walk over a message without copying its arrays; accepts exactly what ``decode`` reads.

    Raises:
        MalformedMessageError: When the bytes do not fit the type.
        KeyError: When the type is none of ``ros2_definitions``.
    """
    order = _byte_order(type_name, data)
    at = ORIGIN
    try:
        for part in walker_of(type_name, order):
            at = part(data, at)
    except (struct.error, ValueError) as error:
        raise MalformedMessageError(type_name=type_name, found=str(error)) from error


def _byte_order(type_name: str, data: Buffer) -> str:
    if len(data) < ORIGIN or data[1] not in (0, 1):
        found = f"{len(data)} bytes without a CDR encapsulation header"
        raise MalformedMessageError(type_name=type_name, found=found)
    return "<" if data[1] == 1 else ">"
