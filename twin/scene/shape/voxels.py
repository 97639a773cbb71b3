"""A box of voxels, and how each voxel stands to the surface that one view sees."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from bridge.geometry import se3
from twin.scene.shape.masked_view import MaskedView

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
    x, y, z = _in_camera(box, se3.invert(view.T_base_camera))
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


def _in_camera(
    box: VoxelBox, T_camera_base: Float[np.ndarray, "4 4"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Camera coordinates of all centres; sums of three rows instead of a matrix product."""
    T = T_camera_base.astype(np.float64)
    rows = []
    for row in T[:3]:
        along = [(row[axis] * box.axis_m(axis)).astype(np.float32) for axis in range(3)]
        along[2] = along[2] + np.float32(row[3])
        rows.append(along[0][:, None, None] + along[1][:, None] + along[2])
    return rows[0], rows[1], rows[2]
