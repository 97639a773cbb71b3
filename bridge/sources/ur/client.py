"""Reads a UR controller over RTDE: every package, in order, with the controller's own time."""

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from bridge.sources.ur.errors import ControllerError, NotRtdeError
from bridge.sources.ur.gripper import Value
from bridge.sources.ur.link import RtdeLink
from bridge.sources.ur.protocol import (
    NOT_FOUND,
    PROTOCOL_VERSION,
    BrokenPackageError,
    Kind,
    Recipe,
)

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
        """Connect, agree on what is sent, and start it.

        Args:
            host: Name or address of the controller.
            port: 30004, unless forwarded.
            wish: What it shall send; ``timestamp`` is always read.
            now_ns: The host's clock.
            on_text: Told what the controller says in words.

        Raises:
            ControllerError: When nobody answers, a required variable is unknown, or the
                controller refuses to start.
            NotRtdeError: When what answers does not speak RTDE.
        """
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
        """Yield every data package in the order it was sent, until the connection ends.

        Raises:
            ControllerError: When the controller went away.
            NotRtdeError: When a package is broken.
        """
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
