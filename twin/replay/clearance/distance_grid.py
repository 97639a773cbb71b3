"""Signed distances at many points at once: the values of a grid and nothing else, in float32.

``SdfGrid.distance`` is the same function with derivatives; this one is what a replay asks a
thousand times for each state, so every array is written once and no index is checked twice.
"""

import numpy as np
from jaxtyping import Float, Float32

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
