"""Which voxels are the object: seen through is free, behind a surface is solid.

Space carving (Kutulakos and Seitz 2000) with depth, and a truncated signed distance (Curless and
Levoy 1996) on the object's own pixels. What nobody saw stays solid: under a thing that stands on
a plane there is no air.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int16
from scipy import ndimage

from bridge.geometry import se3
from bridge.geometry.camera import Camera
from twin.errors import TwinError


class ShapeError(TwinError):
    """There is not enough to make a shape from, or what there is contradicts itself."""


@dataclass(frozen=True, kw_only=True)
class MaskedView:
    """One depth image and the object's pixels in it.

    ``base`` may be any frame whose z axis points up: the robot's, or the object's own.
    """

    camera: Camera
    T_base_camera: Float[np.ndarray, "4 4"]
    depth_m: Float[np.ndarray, "height width"]
    """Along the optical axis; 0, negative or not finite is "not measured"."""
    mask: Bool[np.ndarray, "mask_height mask_width"]
    """True where the object is seen."""
    sensor: str = ""
    """Which camera it is: views of one camera share the errors of its depth."""

    def known_depth_m(self) -> Float32[np.ndarray, "height width"]:
        """Depth with 0 wherever it was not measured [m]."""
        depth = self.depth_m.astype(np.float32)
        return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0.0))

    def points_m(self) -> Float[np.ndarray, "num_points 3"]:
        """Measured points of the object, in ``base`` [m]."""
        depth = self.known_depth_m()
        p_camera = self.camera.unproject(depth.astype(np.float64))[self.mask & (depth > 0)]
        return se3.apply(self.T_base_camera, p_camera)


NEAR_M = 0.03
"""Voxels nearer to a camera than this are not in its sight."""

BETWEEN_M = 0.03
"""Nearer to a surface than this, depth is taken between pixels."""
ONE_SURFACE_M = 0.012
"""Four pixels whose depths differ by less show one surface."""


@dataclass(frozen=True, kw_only=True)
class VoxelBox:
    """Cubes of one size in rows; ``origin_m`` is the centre of the first."""

    origin_m: Float[np.ndarray, "3"]
    voxel_m: float
    counts: tuple[int, int, int]

    @property
    def num_voxels(self) -> int:
        """How many there are."""
        return self.counts[0] * self.counts[1] * self.counts[2]

    def axis_m(self, axis: int) -> Float[np.ndarray, " num_along"]:
        """Coordinates of the centres along one axis [m]."""
        return np.asarray(self.origin_m[axis] + self.voxel_m * np.arange(self.counts[axis]))

    def centres_m(self, ids: Int[np.ndarray, " num_ids"]) -> Float[np.ndarray, "num_ids 3"]:
        """Centres of voxels given by their flat number [m]."""
        index = np.stack(np.unravel_index(ids, self.counts), axis=1)
        return np.asarray(self.origin_m + self.voxel_m * index)


@dataclass(frozen=True, kw_only=True)
class Sight:
    """What one view says about the voxels in its image, one row per voxel."""

    ids: Int[np.ndarray, " num_ids"]
    """Flat numbers of the voxels."""
    gap_m: Float32[np.ndarray, " num_ids"]
    """Depth of the voxel's pixel minus the voxel's depth: positive in front of the surface.
    Minus infinity where the pixel measured nothing."""
    clear_m: Float32[np.ndarray, " num_ids"]
    """The smallest gap of the four pixels around. A voxel is only looked through when all four
    look through it: then one noisy or flying pixel, or half a pixel at an outline, carves
    nothing."""
    on_object: Bool[np.ndarray, " num_ids"]
    """The voxel's pixel is the object's."""
    near_object: Bool[np.ndarray, " num_ids"]
    """One of the four pixels around is the object's."""


def look(box: VoxelBox, view: MaskedView) -> Sight:
    """Project all voxel centres into a view and compare depths."""
    rows = []  # of camera coordinates: sums of three instead of a matrix product
    for row in se3.invert(view.T_base_camera)[:3].astype(np.float64):
        along = [(row[axis] * box.axis_m(axis)).astype(np.float32) for axis in range(3)]
        along[2] = along[2] + np.float32(row[3])
        rows.append(along[0][:, None, None] + along[1][:, None] + along[2])
    x, y, z = rows
    camera = view.camera
    inverse = 1.0 / np.maximum(z, np.float32(NEAR_M))
    u = np.float32(camera.fx) * x * inverse + np.float32(camera.cx)
    v = np.float32(camera.fy) * y * inverse + np.float32(camera.cy)
    # Half a pixel from the edge: all four pixels around are in the image.
    seen = (z > NEAR_M) & (u >= 0.5) & (u < camera.width - 0.5)
    seen &= (v >= 0.5) & (v < camera.height - 0.5)
    ids = np.flatnonzero(seen)
    u, v, z = u.ravel()[ids], v.ravel()[ids], z.ravel()[ids]
    pixel = v.astype(np.int32) * camera.width + u.astype(np.int32)
    left, top = (u - np.float32(0.5)).astype(np.int32), (v - np.float32(0.5)).astype(np.int32)
    block = top * np.int32(camera.width - 1) + left
    depth = view.known_depth_m()
    ends = (slice(None, -1), slice(1, None))
    four = [(rows, columns) for rows in ends for columns in ends]
    nearest = np.minimum.reduce([depth[part] for part in four]).ravel()
    around = np.logical_or.reduce([view.mask[part] for part in four]).ravel()
    measured = depth.ravel()[pixel]
    on_object = view.mask.ravel()[pixel]
    near = np.flatnonzero(on_object & (measured > 0) & (np.abs(measured - z) < BETWEEN_M))
    measured[near] = _between_pixels(depth, u[near], v[near], measured[near])
    return Sight(
        ids=ids,
        gap_m=np.where(measured > 0, measured - z, np.float32(-np.inf)),
        clear_m=np.where(nearest[block] > 0, nearest[block] - z, np.float32(-np.inf)),
        on_object=on_object,
        near_object=around[block],
    )


def _between_pixels(
    depth_m: Float32[np.ndarray, "height width"],
    u: Float32[np.ndarray, " num_near"],
    v: Float32[np.ndarray, " num_near"],
    nearest_m: Float32[np.ndarray, " num_near"],
) -> Float32[np.ndarray, " num_near"]:
    """Depth between the four pixels around; the nearest pixel's where they show two surfaces.

    Seen at a slant, half a pixel is as much as the wall of a box.
    """
    x, y = u - np.float32(0.5), v - np.float32(0.5)
    left, top = x.astype(np.int32), y.astype(np.int32)
    x, y = x - left.astype(np.float32), y - top.astype(np.float32)
    a, b = depth_m[top, left], depth_m[top, left + 1]
    c, d = depth_m[top + 1, left], depth_m[top + 1, left + 1]
    lowest, highest = np.minimum.reduce([a, b, c, d]), np.maximum.reduce([a, b, c, d])
    one = (lowest > 0) & (highest - lowest < ONE_SURFACE_M)
    between = (a * (1 - x) + b * x) * (1 - y) + (c * (1 - x) + d * x) * y
    return np.where(one, between, nearest_m)


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
    """Voxels of the object: its largest piece above the plane, without hollows nobody sees."""
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


UNSEEN_VOXELS = 0.5
"""Where nobody measured, the surface runs in the middle between a solid and a free voxel."""
MIN_WEIGHT = 0.5
"""Of one view that measured well in front of its reach is 1."""
NEXT_VOXEL = 0.95
"""The surface does not run through a neighbour: that one is on the other side."""
MAX_SLOPE = 3.0
"""Views measure along their rays, so distances grow faster than the way; at most so much faster."""


def signed_distances(
    solid: Bool[np.ndarray, "num_x num_y num_z"], evidence: Evidence, truncation_m: float
) -> Float32[np.ndarray, "num_x num_y num_z"]:
    """Signed distance of voxel centres to the surface of a carved solid [m].

    Whether a voxel is solid is a yes or no, and a wall of three voxels is wrong by a third when
    one of them is. The mean distance the views measured beside the surface is finer: voxels
    beside it have that distance, all others the Euclidean distance to the nearest of them, plus
    what that one has left (the faces between voxels where nobody measured, as in
    ``distances_of_solid``).
    """
    voxel = evidence.box.voxel_m
    seen = evidence.weight >= MIN_WEIGHT
    measured = evidence.tsdf * np.float32(truncation_m / voxel)
    measured = measured / np.clip(_slope(measured, seen), 1.0, MAX_SLOPE)
    depth_in, way_in = ndimage.distance_transform_edt(solid, return_indices=True)
    depth_out, way_out = ndimage.distance_transform_edt(~solid, return_indices=True)
    told = seen & (np.where(solid, depth_in, depth_out) <= 1.0)
    told &= solid == (measured < 0)
    half = np.where(solid, np.float32(-UNSEEN_VOXELS), np.float32(UNSEEN_VOXELS))
    beside = np.where(told, np.clip(measured, -NEXT_VOXEL, NEXT_VOXEL), half)
    values = np.where(solid, beside[tuple(way_in)] - depth_in, beside[tuple(way_out)] + depth_out)
    return np.asarray(np.where(told, beside, values) * voxel, dtype=np.float32)


def _slope(
    measured: Float32[np.ndarray, "num_x num_y num_z"],
    seen: Bool[np.ndarray, "num_x num_y num_z"],
) -> Float32[np.ndarray, "num_x num_y num_z"]:
    """Length of the gradient by differences to neighbours that are known too, per voxel."""
    square = np.zeros_like(measured)
    for axis in range(3):
        low = tuple(slice(None, -1) if a == axis else slice(None) for a in range(3))
        high = tuple(slice(1, None) if a == axis else slice(None) for a in range(3))
        both = seen[low] & seen[high]
        step = np.where(both, measured[high] - measured[low], np.float32(0.0))
        total, count = np.zeros_like(measured), np.zeros_like(measured)
        for part in (low, high):
            total[part] += step
            count[part] += both
        square += np.square(total / np.maximum(count, 1.0))
    return np.asarray(np.sqrt(square))
