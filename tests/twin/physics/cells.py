"""Worlds of both engines for tests of laws, and a robot that is a pendulum."""

import numpy as np

from bridge.geometry import se3
from bridge.robots.default import ARM_JOINTS, FINGER_JOINTS, FINGER_LINKS, ROBOT, TCP_FRAME
from twin.physics.config import PhysicsConfig
from twin.physics.engines import PhysicsWorld, open_world
from twin.physics.mujoco_world import MujocoWorld
from twin.physics.world import World
from twin.robot.model import with_absolute_meshes

ENGINES = ("pybullet", "mujoco")
HOME = np.array([0.0, -1.57, 1.57, -1.57, -1.57, 0.0])
URDF = with_absolute_meshes(ROBOT.urdf_text())


def cell(engine: str, urdf: str = URDF, **settings: float) -> PhysicsWorld:
    """An empty world; objects are put where the arm is not."""
    return open_world(engine, urdf, {}, PhysicsConfig(**settings))


def at(x: float, y: float, z: float, R: np.ndarray | None = None) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = x, y, z
    T[:3, :3] = np.eye(3) if R is None else R
    return T


def push(world: PhysicsWorld, name: str, linear_m_s: object, angular_rad_s: object) -> None:
    """Give an object a velocity, base frame: the one thing here that no replay asks for."""
    _PUSHES[type(world)](world, name, np.array(linear_m_s, float), np.array(angular_rad_s, float))


def _push_pybullet(world: World, name: str, v: np.ndarray, omega: np.ndarray) -> None:
    from twin.physics.engine import pybullet

    body = world.free_ids[name]
    pybullet.resetBaseVelocity(body, v.tolist(), omega.tolist(), physicsClientId=world.client)


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


def pendulum_urdf(mass_kg: float, length_m: float, inertia: float) -> str:
    """A robot whose last joint has no motor and carries a weight; all others hold still."""
    links = [_link("base_link", 1.0, 0.0, 1e-2)]
    joints = []
    parent = "base_link"
    for number, name in enumerate(ARM_JOINTS):
        last = number == len(ARM_JOINTS) - 1
        child = f"link_{number}"
        links.append(
            _link(child, mass_kg, length_m, inertia) if last else _link(child, 50.0, 0.0, 1.0)
        )
        joints.append(_joint(name, "revolute", parent, child, "0 1 0", 0.0 if last else 1e5))
        parent = child
    for name in FINGER_LINKS:
        links.append(_link(name, 1e-3, 0.0, 1e-6))
    for name, child, axis in zip(FINGER_JOINTS, FINGER_LINKS, ("0 1 0", "0 -1 0"), strict=True):
        joints.append(_joint(name, "prismatic", "link_0", child, axis, 60.0))
    links.append(_link(TCP_FRAME, 1e-3, 0.0, 1e-6))
    joints.append(_joint("tool", "fixed", "link_0", TCP_FRAME, "0 0 1", 0.0))
    return f'<robot name="pendulum">{"".join(links)}{"".join(joints)}</robot>'


def _link(name: str, mass_kg: float, down_m: float, inertia: float) -> str:
    return (
        f'<link name="{name}"><inertial><origin xyz="0 0 {-down_m}"/><mass value="{mass_kg}"/>'
        f'<inertia ixx="{inertia}" iyy="{inertia}" izz="{inertia}" ixy="0" ixz="0" iyz="0"/>'
        "</inertial></link>"
    )


def _joint(name: str, kind: str, parent: str, child: str, axis: str, effort: float) -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<axis xyz="{axis}"/><limit lower="-3" upper="3" effort="{effort}" velocity="10"/></joint>'
    )
