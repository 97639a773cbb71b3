"""Where between two voxels a carved surface runs: what views measured there says it."""

import numpy as np
from jaxtyping import Bool, Float32
from scipy import ndimage

from twin.scene.shape.carve import Evidence

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

    Args:
        solid: True inside; with at least one voxel of each kind.
        evidence: Mean distances in truncations, and where there are any.
        truncation_m: From ``voxel_box``.
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
