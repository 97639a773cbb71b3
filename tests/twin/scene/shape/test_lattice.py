"""The lattice of a soft body: inside, connected, filling the volume."""

from dataclasses import replace

import numpy as np
import pytest
from solid_shapes import ball_shape, grid, shape_of

from bridge.task.meshes.lattice import volumes_m3
from twin.scene.shape.carve import ShapeError
from twin.scene.shape.lattice import lattice
from twin.scene.shape.reconstruct import ObjectShape


@pytest.fixture(scope="module")
def ball() -> ObjectShape:
    return ball_shape()


@pytest.fixture(scope="module")
def inside(ball: ObjectShape) -> dict[str, np.ndarray]:
    return lattice(ball.sdf)


def test_tetrahedra_are_positive_and_fill_the_shape(
    ball: ObjectShape, inside: dict[str, np.ndarray]
) -> None:
    volumes = volumes_m3(inside["nodes_m"].astype(np.float64), inside["tets"])
    assert np.all(volumes > 0)
    assert volumes.sum() == pytest.approx(ball.volume_m3, rel=0.15)
    assert inside["mass_fraction"].sum() == pytest.approx(1.0, abs=1e-5)
    assert np.all(inside["mass_fraction"] > 0)
    centre = inside["mass_fraction"] @ inside["nodes_m"]
    np.testing.assert_allclose(centre, ball.vertices_m.mean(axis=0), atol=0.001)


def test_a_shape_thinner_than_the_lattice_says_so() -> None:
    x, y, z = grid(30)
    wedge = (np.abs(x) < 10) & (np.abs(y) < 10) & (np.abs(z - np.abs(x)) < 0.6)
    shape = shape_of(wedge | ((np.abs(x) < 1) & (np.abs(y) < 10) & (z > 8) & (z < 10)), 0.001)
    thin = replace(shape.sdf, values_m=np.abs(shape.sdf.values_m) + 2e-3)
    with pytest.raises(ShapeError, match="finer one"):
        lattice(thin)
