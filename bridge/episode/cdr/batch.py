"""Read and write many messages of a topic at once: they differ in stamps and numbers only.

The first is read as any other; of the rest only the bytes that may differ are looked at. What is
not alike is left to be read one by one, with the same result (tests compare them). ``repeated``
writes such runs of messages.
"""

import struct
from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float, Int, UInt8

from bridge.clock import NS_PER_S
from bridge.episode.cdr.messages import JointSample, PoseSample
from bridge.errors import BridgeError
from bridge.geometry import se3

# One message is serialised as any other; the rest are copies of its bytes with other stamps and
# numbers. The bytes are those that one by one would give (tests compare them).

_SEC, _NANOSEC = slice(4, 8), slice(8, 12)
"""Where ``header.stamp`` lies, behind the four bytes that name the encoding."""
_NS = 1_000_000_000


def joint_messages(
    stamps_ns: Int[np.ndarray, " num_messages"],
    names: Sequence[str],
    position: Float[np.ndarray, "num_messages num_joints"],
) -> Iterator[bytes]:
    """Yield sensor_msgs/JointState messages with positions alone.

    Args:
        stamps_ns: Source time of each message [ns since 1970].
        names: Joints, in the order of the columns of ``position``.
        position: One row for each message [rad; m for a gripper's width].
    """
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
    """Yield geometry_msgs/PoseStamped messages.

    Args:
        stamps_ns: Source time of each message [ns since 1970].
        frame_id: The frame the poses are expressed in.
        Ts_frame_body: Pose of the body in that frame, one for each message.
    """
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


ORIGIN = 4
"""CDR aligns to this byte, behind those that name the encoding."""
_STAMP = (4, 12)
_FRAME_AT = 12
_LITTLE_ENDIAN = 1
_POSE_BYTES = 7 * 8
_FAINT, _HUGE = 1e-6, 1e6
"""A quaternion whose length is not between these is none."""

Span = tuple[int, int]


def poses_of(
    payloads: Sequence[bytes],
) -> tuple[Int[np.ndarray, " num_messages"], Float[np.ndarray, "num_messages 4 4"]] | None:
    """Return stamps [ns] and ``Ts_frame_body`` of geometry_msgs/PoseStamped messages in order.

    None when they are not alike: other frames, broken bytes, or no rotation.
    """
    rows = _rows(payloads)
    if rows is None:
        return None
    try:
        PoseSample.from_cdr(payloads[0])
        at = _aligned(_behind_text(payloads[0], _FRAME_AT), 8)
    except (BridgeError, struct.error):
        return None
    spans = (_STAMP, (at, at + _POSE_BYTES))
    if not _differ_only_in(rows, spans):
        return None
    numbers = _numbers(rows, spans[1])
    q = numbers[:, [6, 3, 4, 5]]
    length = np.linalg.norm(q, axis=1)
    if not ((length > _FAINT) & (length < _HUGE)).all():
        return None
    return _stamps_ns(rows), se3.transform_from(q, numbers[:, :3])


def joints_of(
    payloads: Sequence[bytes],
) -> (
    tuple[
        tuple[str, ...],
        Int[np.ndarray, " num_messages"],
        Float[np.ndarray, "num_messages num_joints"],
    ]
    | None
):
    """Return names, stamps [ns] and positions of sensor_msgs/JointState messages in their order.

    None when they are not alike: other joints, broken bytes, or no positions.
    """
    rows = _rows(payloads)
    if rows is None:
        return None
    try:
        first = JointSample.from_cdr(payloads[0])
        position, *others = _joint_spans(payloads[0])
    except (BridgeError, struct.error):
        return None
    if not len(first.position) or not _differ_only_in(rows, (_STAMP, position, *others)):
        return None
    return first.names, _stamps_ns(rows), _numbers(rows, position)


def _rows(payloads: Sequence[bytes]) -> UInt8[np.ndarray, "num_messages num_bytes"] | None:
    if not payloads:
        return None
    size = len(payloads[0])
    if size < _FRAME_AT or payloads[0][1] != _LITTLE_ENDIAN:
        return None
    if set(map(len, payloads)) != {size}:
        return None
    return np.frombuffer(b"".join(payloads), dtype=np.uint8).reshape(len(payloads), size)


def _differ_only_in(
    rows: UInt8[np.ndarray, "num_messages num_bytes"], spans: Sequence[Span]
) -> bool:
    fixed = np.ones(rows.shape[1], dtype=bool)
    for first, last in spans:
        fixed[first:last] = False
    return bool((rows[:, fixed] == rows[0, fixed]).all())


def _joint_spans(payload: bytes) -> tuple[Span, Span, Span]:
    """Where position, velocity and effort lie, behind the frame and the names."""
    at = _aligned(_behind_text(payload, _FRAME_AT), 4)
    (count,) = struct.unpack_from("<I", payload, at)
    at += 4
    for _ in range(count):
        at = _behind_text(payload, _aligned(at, 4))
    spans: list[Span] = []
    for _ in range(3):
        at = _aligned(at, 4)
        (count,) = struct.unpack_from("<I", payload, at)
        at = _aligned(at + 4, 8) if count else at + 4
        spans.append((at, at + 8 * count))
        at += 8 * count
    return spans[0], spans[1], spans[2]


def _behind_text(payload: bytes, at: int) -> int:
    (length,) = struct.unpack_from("<I", payload, at)
    return at + 4 + int(length)


def _aligned(at: int, size: int) -> int:
    return at + (ORIGIN - at) % size


def _numbers(
    rows: UInt8[np.ndarray, "num_messages num_bytes"], span: Span
) -> Float[np.ndarray, "num_messages num_values"]:
    return np.ascontiguousarray(rows[:, span[0] : span[1]]).view("<f8").astype(np.float64)


def _stamps_ns(
    rows: UInt8[np.ndarray, "num_messages num_bytes"],
) -> Int[np.ndarray, " num_messages"]:
    seconds = np.ascontiguousarray(rows[:, 4:8]).view("<i4")[:, 0].astype(np.int64)
    rest = np.ascontiguousarray(rows[:, 8:12]).view("<u4")[:, 0].astype(np.int64)
    return seconds * NS_PER_S + rest
