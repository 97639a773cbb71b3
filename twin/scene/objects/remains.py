"""What an object leaves behind when only Gaussians at its surface are taken out of a scene.

A shape is reconstructed from views that were laid onto each other; Gaussians still stand where each
camera's wrong pose put them, some millimetres off. Without them a grey outline of the object would
stay on the table. And what a fit has put where object and table touch, nobody has seen.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from bridge.geometry import se3
from bridge.task.task_file import ObjectModel, Task
from twin.scene.gaussians.cloud import GaussianCloud
from twin.scene.localise.colour import ColourConfig, likeness, linear_from_srgb
from twin.scene.shape.reconstruct import ObjectShape

Poses = Mapping[str, Float[np.ndarray, "4 4"]]
Shapes = Mapping[str, ObjectShape]

HALO_M = 0.015
"""Gaussians this near a surface may still show it: cameras are wrong by 5 to 10 mm."""
STANDS_M = 0.008
"""Higher Gaussians are no table."""
UNDER_M = 0.004
"""Table this near an object's surface is hidden by it."""
MIN_LIKENESS = 0.35
"""Of a Gaussian that has an object's colour."""


def with_halo(
    cloud: GaussianCloud, owner: Int[np.ndarray, " num_splats"], poses: Poses, shapes: Shapes
) -> Int[np.ndarray, " num_splats"]:
    """Give Gaussians around an object to it, unless something else stands nearer to them.

    Those above the table and within ``HALO_M`` go where the nearest one goes that is decided:
    taken already, or above the table and farther away from all objects.

    Args:
        cloud: The whole scene in ``base_link`` whose z = 0 is the table.
        owner: Index of the object each Gaussian belongs to so far, in the order of the poses; -1.
        poses: Where the objects are.
        shapes: Reconstructed shapes in the frames of their objects; others are left as they are.
    """
    distance, nearest = _nearest(cloud, poses, shapes)
    above = cloud.means_m[:, 2] > STANDS_M
    open_ids = np.flatnonzero((owner < 0) & above & (distance < HALO_M))
    decided = np.flatnonzero((owner >= 0) | (above & (distance >= HALO_M)))
    if not len(open_ids) or not len(decided):
        return owner
    _, found = cKDTree(cloud.means_m[decided]).query(cloud.means_m[open_ids])
    given = owner[decided[found]]
    result = owner.copy()
    # What stands against another object's shape goes to neither: it is nearest to this one.
    same = given == nearest[open_ids]
    result[open_ids[same]] = given[same]
    return result


def hidden_table(
    cloud: GaussianCloud,
    owner: Int[np.ndarray, " num_splats"],
    poses: Poses,
    shapes: Shapes,
    task: Task,
    min_likeness: float = MIN_LIKENESS,
) -> Bool[np.ndarray, " num_splats"]:
    """Tell which Gaussians of the table nobody saw, or are a shifted object's: to be filled.

    Those where an object stands, and around it those in its own colour. A table of that colour
    loses nothing: the filling has it too.

    Args:
        cloud: As in ``with_halo``.
        owner: As in ``with_halo``; what belongs to an object is not asked.
        poses: Where the objects are.
        shapes: Reconstructed shapes in the frames of their objects.
        task: Their colours.
        min_likeness: Of a Gaussian in an object's own colour.
    """
    on_top = cloud.means_m.astype(np.float64)
    on_top[:, 2] = np.maximum(on_top[:, 2], 0.0)  # below the table, the point above counts
    low = (owner < 0) & (cloud.means_m[:, 2] <= STANDS_M)
    distance, nearest = _nearest(cloud, poses, shapes, on_top)
    hidden = low & (distance < UNDER_M)
    for number, key in enumerate(poses):
        around = np.flatnonzero(low & ~hidden & (nearest == number) & (distance < HALO_M))
        hidden[around] = alike(cloud.take(around), task.objects[key], min_likeness)
    return np.asarray(hidden)


def alike(
    cloud: GaussianCloud, model: ObjectModel, min_likeness: float
) -> Bool[np.ndarray, " num_splats"]:
    """Tell which Gaussians have an object's colour, see ``twin.scene.localise.colour.likeness``."""
    color_u8 = np.clip(np.rint(cloud.colors * 255), 0, 255).astype(np.uint8)
    linear = linear_from_srgb(color_u8[None])[0]
    return np.asarray(likeness(linear, model.color_srgb, ColourConfig()) >= min_likeness)


def _nearest(
    cloud: GaussianCloud,
    poses: Poses,
    shapes: Shapes,
    points_m: Float[np.ndarray, "num_splats 3"] | None = None,
) -> tuple[Float[np.ndarray, " num_splats"], Int[np.ndarray, " num_splats"]]:
    """Signed distance to the nearest shape [m], infinity far away, and which of the poses it is."""
    points = cloud.means_m.astype(np.float64) if points_m is None else points_m
    distance = np.full(len(cloud), np.inf)
    index = np.full(len(cloud), -1, dtype=np.int64)
    for number, (key, T) in enumerate(poses.items()):
        shape = shapes.get(key)
        if shape is None:
            continue
        reach = float(np.linalg.norm(shape.vertices_m, axis=1).max()) + HALO_M
        ids = np.flatnonzero(np.linalg.norm(points - T[:3, 3], axis=1) < reach)
        found = shape.sdf.distance(se3.apply(se3.invert(T), points[ids]))
        wins = found < distance[ids]
        distance[ids[wins]], index[ids[wins]] = found[wins], number
    return distance, index
