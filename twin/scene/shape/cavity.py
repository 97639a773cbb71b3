"""The room inside a container: what a view looked into and walls enclose all around."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from twin.scene.shape.voxels import VoxelBox

MIN_SHARE = 0.05
"""Of the volume with the cavity filled; less is a dent."""
MIN_VOXELS = 30
MAX_POINTS = 400
LEAK_VOXELS = 2
"""Gaps in a wall up to twice this are closed before looking for the room behind it."""
CLEARANCE_VOXELS = 2.0
"""Sample points keep this distance from the walls."""


@dataclass(frozen=True, kw_only=True)
class Cavity:
    """Free space that the object encloses on all sides at the same height."""

    volume_m3: float
    depth_m: float
    """From its highest to its lowest voxel."""
    points_m: Float[np.ndarray, "num_points 3"]
    """Samples known to be free, away from the walls: no collision part may hold one."""


def find_cavity(
    solid: Bool[np.ndarray, "num_x num_y num_z"],
    free: Bool[np.ndarray, "num_x num_y num_z"],
    box: VoxelBox,
) -> Cavity | None:
    """Fill each horizontal layer; what that adds and somebody looked through is the cavity.

    Only the largest connected room counts. None when there is no cavity worth the name. One that
    no view looked into stays solid, and is found among the faces nobody saw.
    """
    in_layer = ndimage.generate_binary_structure(3, 1)
    in_layer[:, :, [0, 2]] = False
    tight = ndimage.binary_closing(solid, structure=in_layer, iterations=LEAK_VOXELS)
    filled = ndimage.binary_fill_holes(tight | solid, structure=in_layer)
    room = filled & ~solid & free
    pieces, count = ndimage.label(room)
    if count == 0:
        return None
    sizes = np.bincount(pieces.ravel())
    sizes[0] = 0
    room = pieces == sizes.argmax()
    num = int(room.sum())
    if num < max(MIN_VOXELS, MIN_SHARE * (num + int(solid.sum()))):
        return None
    layers = np.flatnonzero(room.any(axis=(0, 1)))
    away = ndimage.distance_transform_edt(~solid) - 0.5
    ids = np.flatnonzero(room & (away >= CLEARANCE_VOXELS))
    chosen = ids[np.linspace(0, len(ids) - 1, min(MAX_POINTS, len(ids))).round().astype(np.int64)]
    return Cavity(
        volume_m3=num * box.voxel_m**3,
        depth_m=float(layers[-1] - layers[0] + 1) * box.voxel_m,
        points_m=box.centres_m(chosen),
    )
