"""Spheres that together hold a convex piece: what the path search asks before it asks hulls."""

import heapq
from functools import lru_cache

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from twin.plan.arrays import Points, Spheres, Vector

SPHERES = 16
"""For each hull of a link or box that is carried."""
_GROWN = 1e-9
"""Relative; so that rounding leaves no corner outside [1]."""
_PROBES = 64


def covering_spheres(corners_m: Points, count: int = SPHERES) -> Spheres:
    """Cover the convex hull of points by spheres."""
    heap = [_part(corners_m, 0)]
    done: list[_Part] = []
    number = 1
    while heap and len(heap) + len(done) < count:
        worst = heapq.heappop(heap)
        halves = _halves(worst[2])
        if halves is None:
            done.append(worst)
            continue
        for half in halves:
            heapq.heappush(heap, _part(half, number))
            number += 1
    parts = sorted([*heap, *done], key=lambda part: part[1])
    return np.array([[*centre, radius] for *_, centre, radius in parts])


_Part = tuple[float, int, Points, Vector, float]
"""How little its sphere wastes, its number, its corners, centre and radius."""


def _part(corners_m: Points, number: int) -> _Part:
    centre = (corners_m.min(axis=0) + corners_m.max(axis=0)) / 2
    radius = float(np.linalg.norm(corners_m - centre, axis=1).max()) * (1 + _GROWN)
    # A long part wastes more than a round one of the same size.
    spread = np.linalg.svd(corners_m - corners_m.mean(axis=0), full_matrices=False)[2]
    thinnest = float(np.ptp(corners_m @ spread[2]))
    return (thinnest / 2 - radius, number, corners_m, centre, radius)


def _halves(corners_m: Points) -> list[Points] | None:
    """Cut a convex part by the plane across the middle of its longest axis."""
    try:
        hull = ConvexHull(corners_m)
    except QhullError:
        return None
    corners = corners_m[hull.vertices]
    axis = np.linalg.svd(corners - corners.mean(axis=0), full_matrices=False)[2][0]
    along = corners_m @ axis
    height = along - (along[hull.vertices].min() + along[hull.vertices].max()) / 2
    edges = np.concatenate([hull.simplices[:, pair] for pair in ([0, 1], [1, 2], [2, 0])])
    first, second = edges.T
    crossing = height[first] * height[second] < 0
    first, second = first[crossing], second[crossing]
    share = (height[first] / (height[first] - height[second]))[:, None]
    cut = corners_m[first] + share * (corners_m[second] - corners_m[first])
    cut = np.unique(cut.round(12), axis=0)
    above = height[hull.vertices] >= 0
    return [np.concatenate([corners[side], cut]) for side in (above, ~above)]


def excess_m(corners_m: Points, spheres_m: Spheres) -> float:
    """How far spheres stand out of the hull of points at most [m], looked at in some directions."""
    equations = ConvexHull(corners_m).equations
    normals, offsets = equations[:, :3], equations[:, 3]
    turns = np.random.default_rng(0).normal(size=(_PROBES, 3))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    tips = spheres_m[:, None, :3] + spheres_m[:, 3, None, None] * turns
    outside = (tips.reshape(-1, 3) @ normals.T + offsets).max(axis=1)
    return float(max(0.0, outside.max()))


@lru_cache(maxsize=64)
def box_spheres(size_m: tuple[float, float, float], count: int = SPHERES) -> Spheres:
    """Cover a box around the origin; the same for all boxes of a size."""
    half = np.array(size_m) / 2
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    return covering_spheres(signs * half, count)
