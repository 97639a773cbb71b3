"""Signed distances at many points at once: the values of a grid and nothing else, in float32.

``SdfGrid.distance`` is the same function with derivatives; this one is what a replay asks a
thousand times for each state, so every array is written once and no index is checked twice.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from twin.replay._clearance import (
    points_to_boxes,
    points_to_grid,
    surface_to_boxes,
    surface_to_grid,
)
from twin.scene.shape.sdf import SdfGrid


class GridLookup:
    """Trilinear distances; beyond the grid the largest that is certain if nothing is there."""

    def __init__(self, grid: SdfGrid) -> None:
        """Lay the grid's values out for lookups."""
        num_x, num_y, num_z = grid.values_m.shape
        self.voxel_m = float(grid.voxel_m)
        self.origin_m = np.asarray(grid.origin_m, dtype=np.float64)
        self.values_m = np.ascontiguousarray(grid.values_m, dtype=np.float32)
        self._strides = (num_y * num_z, num_z)
        self._last = np.array([[num_x - 1], [num_y - 1], [num_z - 1]], dtype=np.float32)
        self._cells = (num_x - 2, num_y - 2, num_z - 2)
        rows = self.values_m.ravel()
        # The same memory from each corner of the first cell on.
        self._corners = [
            rows[i * num_y * num_z + j * num_z + k :]
            for i in (0, 1)
            for j in (0, 1)
            for k in (0, 1)
        ]

    def distance(self, points_m: Float[np.ndarray, "num_points 3"]) -> Float32[np.ndarray, " n"]:
        """Distances of points in the grid's frame [m]."""
        place = (points_m - self.origin_m) / self.voxel_m
        return self.at(np.ascontiguousarray(place.T, dtype=np.float32))

    def at(self, place: Float32[np.ndarray, "3 num_points"]) -> Float32[np.ndarray, " n"]:
        """Distances [m] of places in voxels from the centre of the first one.

        All solid lies inside the grid or nobody knows of it, so beyond the grid the nearest grid
        point at distance e bounds the distance by sqrt(d^2 + e^2); solid that reaches the edge is
        taken to end behind it as deep as it was.
        """
        held = np.minimum(np.maximum(place, np.float32(0.0)), self._last)
        x, y, z = held
        i, j, k = (
            np.minimum(row.astype(np.int64), top)
            for row, top in zip(held, self._cells, strict=True)
        )
        tx, ty, tz = x - i.astype(np.float32), y - j.astype(np.float32), z - k.astype(np.float32)
        i *= self._strides[0]
        j *= self._strides[1]
        i += j
        i += k
        c = [corner.take(i, mode="clip") for corner in self._corners]
        for low, high in ((0, 1), (2, 3), (4, 5), (6, 7)):
            _blend(c[low], c[high], tz)
        _blend(c[0], c[2], ty)
        _blend(c[4], c[6], ty)
        _blend(c[0], c[4], tx)
        value: Float32[np.ndarray, " n"] = c[0]
        beyond = place - held
        if beyond.any():
            e = np.sqrt(np.square(beyond).sum(axis=0)) * np.float32(self.voxel_m)
            value = np.where(value > 0, np.hypot(value, e), value + e)
        return value


def _blend(
    low: Float32[np.ndarray, " n"], high: Float32[np.ndarray, " n"], t: Float32[np.ndarray, " n"]
) -> None:
    """Move ``low`` towards ``high``; both are overwritten."""
    high -= low
    high *= t
    low += high


def candidate_clearance(
    lookup: GridLookup,
    points_m: Float[np.ndarray, "num_points 3"],
    Ts_grid_body: Float[np.ndarray, "num_candidates 4 4"],
) -> Float[np.ndarray, " num_candidates"]:
    """Smallest signed distance of a body's surface points, for each pose it might be released at.

    Args:
        lookup: The static scene in the base frame, or an object in its own.
        points_m: Points of the body's surface, in its own frame.
        Ts_grid_body: The poses that are proposed, in the frame of the grid.

    Returns:
        Distances [m], negative inside; a candidate is free when it is above ``eps_col_m``.
    """
    nearest = np.empty(len(Ts_grid_body))
    grid = lookup.values_m, lookup.origin_m, lookup.voxel_m
    surface_to_grid(*grid, *_poses(Ts_grid_body), np.ascontiguousarray(points_m), nearest)
    return nearest


@dataclass(frozen=True, kw_only=True)
class Boxes:
    """Boxes that stand still, as the native loops want them."""

    R: Float[np.ndarray, "num_boxes 3 3"]
    """Rotations ``R_base_box``."""
    centres_m: Float[np.ndarray, "num_boxes 3"]
    """In the base frame."""
    halves_m: Float[np.ndarray, "num_boxes 3"]

    @staticmethod
    def of(boxes: Sequence[tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "3"]]]) -> "Boxes":
        """Lay them out: pose ``T_base_box`` of the middle, and extents [m]."""
        R, centres_m = _poses(np.array([T for T, _ in boxes]).reshape(-1, 4, 4))
        extents = np.array([extents for _, extents in boxes], dtype=np.float64)
        return Boxes(R=R, centres_m=centres_m, halves_m=extents.reshape(-1, 3) / 2)

    def candidate_clearance(
        self,
        points_m: Float[np.ndarray, "num_points 3"],
        Ts_base_body: Float[np.ndarray, "num_candidates 4 4"],
    ) -> Float[np.ndarray, "num_candidates num_boxes"]:
        """Smallest signed distance of a body's surface points to each box, for each pose.

        Args:
            points_m: Points of the body's surface, in its own frame.
            Ts_base_body: The poses that are proposed.

        Returns:
            Distances [m], exact outside; inside minus the depth below the nearest face.
        """
        nearest = np.empty((len(Ts_base_body), len(self.R)))
        body = *_poses(Ts_base_body), np.ascontiguousarray(points_m)
        surface_to_boxes(self.R, self.centres_m, self.halves_m, *body, nearest)
        return nearest

    def lower(
        self,
        margins_m: Float[np.ndarray, "num_candidates num_points"],
        keep_m: Float[np.ndarray, " num_boxes"],
        points_m: Float[np.ndarray, "num_points 3"],
        Ts_base_body: Float[np.ndarray, "num_candidates 4 4"],
    ) -> None:
        """Lower each point's margin to its distance to the boxes less what is to be kept.

        Args:
            margins_m: Overwritten; one value everywhere at first, boxes beyond it do not count.
            keep_m: Distance to keep from each box.
            points_m: Points of the body's surface, in its own frame.
            Ts_base_body: The poses that are proposed.
        """
        most = float(margins_m.max(initial=-np.inf))
        body = *_poses(Ts_base_body), np.ascontiguousarray(points_m)
        points_to_boxes(self.R, self.centres_m, self.halves_m, keep_m, most, *body, margins_m)


def lower_by_grid(
    lookup: GridLookup,
    margins_m: Float[np.ndarray, "num_candidates num_points"],
    keep_m: float,
    points_m: Float[np.ndarray, "num_points 3"],
    Ts_grid_body: Float[np.ndarray, "num_candidates 4 4"],
) -> None:
    """Lower each point's margin to its distance to a grid less what is to be kept.

    Args:
        lookup: Distances to an obstacle.
        margins_m: Overwritten.
        keep_m: Distance to keep.
        points_m: Points of the body's surface, in its own frame.
        Ts_grid_body: The poses that are proposed, in the frame of the grid.
    """
    grid = lookup.values_m, lookup.origin_m, lookup.voxel_m
    body = *_poses(Ts_grid_body), np.ascontiguousarray(points_m)
    points_to_grid(*grid, keep_m, *body, margins_m)


def _poses(
    Ts: Float[np.ndarray, "num_poses 4 4"],
) -> tuple[Float[np.ndarray, "num_poses 3 3"], Float[np.ndarray, "num_poses 3"]]:
    """Rotations and origins, each in one piece of memory."""
    return np.ascontiguousarray(Ts[:, :3, :3]), np.ascontiguousarray(Ts[:, :3, 3])
