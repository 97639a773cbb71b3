"""Stalled fingers: their whole force, and the usual speed as soon as they are free."""

from dataclasses import replace

import numpy as np
import pytest

from bridge.robots.default import FINGER_JOINTS
from twin.physics import arm
from twin.physics.config import FINGER_SPEED_M_S, PhysicsConfig
from twin.physics.world import World

HOME = np.array([0.0, -1.57, 1.57, -1.57, -1.57, 0.0])
SIZE = np.array([0.04, 0.04, 0.04])
STILL = np.zeros(6)
STRONG = PhysicsConfig(grip_force_N=30.0)
OPEN_M, CLOSED_M = 0.06, 0.0


def fingers(world: World) -> np.ndarray:
    """Speed [m/s] and force [N] of each finger."""
    names = {
        world.client.getJointInfo(world.robot.id, index)[1].decode(): (index)
        for index in range(world.client.getNumJoints(world.robot.id))
    }
    states = world.client.getJointStates(world.robot.id, [names[name] for name in FINGER_JOINTS])
    return np.array([[state[1], state[3]] for state in states])


def run(world: World, steps: int, width_m: float) -> np.ndarray:
    """Step, and return the speeds and forces on the way."""
    rows = []
    for _ in range(steps):
        world.robot.command(HOME, STILL, width_m)
        world.step()
        rows.append(fingers(world))
    return np.array(rows)


def holding(world: World) -> np.ndarray:
    """Close on a cube that floats between the fingers."""
    world.client.setGravity(0, 0, 0)
    world.reset_robot(HOME, OPEN_M)
    world.add_free("cube", SIZE, 0.05, world.robot.T_base_link("tcp"))
    run(world, 10, OPEN_M)
    return run(world, 120, CLOSED_M)


def test_the_whole_force_is_there_after_a_few_iterations(
    urdf: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    few = replace(STRONG, solver_iterations=20)
    with World(urdf, {}, few) as world:
        np.testing.assert_allclose(np.abs(holding(world)[-20:, :, 1]), 30.0, rtol=1e-6)
    monkeypatch.setattr(arm, "PATIENCE", 10**9)
    with World(urdf, {}, few) as world:
        assert np.abs(holding(world)[-20:, :, 1]).max() < 20.0, "at the usual speed it is not"


def test_fingers_keep_their_speed_until_they_meet_something(urdf: str) -> None:
    with World(urdf, {}, STRONG) as world:
        world.reset_robot(HOME, OPEN_M)
        run(world, 10, OPEN_M)
        speeds = np.abs(run(world, 60, CLOSED_M)[:, :, 0])
        assert speeds.max() < 1.05 * FINGER_SPEED_M_S
        assert speeds[:40].max() > 0.95 * FINGER_SPEED_M_S


def test_fingers_whose_cube_is_gone_are_slow_again_after_a_few_steps(urdf: str) -> None:
    with World(urdf, {}, STRONG) as world:
        holding(world)
        width_m = world.robot.width_m()
        world.client.resetBasePositionAndOrientation(
            world.free_ids["cube"], [2.0, 0.0, 1.0], [0, 0, 0, 1]
        )
        speeds = np.abs(run(world, 12, CLOSED_M)[:, :, 0])
        free_m_s = 1.05 * FINGER_SPEED_M_S
        assert (speeds.max(axis=1) > free_m_s).sum() <= arm.EVERY_STEPS
        usual_m = 2 * FINGER_SPEED_M_S * 12 / STRONG.rate_hz
        farthest_m = 2 * arm.EVERY_STEPS * arm.PRESS_M_S / STRONG.rate_hz
        assert world.robot.width_m() > width_m - usual_m - farthest_m - 1e-3
