"""Which Gaussians belong to which object: by distance to its surface, by colour near the table.

A shape is reconstructed from views that were laid onto each other; Gaussians still stand where each
camera's wrong pose put them, some millimetres off. Those in the halo of an object go with it, or a
grey outline would stay on the table. What a fit put where object and table touch, nobody has seen.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from bridge.geometry import se3
from bridge.task.task_file import SCANNED, ObjectModel, Task
from twin.scene.gaussians import GaussianCloud
from twin.scene.localise.points import ColourConfig, likeness, linear_image
from twin.scene.localise.result import LocalisedObject
from twin.scene.localise.shape_fit import ShapeFitConfig, refine_on_points
from twin.scene.shape.from_training import Poses
from twin.scene.shape.known import surface_distances
from twin.scene.shape.reconstruct import ObjectShape

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
        owner: As in ``with_halo``; what belongs to an object is not asked.
        shapes: Reconstructed shapes in the frames of their objects.
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
    """Tell which Gaussians have an object's colour, see ``twin.scene.localise.points.likeness``."""
    color_u8 = np.clip(np.rint(cloud.colors * 255), 0, 255).astype(np.uint8)
    linear = linear_image(color_u8[None])[0]
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


MIN_SPLATS_TO_REFINE = 50
TABLE_BAND_M = 0.003
"""Lower Gaussians need the object's colour: there poses are wrong by as much."""


@dataclass(frozen=True, kw_only=True)
class SplitConfig:
    """Which Gaussians belong to an object."""

    search_m: float = 0.012
    """Around the localised surface, coloured Gaussians are looked for to refine the pose."""
    margin_m: float = 0.006
    """Gaussians whose centre is nearer than this to the refined surface may belong to it."""
    min_likeness: float = MIN_LIKENESS
    """Near the table a Gaussian must also have the object's colour, see ``likeness``."""
    max_scale_m: float = 0.05
    """Larger Gaussians are background that happens to pass through."""


def object_poses(
    cloud: GaussianCloud,
    localised: Mapping[str, LocalisedObject],
    task: Task,
    config: SplitConfig | None = None,
) -> dict[str, Float[np.ndarray, "4 4"]]:
    """Where the Gaussians of each object that was found are: its pose laid onto them."""
    config = SplitConfig() if config is None else config
    return {
        key: _refined(cloud, task.objects[key], item.T_base_object, config)
        for key, item in localised.items()
        if item.T_base_object is not None
    }


def assign_splats(
    cloud: GaussianCloud,
    poses: Poses,
    task: Task,
    shapes: Mapping[str, ObjectShape] | None = None,
    config: SplitConfig | None = None,
) -> Int[np.ndarray, " num_splats"]:
    """Index of the object each Gaussian belongs to, in the order of the poses; -1: background.

    Args:
        cloud: The whole scene in ``base_link`` whose z = 0 is the table.
        shapes: Reconstructed shapes in the frames of their objects, where there are any.
    """
    config = SplitConfig() if config is None else config
    shapes = {} if shapes is None else shapes
    owner = np.full(len(cloud), -1, dtype=np.int64)
    nearest = np.full(len(cloud), np.inf)
    small = np.exp(cloud.scales_log.max(axis=1)) < config.max_scale_m if len(cloud) else owner > 0
    for index, (key, T) in enumerate(poses.items()):
        model, shape = task.objects[key], shapes.get(key)
        ids, distance = _near(cloud, model, T, config.margin_m, shape)
        ids, distance = ids[small[ids]], distance[small[ids]]
        part = cloud.take(ids)
        height = part.means_m[:, 2].astype(np.float64)
        colored = alike(part, model, config.min_likeness)
        if shape is None:
            mine = (height > config.margin_m) | colored
        else:
            mine = (height > TABLE_BAND_M) | colored
            mine &= np.maximum(distance, 0.0) < np.abs(height)
        # Of two surfaces that touch, the one of the Gaussian's own colour wins.
        distance = np.abs(distance) + np.where(colored, 0.0, config.margin_m)
        wins = mine & (distance < nearest[ids])
        owner[ids[wins]] = index
        nearest[ids[wins]] = distance[wins]
    return with_halo(cloud, owner, poses, shapes)


def _refined(
    cloud: GaussianCloud,
    model: ObjectModel,
    T_base_object: Float[np.ndarray, "4 4"],
    config: SplitConfig,
) -> Float[np.ndarray, "4 4"]:
    """The scene's own errors shift what it shows by millimetres: follow the Gaussians.

    Only boxes: what stands in for other shapes is too coarse to lay them out by, and knows no tilt.
    """
    if model.shape in ("mesh", SCANNED):
        return T_base_object
    ids, _ = _near(cloud, model, T_base_object, config.search_m, None)
    ids = ids[alike(cloud.take(ids), model, config.min_likeness)]
    if len(ids) < MIN_SPLATS_TO_REFINE:
        return T_base_object
    points = cloud.means_m[ids].astype(np.float64)
    return refine_on_points(points, model, T_base_object, ShapeFitConfig())


def _near(
    cloud: GaussianCloud,
    model: ObjectModel,
    T_base_object: Float[np.ndarray, "4 4"],
    margin_m: float,
    shape: ObjectShape | None,
) -> tuple[Int[np.ndarray, " num_near"], Float[np.ndarray, " num_near"]]:
    """Ids of Gaussians within a margin of the surface or inside the material, and how far."""
    reach = float(np.linalg.norm(model.size_m)) + margin_m
    around = np.linalg.norm(cloud.means_m - T_base_object[:3, 3].astype(np.float32), axis=1) < reach
    ids = np.flatnonzero(around)
    points = cloud.means_m[ids].astype(np.float64)
    if shape is None:
        distance, _ = surface_distances(points, model, T_base_object)
    else:
        distance = shape.sdf.distance(se3.apply(se3.invert(T_base_object), points))
    near = distance < margin_m
    return np.asarray(ids[near]), np.asarray(distance[near])
