"""Where the objects of a task are, from RGB-D frames: colour proposes, known shapes fit.

Boxes are laid onto points and outlines, meshes onto points; soft toys come last, out of what the
rigid objects leave.

Reads posed frames only, in the robot's ``base_link`` frame whose z = 0 is the table top. Nothing
here learns from a simulator: the shapes come from the task file, the pixels from the cameras.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.episode.streams import RgbdFrame
from bridge.geometry import se3
from bridge.task.record import check_record
from bridge.task.task_file import ObjectModel, Task
from twin.scene.localise_colour import ColourConfig
from twin.scene.localise_fit import FitConfig, ShapeFit, fit_shape
from twin.scene.localise_mesh import MeshFit, MeshFitConfig, fit_mesh, known_surface
from twin.scene.localise_points import Cluster, PointConfig, View, fuse_stills, object_points
from twin.scene.localise_shape import rest_height_m, yaw_period_rad
from twin.scene.localise_soft import SoftConfig, SoftFit, fit_toys
from twin.scene.localise_table import TableConfig, TableFit, correct_for_table

SCHEMA_VERSION = 1
METHOD = "colour_shape_fit"
MESH_METHOD = "colour_mesh_icp"
UPRIGHT = 0.98
"""Cosine of the tilt up to which an object stands."""


@dataclass(frozen=True, kw_only=True)
class LocaliseConfig:
    """How objects are found; the defaults suit a table seen from about a metre."""

    colour: ColourConfig = field(default_factory=ColourConfig)
    """Which pixels have an object's colour."""
    points: PointConfig = field(default_factory=PointConfig)
    """Which points belong to an object."""
    table: TableConfig = field(default_factory=TableConfig)
    """How far the seen table may correct the cameras."""
    fit: FitConfig = field(default_factory=FitConfig)
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


@dataclass(frozen=True, kw_only=True)
class LocalisedObject:
    """One object's pose, or the reason why there is none."""

    object_id: str
    found: bool
    T_base_object: Float[np.ndarray, "4 4"] | None
    covariance: Float[np.ndarray, "6 6"] | None
    """Of (x, y, z, rotation about x, y, z), base frame [m^2, m rad, rad^2]."""
    confidence: float
    """0 to 1: the share of points and outline that the fitted shape explains."""
    method: str
    reason: str | None
    stamp_ns: int
    symmetry: str = "none"
    detail: Mapping[str, Any] = field(default_factory=dict)
    """Numbers behind the pose: points, residuals, what the table said of the cameras."""

    def to_record(self) -> dict[str, Any]:
        """Return the gst localisation v1 record, checked against its schema."""
        pose = None
        if self.T_base_object is not None:
            q, p = se3.split(self.T_base_object)
            pose = {"p_m": p.tolist(), "q_wxyz": q.tolist()}
        record = {
            "schema_version": SCHEMA_VERSION,
            "stamp_ns": self.stamp_ns,
            "object": self.object_id,
            "found": self.found,
            "T_base_object": pose,
            "covariance": None if self.covariance is None else self.covariance.ravel().tolist(),
            "symmetry": self.symmetry,
            "confidence": self.confidence,
            "method": self.method,
            "reason": self.reason,
            **self.detail,
        }
        check_record(record, name="localisation")
        return record


@dataclass(frozen=True, kw_only=True)
class Localisation:
    """All objects of a task, and what the table told about each camera."""

    objects: dict[str, LocalisedObject]
    tables: dict[str, TableFit]


def localise_objects(
    frames: Sequence[RgbdFrame],
    task: Task,
    config: LocaliseConfig | None = None,
    last_seen_m: Mapping[str, Float[np.ndarray, "3"]] | None = None,
) -> dict[str, LocalisedObject]:
    """Find every object of a task in frames taken while nothing moved.

    Args:
        frames: Posed frames of any cameras; several of one still camera are averaged.
        task: Whose ``objects`` are looked for by colour and laid out by known shape.
        config: Settings; the defaults when None.
        last_seen_m: Where objects were seen before; tells equal ones apart. Default: where the
            task starts them.

    Returns:
        One entry per object of the task; ``found`` is False, with a reason, where it was not
        seen. Never a guess.
    """
    return localise(frames, task, config, last_seen_m).objects


def localise(
    frames: Sequence[RgbdFrame],
    task: Task,
    config: LocaliseConfig | None = None,
    last_seen_m: Mapping[str, Float[np.ndarray, "3"]] | None = None,
) -> Localisation:
    """Like ``localise_objects``, and keep what the table said of the cameras."""
    config = LocaliseConfig() if config is None else config
    views = fuse_stills(frames, config.max_frames, config.max_views, task, config.points)
    views, tables = correct_for_table(views, task, config.table, config.points, config.colour)
    objects = {
        object_id: _localise_one(views, model, config, tables)
        for object_id, model in task.objects.items()
        if model.soft is None or not views
    }
    if views:
        expected_m = _start_middles(task) | dict(last_seen_m or {})
        objects |= _localise_toys(views, task, config, tables, objects, expected_m)
    return Localisation(objects={key: objects[key] for key in task.objects}, tables=tables)


def _start_middles(task: Task) -> dict[str, Float[np.ndarray, "3"]]:
    return {
        key: np.array([np.mean(s.x_m), np.mean(s.y_m), rest_height_m(task.objects[key])])
        for key, s in task.start.items()
    }


def _localise_toys(
    views: Sequence[View],
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
    views: Sequence[View],
    config: LocaliseConfig,
    tables: Mapping[str, TableFit],
    equals: int,
) -> LocalisedObject:
    stamp_ns = max(view.stamp_ns for view in views)
    detail = _detail(views, toy.num_points, tables)
    if equals > 1:
        detail |= {"equal_objects": equals, "assignment_margin_m": toy.margin_m}
    if toy.fit is None or toy.shape is None:
        return _missing(model, stamp_ns, str(toy.reason), detail)
    found = _found_mesh(model, toy.fit, stamp_ns, config, detail)
    shape = toy.shape
    if found.T_base_object is not None:
        shape = replace(shape, centroid_m=found.T_base_object[:3, 3].copy())
    reasons = [text for text in (found.reason, toy.reason) if text]
    return replace(
        found,
        reason="; ".join(reasons) or None,
        detail={**found.detail, "soft_shape": shape.to_record()},
    )


def _detail(
    views: Sequence[View], num_points: int, tables: Mapping[str, TableFit]
) -> dict[str, Any]:
    return {
        "cameras": sorted({view.camera_id for view in views}),
        "num_frames": sum(view.num_frames for view in views),
        "num_points": num_points,
        "table": {camera_id: fit.to_record() for camera_id, fit in tables.items()},
    }


def _localise_one(
    views: Sequence[View],
    model: ObjectModel,
    config: LocaliseConfig,
    tables: Mapping[str, TableFit],
) -> LocalisedObject:
    stamp_ns = max((view.stamp_ns for view in views), default=0)
    if not views:
        return _missing(model, stamp_ns, "no frames with colour, depth and a pose were given", {})
    groups = object_points(views, model, config.points, config.colour)
    seen = len(groups[0]) if groups else 0
    detail = _detail(views, seen, tables)
    if seen < config.points.min_points:
        reason = (
            f"{seen} points have the colour of {model.id} above the table, "
            f"{config.points.min_points} are needed (cameras {', '.join(detail['cameras'])})"
        )
        return _missing(model, stamp_ns, reason, detail)
    if model.mesh is not None:
        return _localise_mesh(groups[0], views, model, stamp_ns, config, detail)
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
        return _missing(model, stamp_ns, reason, detail)
    return _found(model, fit, stamp_ns, config, detail)


def _localise_mesh(
    group: Cluster,
    views: Sequence[View],
    model: ObjectModel,
    stamp_ns: int,
    config: LocaliseConfig,
    detail: dict[str, Any],
) -> LocalisedObject:
    """Lay the mesh of a rigid object that stands onto its points."""
    fit = fit_mesh(
        group,
        views,
        known_surface(model, config.mesh.num_samples),
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
        return _missing(model, stamp_ns, reason, detail)
    return _found_mesh(model, fit, stamp_ns, config, detail)


def _found_mesh(
    model: ObjectModel,
    fit: MeshFit,
    stamp_ns: int,
    config: LocaliseConfig,
    detail: dict[str, Any],
) -> LocalisedObject:
    T = fit.T_base_object.copy()
    lift_m = float(T[2, 3]) - rest_height_m(model)
    detail |= {
        "residual_m": fit.residual_m,
        "seen_through_fraction": fit.seen_through,
        "lift_m": lift_m,
    }
    reason = None
    stands = bool(T[2, 2] > UPRIGHT) and abs(lift_m) <= config.rest_tolerance_m
    if stands:
        T[2, 3] = rest_height_m(model)
    else:
        tilt = np.degrees(np.arccos(np.clip(T[2, 2], -1, 1)))
        reason = (
            f"{model.id} is {lift_m * 1e3:+.0f} mm from standing on the table, "
            f"tilted by {tilt:.0f} degrees"
        )
    if model.soft is None and stands:
        T = reduce_by_symmetry(T, model)
    return LocalisedObject(
        object_id=model.id,
        found=True,
        T_base_object=T,
        covariance=fit.covariance,
        confidence=fit.explained * (1 - fit.seen_through),
        method=MESH_METHOD,
        reason=reason,
        stamp_ns=stamp_ns,
        symmetry=model.symmetry,
        detail=detail,
    )


def _by_view(views: Sequence[View], values: Sequence[float]) -> dict[str, list[float]]:
    table: dict[str, list[float]] = {}
    for view, value in zip(views, values, strict=True):
        table.setdefault(view.camera_id, []).append(value)
    return table


def _missing(
    model: ObjectModel, stamp_ns: int, reason: str, detail: Mapping[str, Any]
) -> LocalisedObject:
    return LocalisedObject(
        object_id=model.id,
        found=False,
        T_base_object=None,
        covariance=None,
        confidence=0.0,
        method=METHOD if model.mesh is None else MESH_METHOD,
        reason=reason,
        stamp_ns=stamp_ns,
        symmetry=model.symmetry,
        detail=detail,
    )


def _found(
    model: ObjectModel,
    fit: ShapeFit,
    stamp_ns: int,
    config: LocaliseConfig,
    detail: dict[str, Any],
) -> LocalisedObject:
    T = reduce_by_symmetry(fit.T_base_object, model)
    lift_m = float(T[2, 3]) - rest_height_m(model)
    detail["lift_m"] = lift_m
    reason = None
    if abs(lift_m) <= config.rest_tolerance_m:
        T[2, 3] = rest_height_m(model)
    else:
        reason = f"{model.id} is {lift_m * 1e3:+.0f} mm from standing on the table"
    return LocalisedObject(
        object_id=model.id,
        found=True,
        T_base_object=T,
        covariance=fit.covariance,
        confidence=fit.explained,
        method=METHOD,
        reason=reason,
        stamp_ns=stamp_ns,
        symmetry=model.symmetry,
        detail=detail,
    )


def reduce_by_symmetry(
    T_base_object: Float[np.ndarray, "4 4"], model: ObjectModel
) -> Float[np.ndarray, "4 4"]:
    """Choose the yaw nearest zero among those that look the same."""
    period = yaw_period_rad(model)
    yaw = np.arctan2(T_base_object[1, 0], T_base_object[0, 0])
    reduced = np.mod(yaw + period / 2, period) - period / 2
    T = T_base_object.copy()
    c, s = np.cos(reduced), np.sin(reduced)
    T[:2, :2] = [[c, -s], [s, c]]
    return T
