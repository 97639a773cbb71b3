"""A UR controller's RTDE interface, written from the vendor's public guide, for tests only."""

import contextlib
import socket
import struct
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

TYPES = {
    "timestamp": "DOUBLE",
    "actual_q": "VECTOR6D",
    "actual_qd": "VECTOR6D",
    "target_q": "VECTOR6D",
    "actual_TCP_pose": "VECTOR6D",
    "actual_TCP_force": "VECTOR6D",
    "speed_scaling": "DOUBLE",
    "robot_mode": "INT32",
    "safety_mode": "INT32",
    "actual_digital_input_bits": "UINT64",
    "actual_digital_output_bits": "UINT64",
    "standard_analog_input0": "DOUBLE",
    "tool_analog_input0": "DOUBLE",
    "output_double_register_0": "DOUBLE",
    "output_int_register_0": "INT32",
}
FORMATS = {"DOUBLE": "d", "VECTOR6D": "6d", "INT32": "i", "UINT64": "Q", "UINT32": "I"}

State = Callable[[int], dict[str, object]]


def counting_state(number: int) -> dict[str, object]:
    """What the robot does: every value tells the sample it belongs to."""
    return {
        "actual_q": [number * 1e-3 + joint for joint in range(6)],
        "actual_qd": [0.125] * 6,
        "target_q": [number * 1e-3 + joint + 0.5 for joint in range(6)],
        "actual_TCP_pose": [0.1, 0.2, 0.3, 0.0, 0.0, number * 1e-3],
        "actual_TCP_force": [1.0, 2.0, 3.0, 4.0, 5.0, 6.0],
        "speed_scaling": 1.0 if number < 250 else 0.25,
        "robot_mode": 7,
        "safety_mode": 1 if number < 250 else 3,
        "actual_digital_output_bits": int(number >= 250),
    }


@dataclass
class RtdeServer:
    """Serves one client after another until closed; every choice is an attribute."""

    state: State
    port: int = 0
    types: dict[str, str] = field(default_factory=lambda: dict(TYPES))
    version: tuple[int, int, int, int] = (5, 12, 0, 1101)
    speaks: int = 2
    real_time: bool = True
    start_s: float = 1000.0
    skipped: set[int] = field(default_factory=set)
    """Sample numbers a busy controller does not send."""
    cut_at: int | None = None
    """Close the connection in the middle of this sample."""
    last: int | None = None
    """Send nothing after this sample, but stay connected."""
    hold: threading.Event = field(default_factory=threading.Event)
    sent: list[int] = field(default_factory=list)
    recipes: list[list[str]] = field(default_factory=list)
    rates: list[float] = field(default_factory=list)
    text: bytes = b""

    def __post_init__(self) -> None:
        """Listen and serve."""
        self._listener = socket.socket()
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self._listener.bind(("127.0.0.1", self.port))
        self._listener.listen()
        self.port = self._listener.getsockname()[1]
        self._closed = threading.Event()
        self._number = 0
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._closed.set()
        self._listener.close()
        with contextlib.suppress(OSError):  # wakes accept
            socket.create_connection(("127.0.0.1", self.port), timeout=0.2).close()
        self._thread.join(timeout=5.0)

    def __enter__(self) -> "RtdeServer":
        """Use as a context manager."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()

    def _serve(self) -> None:
        while not self._closed.is_set():
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            with connection, contextlib.suppress(OSError):
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._talk(connection)

    def _talk(self, connection: socket.socket) -> None:
        stream = connection.makefile("rb")
        names: list[str] = []
        while not self._closed.is_set():
            header = stream.read(3)
            if len(header) < 3:
                return
            size, kind = struct.unpack(">HB", header)
            payload = stream.read(size - 3)
            if kind == ord("V"):
                accepted = struct.unpack(">H", payload)[0] == self.speaks
                self._send(connection, kind, bytes([accepted]))
            elif kind == ord("v"):
                if self.text:
                    source = b"test"
                    body = bytes([len(self.text)]) + self.text + bytes([len(source)]) + source
                    self._send(connection, ord("M"), body + b"\x03")
                self._send(connection, kind, struct.pack(">4I", *self.version))
            elif kind == ord("O"):
                self.rates.append(struct.unpack(">d", payload[:8])[0])
                names = payload[8:].decode().rstrip(",").split(",")
                self.recipes.append(names)
                types = [self.types.get(name, "NOT_FOUND") for name in names]
                self._send(connection, kind, b"\x01" + ",".join(types).encode())
            elif kind == ord("S"):
                self._send(connection, kind, b"\x01")
                self._stream(connection, names)
                return
            elif kind == ord("P"):
                self._send(connection, kind, b"\x01")

    def _send(self, connection: socket.socket, kind: int, payload: bytes) -> None:
        connection.sendall(struct.pack(">HB", 3 + len(payload), kind) + payload)

    def _stream(self, connection: socket.socket, names: list[str]) -> None:
        period_s = 1.0 / self.rates[-1]
        began_s, first = time.monotonic(), self._number
        while not self._closed.is_set():
            if self.last is not None and self._number > self.last:
                self._closed.wait(0.02)
                continue
            if self.hold.is_set():
                time.sleep(0.002)
                began_s, first = time.monotonic(), self._number
                continue
            if self.real_time:
                due_s = began_s + (self._number - first) * period_s
                time.sleep(max(0.0, due_s - time.monotonic()))
            number = self._number
            self._number += 1
            if number in self.skipped:
                continue
            package = self._package(number, period_s, names)
            if number == self.cut_at:
                self.cut_at = None
                connection.sendall(package[: len(package) // 2])
                return
            connection.sendall(package)
            self.sent.append(number)

    def _package(self, number: int, period_s: float, names: list[str]) -> bytes:
        values = {"timestamp": self.start_s + number * period_s, **self.state(number)}
        payload = b"\x01"
        for name in names:
            value = values.get(name, 0)
            form = FORMATS[self.types[name]]
            items = value if isinstance(value, list | tuple) else [value] * int(form[:-1] or 1)
            payload += struct.pack(">" + form, *items)
        return struct.pack(">HB", 3 + len(payload), ord("U")) + payload
