"""Worlds of both engines for tests of laws, and a robot that is a pendulum."""

import numpy as np

from bridge.geometry import se3
from bridge.robots.default import ROBOT
from twin.physics.config import PhysicsConfig
from twin.physics.engines import PhysicsWorld, open_world
from twin.physics.mujoco_world import MujocoWorld
from twin.physics.world import World
from twin.robot.model import load_robot, with_absolute_meshes

ENGINES = ("pybullet", "mujoco")
HOME = np.array([0.0, -1.57, 1.57, -1.57, -1.57, 0.0])
URDF = with_absolute_meshes(ROBOT.urdf_text())


def cell(engine: str, urdf: str = URDF, **settings: float) -> PhysicsWorld:
    """An empty world; objects are put where the arm is not."""
    return open_world(engine, urdf, {}, PhysicsConfig(**settings))


def T_base_tcp(world: PhysicsWorld) -> np.ndarray:
    """Where the tool is."""
    return load_robot(URDF).T_base_tcp(world.robot.posture()[0])


def at(x: float, y: float, z: float, R: np.ndarray | None = None) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = x, y, z
    T[:3, :3] = np.eye(3) if R is None else R
    return T


def push(world: PhysicsWorld, name: str, linear_m_s: object, angular_rad_s: object) -> None:
    """Give an object a velocity, base frame: the one thing here that no replay asks for."""
    _PUSHES[type(world)](world, name, np.array(linear_m_s, float), np.array(angular_rad_s, float))


def _push_pybullet(world: World, name: str, v: np.ndarray, omega: np.ndarray) -> None:

    body = world.free_ids[name]
    world.client.resetBaseVelocity(body, v.tolist(), omega.tolist())


def _push_mujoco(world: MujocoWorld, name: str, v: np.ndarray, omega: np.ndarray) -> None:
    R = world.T_base_object(name)[:3, :3]
    world._data.joint(f"object/{name}").qvel = np.concatenate([v, R.T @ omega])


_PUSHES = {World: _push_pybullet, MujocoWorld: _push_mujoco}


def poses(world: PhysicsWorld, name: str, steps: int) -> np.ndarray:
    """Where an object is, before the first step and after each."""
    found = [world.object_pose(name)]
    for _ in range(steps):
        world.step()
        found.append(world.object_pose(name))
    return np.array(found)


def rotations(rows: np.ndarray) -> np.ndarray:
    return se3.transform_from(rows[:, 3:], rows[:, :3])[:, :3, :3]
