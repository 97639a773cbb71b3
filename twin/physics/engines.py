"""What a replay asks of a physics engine, and which engines answer."""

from collections.abc import Sequence
from importlib import metadata
from types import TracebackType
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from twin.physics.arm import Hulls, Joints
from twin.physics.bending import SoftBodies
from twin.physics.config import Engine, PhysicsConfig, require_engine
from twin.physics.engine import ENGINE_VERSION
from twin.physics.unseen import EVEN, Unseen
from twin.physics.world import Box, World


@runtime_checkable
class DrivenRobot(Protocol):
    """An arm with a gripper that follows commands."""

    def command(self, joints_rad: Joints, velocity_rad_s: Joints, width_m: float) -> None:
        """Set the targets that the motors follow from the next step on."""

    def posture(self) -> tuple[Float[np.ndarray, " num_joints"], float]:
        """Where the arm is, and the distance between the finger pads."""

    def width_m(self) -> float:
        """Distance between the finger pads."""

    def T_base_link(self, link: str) -> Float[np.ndarray, "4 4"]:
        """Pose of a link's frame."""


@runtime_checkable
class PhysicsWorld(Protocol):
    """One simulated cell, whatever engine moves it. A context manager.

    The robot stands at the origin. Contact has Coulomb friction with the product of both partners'
    coefficients. The same calls give the same bits on every run.
    """

    @property
    def config(self) -> PhysicsConfig:
        """Rates, frictions and forces."""

    @property
    def robot(self) -> DrivenRobot:
        """The arm with its gripper."""

    def soft_bodies(self) -> SoftBodies:
        """What is soft in this world; an engine for rigid bodies only raises ``UsageError``."""

    def add_table(self, height_m: float) -> object:
        """Add the table: a slab whose top is at the height."""

    def add_static(self, boxes: Sequence[Box], T_base_owner: Float[np.ndarray, "4 4"]) -> object:
        """Add solid boxes that never move."""

    def add_free(
        self,
        object_id: str,
        size_m: Float[np.ndarray, "3"],
        mass_kg: float,
        T_base_object: Float[np.ndarray, "4 4"],
        unseen: Unseen = EVEN,
    ) -> None:
        """Add a solid box that moves."""

    def reset_robot(self, joints_rad: Float[np.ndarray, " num_joints"], width_m: float) -> None:
        """Put the robot into a posture at rest, without simulating."""

    def step(self) -> None:
        """Advance by one control period, 1 / ``rate_hz``."""

    def object_pose(self, object_id: str) -> tuple[float, ...]:
        """Position [m] and quaternion wxyz of an object that moves, seven numbers."""

    def T_base_object(self, object_id: str) -> Float[np.ndarray, "4 4"]:
        """Pose of an object that moves."""

    def finger_touches(self, object_id: str) -> bool:
        """Whether a finger is in contact with an object that moves."""

    def arm_force_N(self) -> float:
        """Size of the force that rigid bodies exert on the arm in all; a grasp's cancel out."""

    def __enter__(self) -> "PhysicsWorld":
        """Use as a context manager."""

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Free what the engine holds."""


def open_world(
    engine: Engine, urdf: str, mesh_hulls_m: Hulls, config: PhysicsConfig
) -> PhysicsWorld:
    """Make an empty world with the robot in it."""
    if engine == "pybullet":
        return World(urdf, mesh_hulls_m, config)
    require_engine(engine)
    from twin.physics.mujoco_world import MujocoWorld  # noqa: PLC0415  # an extra of its own

    return MujocoWorld(urdf, mesh_hulls_m, config)


def engine_version(engine: Engine) -> str:
    """Name an engine with its version, as verdicts carry it."""
    if engine == "pybullet":
        return ENGINE_VERSION
    require_engine(engine)
    return f"{engine}-{metadata.version(engine)}"
