"""``--grasp attach``: what is touched is carried whatever the friction, and the engine says so."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from bridge.geometry import se3
from bridge.robots.default import ROBOT
from twin.physics.config import PhysicsConfig
from twin.physics.engines import Attachment
from twin.physics.world import World
from twin.replay.config import ReplayConfig
from twin.replay.verdict import engine_of
from twin.robot.model import with_absolute_meshes

HOME = np.array([0.0, -1.57, 1.57, -1.57, -1.57, 0.0])
SLIPPERY = replace(PhysicsConfig(), finger_friction=0.0, object_friction=0.02)
SIZE = np.array([0.04, 0.04, 0.04])


def held(tied: bool) -> tuple[float, float]:
    """How far a cube without friction falls from between the fingers, closed and then open."""
    with World(with_absolute_meshes(ROBOT.urdf_text()), {}, SLIPPERY) as world:
        world.reset_robot(HOME, 0.045)
        T = world.robot.T_base_link("tcp")
        world.add_free("cube", SIZE, 0.05, T)
        tie = Attachment(world)
        drops = []
        for width in (0.02, 0.08):
            for _ in range(120):
                world.robot.command(HOME, np.zeros(6), width)
                world.step()
                if tied:
                    tie.update(width)
            drops.append(float(T[2, 3] - world.T_base_object("cube")[2, 3]))
        return drops[0], drops[1]


def test_an_attached_cube_does_not_slip_and_is_let_go_when_the_fingers_open() -> None:
    closed, opened = held(tied=True)
    assert abs(closed) < 5e-3
    assert opened > 0.1
    assert held(tied=False)[0] > 0.1, "without the tie it falls"


def test_an_attached_cube_keeps_its_place_in_the_hand() -> None:
    with World(with_absolute_meshes(ROBOT.urdf_text()), {}, SLIPPERY) as world:
        world.reset_robot(HOME, 0.045)
        world.add_free("cube", SIZE, 0.05, world.robot.T_base_link("tcp"))
        tie = Attachment(world)
        for step in range(240):
            target = HOME + np.array([0.3, 0, 0, 0, 0, 0.4]) * min(step / 200, 1.0)
            world.robot.command(target, np.zeros(6), 0.02)
            world.step()
            tie.update(0.02)
            if step == 60:
                before = se3.invert(world.robot.T_base_link("tcp")) @ world.T_base_object("cube")
        after = se3.invert(world.robot.T_base_link("tcp")) @ world.T_base_object("cube")
    assert np.linalg.norm(after[:3, 3] - before[:3, 3]) < 2e-3


@pytest.mark.parametrize(("grasp", "word"), [("friction", False), ("attach", True)])
def test_the_engine_is_named_after_the_grasp(
    script: SimpleNamespace, grasp: str, word: bool
) -> None:
    config = replace(ReplayConfig(), grasp=grasp)
    assert ("+attach" in engine_of(script.scene().task, config)) is word
    assert "+attach" not in engine_of(script.scene().task, replace(config, mode="kinematic"))
