"""Where the objects of a task are, from RGB-D frames: colour proposes, known shapes fit.

Boxes are laid onto points and outlines, meshes onto points; soft toys come last, out of what the
rigid objects leave. Reads posed frames only, in the robot's ``base_link`` frame whose z = 0 is the
table top: the shapes come from the task file, the pixels from the cameras.

The table corrects each camera that sees it too high or tilted, because its pose or depth scale is
wrong. The table alone cannot tell a camera that sits too high from depth that reads too short, so a
prior on each shares the blame (maximum a posteriori, linearised about the recorded pose).
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.episode.streams import RgbdFrame
from bridge.geometry import se3
from bridge.task.task_file import SCANNED, ObjectModel, Task
from twin.scene.least_squares import normal_equations, tukey_weights
from twin.scene.localise.mesh_fit import (
    MIN_EXPLAINED,
    UPRIGHT_SIGMA_RAD,
    MeshSurface,
    fit_box,
    fit_mesh,
    known_surface,
)
from twin.scene.localise.points import (
    MIN_HEIGHT_M,
    MIN_LIKENESS,
    MIN_POINTS,
    CameraView,
    fuse_stationary,
    likeness,
    moved,
    object_points,
)
from twin.scene.localise.result import LocalisedObject, found_by_box, found_by_fit, missing
from twin.scene.localise.soft import LEAST_HEIGHT_M, SoftFit, fit_toys
from twin.scene.shape.known import yaw_period_rad

BAND_M = 0.025
"""Points this far above or below z = 0 may be table."""
MIN_TABLE_POINTS = 300
"""With fewer the camera is left as it is."""
MAX_TABLE_POINTS = 6000
"""Enough to average the noise; more are thinned out evenly."""
DEPTH_SCALE_SIGMA = 0.005
"""Prior of the relative depth error."""
HEIGHT_SIGMA_M = 0.002
"""Prior of the camera height error."""
TILT_SIGMA_RAD = 0.006
"""Prior of the camera tilt error about each horizontal axis."""
NOISE_SIGMA_M = 0.002
"""Of one table point."""


def correct_for_table(views: Sequence[CameraView], task: Task) -> list[CameraView]:
    """Move each view so that its table lies at z = 0; views that see too little stay.

    Points of the task's objects do not count as table.
    """
    corrected = []
    for view in views:
        wanted = np.abs(view.p_base[:, 2]) < BAND_M
        step = max(1, int(wanted.sum()) // MAX_TABLE_POINTS)
        ids = everything = np.flatnonzero(wanted)[::step]
        for model in task.objects.values():
            like = likeness(view.color_linear[ids], model.color_srgb)
            ids = ids[like < MIN_LIKENESS / 2]
        # A table of the objects' own colour: most points of the band are table all the same.
        p = view.p_base[ids if len(ids) >= MIN_TABLE_POINTS else everything]
        is_seen = len(p) >= MIN_TABLE_POINTS
        fit = fit_table(p, view.T_base_depth[:3, 3]) if is_seen else (np.eye(4), 1.0)
        corrected.append(moved(view, *fit))
    return corrected


def fit_table(
    p_base: Float[np.ndarray, "num_points 3"], p_base_camera: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "4 4"], float]:
    """Find the correction that best lays table points on z = 0.

    Unknowns: relative depth error, camera height error, rotation about base x and y; least squares
    with Tukey weights and Gaussian priors. The rotation is about the camera.

    Returns:
        The camera's motion in the base frame, ``T_new_old``, and by what depth is multiplied.
    """
    d = p_base - p_base_camera
    # z after the correction: p_z - s d_z + h + (rotation x d)_z. On the table d_z is minus the
    # camera height; the measured d_z would let s shrink the noise.
    height = np.full(len(d), p_base_camera[2])
    A = np.stack([height, np.ones(len(d)), d[:, 1], -d[:, 0]], axis=1)
    sigma = np.array([DEPTH_SCALE_SIGMA, HEIGHT_SIGMA_M, *[TILT_SIGMA_RAD] * 2])
    # Neighbouring pixels share their error: count the points as at most a few hundred.
    weight = np.ones(len(d)) * min(1.0, 500 / len(d)) / NOISE_SIGMA_M**2
    x = np.zeros(4)
    for _ in range(8):
        residual = p_base[:, 2] + A @ x
        centred = residual - np.median(residual)
        spread = 1.4826 * float(np.median(np.abs(centred)))
        robust = tukey_weights(centred, max(6.0 * spread, 1e-3)) * weight
        H, gradient = normal_equations(A, p_base[:, 2], robust)
        x = -np.linalg.solve(H + np.diag(1 / sigma**2), gradient)
    R = se3.rotation_from_vector(np.array([x[2], x[3], 0.0]))
    lifted = p_base_camera + np.array([0.0, 0.0, x[1]])
    return se3.from_rotation(R, lifted - R @ p_base_camera), float(1 - x[0])


MAX_FRAMES = 3
"""Frames of one camera pose that are averaged."""
MAX_VIEWS = 8
"""Poses of one camera that are used, for example of a wrist camera during a scan."""


def localise_objects(
    frames: Sequence[RgbdFrame],
    task: Task,
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
    views = fuse_stationary(frames, MAX_FRAMES, MAX_VIEWS, task)
    views = correct_for_table(views, task)
    objects = {
        object_id: _localise_one(views, model, (surfaces or {}).get(object_id))
        for object_id, model in task.objects.items()
        if model.soft is None or not views
    }
    if views:
        starts_m = {
            key: np.array([np.mean(s.x_m), np.mean(s.y_m), task.objects[key].rest_height_m])
            for key, s in task.start.items()
        }
        expected_m = starts_m | dict(last_seen_m or {})
        objects |= _localise_toys(views, task, objects, expected_m)
    return {key: objects[key] for key in task.objects}


def _localise_toys(
    views: Sequence[CameraView],
    task: Task,
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
        fits = fit_toys(models, views, blocked, expected_m)
        for model in models:
            found[model.id] = _toy(model, fits[model.id], views)
    return found


def _toy(model: ObjectModel, toy: SoftFit, views: Sequence[CameraView]) -> LocalisedObject:
    stamp_ns = max(view.stamp_ns for view in views)
    detail = _detail(views, toy.num_points)
    if toy.fit is None or toy.shape is None:
        return missing(model, stamp_ns, str(toy.reason), detail)
    found = found_by_fit(model, toy.fit, stamp_ns, detail)
    reasons = [text for text in (found.reason, toy.reason) if text]
    return replace(
        found,
        reason="; ".join(reasons) or None,
        detail={**found.detail, "soft_shape": toy.shape},
    )


def _detail(views: Sequence[CameraView], num_points: int) -> dict[str, Any]:
    return {
        "cameras": sorted({view.camera_id for view in views}),
        "num_frames": sum(view.num_frames for view in views),
        "num_points": num_points,
    }


def _localise_one(
    views: Sequence[CameraView], model: ObjectModel, scanned: MeshSurface | None
) -> LocalisedObject:
    stamp_ns = max((view.stamp_ns for view in views), default=0)
    if not views:
        return missing(model, stamp_ns, "no frames with colour, depth and a pose were given", {})
    is_box = model.mesh is None and scanned is None
    low_m = MIN_HEIGHT_M if is_box else LEAST_HEIGHT_M
    groups = object_points(views, model, low_m)
    seen = len(groups[0]) if groups else 0
    detail = _detail(views, seen)
    if seen < MIN_POINTS:
        reason = (
            f"{seen} points have the colour of {model.id} above the table, "
            f"{MIN_POINTS} are needed (cameras {', '.join(detail['cameras'])})"
        )
        return missing(model, stamp_ns, reason, detail)
    if model.mesh is not None:
        scanned = known_surface(model)
    if scanned is None and model.shape == SCANNED:  # no scan has shown it yet
        boxed = found_by_box(model, groups[0].p_base, stamp_ns, detail)
        reason = _misfit(model, boxed.confidence, seen, "into the box")
        return missing(model, stamp_ns, reason, detail) if reason else boxed
    if scanned is None:
        fit, onto = fit_box(groups[0], views, model), "the shape"
    else:
        onto = "the mesh"
        fit = fit_mesh(
            groups[0],
            views,
            scanned,
            tilt_sigma_rad=UPRIGHT_SIGMA_RAD,
            yaw_period_rad=yaw_period_rad(model),
        )
    reason = _misfit(model, fit.explained, seen, onto)
    if reason:
        return missing(model, stamp_ns, reason, detail)
    return found_by_fit(model, fit, stamp_ns, detail)


def _misfit(model: ObjectModel, explained: float, num_points: int, onto: str) -> str:
    """Why points are not the object's; empty when they are."""
    if explained >= MIN_EXPLAINED:
        return ""
    return (
        f"only {explained:.0%} of {num_points} points fit {onto} of {model.id}, "
        f"{MIN_EXPLAINED:.0%} are needed"
    )
