"""Soft bodies in the world of the robot: gripped, lifted, let go, and the same on every run."""

import hashlib
from collections.abc import Callable

import numpy as np
import pytest

from bridge.geometry import se3
from twin.physics.arm import PhysicsError
from twin.physics.config import PhysicsConfig
from twin.physics.soft import SoftModel
from twin.physics.world import World

HOME = np.array([0.0, -1.57, 1.57, -1.57, -1.57, 0.0])
Boxes = Callable[..., SoftModel]


def at(x: float, y: float, z: float) -> np.ndarray:
    return se3.transform_from(np.array([1.0, 0, 0, 0]), np.array([x, y, z]))


def closed_on(world: World, model: SoftModel, steps: int = 120) -> np.ndarray:
    """Close the fingers on a body between them; where the tool is."""
    world.reset_robot(HOME, 0.043)
    T_tcp = world.robot.T_base_link("tcp")
    world.soft_bodies().add("toy", model, T_tcp)
    for _ in range(steps):
        world.robot.command(HOME, np.zeros(6), 0.0)
        world.step()
    return T_tcp


def test_fingers_stop_on_a_soft_body_and_hold_it(urdf: str, box_of_cells: Boxes) -> None:
    model = box_of_cells((3, 3, 3), young_pa=8e4)
    with World(urdf, {}, PhysicsConfig()) as world:
        T_tcp = closed_on(world, model)
        width = world.robot.width_m()
        assert 0.015 < width < 0.041, "they pressed into it, and did not go through it"
        assert world.finger_touches("toy")
        drift = world.T_base_object("toy")[:3, 3] - T_tcp[:3, 3]
        assert np.linalg.norm(drift) < 5e-3, "the grasp does not hold against gravity"
        assert world.soft_bodies().health("toy").sound
        widths = []
        for _ in range(60):
            world.robot.command(HOME, np.zeros(6), 0.0)
            world.step()
            widths.append(world.robot.width_m())
        assert np.ptp(widths) < 1e-3, "the fingers shake"


def test_a_body_let_go_falls_and_takes_its_shape_again(urdf: str, box_of_cells: Boxes) -> None:
    model = box_of_cells((3, 3, 3), young_pa=4e4)
    with World(urdf, {}, PhysicsConfig()) as world:
        world.add_table(0.0)
        closed_on(world, model)
        assert world.robot.width_m() < 0.038, "it is not squeezed"
        for _ in range(240):
            world.robot.command(HOME, np.zeros(6), 0.085)
            world.step()
        assert not world.finger_touches("toy")
        assert world.T_base_object("toy")[2, 3] < 0.05
        np.testing.assert_allclose(
            world.soft_bodies().extents_m("toy") / model.size_m, 1.0, atol=0.05
        )


def test_a_soft_body_rests_on_a_free_box(urdf: str, box_of_cells: Boxes) -> None:
    with World(urdf, {}, PhysicsConfig()) as world:
        world.add_table(0.0)
        world.reset_robot(HOME, 0.08)
        world.add_free("cube", np.full(3, 0.06), 0.2, at(0.6, 0.3, 0.0301))
        world.soft_bodies().add("toy", box_of_cells((3, 3, 2)), at(0.6, 0.3, 0.076))
        for _ in range(240):
            world.step()
        assert world.T_base_object("toy")[2, 3] == pytest.approx(0.074, abs=2e-3)
        assert world.T_base_object("cube")[2, 3] == pytest.approx(0.03, abs=1e-3)


def test_every_run_gives_the_same_bits(urdf: str, box_of_cells: Boxes) -> None:
    found = set()
    for _ in range(2):
        with World(urdf, {}, PhysicsConfig()) as world:
            closed_on(world, box_of_cells((3, 3, 3)), 30)
            digest = hashlib.sha256(world.soft_bodies().nodes_m("toy").astype(np.float32).tobytes())
            digest.update(world.robot.posture()[0].tobytes())
            found.add(digest.hexdigest())
    assert len(found) == 1


def test_poses_and_extents_at_rest_are_those_given(urdf: str) -> None:
    from bridge.task.task_file import load_task

    duck = load_task("five_ducks_into_basket").objects["duck_1"]
    T = se3.transform_from(np.array([0.8, 0.0, 0.6, 0.0]), np.array([0.4, 0.1, 0.5]))
    with World(urdf, {}, PhysicsConfig()) as world:
        world.soft_bodies().add("duck", SoftModel.from_task(duck), T)
        np.testing.assert_allclose(world.T_base_object("duck"), T, atol=1e-6)
        np.testing.assert_allclose(world.soft_bodies().extents_m("duck"), duck.size_m, rtol=1e-5)
        assert not world.finger_touches("duck")


def test_an_unknown_object_is_named_with_those_there_are(urdf: str, box_of_cells: Boxes) -> None:
    with World(urdf, {}, PhysicsConfig()) as world:
        world.soft_bodies().add("toy", box_of_cells((2, 2, 2)), at(0.5, 0.0, 0.5))
        with pytest.raises(PhysicsError, match="There are: toy"):
            world.T_base_object("cube")
