"""What is put into the physics world lies there as it was told, and is carried as it lies."""

from dataclasses import replace

import numpy as np
import pytest

from bridge.geometry import se3
from bridge.robots.default import ROBOT
from twin.physics.config import PhysicsConfig
from twin.physics.engine import pybullet
from twin.physics.engines import Attachment
from twin.physics.world import World
from twin.robot.model import with_absolute_meshes

HOME = np.array([0.0, -1.57, 1.57, -1.57, -1.57, 0.0])
SIZE = np.array([0.04, 0.04, 0.04])


@pytest.fixture(scope="module")
def urdf() -> str:
    return with_absolute_meshes(ROBOT.urdf_text())


@pytest.mark.parametrize("seed", range(5))
def test_an_object_lies_where_and_as_it_was_put(urdf: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    T = se3.transform_from(rng.normal(size=4), np.array([0.5, 0.1, 0.8]))
    with World(urdf, {}, PhysicsConfig()) as world:
        world.add_free("a", np.array([0.02, 0.04, 0.06]), 0.05, T)
        np.testing.assert_allclose(world.T_base_object("a"), T, atol=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_a_wall_reaches_as_far_as_its_pose_says(urdf: str, seed: int) -> None:
    """Rays along the box's axes meet its faces at half of its extents: asked of the engine."""
    rng = np.random.default_rng(seed)
    extents = np.array([0.1, 0.2, 0.4])
    T = se3.transform_from(rng.normal(size=4), np.array([2.0, 2.0, 2.0]))
    with World(urdf, {}, PhysicsConfig()) as world:
        world.add_static([(np.array([0.05, 0.0, 0.0]), extents)], T)
        for axis in range(3):
            centre = np.array([0.05, 0.0, 0.0])
            start = centre + np.eye(3)[axis]
            hit = pybullet.rayTest(
                se3.apply(T, start).tolist(),
                se3.apply(T, centre).tolist(),
                physicsClientId=world.client,
            )[0]
            assert hit[2] == pytest.approx(1.0 - extents[axis] / 2, abs=1e-3)


def test_a_cube_comes_to_rest_on_a_table_of_any_height(urdf: str) -> None:
    with World(urdf, {}, PhysicsConfig()) as world:
        world.add_table(-0.3)
        T = np.eye(4)
        T[:3, 3] = (0.6, 0.3, -0.27)
        world.add_free("cube", SIZE, 0.05, T)
        for _ in range(120):
            world.step()
        assert world.T_base_object("cube")[2, 3] == pytest.approx(-0.28, abs=1e-3)


@pytest.mark.parametrize("axes", [(0, 1, 2), (1, 2, 0), (2, 0, 1)])
def test_an_attached_cube_stays_turned_in_the_hand_as_it_was(
    urdf: str, axes: tuple[int, int, int]
) -> None:
    """Position and rotation in the tool's frame, while the hand turns; faces stay parallel."""
    with World(urdf, {}, PhysicsConfig()) as world:
        world.reset_robot(HOME, 0.045)
        T = world.robot.T_base_link("tcp").copy()
        T[:3, :3] = T[:3, :3] @ np.eye(3)[:, axes]
        world.add_free("cube", SIZE, 0.05, T)
        tie = Attachment(world)
        relative = []
        for step in range(240):
            target = HOME + np.array([0.3, 0.1, 0, 0, 0, 0.4]) * min(step / 200, 1.0)
            world.robot.command(target, np.zeros(6), 0.02)
            world.step()
            tie.update(0.02)
            hand = world.robot.T_base_link("tcp")
            relative.append(se3.invert(hand) @ world.T_base_object("cube"))
    turned = se3.rotation_angle_rad(relative[60][:3, :3].T @ relative[-1][:3, :3])
    assert turned < 0.03
    np.testing.assert_allclose(relative[-1][:3, 3], relative[60][:3, 3], atol=2e-3)
    about = se3.rotation_angle_rad(np.eye(3)[:, axes].T @ relative[-1][:3, :3])
    assert about < 0.1, "it is tied as it was touched"


def test_fingers_told_the_width_they_have_keep_what_is_attached_and_let_go_when_wider(
    urdf: str,
) -> None:
    """Without friction only the tie holds it."""
    slippery = replace(PhysicsConfig(), finger_friction=0.0, object_friction=0.0)
    with World(urdf, {}, slippery) as world:
        world.reset_robot(HOME, 0.045)
        T = world.robot.T_base_link("tcp").copy()
        world.add_free("cube", SIZE, 0.05, T)
        tie = Attachment(world)

        def fallen(width_m: float, steps: int = 60) -> float:
            for _ in range(steps):
                world.robot.command(HOME, np.zeros(6), width_m)
                world.step()
                tie.update(width_m)
            return float(T[2, 3] - world.T_base_object("cube")[2, 3])

        assert fallen(0.02) < 5e-3
        assert fallen(world.robot.width_m()) < 5e-3
        assert fallen(world.robot.width_m() + 0.004, 120) > 0.1
