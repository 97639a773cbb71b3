"""Many messages of one topic at once: they differ in their stamp and in some numbers only.

One message is serialised as any other; the rest are copies of its bytes with other stamps and
numbers. The bytes are those that one by one would give (tests compare them).
"""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float, Int

from bridge.episode.records import JointSample, PoseSample
from bridge.geometry import se3

_SEC, _NANOSEC = slice(4, 8), slice(8, 12)
"""Where ``header.stamp`` lies, behind the four bytes that name the encoding."""
_NS = 1_000_000_000


def joint_messages(
    stamps_ns: Int[np.ndarray, " num_messages"],
    names: Sequence[str],
    position: Float[np.ndarray, "num_messages num_joints"],
) -> Iterator[bytes]:
    """Yield sensor_msgs/JointState messages with positions alone."""
    marks = np.arange(1, len(names) + 1) * 1.2345678e-301  # found nowhere else in the bytes
    sample = JointSample(
        stamp_ns=0,
        names=tuple(names),
        position=marks,
        velocity=np.zeros(0),
        effort=np.zeros(0),
    )
    template = sample.to_cdr()
    first = template.index(marks.astype("<f8").tobytes())
    yield from _patched(template, first, stamps_ns, position)


def pose_messages(
    stamps_ns: Int[np.ndarray, " num_messages"],
    frame_id: str,
    Ts_frame_body: Float[np.ndarray, "num_messages 4 4"],
) -> Iterator[bytes]:
    """Yield geometry_msgs/PoseStamped messages."""
    sample = PoseSample(stamp_ns=0, frame_id=frame_id, T_frame_body=np.eye(4))
    template = sample.to_cdr()
    q, p = se3.split(Ts_frame_body)
    numbers = np.concatenate([p, q[:, 1:], q[:, :1]], axis=1)
    yield from _patched(template, len(template) - 8 * numbers.shape[1], stamps_ns, numbers)


def _patched(
    template: bytes,
    first: int,
    stamps_ns: Int[np.ndarray, " num_messages"],
    numbers: Float[np.ndarray, "num_messages num_values"],
) -> Iterator[bytes]:
    rows = np.tile(np.frombuffer(template, dtype=np.uint8), (len(stamps_ns), 1))
    stamps = stamps_ns.astype(np.int64)
    rows[:, _SEC] = _bytes_of((stamps // _NS).astype("<i4")[:, None])
    rows[:, _NANOSEC] = _bytes_of((stamps % _NS).astype("<u4")[:, None])
    rows[:, first : first + 8 * numbers.shape[1]] = _bytes_of(numbers.astype("<f8"))
    for row in rows:
        yield row.tobytes()


def _bytes_of(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values).view(np.uint8)
