"""The physics world: things fall, rest, are gripped, and do the same on every run."""

import hashlib
from pathlib import Path

import numpy as np
import pytest

from bridge.geometry import se3
from bridge.geometry.mesh import box_corners
from twin.physics import engine
from twin.physics.arm import Arm, write_description
from twin.physics.config import PhysicsConfig
from twin.physics.world import World

HOME = np.array([0.0, -1.57, 1.57, -1.57, -1.57, 0.0])
SIZE = np.array([0.04, 0.04, 0.04])


def at(x: float, y: float, z: float) -> np.ndarray:
    return se3.transform_from(np.array([1.0, 0, 0, 0]), np.array([x, y, z]))


def dropped(urdf: str, steps: int) -> str:
    """Drop two cubes onto the table; the last pose, and a hash of all of them."""
    digest = hashlib.sha256()
    with World(urdf, {}, PhysicsConfig()) as world:
        world.add_table(0.0)
        world.add_free("low", SIZE, 0.05, at(0.5, 0.0, 0.05))
        world.add_free("high", SIZE, 0.05, at(0.51, 0.01, 0.12))
        world.reset_robot(HOME, 0.08)
        for _ in range(steps):
            world.robot.command(HOME, np.zeros(6), 0.08)
            world.step()
            digest.update(world.T_base_object("low").tobytes())
            digest.update(world.T_base_object("high").tobytes())
            digest.update(world.robot.posture()[0].tobytes())
        return digest.hexdigest()


def test_what_a_world_before_was_told_changes_nothing(urdf: str) -> None:
    """Clients are used again: settings, bodies and constraints of one world end with it."""
    while engine._IDLE:
        engine._IDLE.pop().disconnect()
    first = dropped(urdf, 60)
    odd = PhysicsConfig(rate_hz=480, solver_iterations=7, solver_residual=1e-2, gravity_m_s2=1.0)
    with World(urdf, {}, odd) as world:
        client = world.client
        client.setPhysicsEngineParameter(
            enableConeFriction=0,
            erp=0.9,
            contactERP=0.9,
            frictionERP=0.9,
            numSubSteps=3,
            reportSolverAnalytics=1,
        )
        world.add_free("left", SIZE, 0.05, at(0.5, 0.0, 0.3))
        for _ in range(20):
            world.step()
    with World(urdf, {}, PhysicsConfig()) as world:
        assert world.client == client, "this is about one client"
    assert dropped(urdf, 60) == first


def test_two_worlds_at_once_are_apart(urdf: str) -> None:
    with World(urdf, {}, PhysicsConfig()) as one, World(urdf, {}, PhysicsConfig()) as other:
        assert one.client != other.client
        one.add_free("cube", SIZE, 0.05, at(0.5, 0.0, 0.3))
        assert not other.free_ids
    assert len(engine._IDLE) == 1


def test_orders_given_once_do_what_repeated_ones_do(
    urdf: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    once = dropped(urdf, 60)
    command = Arm.command

    def again(self: Arm, joints: np.ndarray, velocity: np.ndarray, width_m: float) -> None:
        self._arm_order = self._finger_order = None
        command(self, joints, velocity, width_m)

    monkeypatch.setattr(Arm, "command", again)
    assert dropped(urdf, 60) == once


def test_a_link_may_be_called_what_no_file_can_be(urdf: str, tmp_path: Path) -> None:
    other = urdf.replace('"forearm_link"', '"left/forearm_link"')
    assert other != urdf
    path = write_description(other, {"left/forearm_link": [box_corners(SIZE)]}, tmp_path)
    assert "left/forearm_link" in path.read_text()
    assert len(list(tmp_path.glob("*.obj"))) == 1
