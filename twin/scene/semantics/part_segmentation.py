"""Segment a container into parts by its geometry: rim, floor, walls and handle."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from twin.naming.words import kind_of
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


@dataclass(frozen=True, kw_only=True)
class Parts:
    """Named subsets of points, and named places."""

    masks: Mapping[str, Bool[np.ndarray, " num_points"]]
    """Disjoint."""
    keypoints: Mapping[str, Float[np.ndarray, "3"]]
    """x, y and height above the plane, like the points."""


@dataclass(frozen=True, kw_only=True)
class PartsConfig:
    """How parts are told apart."""

    rim_fraction: float = 0.1
    """Points within this share of the height of the rim's height are rim."""
    floor_fraction: float = 0.12
    """Points in the lowest share of the cavity's depth are its floor."""
    handle_fraction: float = 0.08
    """Points this share of the height above the rim are handle."""


def find_parts(
    xyh_m: Float[np.ndarray, "num_points 3"],
    label: str,
    cell_m: float,
    config: PartsConfig,
) -> Parts:
    """Parts and keypoints of one thing.

    Containers get rim, floor, walls and handle; every thing the keypoints centre, top and bottom.
    A part that is not there is not named.

    Args:
        label: What it is called; decides what parts to look for.
    """
    low, high = np.quantile(xyh_m, [0.01, 0.99], axis=0)
    middle = (low + high) / 2
    keypoints = {
        "centre": middle,
        "top": np.array([middle[0], middle[1], high[2]]),
        "bottom": np.array([middle[0], middle[1], max(low[2], 0.0) if low[2] > cell_m else 0.0]),
    }
    masks: dict[str, np.ndarray] = {}
    if kind_of(label) == "container":
        heights = height_map(xyh_m, max(cell_m, float((high - low).max()) / 48))
        cavity = find_height_map_cavity(heights)
        if cavity is not None:
            masks = _container(xyh_m, heights, cavity, float(high[2]), config)
            keypoints |= _container_points(xyh_m, heights, cavity, masks)
    least = MIN_SHARE * len(xyh_m)
    return Parts(
        masks={name: mask for name, mask in masks.items() if mask.sum() >= max(least, 1)},
        keypoints=keypoints,
    )


def _container(
    xyh_m: np.ndarray,
    heights: HeightMap,
    cavity: HeightMapCavity,
    top_m: float,
    config: PartsConfig,
) -> dict[str, np.ndarray]:
    over = ndimage.binary_dilation(cavity.mask)[heights.cells(xyh_m)]
    height, depth = xyh_m[:, 2], cavity.rim_m - cavity.floor_m
    span = config.rim_fraction * cavity.rim_m
    margin = max(config.handle_fraction * cavity.rim_m, heights.cell_m)
    wall = heights.top_m[heights.footprint & ~cavity.mask]
    if (wall > cavity.rim_m + margin).mean() > MAX_HANDLE:
        handle = np.zeros(len(xyh_m), dtype=bool)  # the rim is that high, but for a low place
    else:
        handle = (height > cavity.rim_m + margin) & (top_m > cavity.rim_m + 2 * margin)
    handle |= _sticking_out(xyh_m, heights, cavity)
    if handle.sum() < MIN_HANDLE * len(xyh_m):
        handle = np.zeros_like(handle)  # a ragged rim
    thick = max(config.floor_fraction * depth, 0.004)
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


def _container_points(
    xyh_m: np.ndarray, heights: HeightMap, cavity: HeightMapCavity, masks: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    centre = heights.centre_m(cavity.mask)
    points = {
        "opening": np.array([*centre, cavity.rim_m]),
        "cavity": np.array([*centre, (cavity.rim_m + cavity.floor_m) / 2]),
        "floor": np.array([*centre, cavity.floor_m]),
    }
    handle = xyh_m[masks["handle"]]
    if len(handle) >= MIN_SHARE * len(xyh_m):
        points["handle"] = handle[handle[:, 2] >= np.quantile(handle[:, 2], 0.8)].mean(axis=0)
    rim = xyh_m[masks["rim"]]
    for name, axis, sign in (("+x", 0, 1), ("-x", 0, -1), ("+y", 1, 1), ("-y", 1, -1)):
        if len(rim):
            along = sign * rim[:, axis]
            points[f"rim {name}"] = rim[along >= np.quantile(along, 0.95)].mean(axis=0)
    return points
