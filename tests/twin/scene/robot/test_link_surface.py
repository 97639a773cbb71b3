"""A link drawn on its own shape: closed, in the colours that each side was seen in."""

import numpy as np

from bridge.geometry.mesh import sample_triangles
from twin.scene.frames.rgbd import PointSet
from twin.scene.gaussians import as_float32
from twin.scene.robot.extraction import on_surface
from twin.scene.shape.mesh import Mesh

HALF_M = np.array([0.05, 0.04, 0.2])
RED, GREEN = np.array([0.8, 0.1, 0.1]), np.array([0.1, 0.7, 0.2])


def box(half_m: np.ndarray = HALF_M) -> Mesh:
    corners = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    triangles = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    return corners * half_m, triangles


def seen(noise_m: float = 0.002) -> PointSet:
    """Two sides of the box, red towards +x and green towards +y, measured with noise."""
    rng = np.random.default_rng(1)
    p = rng.uniform(-1, 1, (6000, 3)) * HALF_M
    axis = np.repeat([0, 1], 3000)
    p[np.arange(6000), axis] = HALF_M[axis]
    normals = np.eye(3)[axis]
    p += normals * rng.normal(0, noise_m, (6000, 1))
    colors = np.where(axis[:, None] == 0, RED, GREEN) + rng.normal(0, 0.03, (6000, 3))
    return PointSet(
        p_m=as_float32(p),
        normals=as_float32(normals),
        colors=as_float32(colors),
        footprint_m=as_float32(np.full(6000, 0.003)),
    )


def test_gaussians_lie_on_the_shape_densely_and_keep_the_colour_of_their_side() -> None:
    cloud = on_surface([box()], [seen()], 0.01)
    assert cloud is not None
    p = cloud.means_m.astype(np.float64)
    np.testing.assert_allclose(np.max(np.abs(p) / HALF_M, axis=1), 1.0, atol=1e-5)
    inner = np.abs(p) < HALF_M - 0.012
    for axis, color in ((0, RED), (1, GREEN)):
        side = (p[:, axis] > HALF_M[axis] - 1e-5) & np.delete(inner, axis, axis=1).all(axis=1)
        assert side.sum() > 50
        np.testing.assert_allclose(cloud.colors[side].mean(axis=0), color, atol=0.02)
    grid, _, _ = _evenly(box(), 4000)
    gap_m = np.linalg.norm(grid[:, None] - p[None], axis=2).min(axis=1)
    from_edge_m = np.sort(HALF_M - np.abs(grid), axis=1)[:, 1]
    assert gap_m[from_edge_m > 0.01].max() < 0.015  # no hole wider than a spacing and a half
    assert gap_m.max() < 0.02  # a corner is as far from the ends along two edges


def _evenly(surface: Mesh, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    corners = surface[0][surface[1]]
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    chosen, u, v = sample_triangles(area, count, np.random.default_rng(2))
    return a[chosen] + u * (b - a)[chosen] + v * (c - a)[chosen], u, v


def test_a_shape_that_is_not_the_links_is_not_used() -> None:
    assert on_surface([box(HALF_M + 0.03)], [seen()], 0.01) is None
    assert on_surface([box(HALF_M + 0.003)], [seen()], 0.01) is not None
