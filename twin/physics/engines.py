"""What a replay asks of a physics engine, and which engines answer."""

from importlib import metadata
from typing import TYPE_CHECKING, Union

from twin.physics.arm import Hulls
from twin.physics.config import Engine, PhysicsConfig, require_engine
from twin.physics.engine import ENGINE_VERSION
from twin.physics.world import World

if TYPE_CHECKING:
    import twin.physics.mujoco_world

PhysicsWorld = Union[World, "twin.physics.mujoco_world.MujocoWorld"]  # not loaded
"""One simulated cell, whatever engine moves it. A context manager.

The robot stands at the origin. Contact has Coulomb friction with the product of both partners'
coefficients. The same calls give the same bits on every run.
"""


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
