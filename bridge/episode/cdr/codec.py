"""ROS 2 CDR (XCDR1; written little endian, read in both orders) of ``ros2_definitions``.

Messages are plain dicts. ``uint8[]`` is a memoryview; numeric arrays are NumPy arrays; times are
dicts.
Layout: OMG DDS-XTypes 1.3, section 7.4.3: every primitive is aligned to its size, counted from
the end of the 4-byte encapsulation header.
"""

import re
import struct
from collections.abc import Callable, Iterator, Mapping
from functools import cache, lru_cache
from typing import Any, NamedTuple

import numpy as np

from bridge.clock import NS_PER_S
from bridge.episode.schema import DEFINITIONS, full_name
from bridge.errors import BridgeError

# A plan is a chain of small functions. Neighbouring fields of fixed size are read by one
# ``struct`` call; as padding depends on where such a run begins, there is one layout for each of
# the eight positions modulo 8. Positions count from the start of the message, 4 bytes before the
# origin that CDR aligns to.

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
ReadPart = Callable[[Buffer, int, Message], int]
"""Reads one part of a message from a position into the dict; returns the position behind it."""
Shape = tuple[tuple[str, Any], ...]
"""Names of a run of fixed-size fields; a nested message has a shape of its own, others None."""


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


@cache
def reader_of(type_name: str, order: str) -> tuple[ReadPart, ...]:
    """Return the functions that read a message of this type; ``order`` is ``<`` or ``>``."""
    parts: list[ReadPart] = []
    for run, field in _runs(type_name):
        if run is not None:
            parts.append(_read_run(*run, order))
        if field is not None:
            parts.append(_read_field(field, order))
    return tuple(parts)


@cache
def _fixed(type_name: str) -> tuple[Shape | None, str] | None:
    """Shape and struct codes of a type without strings and arrays, else None."""
    if type_name in PRIMITIVES:
        return None, PRIMITIVES[type_name]
    if type_name == "string":
        return None
    shape, codes = [], ""
    for field in fields_of(type_name):
        inner = _fixed(field.type_name) if field.length is None else None
        if inner is None:
            return None
        shape.append((field.name, inner[0]))
        codes += inner[1]
    return tuple(shape), codes


def _runs(type_name: str) -> Iterator[tuple[tuple[Shape, str] | None, Field | None]]:
    """Split a type into runs of fixed-size fields and the field that ends each."""
    shape: list[tuple[str, Any]] = []
    codes = ""
    for field in fields_of(type_name):
        fixed = _fixed(field.type_name) if field.length is None else None
        if fixed is None:
            yield (tuple(shape), codes) if shape else None, field
            shape, codes = [], ""
        else:
            shape.append((field.name, fixed[0]))
            codes += fixed[1]
    if shape:
        yield (tuple(shape), codes), None


def _layouts(codes: str, order: str) -> tuple[struct.Struct, ...]:
    """The run's layout for each start position modulo 8, padding in front included."""
    layouts = []
    for start in range(8):
        at, text = (start - ORIGIN) % 8, order
        for code in codes:
            size = struct.calcsize("<" + code)
            padding = -at % size
            text += "x" * padding + code
            at += padding + size
        layouts.append(struct.Struct(text))
    return tuple(layouts)


def _read_run(shape: Shape, codes: str, order: str) -> ReadPart:
    layouts = _layouts(codes, order)
    names = tuple(name for name, _ in shape)

    def read_flat(data: Buffer, at: int, out: Message) -> int:
        layout = layouts[at & 7]
        out.update(zip(names, layout.unpack_from(data, at), strict=True))
        return at + layout.size

    def read_nested(data: Buffer, at: int, out: Message) -> int:
        layout = layouts[at & 7]
        _nest(shape, iter(layout.unpack_from(data, at)), out)
        return at + layout.size

    return read_flat if all(inner is None for _, inner in shape) else read_nested


def _nest(shape: Shape, values: Iterator[Any], out: Message) -> None:
    for name, inner in shape:
        if inner is None:
            out[name] = next(values)
        else:
            nested: Message = {}
            out[name] = nested
            _nest(inner, values, nested)


def _counter(order: str, *, item_bytes: int = 1) -> Callable[[Buffer, int], tuple[int, int]]:
    """Reads a sequence's length, refusing one that cannot fit into the rest of the message."""
    unpack = struct.Struct(order + "I").unpack_from

    def count(data: Buffer, at: int) -> tuple[int, int]:
        at += -at & 3
        (length,) = unpack(data, at)
        at += 4
        if length * item_bytes > len(data) - at:
            raise ValueError(f"{length} items of {item_bytes} bytes or more run past the end")
        return length, at

    return count


def _text(order: str) -> Callable[[Buffer, int], tuple[str, int]]:
    unpack = struct.Struct(order + "I").unpack_from

    def text(data: Buffer, at: int) -> tuple[str, int]:
        at += -at & 3
        end = at + 4 + unpack(data, at)[0]
        if end > len(data):
            raise ValueError(f"string of {end - at - 4} bytes runs past the end")
        return str(data[at + 4 : end], "utf-8").rstrip("\0"), end

    return text


def _read_field(field: Field, order: str) -> ReadPart:
    name = field.name
    if field.length is not None and field.type_name in PRIMITIVES:
        return _read_array(field, order)
    if field.length is not None:
        return _read_sequence(field, order)
    if field.type_name == "string":
        text = _text(order)

        def read_text(data: Buffer, at: int, out: Message) -> int:
            out[name], at = text(data, at)
            return at

        return read_text
    parts = reader_of(field.type_name, order)

    def read_message(data: Buffer, at: int, out: Message) -> int:
        inner: Message = {}
        out[name] = inner
        for part in parts:
            at = part(data, at, inner)
        return at

    return read_message


def _extent(field: Field, order: str) -> Callable[[Buffer, int], tuple[int, int]]:
    """Where an array of primitives begins and how many values it has."""
    size = struct.calcsize("<" + PRIMITIVES[field.type_name])
    fixed, mask = field.length, size - 1
    count = _counter(order, item_bytes=size)

    def extent(data: Buffer, at: int) -> tuple[int, int]:
        if fixed:
            length = fixed
        else:
            length, at = count(data, at)
            if not length:  # an empty sequence is not padded
                return at, 0
        at += (ORIGIN - at) & mask
        if at + length * size > len(data):
            raise ValueError(f"array of {length} x {field.type_name} runs past the end")
        return at, length

    return extent


def _read_array(field: Field, order: str) -> ReadPart:
    name, extent = field.name, _extent(field, order)
    dtype = np.dtype(order + PRIMITIVES[field.type_name])
    size = dtype.itemsize
    nothing = np.frombuffer(b"", dtype)

    def read_bytes(data: Buffer, at: int, out: Message) -> int:
        at, length = extent(data, at)
        out[name] = data[at : at + length]
        return at + length

    def read_array(data: Buffer, at: int, out: Message) -> int:
        at, length = extent(data, at)
        out[name] = np.frombuffer(data, dtype, length, at) if length else nothing
        return at + length * size

    return read_bytes if field.type_name == "uint8" else read_array


def _read_sequence(field: Field, order: str) -> ReadPart:
    name, fixed = field.name, field.length
    count = _counter(order, item_bytes=_least_bytes(field.type_name))
    if field.type_name == "string":
        text = _text(order)

        def read_texts(data: Buffer, at: int, out: Message) -> int:
            length, at = (fixed, at) if fixed else count(data, at)
            out[name] = texts = []
            for _ in range(length):
                item, at = text(data, at)
                texts.append(item)
            return at

        return read_texts
    parts = reader_of(field.type_name, order)

    def read_messages(data: Buffer, at: int, out: Message) -> int:
        length, at = (fixed, at) if fixed else count(data, at)
        out[name] = items = []
        for _ in range(length):
            item: Message = {}
            for part in parts:
                at = part(data, at, item)
            items.append(item)
        return at

    return read_messages


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
    message: Message = {}
    at, view = ORIGIN, memoryview(data)
    try:
        for part in reader_of(type_name, order):
            at = part(view, at, message)
    except (struct.error, ValueError) as error:
        raise MalformedMessageError(type_name=type_name, found=str(error)) from error
    return message


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
