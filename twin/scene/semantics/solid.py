"""From the visible surface of a thing to the cells it fills."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage
from scipy.spatial import cKDTree

MAX_CELLS = 72
"""Along the longest side."""
MARGIN_CELLS = 4
GAP_SPACINGS = 0.9
"""Points are balls of this many spacings, so that light cannot pass between them."""
UNSEEN_FRACTION = 0.45
"""Lowest share of the height that cameras from above may not see: it is filled to the plane."""


@dataclass(frozen=True, kw_only=True)
class Solid:
    """Filled cells of a grid."""

    cells: Bool[np.ndarray, "num_x num_y num_z"]
    origin_m: Float[np.ndarray, "3"]
    """Lower corner of the first cell."""
    size_m: float

    def cells_of(
        self, p_m: Float[np.ndarray, "num_points 3"]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Cell of each point; points beyond the grid go to its edge."""
        index = np.floor((p_m - self.origin_m) / self.size_m).astype(np.int64)
        index = np.clip(index, 0, np.array(self.cells.shape) - 1)
        return index[:, 0], index[:, 1], index[:, 2]

    def centres_m(
        self, mask: Bool[np.ndarray, "num_x num_y num_z"]
    ) -> Float[np.ndarray, "num_marked 3"]:
        """Middles of the marked cells."""
        return np.asarray((np.argwhere(mask) + 0.5) * self.size_m + self.origin_m)


def fill_solid(xyh_m: Float[np.ndarray, "num_points 3"]) -> Solid:
    """Cells that a surface encloses: hidden from at least five of the six axis directions.

    From below everything is hidden by what the thing stands on, so an underside that nobody saw
    is closed by the plane. A sixth direction may be open: a side that nobody saw.

    Args:
        xyh_m: Points of the surface: x, y and height above the plane.
    """
    low, high = np.quantile(xyh_m, [0.002, 0.998], axis=0)
    radius_m = max(GAP_SPACINGS * _sparse_spacing(xyh_m), 1e-4)
    size_m = max(0.6 * radius_m, float((high - low).max()) / MAX_CELLS)
    radius = max(radius_m / size_m, 1.0)
    origin = np.array([*(low[:2] - MARGIN_CELLS * size_m), -MARGIN_CELLS * size_m])
    shape = np.ceil((high - origin) / size_m).astype(np.int64) + MARGIN_CELLS
    cells = np.floor((xyh_m - origin) / size_m).astype(np.int64)
    inside = np.all((cells >= 0) & (cells < shape), axis=1)
    surface = np.zeros(tuple(shape), dtype=bool)
    surface[tuple(cells[inside].T)] = True
    shell = ndimage.distance_transform_edt(~surface) <= radius
    hit = _hidden(shell).astype(np.float32)
    hit[:, :, :MARGIN_CELLS] = hit[:, :, MARGIN_CELLS : MARGIN_CELLS + 1]
    # Light through a single gap makes a thin shaft: the majority around each cell decides.
    solid = ndimage.gaussian_filter(hit, 1.0) > 0.5
    _stand_on_plane(solid, int(UNSEEN_FRACTION * (high[2] - origin[2]) / size_m))
    solid = ndimage.gaussian_filter(solid.astype(np.float32), 1.0) > 0.5
    # The shell was thickened outwards too, but not into the plane.
    solid[:, :, :MARGIN_CELLS] = solid[:, :, MARGIN_CELLS : MARGIN_CELLS + 1]
    solid = ndimage.distance_transform_edt(solid) > radius
    solid[:, :, :MARGIN_CELLS] = False
    return Solid(cells=np.asarray(solid), origin_m=origin, size_m=size_m)


def _hidden(shell: Bool[np.ndarray, "num_x num_y num_z"]) -> Bool[np.ndarray, "num_x num_y num_z"]:
    """Cells that at most one direction sees; the plane hides everything from below."""
    count = np.ones(shell.shape, dtype=np.int64)
    for axis, forward in ((0, True), (0, False), (1, True), (1, False), (2, False)):
        walls = shell if forward else np.flip(shell, axis)
        behind = np.logical_or.accumulate(walls, axis=axis)
        count += behind if forward else np.flip(behind, axis)
    return np.asarray((count >= 5) | shell)


def _sparse_spacing(p_m: Float[np.ndarray, "num_points 3"]) -> float:
    """Distance to the next point where points are sparse."""
    if len(p_m) < 3:
        return 0.0
    distance, _ = cKDTree(p_m).query(p_m[:: max(1, len(p_m) // 3000)], k=2)
    return float(np.quantile(distance[:, 1], 0.9))


def _stand_on_plane(solid: Bool[np.ndarray, "num_x num_y num_z"], num_unseen: int) -> None:
    """Fill columns whose lowest cell is near the plane down to it."""
    lowest = np.where(solid.any(axis=2), solid.argmax(axis=2), solid.shape[2])
    levels = np.arange(solid.shape[2])
    near = lowest <= MARGIN_CELLS + num_unseen
    solid |= near[..., None] & (levels < lowest[..., None])
