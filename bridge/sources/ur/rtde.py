"""Reads a UR controller over RTDE: every package, in order, with the controller's own time.

All numbers are big endian. A package is its size (uint16, header included), its kind (uint8) and a
payload. Version 2 of the protocol puts the number of the recipe before the data.
"""

import contextlib
import socket
import struct
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import IntEnum

from bridge.sources.ur.config import ControllerError, NotRtdeError, Value

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
        """Add bytes and yield every package that is complete."""
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
        """Prepare for unpacking."""
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
        """Read one data package."""
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


CONNECT_S = 3.0
AGREE_S = 5.0
"""Everything before the first sample, however slowly the answers drip in."""
SILENT_S = 2.0
"""A controller that says nothing for so long is taken for gone."""
RECEIVE_BYTES = 65_536


class RtdeLink:
    """One connection; it never waits longer than the limits above."""

    def __init__(self, host: str, port: int, *, on_text: Callable[[str], None]) -> None:
        """Connect."""
        self.where = f"{host}:{port}"
        self._on_text = on_text
        self._splitter = PackageSplitter()
        self._waiting: deque[Package] = deque()
        try:
            self._socket = socket.create_connection((host, port), timeout=CONNECT_S)
        except OSError as error:
            raise ControllerError(
                where=self.where,
                found=f"no UR controller answers ({error.strerror or error})",
                hint="Check the address, the cable, and that the controller has started.",
            ) from error
        self._socket.settimeout(SILENT_S)
        self._agreed_by_s = time.monotonic() + AGREE_S

    def ask(self, kind: Kind, payload: bytes = b"") -> bytes:
        """Send a request and return the payload of its answer."""
        try:
            self._socket.sendall(encode_package(kind, payload))
        except OSError as error:
            raise self._gone(error.strerror or str(error)) from error
        while True:
            while not self._waiting:
                self._receive()
                if time.monotonic() > self._agreed_by_s:
                    raise self._gone(f"no agreement on what to send within {AGREE_S:g} s")
            package = self._waiting.popleft()
            if package.kind == kind:
                return package.payload
            if package.kind != Kind.TEXT_MESSAGE:
                message = f"a package {chr(package.kind)!r} in answer to {chr(kind)!r}"
                raise BrokenPackageError(message)
            self._on_text(text_of(package.payload))

    def next_data(self) -> list[bytes]:
        """Wait for more and return the payloads of all data packages that are complete."""
        if not self._waiting:
            self._receive()
        payloads = []
        while self._waiting:
            package = self._waiting.popleft()
            if package.kind == Kind.DATA:
                payloads.append(package.payload)
            elif package.kind == Kind.TEXT_MESSAGE:
                self._on_text(text_of(package.payload))
        return payloads

    def _receive(self) -> None:
        try:
            data = self._socket.recv(RECEIVE_BYTES)
        except TimeoutError as error:
            raise self._gone(f"nothing came for {SILENT_S:g} s") from error
        except OSError as error:
            raise self._gone(error.strerror or str(error)) from error
        if not data:
            raise self._gone("it closed the connection")
        self._waiting.extend(self._splitter.feed(data))

    def _gone(self, why: str) -> ControllerError:
        return ControllerError(
            where=self.where,
            found=f"the controller is gone ({why})",
            hint="Check the cable and the controller.",
        )

    def close(self) -> None:
        """Hang up."""
        with contextlib.suppress(OSError):
            self._socket.close()


FAST_HZ, SLOW_HZ = 500.0, 125.0
FIRST_FAST_MAJOR = 5
"""Software 5 and later runs on e-Series and newer arms, whose loop has 500 Hz; CB3 has 125 Hz."""
MAX_UPTIME_S = 1e9


@dataclass(frozen=True, kw_only=True)
class Wish:
    """What a controller shall send."""

    required: tuple[str, ...]
    """RTDE variables without which nothing is gained."""
    optional: tuple[str, ...] = ()
    """Variables that older controllers may not know."""
    rate_hz: float | None = None
    """Packages per second; None: the controller's own rate."""


@dataclass(frozen=True, kw_only=True)
class Sample:
    """One data package."""

    robot_s: float
    """Seconds since the controller was started."""
    received_ns: int
    values: dict[str, Value]


class RtdeClient:
    """A controller that has agreed to send; read its ``samples``, then ``close``."""

    def __init__(
        self,
        host: str,
        port: int,
        wish: Wish,
        *,
        now_ns: Callable[[], int],
        on_text: Callable[[str], None],
    ) -> None:
        """Connect, agree on what is sent, and start it."""
        self._now_ns = now_ns
        required = ("timestamp", *wish.required)
        self._link = RtdeLink(host, port, on_text=on_text)
        absent = self._begin((*required, *wish.optional), wish.rate_hz)
        lacking = sorted(set(absent) & set(required))
        if lacking:
            raise ControllerError(
                where=self._link.where,
                found=f"the controller does not know {', '.join(lacking)}",
                hint="Its software is too old; update it, or ask for less (--gripper none).",
            )
        self.missing = absent
        if absent:  # one connection has one recipe: asking for less takes another
            known = tuple(name for name in wish.optional if name not in absent)
            self._link = RtdeLink(host, port, on_text=on_text)
            if self._begin((*required, *known), wish.rate_hz):
                found = "it takes back variables it had offered"
                raise NotRtdeError(where=self._link.where, found=found)

    def _begin(self, names: tuple[str, ...], rate_hz: float | None) -> tuple[str, ...]:
        """Start sending; when the controller does not know some names, return them and hang up."""
        try:
            self.version = self._agree()
            fast = self.version[0] >= FIRST_FAST_MAJOR
            self.rate_hz = rate_hz or (FAST_HZ if fast else SLOW_HZ)
            types, number = self._set_up(names)
            absent = tuple(n for n, t in zip(names, types, strict=True) if t == NOT_FOUND)
            if not absent:
                self._recipe = Recipe(names, types, number)
                self._start()
                return ()
        except BrokenPackageError as error:
            self.close()
            raise NotRtdeError(where=self._link.where, found=str(error)) from error
        except ControllerError:
            self.close()
            raise
        self.close()
        return absent

    def _agree(self) -> tuple[int, int, int, int]:
        version = struct.pack(">H", PROTOCOL_VERSION)
        if self._link.ask(Kind.REQUEST_PROTOCOL_VERSION, version) != b"\x01":
            raise ControllerError(
                where=self._link.where,
                found=f"the controller does not speak version {PROTOCOL_VERSION} of RTDE",
                hint="Update its software.",
            )
        answer = self._link.ask(Kind.GET_CONTROL_VERSION)
        if len(answer) != 16:
            message = f"a version of {len(answer)} bytes"
            raise BrokenPackageError(message)
        major, minor, bugfix, build = struct.unpack(">4I", answer)
        return major, minor, bugfix, build

    def _set_up(self, names: tuple[str, ...]) -> tuple[tuple[str, ...], int]:
        """Ask for variables; return their types and the recipe's number."""
        request = struct.pack(">d", self.rate_hz) + ",".join(names).encode()
        answer = self._link.ask(Kind.SETUP_OUTPUTS, request)
        types = tuple(answer[1:].decode("ascii", errors="replace").split(","))
        if len(types) != len(names):
            message = f"{len(names)} variables were answered with {answer[:64]!r}"
            raise BrokenPackageError(message)
        return types, answer[0]

    def _start(self) -> None:
        if self._link.ask(Kind.START) != b"\x01":
            raise ControllerError(
                where=self._link.where,
                found="the controller refused to start sending",
                hint="Restart it, or end other RTDE clients.",
            )

    def samples(self) -> Iterator[Sample]:
        """Yield every data package in the order it was sent, until the connection ends."""
        try:
            while True:
                payloads = self._link.next_data()
                received_ns = self._now_ns()
                for payload in payloads:
                    values = self._recipe.unpack(payload)
                    robot_s = values["timestamp"]
                    if not (isinstance(robot_s, float) and 0.0 <= robot_s < MAX_UPTIME_S):
                        message = f"a time of {robot_s} s"
                        raise BrokenPackageError(message)
                    yield Sample(robot_s=robot_s, received_ns=received_ns, values=values)
        except BrokenPackageError as error:
            raise NotRtdeError(where=self._link.where, found=str(error)) from error

    def close(self) -> None:
        """Hang up."""
        self._link.close()
