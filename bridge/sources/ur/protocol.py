"""Packages of the Real-Time Data Exchange, as the vendor's public guide describes them.

All numbers are big endian. A package is its size (uint16, header included), its kind (uint8) and
a payload. Version 2 of the protocol puts the number of the recipe before the data.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum

from bridge.sources.ur.gripper import Value

PROTOCOL_VERSION = 2
HEADER = struct.Struct(">HB")
NOT_FOUND = "NOT_FOUND"


class Kind(IntEnum):
    """Kinds of packages; the code of each is a letter."""

    REQUEST_PROTOCOL_VERSION = ord("V")
    GET_CONTROL_VERSION = ord("v")
    TEXT_MESSAGE = ord("M")
    DATA = ord("U")
    SETUP_OUTPUTS = ord("O")
    START = ord("S")
    PAUSE = ord("P")


_KINDS = frozenset(Kind)
_FORMATS: dict[str, str] = {
    "BOOL": "?",
    "UINT8": "B",
    "UINT32": "I",
    "UINT64": "Q",
    "INT32": "i",
    "DOUBLE": "d",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
    "VECTOR6UINT32": "6I",
}


class BrokenPackageError(ValueError):
    """Bytes that are no RTDE package; says what was found."""


@dataclass(frozen=True, kw_only=True)
class Package:
    """One package without its size."""

    kind: int
    payload: bytes


def encode_package(kind: int, payload: bytes = b"") -> bytes:
    """Put the header before a payload."""
    return HEADER.pack(HEADER.size + len(payload), kind) + payload


class PackageSplitter:
    """Cuts a stream of bytes into packages; a package is at most 65535 bytes long."""

    def __init__(self) -> None:
        """Start at a package's first byte."""
        self._buffer = bytearray()

    def feed(self, data: bytes) -> Iterator[Package]:
        """Add bytes and yield every package that is complete.

        Raises:
            BrokenPackageError: When a size or a kind cannot be RTDE's.
        """
        self._buffer += data
        while len(self._buffer) >= HEADER.size:
            size, kind = HEADER.unpack_from(self._buffer)
            if size < HEADER.size or kind not in _KINDS:
                message = f"it sent {bytes(self._buffer[:16])!r}"
                raise BrokenPackageError(message)
            if len(self._buffer) < size:
                return
            package = Package(kind=kind, payload=bytes(self._buffer[HEADER.size : size]))
            del self._buffer[:size]
            yield package


class Recipe:
    """The layout of the data packages: which variables in which order."""

    def __init__(self, names: tuple[str, ...], types: tuple[str, ...], number: int) -> None:
        """Prepare for unpacking.

        Raises:
            BrokenPackageError: When a type is not one of the guide's.
        """
        unknown = sorted(set(types) - set(_FORMATS))
        if unknown or len(names) != len(types):
            message = f"{len(names)} variables were answered with the types {', '.join(types)}"
            raise BrokenPackageError(message)
        self.number = number
        self._slices: list[tuple[str, int, int]] = []
        at = 0
        for name, type_name in zip(names, types, strict=True):
            count = int(_FORMATS[type_name][:-1] or 1)
            self._slices.append((name, at, count))
            at += count
        self._layout = struct.Struct(">B" + "".join(_FORMATS[name] for name in types))

    def unpack(self, payload: bytes) -> dict[str, Value]:
        """Read one data package.

        Raises:
            BrokenPackageError: When it has another length or another recipe's number.
        """
        if len(payload) != self._layout.size:
            message = f"a data package of {len(payload)} bytes, expected {self._layout.size}"
            raise BrokenPackageError(message)
        number, *values = self._layout.unpack(payload)
        if number != self.number:
            message = f"a data package of recipe {number}, expected {self.number}"
            raise BrokenPackageError(message)
        return {
            name: values[at] if count == 1 else tuple(values[at : at + count])
            for name, at, count in self._slices
        }


def text_of(payload: bytes) -> str:
    """Read a text message: the message and who sent it, each with its length before it."""
    length = payload[0] if payload else 0
    message = payload[1 : 1 + length].decode(errors="replace")
    rest = payload[1 + length :]
    source = rest[1 : 1 + rest[0]].decode(errors="replace") if rest else ""
    return f"{source}: {message}" if source else message
