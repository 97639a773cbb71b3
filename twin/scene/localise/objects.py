"""Where the objects of a task are, from RGB-D frames: colour proposes, known shapes fit.

Boxes are laid onto points and outlines, meshes onto points; soft toys come last, out of what the
rigid objects leave. Reads posed frames only, in the robot's ``base_link`` frame whose z = 0 is the
table top: the shapes come from the task file, the pixels from the cameras.

The table corrects each camera that sees it too high or tilted, because its pose or depth scale is
wrong. The table alone cannot tell a camera that sits too high from depth that reads too short, so a
prior on each shares the blame (maximum a posteriori, linearised about the recorded pose).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.episode.streams import RgbdFrame
from bridge.task.task_file import SCANNED, ObjectModel, Task
from twin.scene.least_squares import normal_equations, tukey_weights
from twin.scene.localise.mesh_fit import MeshFitConfig, MeshSurface, fit_mesh, known_surface
from twin.scene.localise.points import (
    CameraView,
    Cluster,
    ColourConfig,
    PointConfig,
    fuse_stationary,
    likeness,
    moved,
    object_points,
)
from twin.scene.localise.result import (
    LocalisedObject,
    found_by_box,
    found_by_mesh,
    found_by_shape,
    missing,
)
from twin.scene.localise.shape_fit import ShapeFitConfig, fit_shape
from twin.scene.localise.soft import SoftConfig, SoftFit, fit_toys
from twin.scene.shape.known import yaw_period_rad


@dataclass(frozen=True, kw_only=True)
class TableConfig:
    """How far the seen table may correct the cameras."""

    band_m: float = 0.025
    """Points this far above or below z = 0 may be table."""
    min_points: int = 300
    """With fewer the camera is left as it is."""
    max_points: int = 6000
    """Enough to average the noise; more are thinned out evenly."""
    depth_scale_sigma: float = 0.005
    """Prior of the relative depth error."""
    height_sigma_m: float = 0.002
    """Prior of the camera height error."""
    tilt_sigma_rad: float = 0.006
    """Prior of the camera tilt error about each horizontal axis."""
    noise_sigma_m: float = 0.002
    """Of one table point."""


@dataclass(frozen=True, kw_only=True)
class TableFit:
    """What one camera saw of the table, and how it was corrected."""

    camera_id: str
    num_points: int
    offset_m: float
    """Mean height of the table before the correction; 0 is where it should be."""
    tilt_rad: float
    """Slope of the table before the correction."""
    residual_m: float
    """Robust spread of table points about z = 0 after the correction."""
    depth_factor: float
    """Depth is multiplied with this."""
    T_new_old: Float[np.ndarray, "4 4"]
    """The camera's motion in the base frame."""

    def to_record(self) -> dict[str, float | int]:
        """Return the numbers a reader wants to see."""
        return {
            "num_points": self.num_points,
            "offset_m": self.offset_m,
            "tilt_rad": self.tilt_rad,
            "residual_m": self.residual_m,
            "depth_factor": self.depth_factor,
        }


def correct_for_table(
    views: Sequence[CameraView],
    task: Task,
    config: TableConfig,
    points: PointConfig,
    colour: ColourConfig,
) -> tuple[list[CameraView], dict[str, TableFit]]:
    """Move each view so that its table lies at z = 0; views that see too little stay.

    Args:
        task: Its objects do not count as table.
        points: From half its ``min_likeness`` on, a point is the object's and not the table's.
    """
    corrected, fits = [], {}
    for view in views:
        p = _table_points(view, task, config, points, colour)
        if len(p) < config.min_points:
            corrected.append(view)
            continue
        fit = fit_table(p, view.T_base_depth[:3, 3], view.camera_id, config)
        corrected.append(moved(view, fit.T_new_old, fit.depth_factor))
        fits[view.camera_id] = fit
    return corrected, fits


def _table_points(
    view: CameraView, task: Task, config: TableConfig, points: PointConfig, colour: ColourConfig
) -> Float[np.ndarray, "num_points 3"]:
    wanted = np.abs(view.p_base[:, 2]) < config.band_m
    step = max(1, int(wanted.sum()) // config.max_points)
    ids = everything = np.flatnonzero(wanted)[::step]
    for model in task.objects.values():
        like = likeness(view.color_linear[ids], model.color_srgb, colour)
        ids = ids[like < points.min_likeness / 2]
    # A table of the objects' own colour: most points of the band are table all the same.
    return view.p_base[ids if len(ids) >= config.min_points else everything]


def fit_table(
    p_base: Float[np.ndarray, "num_points 3"],
    p_base_camera: Float[np.ndarray, "3"],
    camera_id: str,
    config: TableConfig,
) -> TableFit:
    """Find the correction that best lays table points on z = 0.

    Unknowns: relative depth error, camera height error, rotation about base x and y; least squares
    with Tukey weights and Gaussian priors. The rotation is about the camera.

    Args:
        p_base: Points of the table, as the camera says now [m].
        p_base_camera: Where the camera is [m].
    """
    d = p_base - p_base_camera
    # z after the correction: p_z - s d_z + h + (rotation x d)_z. On the table d_z is minus the
    # camera height; the measured d_z would let s shrink the noise.
    height = np.full(len(d), p_base_camera[2])
    A = np.stack([height, np.ones(len(d)), d[:, 1], -d[:, 0]], axis=1)
    sigma = np.array(
        [config.depth_scale_sigma, config.height_sigma_m, *[config.tilt_sigma_rad] * 2]
    )
    # Neighbouring pixels share their error: count the points as at most a few hundred.
    weight = np.ones(len(d)) * min(1.0, 500 / len(d)) / config.noise_sigma_m**2
    x = np.zeros(4)
    spread = 0.0
    for _ in range(8):
        residual = p_base[:, 2] + A @ x
        centred = residual - np.median(residual)
        spread = 1.4826 * float(np.median(np.abs(centred)))
        robust = tukey_weights(centred, max(6.0 * spread, 1e-3)) * weight
        H, gradient = normal_equations(A, p_base[:, 2], robust)
        x = -np.linalg.solve(H + np.diag(1 / sigma**2), gradient)
    slope = np.linalg.lstsq(
        np.column_stack([p_base[:, :2] - p_base[:, :2].mean(axis=0), np.ones(len(d))]),
        p_base[:, 2],
        rcond=None,
    )[0]
    return TableFit(
        camera_id=camera_id,
        num_points=len(d),
        offset_m=float(np.median(p_base[:, 2])),
        tilt_rad=float(np.hypot(slope[0], slope[1])),
        residual_m=spread,
        depth_factor=float(1 - x[0]),
        T_new_old=_small_motion(x[1], x[2], x[3], p_base_camera),
    )


def _small_motion(
    height_m: float, about_x_rad: float, about_y_rad: float, p_centre: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    """Rotate about a point (Rodrigues), then lift."""
    rotation = np.array([about_x_rad, about_y_rad, 0.0])
    angle = float(np.linalg.norm(rotation))
    T = np.eye(4)
    if angle > 0:
        x, y, z = rotation / angle
        K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        T[:3, :3] = np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K
    T[:3, 3] = p_centre - T[:3, :3] @ p_centre + np.array([0.0, 0.0, height_m])
    return T


@dataclass(frozen=True, kw_only=True)
class LocaliseConfig:
    """How objects are found; the defaults suit a table seen from about a metre."""

    colour: ColourConfig = field(default_factory=ColourConfig)
    """Which pixels have an object's colour."""
    points: PointConfig = field(default_factory=PointConfig)
    """Which points belong to an object."""
    table: TableConfig = field(default_factory=TableConfig)
    """How far the seen table may correct the cameras."""
    fit: ShapeFitConfig = field(default_factory=ShapeFitConfig)
    """How a known shape is laid onto points and outlines."""
    mesh: MeshFitConfig = field(default_factory=MeshFitConfig)
    """How a known mesh is laid onto points."""
    soft: SoftConfig = field(default_factory=SoftConfig)
    """How soft toys are found."""
    max_frames: int = 3
    """Frames of one camera pose that are averaged."""
    max_views: int = 8
    """Poses of one camera that are used, for example of a wrist camera during a scan."""
    min_explained: float = 0.6
    """Share of an object's points that its shape must explain."""
    rest_tolerance_m: float = 0.006
    """Nearer than this to standing on the table counts as standing on it."""


def localise_objects(
    frames: Sequence[RgbdFrame],
    task: Task,
    config: LocaliseConfig | None = None,
    last_seen_m: Mapping[str, Float[np.ndarray, "3"]] | None = None,
    surfaces: Mapping[str, MeshSurface] | None = None,
) -> dict[str, LocalisedObject]:
    """Find every object of a task in frames taken while nothing moved.

    Args:
        frames: Posed frames of any cameras; several of one still camera are averaged.
        task: Whose ``objects`` are looked for by colour and laid out by known shape.
        last_seen_m: Where objects were seen before; tells equal ones apart. Default: where the
            task starts them.
        surfaces: Of scanned objects, from the scene, in their own frames. Without one the object
            is only boxed in: the rough pose that its shape is then reconstructed at.

    Returns:
        One entry per object of the task; ``found`` is False, with a reason, where it was not
        seen. Never a guess.
    """
    config = LocaliseConfig() if config is None else config
    views = fuse_stationary(frames, config.max_frames, config.max_views, task, config.points)
    views, tables = correct_for_table(views, task, config.table, config.points, config.colour)
    objects = {
        object_id: _localise_one(views, model, config, tables, (surfaces or {}).get(object_id))
        for object_id, model in task.objects.items()
        if model.soft is None or not views
    }
    if views:
        starts_m = {
            key: np.array([np.mean(s.x_m), np.mean(s.y_m), task.objects[key].rest_height_m])
            for key, s in task.start.items()
        }
        expected_m = starts_m | dict(last_seen_m or {})
        objects |= _localise_toys(views, task, config, tables, objects, expected_m)
    return {key: objects[key] for key in task.objects}


def _localise_toys(
    views: Sequence[CameraView],
    task: Task,
    config: LocaliseConfig,
    tables: Mapping[str, TableFit],
    rigid: Mapping[str, LocalisedObject],
    expected_m: Mapping[str, Float[np.ndarray, "3"]],
) -> dict[str, LocalisedObject]:
    """Find the soft objects, equal ones together."""
    groups: dict[ObjectModel, list[ObjectModel]] = {}
    for model in task.objects.values():
        if model.soft is not None:
            groups.setdefault(replace(model, id=""), []).append(model)
    blocked = {
        task.objects[key]: item.T_base_object
        for key, item in rigid.items()
        if item.T_base_object is not None
    }
    found = {}
    for models in groups.values():
        fits = fit_toys(
            models,
            views,
            blocked,
            expected_m,
            points=config.points,
            colour=config.colour,
            fit=config.fit,
            mesh=config.mesh,
            soft=config.soft,
            min_explained=config.min_explained,
        )
        for model in models:
            found[model.id] = _toy(model, fits[model.id], views, config, tables, len(models))
    return found


def _toy(
    model: ObjectModel,
    toy: SoftFit,
    views: Sequence[CameraView],
    config: LocaliseConfig,
    tables: Mapping[str, TableFit],
    equals: int,
) -> LocalisedObject:
    stamp_ns = max(view.stamp_ns for view in views)
    detail = _detail(views, toy.num_points, tables)
    if equals > 1:
        detail |= {"equal_objects": equals, "assignment_margin_m": toy.margin_m}
    if toy.fit is None or toy.shape is None:
        return missing(model, stamp_ns, str(toy.reason), detail)
    found = found_by_mesh(model, toy.fit, stamp_ns, config.rest_tolerance_m, detail)
    reasons = [text for text in (found.reason, toy.reason) if text]
    return replace(
        found,
        reason="; ".join(reasons) or None,
        detail={**found.detail, "soft_shape": toy.shape.to_record()},
    )


def _detail(
    views: Sequence[CameraView], num_points: int, tables: Mapping[str, TableFit]
) -> dict[str, Any]:
    return {
        "cameras": sorted({view.camera_id for view in views}),
        "num_frames": sum(view.num_frames for view in views),
        "num_points": num_points,
        "table": {camera_id: fit.to_record() for camera_id, fit in tables.items()},
    }


def _localise_one(
    views: Sequence[CameraView],
    model: ObjectModel,
    config: LocaliseConfig,
    tables: Mapping[str, TableFit],
    scanned: MeshSurface | None,
) -> LocalisedObject:
    stamp_ns = max((view.stamp_ns for view in views), default=0)
    if not views:
        return missing(model, stamp_ns, "no frames with colour, depth and a pose were given", {})
    is_box = model.mesh is None and scanned is None
    low_m = config.points.min_height_m if is_box else config.soft.min_height_m
    points = replace(config.points, min_height_m=low_m)
    groups = object_points(views, model, points, config.colour)
    seen = len(groups[0]) if groups else 0
    detail = _detail(views, seen, tables)
    if seen < config.points.min_points:
        reason = (
            f"{seen} points have the colour of {model.id} above the table, "
            f"{config.points.min_points} are needed (cameras {', '.join(detail['cameras'])})"
        )
        return missing(model, stamp_ns, reason, detail)
    if model.mesh is not None:
        scanned = known_surface(model, config.mesh.num_samples)
    if scanned is not None:
        return _localise_mesh(groups[0], views, model, scanned, stamp_ns, config, detail)
    if model.shape == SCANNED:
        return _boxed_in(groups[0], model, stamp_ns, config, detail)
    fit = fit_shape(groups[0], views, model, config.colour, config.fit)
    detail |= {
        "residual_m": fit.residual_m,
        "outline_residual_m": fit.outline_residual_m,
        "num_edges": fit.num_edges,
        "other_points": sum(len(group) for group in groups[1:]),
        "camera_shift_m": _by_view(views, fit.camera_shift_m),
    }
    if fit.explained < config.min_explained:
        reason = (
            f"only {fit.explained:.0%} of {seen} points fit the shape of {model.id}, "
            f"{config.min_explained:.0%} are needed"
        )
        return missing(model, stamp_ns, reason, detail)
    return found_by_shape(model, fit, stamp_ns, config.rest_tolerance_m, detail)


def _boxed_in(
    group: Cluster,
    model: ObjectModel,
    stamp_ns: int,
    config: LocaliseConfig,
    detail: dict[str, Any],
) -> LocalisedObject:
    """A rough place for what no scan has shown yet."""
    boxed = found_by_box(model, group.p_base, stamp_ns, detail)
    if boxed.confidence >= config.min_explained:
        return boxed
    reason = (
        f"only {boxed.confidence:.0%} of {len(group)} points fit into the box of {model.id}, "
        f"{config.min_explained:.0%} are needed"
    )
    return missing(model, stamp_ns, reason, detail)


def _localise_mesh(
    group: Cluster,
    views: Sequence[CameraView],
    model: ObjectModel,
    surface: MeshSurface,
    stamp_ns: int,
    config: LocaliseConfig,
    detail: dict[str, Any],
) -> LocalisedObject:
    """Lay the mesh of a rigid object that stands onto its points."""
    fit = fit_mesh(
        group,
        views,
        surface,
        config.fit,
        config.mesh,
        tilt_sigma_rad=config.fit.upright_sigma_rad,
        yaw_period_rad=yaw_period_rad(model),
    )
    if fit.explained < config.min_explained:
        reason = (
            f"only {fit.explained:.0%} of {len(group)} points fit the mesh of {model.id}, "
            f"{config.min_explained:.0%} are needed"
        )
        return missing(model, stamp_ns, reason, detail)
    return found_by_mesh(model, fit, stamp_ns, config.rest_tolerance_m, detail)


def _by_view(views: Sequence[CameraView], values: Sequence[float]) -> dict[str, list[float]]:
    table: dict[str, list[float]] = {}
    for view, value in zip(views, values, strict=True):
        table.setdefault(view.camera_id, []).append(value)
    return table
