"""Segment a container into parts by its geometry: rim, floor, walls and handle."""

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from twin.scene.semantics.shape_descriptors import (
    HeightMap,
    HeightMapCavity,
    find_height_map_cavity,
    height_map,
)

MAX_HANDLE = 0.45
MIN_HANDLE = 0.012
"""Share of the points; less is noise at a rim or a foot."""
MIN_SHARE = 0.005
"""A part has at least this share of the points."""


RIM, FLOOR, HANDLE = 0.1, 0.12, 0.08
"""Rim is what is this near to the rim's height, floor the lowest of the cavity's depth, handle what
stands this much above the rim; shares of the height, or of the depth."""


def find_parts(
    xyh_m: Float[np.ndarray, "num_points 3"], cell_m: float
) -> dict[str, Bool[np.ndarray, " num_points"]]:
    """Rim, floor, walls and handle of what may be a container; a part that is not there is none."""
    low, high = np.quantile(xyh_m, [0.01, 0.99], axis=0)
    heights = height_map(xyh_m, max(cell_m, float((high - low).max()) / 48))
    cavity = find_height_map_cavity(heights)
    if cavity is None:
        return {}
    parts = _container(xyh_m, heights, cavity, float(high[2]))
    least = max(MIN_SHARE * len(xyh_m), 1)
    return {name: mask for name, mask in parts.items() if mask.sum() >= least}


def _container(
    xyh_m: np.ndarray,
    heights: HeightMap,
    cavity: HeightMapCavity,
    top_m: float,
) -> dict[str, np.ndarray]:
    over = ndimage.binary_dilation(cavity.mask)[heights.cells(xyh_m)]
    height, depth = xyh_m[:, 2], cavity.rim_m - cavity.floor_m
    span = RIM * cavity.rim_m
    margin = max(HANDLE * cavity.rim_m, heights.cell_m)
    wall = heights.top_m[heights.footprint & ~cavity.mask]
    if (wall > cavity.rim_m + margin).mean() > MAX_HANDLE:
        handle = np.zeros(len(xyh_m), dtype=bool)  # the rim is that high, but for a low place
    else:
        handle = (height > cavity.rim_m + margin) & (top_m > cavity.rim_m + 2 * margin)
    handle |= _sticking_out(xyh_m, heights, cavity)
    if handle.sum() < MIN_HANDLE * len(xyh_m):
        handle = np.zeros_like(handle)  # a ragged rim
    thick = max(FLOOR * depth, 0.004)
    floor = ~handle & over & (height < cavity.floor_m + thick)
    rim = ~handle & ~floor & (height > cavity.rim_m - span)
    return {
        "rim": rim,
        "floor": floor,
        "handle": handle,
        "walls": ~(rim | floor | handle),
    }


def _sticking_out(
    xyh_m: np.ndarray, heights: HeightMap, cavity: HeightMapCavity
) -> Bool[np.ndarray, " num_points"]:
    """Points beside the outline that holds the cavity: an ear, the handle of a mug."""
    thickness = ndimage.distance_transform_edt(heights.footprint)
    radius = 0.35 * float(thickness.max())
    core = thickness > radius
    opened = ndimage.distance_transform_edt(~core) <= radius + 1.0
    around = ndimage.distance_transform_edt(~(opened | cavity.mask)) > 2.5
    return np.asarray((around & heights.footprint)[heights.cells(xyh_m)])
