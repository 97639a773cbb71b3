"""How near a carried body comes to grids and boxes, for many poses that are proposed at once."""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from twin.plan.problem import Numbers, Points, Pose, Poses, Vector
from twin.replay._clearance import surface_to_boxes, surface_to_grid
from twin.scene.shape.sdf import SdfGrid


def grid_clearance(grid: SdfGrid, points_m: Points, Ts_grid_body: Poses) -> Numbers:
    """Smallest signed distance of a body's surface points to what a grid holds, for each pose."""
    nearest = np.empty(len(Ts_grid_body))
    values = grid.values_m, grid.origin_m, grid.voxel_m
    surface_to_grid(*values, *_poses(Ts_grid_body), np.ascontiguousarray(points_m), nearest)
    return nearest


Away = Callable[[Points, Poses], Numbers]
"""Smallest signed distance of a body's surface points to something, for each pose [m]."""


def boxes_clearance(boxes: Sequence[tuple[Pose, Vector]]) -> Away:
    """Distances to boxes that stand still: pose ``T_base_box`` of the middle, and extents [m]."""
    R, centres_m = _poses(np.array([T for T, _ in boxes]))
    halves_m = np.array([extents for _, extents in boxes], dtype=np.float64) / 2

    def away(points_m: Points, Ts_base_body: Poses) -> Numbers:
        nearest = np.empty((len(Ts_base_body), len(R)))
        body = *_poses(Ts_base_body), np.ascontiguousarray(points_m)
        surface_to_boxes(R, centres_m, halves_m, *body, nearest)
        return np.asarray(nearest.min(axis=1))

    return away


def _poses(Ts: Poses) -> tuple[Float[np.ndarray, "num_poses 3 3"], Points]:
    """Rotations and origins, each in one piece of memory."""
    return np.ascontiguousarray(Ts[:, :3, :3]), np.ascontiguousarray(Ts[:, :3, 3])
