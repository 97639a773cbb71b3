"""What is put into the physics world lies there as it was told."""

import numpy as np
import pytest

from bridge.geometry import se3
from twin.physics.config import PhysicsConfig
from twin.physics.world import World

SIZE = np.array([0.04, 0.04, 0.04])


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
            ends = (se3.apply(T, point).tolist() for point in (start, centre))
            (hit,) = world.client.rayTest(*ends)
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


@pytest.mark.parametrize("seed", range(5))
def test_an_object_lies_where_and_as_it_was_put(urdf: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    T = se3.transform_from(rng.normal(size=4), np.array([0.5, 0.1, 0.8]))
    with World(urdf, {}, PhysicsConfig()) as world:
        world.add_free("a", np.array([0.02, 0.04, 0.06]), 0.05, T)
        np.testing.assert_allclose(world.T_base_object("a"), T, atol=1e-6)
