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
from bridge.task.task_file import SCANNED, ObjectModel, Task
from twin.scene.localise.colour import ColourConfig
from twin.scene.localise.fit import FitConfig, fit_shape
from twin.scene.localise.mesh import MeshFitConfig, fit_mesh
from twin.scene.localise.points import Cluster, PointConfig, View, fuse_stills, object_points
from twin.scene.localise.result import (
    LocalisedObject,
    found_by_box,
    found_by_mesh,
    found_by_shape,
    missing,
)
from twin.scene.localise.soft import SoftFit, fit_toys
from twin.scene.localise.soft_config import SoftConfig
from twin.scene.localise.surface import Surface, known_surface
from twin.scene.localise.table import TableConfig, TableFit, correct_for_table
from twin.scene.shape.known import rest_height_m, yaw_period_rad


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
class Localisation:
    """All objects of a task, and what the table told about each camera."""

    objects: dict[str, LocalisedObject]
    tables: dict[str, TableFit]


def localise_objects(
    frames: Sequence[RgbdFrame],
    task: Task,
    config: LocaliseConfig | None = None,
    last_seen_m: Mapping[str, Float[np.ndarray, "3"]] | None = None,
    surfaces: Mapping[str, Surface] | None = None,
) -> dict[str, LocalisedObject]:
    """Find every object of a task in frames taken while nothing moved.

    Args:
        frames: Posed frames of any cameras; several of one still camera are averaged.
        task: Whose ``objects`` are looked for by colour and laid out by known shape.
        config: Settings; the defaults when None.
        last_seen_m: Where objects were seen before; tells equal ones apart. Default: where the
            task starts them.
        surfaces: Of scanned objects, from the scene, in their own frames. Without one the object
            is only boxed in: the rough pose that its shape is then reconstructed at.

    Returns:
        One entry per object of the task; ``found`` is False, with a reason, where it was not
        seen. Never a guess.
    """
    return localise(frames, task, config, last_seen_m, surfaces).objects


def localise(
    frames: Sequence[RgbdFrame],
    task: Task,
    config: LocaliseConfig | None = None,
    last_seen_m: Mapping[str, Float[np.ndarray, "3"]] | None = None,
    surfaces: Mapping[str, Surface] | None = None,
) -> Localisation:
    """Like ``localise_objects``, and keep what the table said of the cameras."""
    config = LocaliseConfig() if config is None else config
    views = fuse_stills(frames, config.max_frames, config.max_views, task, config.points)
    views, tables = correct_for_table(views, task, config.table, config.points, config.colour)
    objects = {
        object_id: _localise_one(views, model, config, tables, (surfaces or {}).get(object_id))
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
        return missing(model, stamp_ns, str(toy.reason), detail)
    found = found_by_mesh(model, toy.fit, stamp_ns, config.rest_tolerance_m, detail)
    reasons = [text for text in (found.reason, toy.reason) if text]
    return replace(
        found,
        reason="; ".join(reasons) or None,
        detail={**found.detail, "soft_shape": toy.shape.to_record()},
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
    scanned: Surface | None,
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
    views: Sequence[View],
    model: ObjectModel,
    surface: Surface,
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


def _by_view(views: Sequence[View], values: Sequence[float]) -> dict[str, list[float]]:
    table: dict[str, list[float]] = {}
    for view, value in zip(views, values, strict=True):
        table.setdefault(view.camera_id, []).append(value)
    return table
