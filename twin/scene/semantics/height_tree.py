"""Part what hangs together low down, as papers under mugs do: raise the level until it parts.

The parts are the branches of the tree of components over rising levels, cut where they first are
small enough for things (Jones 1999 on component trees). What lies below a branch belongs to it.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from twin.scene.semantics.cluster import components, extents_m, pairs_among

LEVELS_M = (0.012, 0.018, 0.026, 0.036, 0.05, 0.07)
"""Heights over the plane at which a group that is too large is looked at again."""
BESIDE = 1.2
"""Voxels this near to a branch, seen from above, lie below it."""
BELOW = 2.0
"""And no higher over its lowest voxel than so many voxels."""


def branches(
    p_m: Float[np.ndarray, "num_voxels 3"],
    height_m: Float[np.ndarray, " num_voxels"],
    pairs: Int[np.ndarray, "num_pairs 2"],
    *,
    voxel_m: float,
    max_size_m: float,
    min_voxels: int,
) -> list[Int[np.ndarray, " num_members"]]:
    """Groups of connected voxels that are small enough; what no level parts is left out."""
    groups: list[np.ndarray] = []
    group = components(len(p_m), pairs)
    large = np.flatnonzero(np.bincount(group, minlength=1) >= min_voxels)
    todo: list[tuple[np.ndarray, tuple[float, ...]]]
    todo = [(np.flatnonzero(group == number), LEVELS_M) for number in large]
    while todo:
        ids, levels = todo.pop(0)
        if extents_m(p_m[ids])[0] <= max_size_m:
            groups.append(ids)
            continue
        parts, left = _parted(ids, p_m, height_m, pairs, levels, max_size_m, min_voxels)
        todo[:0] = [(part, left) for part in parts]
    return _with_what_lies_below(groups, p_m, height_m, voxel_m)


def _parted(
    ids: np.ndarray,
    p_m: np.ndarray,
    height_m: np.ndarray,
    pairs: np.ndarray,
    levels_m: Sequence[float],
    max_size_m: float,
    min_voxels: int,
) -> tuple[list[np.ndarray], tuple[float, ...]]:
    """What is left of a group above the lowest level that parts it, and the levels above that."""
    for place, level_m in enumerate(levels_m):
        high = ids[height_m[ids] > level_m]
        if len(high) < min_voxels:
            break
        group = components(len(high), pairs_among(high, pairs, len(p_m)))
        parts = [high[group == n] for n in np.flatnonzero(np.bincount(group) >= min_voxels)]
        if len(parts) > 1 or (parts and extents_m(p_m[parts[0]])[0] <= max_size_m):
            return parts, tuple(levels_m[place + 1 :])
    return [], ()


def _with_what_lies_below(
    groups: list[np.ndarray], p_m: np.ndarray, height_m: np.ndarray, voxel_m: float
) -> list[np.ndarray]:
    """Each group with the voxels below it that are nobody's; the first group comes first."""
    owner = np.full(len(p_m), -1, dtype=np.int64)
    for number, ids in enumerate(groups):
        owner[ids] = number
    for number, ids in enumerate(groups):
        free = np.flatnonzero(owner < 0)
        free = free[height_m[free] < height_m[ids].min() + BELOW * voxel_m]
        if len(free):
            beside, _ = cKDTree(p_m[ids, :2]).query(
                p_m[free, :2], distance_upper_bound=BESIDE * voxel_m
            )
            owner[free[np.isfinite(beside)]] = number
    return [np.flatnonzero(owner == number) for number in range(len(groups))]
