"""A carved surface lies where it was measured, not where voxels end."""

import numpy as np
import pytest

from twin.scene.shape.carve import Evidence, VoxelBox, signed_distances
from twin.scene.shape.isosurface import isosurface
from twin.scene.shape.sdf import distances_of_solid

VOXEL, TRUNCATION = 0.002, 0.008
COUNTS = (24, 20, 20)
BOX = VoxelBox(origin_m=np.zeros(3), voxel_m=VOXEL, counts=COUNTS)


def wall(low: float, high: float, *, stretch: float = 1.0) -> tuple[np.ndarray, Evidence]:
    """A plate across x between two places in voxels, measured from both sides."""
    x = np.arange(COUNTS[0], dtype=np.float64)
    distance = np.maximum(low - x, x - high)
    solid = np.zeros(COUNTS, dtype=bool)
    solid[distance < 0, 2:-2, 2:-2] = True
    measured = np.broadcast_to((stretch * distance * VOXEL)[:, None, None], COUNTS)
    seen = np.abs(measured) < TRUNCATION
    seen = seen & (np.arange(COUNTS[1]) > 1)[:, None] & (np.arange(COUNTS[1]) < 18)[:, None]
    tsdf = np.where(seen, measured / TRUNCATION, 0.0).astype(np.float32)
    return solid, Evidence(box=BOX, tsdf=tsdf, weight=seen.astype(np.float32), empty=~solid)


@pytest.mark.parametrize("stretch", [1.0, 1.8])
@pytest.mark.parametrize(("low", "high"), [(8.0, 11.4), (8.3, 11.1), (8.49, 11.51)])
def test_a_thin_wall_is_as_thick_as_measured(low: float, high: float, stretch: float) -> None:
    solid, evidence = wall(low, high, stretch=stretch)
    values = signed_distances(solid, evidence, TRUNCATION)
    vertices, _ = isosurface(values, BOX.origin_m, VOXEL)
    middle = vertices[np.all(np.abs(vertices[:, 1:] - 0.019) < 0.01, axis=1), 0] / VOXEL
    np.testing.assert_allclose(middle[middle < 9.7], low, atol=0.06)
    np.testing.assert_allclose(middle[middle > 9.7], high, atol=0.06)


def test_where_nobody_measured_faces_between_voxels_are_the_surface() -> None:
    solid, evidence = wall(8.2, 11.3)
    nothing = np.zeros_like(evidence.tsdf)
    blind = Evidence(box=BOX, tsdf=nothing, weight=nothing, empty=~solid)
    np.testing.assert_allclose(
        signed_distances(solid, blind, TRUNCATION), distances_of_solid(solid, VOXEL), atol=1e-7
    )
