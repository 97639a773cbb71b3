"""What the parts of the planner hand to each other: the scene, states, grasps, releases, paths.

Frames: ``base`` is the robot's base frame, ``tcp`` the tool centre point between the open finger
pads: its z axis points out of the hand (the approach direction), the fingers close along its y.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from bridge.geometry import se3
from bridge.task.task_file import ObjectModel
from twin.errors import TwinError
from twin.replay.scene import ReplayScene
from twin.robot.model import RobotModel

Pose = Float[np.ndarray, "4 4"]
Poses = Float[np.ndarray, "_ 4 4"]
RotationMatrix = Float[np.ndarray, "3 3"]
Covariance = Float[np.ndarray, "6 6"]
"""Of a pose: x, y, z [m] and rotation about them [rad], base frame."""
Joints = Float[np.ndarray, " num_joints"]
Postures = Float[np.ndarray, "_ num_joints"]
Vector = Float[np.ndarray, "3"]
Points = Float[np.ndarray, "_ 3"]
Numbers = Float[np.ndarray, " _"]
Flags = Bool[np.ndarray, " _"]
Ids = Int[np.ndarray, " _"]
Array = Any
"""``np.ndarray``, or a number for all states."""


class NoPlanError(TwinError):
    """The planner finds no plan; the message says why and what would help."""

    def __init__(self, message: str, *, cause: str = "") -> None:
        """Remember the cause, in one word."""
        self.cause = cause
        super().__init__(message)


@dataclass(frozen=True, kw_only=True)
class Shape:
    """The surface of one object, in its own frame."""

    vertices_m: Points
    triangles: Int[np.ndarray, "num_triangles 3"]
    """Counter-clockwise seen from outside."""
    source: str
    """Where it comes from, in words: the scan, or the task file."""
    trusted_from_m: float = -np.inf
    """Below this height in the object frame nobody saw the surface."""
    error_m: float = 0.0
    """How far the surface may be off."""


@dataclass(frozen=True, kw_only=True)
class Problem:
    """What the planner knows when it plans."""

    scene: ReplayScene
    """Task, poses with covariances, static distances, containers, where the arm stands."""
    robot: RobotModel
    shapes: Mapping[str, Shape]

    def model(self, object_id: str) -> ObjectModel:
        """The task file's nominal shape of an object."""
        return self.scene.task.objects[object_id]

    def contacts_of(self, verb: str, object_id: str) -> frozenset[frozenset[str]]:
        """Pairs that may touch in the stage that grasps, or releases, an object."""
        return frozenset(
            frozenset(pair)
            for stage in self.scene.task.stages
            if stage.get(verb) == object_id
            for pair in stage.get("allowed_contacts", ())
        )


@dataclass(frozen=True, kw_only=True)
class State:
    """Many hypothetical states at once: what constraints are asked about.

    Everything is batched over its first axis, ``num_states``.
    """

    Ts_base_object: Mapping[str, Array]
    """Per object ``(num_states, 4, 4)``; those that do not move are broadcast."""
    T_base_tcp: Array
    """``(num_states, 4, 4)``."""
    width_m: Array
    """``(num_states,)``, between the finger pads."""

    @staticmethod
    def single(Ts_base_object: Mapping[str, Pose], T_base_tcp: Pose, width_m: float) -> "State":
        """A batch of one."""
        return State(
            Ts_base_object={name: T[None] for name, T in Ts_base_object.items()},
            T_base_tcp=T_base_tcp[None],
            width_m=np.array([width_m]),
        )


@dataclass(frozen=True, kw_only=True)
class Grasp:
    """One way to take hold of an object."""

    object_id: str
    T_object_tcp: Pose
    """Tool at the grasp instant, in the object's frame (errata: Eq. 9)."""
    width_m: float
    """Distance between the two surfaces it closes on."""
    open_m: float
    """Opening of the hand on its way there."""
    margin: float
    """How many standard deviations of the object's pose it bears; greater is better."""
    joints_rad: Joints
    """Arm at the grasp, from the base's side."""
    pregrasp_m: float
    """Length of the straight approach along the tool's z axis."""


@dataclass(frozen=True, kw_only=True)
class Miss:
    """How far an object came to lie from straight below where it was let go.

    The pads shift and turn it as they close. It moves with the object's frame, for the same grasp
    does the same elsewhere.
    """

    shift_m: Vector = field(default_factory=lambda: np.zeros(3))
    """In the object's frame."""
    turn_rad: float = 0.0
    """About the vertical."""

    @staticmethod
    def measured(T_meant: Pose, T_found: Pose) -> "Miss":
        """What lies between two poses ``T_base_object``, seen from above."""
        way = (T_found[:3, 3] - T_meant[:3, 3]) * (1.0, 1.0, 0.0)
        R = T_found[:3, :3] @ T_meant[:3, :3].T
        turn_rad = float(np.arctan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1]))
        return Miss(shift_m=T_meant[:3, :3].T @ way, turn_rad=turn_rad)

    def applied(self, Ts: Poses) -> Poses:
        """Where objects meant to be here come to lie, their height left as it is."""
        found = Ts.copy()
        found[:, :2, 3] += (Ts[:, :3, :3] @ self.shift_m)[:, :2]
        found[:, :3, :3] = _about_z(self.turn_rad) @ Ts[:, :3, :3]
        return found

    def undone(self, T: Pose) -> Pose:
        """The pose from which an object comes to lie here."""
        found = T.copy()
        found[:3, :3] = _about_z(-self.turn_rad) @ T[:3, :3]
        found[:2, 3] -= (found[:3, :3] @ self.shift_m)[:2]
        return found


def _about_z(angle_rad: float) -> RotationMatrix:
    return se3.rotation_from_vector(np.array([0.0, 0.0, angle_rad]))


@dataclass(frozen=True, kw_only=True)
class Release:
    """One final state of a carried object (Eq. 8 and 9)."""

    object_id: str
    T_base_object: Pose
    T_base_tcp: Pose
    """Tool at the release: ``T_base_object @ T_object_tcp`` of the grasp."""
    cost: float
    """J of Eq. 7, by which they are ranked."""


@dataclass(frozen=True, kw_only=True)
class TimedPath:
    """One collision-free movement with its times."""

    times_s: Numbers
    joints_rad: Postures
