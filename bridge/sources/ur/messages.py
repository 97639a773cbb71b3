"""One sample of a UR arm as messages of an episode.

The controller gives poses and forces in its own base frame, which ROS calls ``base``:
``base_link`` after half a turn about z. Here everything is expressed in ``base_link``, like the
URDF.
"""

import json
import math
import struct
from collections.abc import Callable, Sequence
from typing import Any

from bridge.clock import split_ns
from bridge.episode import schema
from bridge.episode.cdr import codec
from bridge.episode.schema import StampedMessage
from bridge.episode.topics import EVENT, cell_topic

# Messages of one layout are serialised once; then only stamp and numbers change from sample to
# sample. At 500 samples a second and six topics a general serialiser would cost a quarter of a
# core.

_STAMP = {"sec": 0x13579BDF, "nanosec": 0x2468ACE0}
_STAMP_BYTES = struct.pack("<iI", *_STAMP.values())
Stamp = dict[str, int]


class MessageTemplate:
    """A message of which one header stamp and a run of doubles are filled in later."""

    def __init__(
        self, type_name: str, build: Callable[[Stamp, list[float]], dict[str, Any]], count: int
    ) -> None:
        """Serialise once and remember where the numbers went.

        Args:
            type_name: As in ``bridge.episode.schema``.
            build: Makes the message from a stamp and ``count`` numbers.
            count: How many doubles are filled in, in the order the message holds them.
        """
        marks = [2.0**-30 * (3 * number + 1) for number in range(count)]
        self._bytes = codec.encode(type_name, build(_STAMP, marks))
        self._stamp_at = self._place(_STAMP_BYTES)
        runs: list[list[int]] = []
        for mark in marks:
            at = self._place(struct.pack("<d", mark))
            if runs and at == runs[-1][0] + 8 * runs[-1][1]:
                runs[-1][1] += 1
            else:
                runs.append([at, 1])
        self._runs = [(at, struct.Struct(f"<{length}d")) for at, length in runs]

    def _place(self, mark: bytes) -> int:
        at = self._bytes.find(mark)
        if at < 0 or self._bytes.find(mark, at + 1) >= 0:
            message = f"{mark!r} is not once in the message"
            raise ValueError(message)
        return at

    def fill(self, stamp_ns: int, numbers: Sequence[float]) -> bytes:
        """Return the message with this stamp and these numbers."""
        data = bytearray(self._bytes)
        struct.pack_into("<iI", data, self._stamp_at, *split_ns(stamp_ns))
        start = 0
        for at, layout in self._runs:
            count = layout.size // 8
            layout.pack_into(data, at, *numbers[start : start + count])
            start += count
        return bytes(data)


_ROBOT = {
    -1: "NO_CONTROLLER",
    0: "DISCONNECTED",
    1: "CONFIRM_SAFETY",
    2: "BOOTING",
    3: "POWER_OFF",
    4: "POWER_ON",
    5: "IDLE",
    6: "BACKDRIVE",
    7: "RUNNING",
    8: "UPDATING_FIRMWARE",
}
_SAFETY = {
    1: "NORMAL",
    2: "REDUCED",
    3: "PROTECTIVE_STOP",
    4: "RECOVERY",
    5: "SAFEGUARD_STOP",
    6: "SYSTEM_EMERGENCY_STOP",
    7: "ROBOT_EMERGENCY_STOP",
    8: "VIOLATION",
    9: "FAULT",
    10: "VALIDATE_JOINT_ID",
    11: "UNDEFINED_SAFETY_MODE",
    12: "AUTOMATIC_MODE_SAFEGUARD_STOP",
    13: "SYSTEM_THREE_POSITION_ENABLING_STOP",
}


def robot_mode_name(number: int) -> str:
    """Name of a robot mode."""
    return _ROBOT.get(number, f"UNKNOWN_{number}")


def safety_mode_name(number: int) -> str:
    """Name of a safety mode."""
    return _SAFETY.get(number, f"UNKNOWN_{number}")


CONTROLLER_TCP_FRAME = "tool0_controller"
"""The controller's active tool centre point, as ROS drivers of UR arms call it."""
SPEED_NAME = "speed_scaling"
SMALLEST_ANGLE_RAD = 1e-12


def tool_pose(pose: Sequence[float]) -> tuple[float, ...]:
    """The tool in base_link from the controller's (x, y, z [m], rotation vector [rad]).

    Returns:
        x, y, z [m], then the quaternion in the order of ROS messages: x, y, z, w.
    """
    x, y, z, rx, ry, rz = pose
    angle_rad = math.sqrt(rx * rx + ry * ry + rz * rz)
    scale = math.sin(angle_rad / 2) / angle_rad if angle_rad > SMALLEST_ANGLE_RAD else 0.5
    w, i, j, k = math.cos(angle_rad / 2), scale * rx, scale * ry, scale * rz
    # Half a turn about z from the left: (0, 0, 0, 1) times (w, i, j, k).
    turned = (-j, i, w, -k)
    sign = -1.0 if turned[3] < 0 else 1.0
    return (-x, -y, z, *(sign * part for part in turned))


def tool_wrench(wrench: Sequence[float]) -> tuple[float, ...]:
    """Force [N] at, and torque [Nm] about, the tool centre point, along the axes of base_link."""
    fx, fy, fz, tx, ty, tz = wrench
    return -fx, -fy, fz, -tx, -ty, tz


def joints_template(names: tuple[str, ...], *, velocities: bool) -> MessageTemplate:
    """sensor_msgs/JointState: positions [rad or m], then velocities [per s] where wanted."""
    count = len(names)

    def build(stamp: Stamp, numbers: list[float]) -> dict[str, Any]:
        header = {"stamp": stamp, "frame_id": ""}
        first, rest = numbers[:count], numbers[count:]
        return {"header": header, "name": list(names), "position": first, "velocity": rest}

    return MessageTemplate(schema.JOINT_STATE, build, count * (2 if velocities else 1))


def pose_template(base_frame: str) -> MessageTemplate:
    """geometry_msgs/PoseStamped in base_link, filled with ``tool_pose``."""

    def build(stamp: Stamp, numbers: list[float]) -> dict[str, Any]:
        pose = {"position": _named("xyz", numbers), "orientation": _named("xyzw", numbers[3:])}
        return {"header": {"stamp": stamp, "frame_id": base_frame}, "pose": pose}

    return MessageTemplate(schema.POSE_STAMPED, build, 7)


def frame_template(base_frame: str) -> MessageTemplate:
    """tf2_msgs/TFMessage with the tool's frame, so that a camera at the wrist has a place."""

    def build(stamp: Stamp, numbers: list[float]) -> dict[str, Any]:
        transform = {"translation": _named("xyz", numbers), "rotation": _named("xyzw", numbers[3:])}
        header = {"stamp": stamp, "frame_id": base_frame}
        item = {"header": header, "child_frame_id": CONTROLLER_TCP_FRAME, "transform": transform}
        return {"transforms": [item]}

    return MessageTemplate(schema.TF_MESSAGE, build, 7)


def wrench_template(base_frame: str) -> MessageTemplate:
    """geometry_msgs/WrenchStamped along base_link, filled with ``tool_wrench``."""

    def build(stamp: Stamp, numbers: list[float]) -> dict[str, Any]:
        wrench = {"force": _named("xyz", numbers), "torque": _named("xyz", numbers[3:])}
        return {"header": {"stamp": stamp, "frame_id": base_frame}, "wrench": wrench}

    return MessageTemplate(schema.WRENCH_STAMPED, build, 6)


def _named(axes: str, numbers: Sequence[float]) -> dict[str, float]:
    return dict(zip(axes, numbers, strict=False))


def mode_event(
    cell: str, robot_mode: int | None, safety_mode: int | None, stamp_ns: int
) -> StampedMessage:
    """What the controller says of itself, as an event (type note)."""
    robot = None if robot_mode is None else robot_mode_name(robot_mode)
    safety = None if safety_mode is None else safety_mode_name(safety_mode)
    record = {
        "schema_version": 1,
        "stamp_ns": stamp_ns,
        "type": "note",
        "text": f"robot mode {robot or 'not known'}, safety mode {safety or 'not known'}",
        "data": {"robot_mode": robot, "safety_mode": safety},
    }
    return StampedMessage(
        topic=cell_topic(cell, EVENT),
        type_name=schema.EVENT,
        data=json.dumps(record).encode(),
        stamp_ns=stamp_ns,
    )
