"""Many messages of a topic that differ in stamps and numbers only: written, and looked at."""

import math
import struct
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from jaxtyping import Float, Int

from bridge.episode import schema
from bridge.episode.cdr import codec
from bridge.episode.cdr.messages import JointSample, header
from bridge.errors import BridgeError
from bridge.geometry import se3

Write = Callable[[int, Sequence[float]], bytes]
"""Makes a message of a stamp [ns] and the numbers that differ from one to the next."""


def joint_writer(names: Sequence[str], *, velocities: bool = False) -> Write:
    """sensor_msgs/JointState: positions [rad or m], then velocities [per s] where wanted."""
    count = len(names)

    def write(stamp_ns: int, numbers: Sequence[float]) -> bytes:
        values = {"position": numbers[:count], "velocity": numbers[count:] if velocities else ()}
        message = {"header": header(stamp_ns, ""), "name": list(names), **values}
        return codec.encode(schema.JOINT_STATE, message)

    return write


def pose_writer(frame_id: str) -> Write:
    """geometry_msgs/PoseStamped: x, y, z [m], then the quaternion in ROS order: x, y, z, w."""

    def write(stamp_ns: int, numbers: Sequence[float]) -> bytes:
        pose = {"position": named("xyz", numbers), "orientation": named("xyzw", numbers[3:])}
        return codec.encode(
            schema.POSE_STAMPED, {"header": header(stamp_ns, frame_id), "pose": pose}
        )

    return write


def named(axes: str, numbers: Sequence[float]) -> dict[str, float]:
    """Return the first numbers by the names of their axes."""
    return dict(zip(axes, numbers, strict=False))


def pose_messages(
    stamps_ns: Int[np.ndarray, " num_messages"],
    frame_id: str,
    Ts_frame_body: Float[np.ndarray, "num_messages 4 4"],
) -> Iterator[bytes]:
    """Yield geometry_msgs/PoseStamped messages."""
    q, p = se3.split(Ts_frame_body)
    numbers = np.concatenate([p, q[:, 1:], q[:, :1]], axis=1)
    return map(pose_writer(frame_id), stamps_ns.tolist(), numbers.tolist())


_STAMP = (4, 12)
_LITTLE_ENDIAN = 1


class JointLayout:
    """Where the numbers of one message of joints lie; those alike differ from it in them only."""

    def __init__(self, data: bytes) -> None:
        """Read a message that holds positions; raises as ``JointSample.from_cdr`` does."""
        first, origin = JointSample.from_cdr(data), np.frombuffer(data, np.uint8).ctypes.data
        spans = [_STAMP]
        for values in (first.position, first.velocity, first.effort):
            if len(values):
                at = values.ctypes.data - origin
                spans.append((at, at + values.nbytes))
        starts, ends = zip(*spans, strict=True)
        self._fixed = tuple(zip((0, *ends), (*starts, len(data)), strict=True))
        self._size, self._bytes = len(data), [data[a:b] for a, b in self._fixed]
        self.names, self.count = first.names, len(first.position)
        self._unpack = struct.Struct(f"<{self.count}d").unpack_from
        self._at = starts[-1] if len(spans) == 1 else starts[1]
        self.is_of_use = data[1] == _LITTLE_ENDIAN and self.count > 0

    def is_like(self, data: bytes) -> bool:
        """Whether another message holds the same joints at the same places."""
        return len(data) == self._size and [data[a:b] for a, b in self._fixed] == self._bytes

    def has_nan(self, data: bytes) -> bool:
        """Whether a position of a message that is like it is not a number."""
        total: float = sum(self._unpack(data, self._at))
        return not math.isfinite(total)

    def read(self, alike: Sequence[bytes]) -> tuple[np.ndarray, np.ndarray]:
        """Stamps [ns] and positions of messages that are like it, at once."""
        rows = np.frombuffer(b"".join(alike), np.uint8).reshape(len(alike), -1)
        spans = ((4, 8), (8, 12), (self._at, self._at + 8 * self.count))
        s, ns, position = (
            rows[:, start:end].copy().view(kind)
            for (start, end), kind in zip(spans, ("<i4", "<u4", "<f8"), strict=True)
        )
        return s[:, 0].astype(np.int64) * 1_000_000_000 + ns[:, 0], position


def joint_layout(data: bytes) -> JointLayout | None:
    """Find out where the numbers lie; None where there are none, or not as expected."""
    try:
        layout = JointLayout(data)
    except BridgeError:
        return None
    return layout if layout.is_of_use else None
