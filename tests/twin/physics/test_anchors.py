"""Dry friction with anchors: it holds within Coulomb's cone and slides outside it."""

from collections.abc import Iterator

import numpy as np
import pytest

from bridge.geometry import se3
from twin.physics import world as world_module
from twin.physics.config import PhysicsConfig
from twin.physics.world import World

HOME = np.array([0.0, -1.57, 1.57, -1.57, -1.57, 0.0])
SIZE = np.array([0.04, 0.04, 0.04])
STILL = np.zeros(6)
G = 9.81
WEAK = PhysicsConfig(object_friction=0.5, grip_force_N=2.0)
CARRIED_KG = 2 * WEAK.object_friction * WEAK.finger_friction * WEAK.grip_force_N / G


def gripping(world: World, mass_kg: float) -> None:
    """Hold a cube between the fingers, weightless."""
    world.client.setGravity(0, 0, 0)
    world.reset_robot(HOME, 0.041)
    world.add_free("cube", SIZE, mass_kg, world.robot.T_base_link("tcp"))
    for _ in range(60):
        world.robot.command(HOME, STILL, 0.0)
        world.step()


def turning(world: World, angle_rad: float, speed_rad_s: float = 2.0) -> Iterator[np.ndarray]:
    """Turn the last joint step by step; where the joints are told to be."""
    joints, velocity = HOME.copy(), STILL.copy()
    velocity[5] = speed_rad_s
    steps = round(angle_rad / speed_rad_s * world.config.rate_hz)
    yield joints
    for _ in range(steps):
        joints[5] += angle_rad / steps
        world.robot.command(joints, velocity, 0.0)
        world.step()
        yield joints


def weigh_down(world: World, joints: np.ndarray, steps: int) -> float:
    """Switch gravity on; how far the cube has moved in the tool's frame [m]."""
    world.client.setGravity(0, 0, -G)
    start = se3.invert(world.robot.T_base_link("tcp")) @ world.T_base_object("cube")
    for _ in range(steps):
        world.robot.command(joints, STILL, 0.0)
        world.step()
    end = se3.invert(world.robot.T_base_link("tcp")) @ world.T_base_object("cube")
    return float(np.linalg.norm(end[:3, 3] - start[:3, 3]))


def normal_error_rad(world: World) -> float:
    """Angle between the fingers' closing direction and contact normals, weighted by force."""
    finger = world.robot.T_base_link("gripper_left_finger")[:3, :3]
    axis = finger @ np.array([0.0, 1.0, 0.0])
    points = world.client.getContactPoints(world.robot.id, world.free_ids["cube"])
    angles = [np.arccos(min(1.0, abs(axis @ np.array(point[7])))) for point in points]
    return float(np.average(angles, weights=[point[9] for point in points]))


@pytest.mark.parametrize("turn_rad", [0.0, 1.2])
def test_fingers_hold_what_friction_carries_and_lose_what_it_does_not(
    urdf: str, turn_rad: float
) -> None:
    moved = {}
    for share in (0.9, 1.1):
        with World(urdf, {}, WEAK) as world:
            gripping(world, share * CARRIED_KG)
            *_, joints = turning(world, turn_rad)
            moved[share] = weigh_down(world, joints, 72)
    assert moved[0.9] < 1e-3
    assert moved[1.1] > 0.02


def test_what_is_held_does_not_creep(urdf: str) -> None:
    with World(urdf, {}, PhysicsConfig()) as world:
        gripping(world, 0.05)
        weigh_down(world, HOME, 60)
        assert weigh_down(world, HOME, 480) < 2e-5


def test_contact_normals_turn_with_what_is_held(urdf: str, monkeypatch: pytest.MonkeyPatch) -> None:
    errors = {}
    for every in (world_module.EVERY_STEPS, 10**9):
        monkeypatch.setattr(world_module, "EVERY_STEPS", every)
        with World(urdf, {}, PhysicsConfig()) as world:
            gripping(world, 0.05)
            found = [normal_error_rad(world) for _ in turning(world, 1.2)]
        errors[every] = np.rad2deg(np.mean(found))
    kept_fresh, left_alone = errors.values()
    assert kept_fresh < 5.0
    assert left_alone > 15.0, "the engine turns normals itself: nothing need be let go"
