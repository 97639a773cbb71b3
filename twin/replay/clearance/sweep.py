"""What may have happened between two states: how far anything moved, and the state half way.

A point that travels s between two instants is never farther than s / 2 from where it was at one
of them. Two bodies that were d0 and d1 apart and travelled s together therefore kept at least
(d0 + d1 - s) / 2. Where that is not enough, the state half way is looked at, and so on.
"""

from dataclasses import dataclass, field
from math import asin, hypot, sqrt
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from bridge.task.robot import ARM_JOINTS, FINGER_LINKS
from twin.robot.collision import RobotHulls

MAX_LEAP_M = 0.05
"""An object that is this far away at the next state did not move there: something else became
known of it. Nothing is said of its way."""


@dataclass(frozen=True, kw_only=True)
class State:
    """Where everything is at one instant."""

    t_ns: int
    joints_rad: Float[np.ndarray, " num_joints"]
    width_m: float
    Ts_base_object: dict[str, Float[np.ndarray, "4 4"]] = field(default_factory=dict)
    nodes_m: dict[str, Float[np.ndarray, "num_nodes 3"]] = field(default_factory=dict)
    """Soft bodies, base frame."""


def half_way(a: State, b: State) -> State:
    """The state in the middle, straight in joints, positions and nodes.

    Objects that leapt, or are known at one of the two only, are left out.
    """
    poses = {}
    for name in a.Ts_base_object.keys() & b.Ts_base_object.keys():
        if object_travel_m(a, b, name, 0.0) > MAX_LEAP_M:
            continue
        (q_a, p_a), (q_b, p_b) = (
            se3.split(a.Ts_base_object[name]),
            se3.split(b.Ts_base_object[name]),
        )
        q = se3.interpolate_quaternion(q_a, q_b, np.array(0.5))
        poses[name] = se3.transform_from(q, (p_a + p_b) / 2)
    return State(
        t_ns=(a.t_ns + b.t_ns + 1) // 2,
        joints_rad=(a.joints_rad + b.joints_rad) / 2,
        width_m=(a.width_m + b.width_m) / 2,
        Ts_base_object=poses,
        nodes_m={
            name: (a.nodes_m[name] + b.nodes_m[name]) / 2
            for name in a.nodes_m.keys() & b.nodes_m.keys()
            if object_travel_m(a, b, name, 0.0) <= MAX_LEAP_M
        },
    )


class Reach:
    """How far a joint can move any point of each link, per radian."""

    def __init__(self, hulls: RobotHulls) -> None:
        """Add up the lengths of the links between each joint and each hull."""
        robot = hulls.robot
        model = robot.model
        joint_ids = [int(model.getJointId(name)) for name in ARM_JOINTS]
        self._per_rad = np.zeros((len(hulls.hulls), len(joint_ids)))
        self._fingers = np.zeros(len(hulls.hulls))
        for row, hull in enumerate(hulls.hulls):
            frame = model.frames[model.getFrameId(hull.link)]
            points = hull.points_m @ frame.placement.rotation.T + frame.placement.translation
            reach = float(np.linalg.norm(points, axis=1).max())
            joint = int(frame.parentJoint)
            while joint:
                if joint in joint_ids:
                    self._per_rad[row, joint_ids.index(joint)] = reach
                # The joint's own slide, if it is one, moves it by at most its range.
                reach += float(np.linalg.norm(model.jointPlacements[joint].translation))
                reach += _slide_m(model, joint)
                joint = int(model.parents[joint])
            self._fingers[row] = 0.5 if hull.link in FINGER_LINKS else 0.0

    def travel_m(self, a: State, b: State) -> Float[np.ndarray, " num_links"]:
        """How far any point of each link moved at most [m], when the joints moved straight."""
        turned = np.abs(b.joints_rad - a.joints_rad)
        return np.asarray(self._per_rad @ turned + self._fingers * abs(b.width_m - a.width_m))


def object_travel_m(a: State, b: State, name: str, radius_m: float) -> float:
    """How far any point of an object moved at most [m]; infinite when it is in one state only."""
    if name in a.nodes_m and name in b.nodes_m:
        return float(np.linalg.norm(b.nodes_m[name] - a.nodes_m[name], axis=1).max())
    if name not in a.Ts_base_object or name not in b.Ts_base_object:
        return float("inf")
    change = b.Ts_base_object[name] - a.Ts_base_object[name]
    # Rotations an angle apart differ by a matrix of norm sqrt(8) sin(angle / 2).
    turned = 2 * asin(min(1.0, hypot(*change[:3, :3].ravel().tolist()) / sqrt(8)))
    return hypot(*change[:3, 3].tolist()) + turned * radius_m


def _slide_m(model: Any, joint: int) -> float:
    """Largest displacement of a prismatic joint; 0 for one that turns."""
    item = model.joints[joint]
    if "P" not in item.shortname().removeprefix("JointModel"):
        return 0.0
    ends = (model.lowerPositionLimit[item.idx_q], model.upperPositionLimit[item.idx_q])
    return float(np.abs(ends).max())
