"""One sample of a UR arm as messages of an episode.

The controller gives poses and forces in its own base frame, which ROS calls ``base``:
``base_link`` after half a turn about z. Here everything is expressed in ``base_link``, like the
URDF.
"""

import json
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from bridge.clock import split_ns
from bridge.episode import cdr, schema
from bridge.episode.message import StampedMessage
from bridge.episode.records import FrameTransform, JointSample, PoseSample, transforms_to_cdr
from bridge.geometry import se3
from bridge.sources.ur.gripper import Value
from bridge.sources.ur.modes import robot_mode_name, safety_mode_name
from bridge.task.robot import ARM_JOINTS, BASE_FRAME

CONTROLLER_TCP_FRAME = "tool0_controller"
"""The controller's active tool centre point, as ROS drivers of UR arms call it."""
GRIPPER_JOINT = "gripper_width"
SPEED_NAME = "speed_scaling"
T_BASE_LINK_BASE = np.diag([-1.0, -1.0, 1.0, 1.0])
T_BASE_LINK_BASE.setflags(write=False)
SMALLEST_ANGLE_RAD = 1e-12


def vector(values: Mapping[str, Value], name: str) -> Float[np.ndarray, " count"]:
    """A variable of the controller as an array."""
    return np.asarray(values[name], dtype=np.float64)


def T_base_link_tcp(pose: Float[np.ndarray, "6"]) -> Float[np.ndarray, "4 4"]:
    """Pose of the tool from the controller's (x, y, z [m], rotation vector [rad])."""
    turn = pose[3:]
    angle_rad = float(np.linalg.norm(turn))
    axis = turn / angle_rad if angle_rad > SMALLEST_ANGLE_RAD else np.array([1.0, 0.0, 0.0])
    q_wxyz = np.concatenate([[np.cos(angle_rad / 2)], np.sin(angle_rad / 2) * axis])
    return np.asarray(T_BASE_LINK_BASE @ se3.transform_from(q_wxyz, pose[:3]))


def joints_cdr(
    position_rad: Float[np.ndarray, "6"], velocity: Float[np.ndarray, " n"], stamp_ns: int
) -> bytes:
    """Joint positions [rad] and velocities [rad/s] (or none) of the arm."""
    return JointSample(
        stamp_ns=stamp_ns,
        names=ARM_JOINTS,
        position=position_rad,
        velocity=velocity,
        effort=np.zeros(0),
    ).to_cdr()


def number_cdr(name: str, value: float, stamp_ns: int) -> bytes:
    """One named number, in the form that viewers plot without being told how."""
    return JointSample(
        stamp_ns=stamp_ns,
        names=(name,),
        position=np.array([value]),
        velocity=np.zeros(0),
        effort=np.zeros(0),
    ).to_cdr()


def tcp_cdr(T: Float[np.ndarray, "4 4"], stamp_ns: int) -> bytes:
    """Pose ``T_base_link_tcp`` of the tool."""
    return PoseSample(stamp_ns=stamp_ns, frame_id=BASE_FRAME, T_frame_body=T).to_cdr()


def tcp_frame_cdr(T: Float[np.ndarray, "4 4"], stamp_ns: int) -> bytes:
    """The same pose as a transform, so that a camera at the wrist has a place."""
    item = FrameTransform(
        stamp_ns=stamp_ns, parent=BASE_FRAME, child=CONTROLLER_TCP_FRAME, T_parent_child=T
    )
    return transforms_to_cdr([item])


def wrench_cdr(wrench: Float[np.ndarray, "6"], stamp_ns: int) -> bytes:
    """Force [N] at, and torque [Nm] about, the tool centre point, along the axes of base_link."""
    sec, nanosec = split_ns(stamp_ns)
    rotated = T_BASE_LINK_BASE[:3, :3] @ wrench.reshape(2, 3).T
    force, torque = (dict(zip("xyz", map(float, row), strict=True)) for row in rotated.T)
    message = {
        "header": {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": BASE_FRAME},
        "wrench": {"force": force, "torque": torque},
    }
    return cdr.encode(schema.WRENCH_STAMPED, message)


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
        topic=f"/{cell}/event",
        type_name=schema.EVENT,
        data=json.dumps(record).encode(),
        stamp_ns=stamp_ns,
    )
