"""The tree of points in C++ against looking at every point with the grid's own lookup."""

import numpy as np
import pytest
from scipy import ndimage

from twin.replay import _clearance
from twin.replay.clearance.grid import GridLookup
from twin.replay.clearance.shells import FINE_M, Shells, shell_of
from twin.scene.shape.sdf import SdfGrid, distances_of_solid

pytestmark = pytest.mark.parity


@pytest.fixture(scope="module")
def grid() -> SdfGrid:
    """Blobs of 8 mm voxels."""
    noise = ndimage.gaussian_filter(np.random.default_rng(1).normal(size=(60, 50, 40)), 4)
    solid = noise > np.quantile(noise, 0.9)
    values = distances_of_solid(solid, 0.008)
    return SdfGrid(values_m=values, origin_m=np.array([-0.2, 0.1, 0.0]), voxel_m=0.008)


def poses(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Anywhere in the grid, and outside of it."""
    rng = np.random.default_rng(seed)
    q, _ = np.linalg.qr(rng.normal(size=(count, 3, 3)))
    R = q * np.sign(np.linalg.det(q))[:, None, None]
    return np.ascontiguousarray(R), rng.uniform([-0.4, -0.1, -0.2], [0.5, 0.7, 0.5], (count, 3))


def test_no_point_is_nearer_than_the_tree_says(grid: SdfGrid) -> None:
    rng = np.random.default_rng(2)
    pieces = [shell_of(rng.uniform(-s, s, (25, 3))) for s in (0.02, 0.05, 0.08)]
    together, lookup = Shells(pieces), GridLookup(grid)
    inside = 0
    for seed in range(40):
        R, t = poses(3, seed)
        found = together.distances_m(lookup, R, t)
        for piece, R_one, t_one, distance in zip(pieces, R, t, found, strict=True):
            every = lookup.distance(piece.finest_m() @ R_one.T + t_one).min()
            assert distance + FINE_M <= max(every, 0.98 * every) + 1e-5
            assert distance + FINE_M >= min(every, 0.98 * every) - 1e-5
            inside += distance < 0
    assert 10 < inside < 110


def test_the_same_bits_on_every_call(grid: SdfGrid) -> None:
    shell = Shells([shell_of(np.random.default_rng(3).uniform(-0.05, 0.05, (25, 3)))])
    lookup = GridLookup(grid)
    R, t = poses(1, 7)
    first = shell.distances_m(lookup, R, t)
    assert all(shell.distances_m(lookup, R, t).tobytes() == first.tobytes() for _ in range(20))


def test_what_does_not_fit_together_is_refused(grid: SdfGrid) -> None:
    R, t = poses(1, 8)
    points, radius = np.zeros((2, 3)), np.zeros(2)
    roots, answers = np.array([[0, 1]], dtype=np.int32), np.zeros(1)
    fixed = (grid.values_m, grid.origin_m, grid.voxel_m)
    beyond = np.array([[1, 9], [0, 0]], dtype=np.int32)
    with pytest.raises(IndexError, match="not there"):
        _clearance.nearest(*fixed, R, t, points, radius + 9, beyond, roots, answers)
    fine = np.zeros((2, 2), dtype=np.int32)
    with pytest.raises(ValueError, match="differ in number"):
        _clearance.nearest(*fixed, R, t, points, np.zeros(3), fine, roots, answers)
    with pytest.raises(ValueError, match="differ in number"):
        _clearance.nearest(*fixed, R, t, points, radius, fine, roots, np.zeros(2))
