"""From the visible surface of a thing to the cells it fills."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

MAX_CELLS = 72
"""Along the longest side."""
MARGIN_CELLS = 4


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


def fill_solid(xyh_m: Float[np.ndarray, "num_points 3"], spacing_m: float) -> Solid:
    """Cells that a surface encloses: hidden from at least five of the six axis directions.

    From below everything is hidden by what the thing stands on, so an underside that nobody saw
    is closed by the plane. A sixth direction may be open: a side that nobody saw.

    Args:
        xyh_m: Points of the surface: x, y and height above the plane.
        spacing_m: Between neighbouring points; gaps up to twice that are closed.
    """
    low, high = np.quantile(xyh_m, [0.002, 0.998], axis=0)
    size_m = max(0.6 * spacing_m, float((high - low).max()) / MAX_CELLS, 1e-4)
    origin = np.array([*(low[:2] - MARGIN_CELLS * size_m), -MARGIN_CELLS * size_m])
    shape = np.ceil((high - origin) / size_m).astype(np.int64) + MARGIN_CELLS
    cells = np.floor((xyh_m - origin) / size_m).astype(np.int64)
    inside = np.all((cells >= 0) & (cells < shape), axis=1)
    surface = np.zeros(tuple(shape), dtype=bool)
    surface[tuple(cells[inside].T)] = True
    # Gaps in the surface would let the light in.
    gap = min(int(np.ceil(spacing_m / size_m)), MARGIN_CELLS - 1)
    dense = ndimage.binary_closing(surface, structure=np.ones((3, 3, 3)), iterations=gap) | surface
    hidden = np.ones(dense.shape, dtype=np.int64)
    for axis, forward in ((0, True), (0, False), (1, True), (1, False), (2, False)):
        walls = dense if forward else np.flip(dense, axis)
        behind = np.logical_or.accumulate(walls, axis=axis)
        hidden += behind if forward else np.flip(behind, axis)
    solid = (hidden >= 5) | dense
    solid[:, :, :MARGIN_CELLS] = False  # below the plane
    return Solid(cells=np.asarray(ndimage.binary_opening(solid)), origin_m=origin, size_m=size_m)
