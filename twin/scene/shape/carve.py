"""Which voxels are the object: seen through is free, behind a surface is solid.

Space carving (Kutulakos and Seitz 2000) with depth, and a truncated signed distance (Curless and
Levoy 1996) on the object's own pixels. What nobody saw stays solid: under a thing that stands on
a plane there is no air.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int16
from scipy import ndimage

from twin.scene.shape.masked_view import MaskedView, ShapeError
from twin.scene.shape.voxels import VoxelBox, look

FREE_TRUNCATIONS = 0.6
"""A voxel this many truncations in front of a surface is seen through."""
MIN_FREE_SHARE = 0.3
MIN_OTHER_SHARE = 0.5
"""Shares of the views that see a voxel at all: to be free, it must be seen through in the first;
or seen through, or at or before something else than the object, in the second."""
BEHIND_VOXELS = 2.0
"""So far behind a surface it still speaks, unless told otherwise."""
MIN_SOLID_VOXELS = 20


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """What all views together say about each voxel."""

    box: VoxelBox
    tsdf: Float32[np.ndarray, "num_x num_y num_z"]
    """Mean distance in truncations, positive in front of the object's surface; 0 where unseen."""
    weight: Float32[np.ndarray, "num_x num_y num_z"]
    """How many views saw the object's surface near a voxel; 0 is "nobody"."""
    free: Bool[np.ndarray, "num_x num_y num_z"]
    """Looked through in at least two views."""
    empty: Bool[np.ndarray, "num_x num_y num_z"]
    """Not the object: free, at or before something else, or in front of its surface."""


def gather(
    box: VoxelBox,
    views: Sequence[MaskedView],
    truncation_m: float,
    min_free_views: int,
    behind_m: float | None = None,
) -> Evidence:
    """Let every view say which voxels it sees through and which lie at the object's surface.

    Args:
        box: The voxels.
        views: Depth with masks.
        truncation_m: So near to a surface a view says how far it is.
        min_free_views: So many must look through a voxel before it is free.
        behind_m: So far behind a surface it still speaks: further than half a thin wall, and one
            side of it would push out the other. Two voxels when None.
    """
    total = np.zeros(box.num_voxels, dtype=np.float32)
    weight = np.zeros(box.num_voxels, dtype=np.float32)
    free, other, seen = (np.zeros(box.num_voxels, dtype=np.int16) for _ in range(3))
    behind = np.float32(BEHIND_VOXELS * box.voxel_m if behind_m is None else behind_m)
    for view in views:
        sight = look(box, view)
        hit = sight.on_object & (sight.gap_m > -behind) & (sight.gap_m < truncation_m)
        # Full weight down to half the reach, then fading.
        trust = np.minimum(2.0 + 2.0 * sight.gap_m[hit] / behind, 1.0)
        ids = sight.ids[hit]
        total[ids] += trust * sight.gap_m[hit] / np.float32(truncation_m)
        weight[ids] += trust
        through = sight.clear_m > FREE_TRUNCATIONS * truncation_m
        # At another surface as well: nothing behind an object is seen beside the object.
        at_other = ~sight.near_object & (sight.gap_m > -behind)
        free[sight.ids] += through
        other[sight.ids] += through | at_other
        seen[sight.ids] += sight.gap_m > -behind
    tsdf = total / np.maximum(weight, 1e-6)
    is_free = _at_least(free, seen, min_free_views, MIN_FREE_SHARE)
    empty = is_free | _at_least(other, seen, min_free_views, MIN_OTHER_SHARE)
    empty |= (weight > 0) & (tsdf > 0)
    return Evidence(
        box=box,
        tsdf=tsdf.reshape(box.counts),
        weight=weight.reshape(box.counts),
        free=is_free.reshape(box.counts),
        empty=empty.reshape(box.counts),
    )


def _at_least(
    votes: Int16[np.ndarray, " num_voxels"],
    seen: Int16[np.ndarray, " num_voxels"],
    count: int,
    share: float,
) -> Bool[np.ndarray, " num_voxels"]:
    return (votes >= count) & (votes >= share * seen)


def solid_of(
    evidence: Evidence,
    support_z_m: float | None,
    low_m: Float[np.ndarray, "3"],
    high_m: Float[np.ndarray, "3"],
) -> Bool[np.ndarray, "num_x num_y num_z"]:
    """Voxels of the object: its largest piece above the plane, without hollows nobody sees.

    Args:
        evidence: From ``gather``.
        support_z_m: Height of the plane it stands on; nothing of it is below. None without one.
        low_m: Lower corner of the region in which the object's points were measured.
        high_m: Upper corner.

    Raises:
        ShapeError: When next to nothing is left.
    """
    box = evidence.box
    solid = ~evidence.empty
    for axis in range(3):
        place = box.axis_m(axis)
        inside = (place > low_m[axis]) & (place < high_m[axis])
        if axis == 2 and support_z_m is not None:
            inside = (place > support_z_m) & (place < high_m[axis])
        inside[[0, -1]] = False
        solid &= inside.reshape([-1 if a == axis else 1 for a in range(3)])
    pieces, count = ndimage.label(solid)
    if count == 0:
        largest = 0
    else:
        sizes = np.bincount(pieces.ravel())
        sizes[0] = 0
        solid = pieces == sizes.argmax()
        largest = int(sizes.max())
    if largest < MIN_SOLID_VOXELS:
        message = (
            f"carving left {largest} voxels of {box.voxel_m * 1e3:.1f} mm: masks, depth and poses "
            "contradict each other. Check the camera poses and the masks."
        )
        raise ShapeError(message)
    return np.asarray(ndimage.binary_fill_holes(solid))
