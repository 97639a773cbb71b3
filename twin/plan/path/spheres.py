"""Spheres that together hold a convex piece: what the path search asks before it asks hulls."""

import numpy as np
from scipy.spatial import ConvexHull

from twin.plan.problem import Points, Spheres

SPHERES = 16
"""For each hull of a link or box that is carried."""
_GROWN = 1 + 1e-9
"""So that rounding leaves no corner outside."""
_PROBES = 64


def covering_spheres(corners_m: Points, count: int = SPHERES) -> Spheres:
    """Cover a convex hull: the box along its axes, its longest cells halved, a sphere for each."""
    middle = corners_m.mean(axis=0)
    axes = np.linalg.svd(corners_m - middle, full_matrices=True)[2]
    along = (corners_m - middle) @ axes.T
    low, extents = along.min(axis=0), np.ptp(along, axis=0)
    cells = np.ones(3, dtype=np.int64)
    while 2 * cells.prod() <= count:
        cells[int(np.argmax(extents / cells))] *= 2
    size = extents / cells
    numbers = np.stack(np.meshgrid(*map(np.arange, cells), indexing="ij"), axis=-1).reshape(-1, 3)
    centres = middle + (low + (numbers + 0.5) * size) @ axes
    radius = np.full((len(centres), 1), np.linalg.norm(size) / 2 * _GROWN)
    return np.concatenate([centres, radius], axis=1)


def excess_m(corners_m: Points, spheres_m: Spheres) -> float:
    """How far spheres stand out of the hull of points at most [m], looked at in some directions."""
    equations = ConvexHull(corners_m).equations
    normals, offsets = equations[:, :3], equations[:, 3]
    turns = np.random.default_rng(0).normal(size=(_PROBES, 3))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    tips = spheres_m[:, None, :3] + spheres_m[:, 3, None, None] * turns
    outside = (tips.reshape(-1, 3) @ normals.T + offsets).max(axis=1)
    return float(max(0.0, outside.max()))
