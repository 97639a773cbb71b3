"""Training views and localised objects in, one shape per object out.

An object's pixels are those whose measured point lies at its localised surface. The shape is made
in the object's own frame, so walls of a box lie along the voxels.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from bridge.episode import provenance
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.task.task_file import BASKET, SCANNED, ObjectModel, Task
from bridge.terminal import Advance
from twin.errors import TwinError
from twin.scene.frames.rgbd import TrainingView
from twin.scene.frames.selection import spread
from twin.scene.shape.carve import MaskedView
from twin.scene.shape.known import outside_m, pose_of, shape_mesh
from twin.scene.shape.reconstruct import ObjectShape, reconstruct, shape_of_mesh
from twin.scene.shape.static import everything_in, static_sdf
from twin.scene.store.library import SDF

MASK_MARGIN_M = 0.008
"""A measured point this near to the known surface is the object's."""
TABLE_M = 0.003
"""Lower points may be the table's."""
STANDING_M = 0.008
"""An object whose underside is at most this far from the table stands on it."""
UPRIGHT_COSINE, LEANING_COSINE = 0.999, 0.95
"""Above the first an object's own frame is level; a toy may rest leaning, down to the second."""
ALIGN_ROUNDS = 8

Poses = Mapping[str, Float[np.ndarray, "4 4"]]


def shapes_of(
    views: Sequence[TrainingView],
    models: Mapping[str, ObjectModel],
    Ts_base_object: Poses,
    wanted: Iterable[str] | None = None,
    advance: Advance = lambda done, note: None,
) -> dict[str, ObjectShape | str]:
    """Shapes of objects in their own frames, or why there is none.

    What is rigid and known has the task's shape: views leave it ragged, and thin walls too thick.
    """
    found: dict[str, ObjectShape | str] = {}
    for done, key in enumerate(Ts_base_object if wanted is None else wanted):
        advance(done, key)
        T = Ts_base_object[key]
        if T[2, 2] < LEANING_COSINE:
            found[key] = f"{key} does not stand upright, so its underside cannot be closed"
            continue
        masked = [masked_view(view, key, models, Ts_base_object) for view in views]
        useful, support = [v for v in masked if v.mask.any()], support_z_m(models[key], T)
        make = reconstruct if T[2, 2] >= UPRIGHT_COSINE else partial(_leaning, T_base_object=T)
        try:
            if is_known(models[key]) and useful:
                found[key] = shape_of_mesh(*shape_mesh(models[key]), len(useful))
            else:
                found[key] = make(useful, support, align_rounds=ALIGN_ROUNDS)
        except TwinError as error:
            found[key] = str(error)
    return found


def is_known(model: ObjectModel) -> bool:
    """Whether the task states the shape that an object has now."""
    return model.shape != SCANNED and model.soft is None


def _leaning(
    views: Sequence[MaskedView],
    support: float | None,
    T_base_object: Float[np.ndarray, "4 4"],
    align_rounds: int,
) -> ObjectShape:
    """Reconstruct in a level frame, where the table is a plane of the grid; then lean it."""
    yaw = np.arctan2(T_base_object[1, 0], T_base_object[0, 0])
    T_base_level = pose_of(np.array([*T_base_object[:3, 3], yaw]))
    T_level_object = se3.invert(T_base_level) @ T_base_object
    moved = [replace(view, T_base_camera=T_level_object @ view.T_base_camera) for view in views]
    level = reconstruct(moved, support, align_rounds=align_rounds)
    vertices = se3.apply(se3.invert(T_level_object), level.vertices_m)
    return shape_of_mesh(vertices, level.faces, level.num_views)


def support_z_m(model: ObjectModel, T_base_object: Float[np.ndarray, "4 4"]) -> float | None:
    """Height of the table in the object's frame [m]; None when it does not stand on it.

    Args:
        T_base_object: Where it is; the table is at z = 0 of the base.
    """
    underside = float(min((centre - extents / 2)[2] for centre, extents in model.panels()))
    table = -float(T_base_object[2, 3])
    return table if abs(underside - table) <= STANDING_M else None


def masked_view(
    view: TrainingView, key: str, models: Mapping[str, ObjectModel], Ts_base_object: Poses
) -> MaskedView:
    """One training view in an object's frame, with the pixels that show the object.

    A pixel belongs to the object whose surface is nearest to its point.
    """
    target = view.full
    depth = np.where(target.static_mask, target.depth_m, np.float32(0.0))
    camera = target.camera
    model, T = models[key], Ts_base_object[key]
    reach = float(np.linalg.norm(model.size_m)) + MASK_MARGIN_M
    rows, columns = image_window(camera, se3.invert(view.T_base_color) @ T[:, 3], reach)
    row, column = np.nonzero(depth[rows, columns] > 0)
    row, column = row + rows.start, column + columns.start
    z = depth[row, column].astype(np.float64)
    p_camera = camera.rays()[row, column] * z[:, None]
    p_base = se3.apply(view.T_base_color, p_camera)
    near = np.flatnonzero(np.linalg.norm(p_base - T[:3, 3], axis=1) < reach)
    near = near[p_base[near, 2] > TABLE_M]
    own = _away(p_base[near], model, T)
    mine: Bool[np.ndarray, " num_near"] = own < MASK_MARGIN_M
    for other, T_other in Ts_base_object.items():
        if other != key and np.linalg.norm(T_other[:3, 3] - T[:3, 3]) < 2 * reach:
            mine &= own <= _away(p_base[near], models[other], T_other)
    mask = np.zeros(depth.shape, dtype=bool)
    mask[row[near[mine]], column[near[mine]]] = True
    return MaskedView(
        camera=camera,
        T_base_camera=se3.invert(T) @ view.T_base_color,
        depth_m=depth,
        mask=mask,
        sensor=view.camera_id,
    )


def image_window(
    camera: Camera, p_camera: Float[np.ndarray, "4"], reach_m: float
) -> tuple[slice, slice]:
    """Rows and columns that can show something within reach of a point; none behind the camera.

    Args:
        p_camera: The point in the camera's frame [m]; homogeneous.
    """
    x, y, z = p_camera[:3]
    if z + reach_m <= 0:
        return slice(0, 0), slice(0, 0)
    nearest = max(z - reach_m, 1e-3)
    spans = []
    for centre, focal, middle, size in (
        (y, camera.fy, camera.cy, camera.height),
        (x, camera.fx, camera.cx, camera.width),
    ):
        ends = [
            side / depth * focal + middle
            for side in (centre - reach_m, centre + reach_m)
            for depth in (nearest, z + reach_m)
        ]
        first, last = np.clip([np.floor(min(ends)), np.ceil(max(ends))], 0, size).astype(int)
        spans.append(slice(int(first), int(last)))
    return spans[0], spans[1]


def _away(
    points: Float[np.ndarray, "num_points 3"],
    model: ObjectModel,
    T_base_object: Float[np.ndarray, "4 4"],
) -> Float[np.ndarray, " num_points"]:
    """Distance to the known surface; where only the box around is known, 0 inside of it."""
    distance = outside_m(points, model, T_base_object)
    return np.asarray(np.abs(distance) if is_known(model) else np.maximum(distance, 0.0))


WALL_BAND_M = (0.006, 0.008)
"""Points this far inside of a container's inner face, and outside of its outer one, are of its
walls."""
HEIGHTS = (0.3, 2.0)
"""Of the published height: below, a wall may be hidden; above, nothing is the container's."""
TOP_PERCENTILE = 98.0
FEWEST_POINTS = 300
MOST_VIEWS = 40


def rim_height_m(
    views: Sequence[TrainingView], model: ObjectModel, T_base_object: Float[np.ndarray, "4 4"]
) -> float | None:
    """Height of a container's rim over its origin as the views show it [m].

    What is published of a container may be wrong, and a plan that passes low over the rim hangs on
    it. None where the views show too little of the walls.
    """
    half, wall = np.array(model.size_m[:2]) / 2, model.wall_m
    low_m, high_m = (share * model.size_m[2] for share in HEIGHTS)
    T_object_base = se3.invert(T_base_object)
    heights = []
    for index in spread(np.arange(len(views)), MOST_VIEWS):
        p = se3.apply(T_object_base, everything_in(views[index]).points_m())
        beyond = np.abs(p[:, :2]) - half
        outside = beyond.max(axis=1)
        chosen = (outside > -wall - WALL_BAND_M[0]) & (outside < WALL_BAND_M[1])
        chosen &= (p[:, 2] > low_m) & (p[:, 2] < high_m)
        if model.mesh == BASKET:  # handles stand on the walls across x
            chosen &= beyond[:, 1] > beyond[:, 0]
        heights.append(p[chosen, 2])
    seen = np.concatenate(heights) if heights else np.zeros(0)
    return float(np.percentile(seen, TOP_PERCENTILE)) if len(seen) >= FEWEST_POINTS else None


def _rim_heights_m(scans: Sequence["ObjectViews"]) -> dict[str, float]:
    """Of the containers whose walls the views show; each by the first scan that does."""
    found: dict[str, float] = {}
    for scan in scans:
        for key, T in scan.Ts_base_object.items():
            if scan.task.objects[key].wall_m > 0 and key not in found:
                height_m = rim_height_m(scan.views, scan.task.objects[key], T)
                if height_m is not None:
                    found[key] = height_m
    return found


def with_heights(task: Task, heights_m: Mapping[str, float]) -> Task:
    """A task whose containers are as high as they were seen to be."""
    objects = {
        key: replace(model, size_m=(*model.size_m[:2], heights_m[key]))
        if key in heights_m
        else model
        for key, model in task.objects.items()
    }
    return replace(task, objects=objects)


@dataclass(frozen=True, kw_only=True)
class ObjectViews:
    """Training views of one episode, and where it has its task's objects."""

    views: Sequence[TrainingView]
    task: Task
    Ts_base_object: Poses


def write_static(
    folder: Path,
    views: Sequence[TrainingView],
    scans: Sequence[ObjectViews],
) -> dict[str, Any]:
    """Write ``sdf.npz``, the static scene without the objects, and return its record.

    Only a task says that z = 0 is a table; without one nothing closes the scene below.
    """
    path = folder / SDF
    path.unlink(missing_ok=True)
    heights_m = _rim_heights_m(scans)
    objects = [
        partial(from_outside_m, model=seen.objects[key], T_base_object=T)
        for scan in scans
        for seen in [with_heights(scan.task, heights_m)]
        for key, T in scan.Ts_base_object.items()
    ]
    try:
        static = static_sdf(views, 0.0 if scans else None, objects)
    except TwinError as error:
        return {"file": None, "remark": str(error), "rim_height_m": heights_m}
    static.save(path)
    sha256 = provenance.hash_file(path)
    return {"file": SDF, "sha256": sha256, "rim_height_m": heights_m}


def from_outside_m(
    points: Float[np.ndarray, "num_points 3"],
    model: ObjectModel,
    T_base_object: Float[np.ndarray, "4 4"],
) -> Float[np.ndarray, " num_points"]:
    """Signed distance of points to what an object takes up: handles, rim and cavity included [m].

    What cameras that are a little off see of a container's far wall lies in its cavity. Were it
    left in the scene, nothing could be put there once the container stands elsewhere.
    """
    distance = outside_m(points, model, T_base_object)
    if model.wall_m > 0:
        half = np.array(model.inner_m) / 2
        p = se3.apply(se3.invert(T_base_object), points) - [0.0, 0.0, model.wall_m + half[2]]
        from_cavity = np.linalg.norm(np.maximum(np.abs(p) - half, 0.0), axis=1)
        distance = np.minimum(distance, from_cavity)
    return np.asarray(distance)
