"""Which Gaussians belong to which object: by distance to its surface, by colour near the table."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from bridge.geometry import se3
from bridge.task.task_file import SCANNED, ObjectModel, Task
from twin.scene.gaussians.cloud import GaussianCloud
from twin.scene.localise.fit import FitConfig, refine_on_points
from twin.scene.localise.result import LocalisedObject
from twin.scene.objects.remains import MIN_LIKENESS, Poses, alike, with_halo
from twin.scene.shape.known import surface_distances
from twin.scene.shape.reconstruct import ObjectShape

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
    """Where the Gaussians of each object that was found are: its pose laid onto them.

    Args:
        cloud: The whole scene in ``base_link``.
        localised: Where the objects were while it was scanned.
        task: Their shapes and colours.
        config: Settings; the defaults when None.
    """
    config = SplitConfig() if config is None else config
    return {
        key: _refined(cloud, task.objects[key], item.T_base_object, config)
        for key, item in localised.items()
        if item.T_base_object is not None
    }


def owners(
    cloud: GaussianCloud,
    poses: Poses,
    task: Task,
    shapes: Mapping[str, ObjectShape] | None = None,
    config: SplitConfig | None = None,
) -> Int[np.ndarray, " num_splats"]:
    """Index of the object each Gaussian belongs to, in the order of the poses; -1: background.

    Args:
        cloud: The whole scene in ``base_link`` whose z = 0 is the table.
        poses: From ``object_poses``.
        task: Shapes and colours.
        shapes: Reconstructed shapes in the frames of their objects, where there are any.
        config: Settings; the defaults when None.
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
    return refine_on_points(points, model, T_base_object, FitConfig())


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
