"""One sample of a UR arm as messages of an episode.

The controller gives poses and forces in its own base frame, which ROS calls ``base``:
``base_link`` after half a turn about z. Here everything is expressed in ``base_link``, like the
URDF.
"""

import json
import math
from collections.abc import Sequence

from bridge.episode import schema
from bridge.episode.cdr import codec
from bridge.episode.cdr.batch import Write, named
from bridge.episode.cdr.messages import header
from bridge.episode.schema import StampedMessage
from bridge.episode.topics import EVENT, cell_topic

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


def frame_writer(base_frame: str) -> Write:
    """tf2_msgs/TFMessage with the tool's frame, so that a camera at the wrist has a place."""

    def write(stamp_ns: int, numbers: Sequence[float]) -> bytes:
        transform = {"translation": named("xyz", numbers), "rotation": named("xyzw", numbers[3:])}
        about = {"header": header(stamp_ns, base_frame), "child_frame_id": CONTROLLER_TCP_FRAME}
        return codec.encode(schema.TF_MESSAGE, {"transforms": [{**about, "transform": transform}]})

    return write


def wrench_writer(base_frame: str) -> Write:
    """geometry_msgs/WrenchStamped along base_link, of ``tool_wrench``."""

    def write(stamp_ns: int, numbers: Sequence[float]) -> bytes:
        wrench = {"force": named("xyz", numbers), "torque": named("xyz", numbers[3:])}
        message = {"header": header(stamp_ns, base_frame), "wrench": wrench}
        return codec.encode(schema.WRENCH_STAMPED, message)

    return write


def mode_event(
    cell: str, robot_mode: int | None, safety_mode: int | None, stamp_ns: int
) -> StampedMessage:
    """What the controller says of itself, as an event (type note)."""
    robot, safety = (
        None if number is None else names.get(number, f"UNKNOWN_{number}")
        for names, number in ((_ROBOT, robot_mode), (_SAFETY, safety_mode))
    )
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
