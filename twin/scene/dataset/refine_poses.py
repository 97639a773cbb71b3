"""Lay each training view's depth onto the model of all of them: better poses before the fit.

Projective point-to-plane (Chen and Medioni 1992; Newcombe et al. 2011), one view at a time, with
a prior at the recorded pose. The gauge is fixed: the views together neither shift nor turn, so
that the scene stays where the robot is.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.terminal import Output
from twin.scene.fit.initialise import fuse
from twin.scene.frames.rgbd import PointSet, TrainingView
from twin.scene.frames.selection import FrameChoice
from twin.scene.gaussians import GaussianCloud, as_float32
from twin.scene.least_squares import normal_equations, tukey_weights
from twin.scene.settings import InitialiseConfig

ROUNDS = 3
"""The model is fused anew from the improved views this often."""
STEPS = 4
"""Gauss-Newton steps per view and round."""
MODEL_SPLATS = 60_000
REACH_M = (0.04, 0.025, 0.015)
"""Points farther from the model than this have another surface, round by round."""
TUKEY_M = (0.03, 0.015, 0.01)
MIN_COSINE = 0.7
PRIOR_M = 0.02
PRIOR_RAD = 0.02
"""How far recorded poses may be off."""
DEPTH_SIGMA_M = 0.004
"""Noise of one depth measurement, and ..."""
INDEPENDENT = 0.02
"""... the share of measurements that say something new: neighbours err together."""
COLUMNS = 80
"""Model points are looked up in a grid of about this many cells across the image."""
MIN_POINTS = 200


@dataclass(frozen=True, kw_only=True)
class ModelSurface:
    """Points with normals, in the root frame."""

    p_m: Float[np.ndarray, "num_points 3"]
    normals: Float[np.ndarray, "num_points 3"]


@dataclass(frozen=True, kw_only=True)
class Refined:
    """Training frames under better poses."""

    points: list[PointSet]
    views: list[TrainingView]
    corrections: list[Float[np.ndarray, "4 4"]]
    """``T_new_old`` of each view in the root frame."""


def refine_poses(
    points: Sequence[PointSet], views: Sequence[TrainingView], output: Output
) -> Refined:
    """Improve the poses of training views by their depth; held-out frames keep theirs.

    Args:
        points: Surface points of each view.
        views: Training views, in the order of ``points``.
        output: Told how far the cameras moved.
    """
    corrections = [np.eye(4) for _ in views]
    with output.progress("align poses", ROUNDS * len(views)) as advance:
        for number in range(ROUNDS):
            moved = [_moved_points(p, T) for p, T in zip(points, corrections, strict=True)]
            model = model_surface(
                fuse(moved, InitialiseConfig(max_splats=MODEL_SPLATS, growth=0.25))
            )
            for index, view in enumerate(views):
                corrections[index] = refine_view_pose(
                    points[index], view, model, corrections[index], number
                )
                advance(number * len(views) + index + 1, "")
            corrections = without_drift(corrections, views)
    shifts = [
        float(np.linalg.norm(_camera_shift(T, v))) for T, v in zip(corrections, views, strict=True)
    ]
    turns = [float(se3.rotation_angle_rad(T[:3, :3])) for T in corrections]
    output.say(
        f"poses aligned by depth: cameras moved by {1e3 * np.mean(shifts):.1f} mm and "
        f"{np.degrees(np.mean(turns)):.2f} degrees on average"
    )
    return Refined(
        points=[_moved_points(p, T) for p, T in zip(points, corrections, strict=True)],
        views=[
            replace(view, T_base_color=T @ view.T_base_color)
            for view, T in zip(views, corrections, strict=True)
        ],
        corrections=corrections,
    )


def with_corrections(
    choices: Sequence[FrameChoice],
    choice_of_view: Sequence[int],
    views: Sequence[TrainingView],
    corrections: Sequence[np.ndarray],
) -> list[FrameChoice]:
    """Write the corrections of views into the choices they come from, for later readers.

    Args:
        choices: Whose frames were read.
        choice_of_view: Position in ``choices`` of each view.
        views: The frames that were corrected.
        corrections: ``T_new_old`` of each view, in the root frame.
    """
    found: list[dict[int, np.ndarray]] = [{} for _ in choices]
    for owner, view, T in zip(choice_of_view, views, corrections, strict=True):
        found[owner][view.stamp_ns] = T
    return [replace(c, corrections=mine) for c, mine in zip(choices, found, strict=True)]


def model_surface(cloud: GaussianCloud) -> ModelSurface:
    """Centres and normals of flat Gaussians; the normal is their shortest axis."""
    R = se3.rotation_from_quaternion(cloud.quats_wxyz.astype(np.float64))
    return ModelSurface(p_m=cloud.means_m.astype(np.float64), normals=R[:, :, 2])


def refine_view_pose(
    points: PointSet,
    view: TrainingView,
    model: ModelSurface,
    T_new_old: Float[np.ndarray, "4 4"],
    number: int,
) -> Float[np.ndarray, "4 4"]:
    """Move one view so that its points lie on the model.

    Args:
        points: Of the view, under its recorded pose.
        view: Its camera, likewise.
        model: What it is laid onto.
        T_new_old: The correction so far.
        number: Of the round, from 0; later rounds look closer.

    Returns:
        The correction, to be multiplied from the left onto poses in the root frame.
    """
    T = T_new_old
    p_old, n_old = points.p_m.astype(np.float64), points.normals.astype(np.float64)
    for _ in range(STEPS):
        p, n = se3.apply(T, p_old), n_old @ T[:3, :3].T
        lookup = _Lookup(model, view.half.camera, T @ view.T_base_color)
        index, found = lookup.nearest(p)
        q, m = model.p_m[index], model.normals[index]
        distance = np.linalg.norm(p - q, axis=1)
        found &= (distance < REACH_M[number]) & (np.abs((n * m).sum(axis=1)) > MIN_COSINE)
        if found.sum() < MIN_POINTS:
            return T
        step = _solve(p[found], q[found], m[found], T, view, TUKEY_M[number])
        T = step @ T
        if np.linalg.norm(step[:3, 3]) < 1e-5:
            break
    return T


def without_drift(
    corrections: Sequence[Float[np.ndarray, "4 4"]], views: Sequence[TrainingView]
) -> list[Float[np.ndarray, "4 4"]]:
    """Take out the motion that all cameras share: the best rigid fit of new onto old poses.

    Args:
        corrections: ``T_new_old`` of each view, in the root frame.
        views: With their old poses.
    """
    old = np.stack([_frame_points(view.T_base_color) for view in views]).reshape(-1, 3)
    new = np.stack(
        [_frame_points(T @ v.T_base_color) for T, v in zip(corrections, views, strict=True)]
    ).reshape(-1, 3)
    T_old_new = se3.align_rigid(new, old)
    return [T_old_new @ T for T in corrections]


class _Lookup:
    """Finds the model point that a view sees where it sees a point of its own."""

    def __init__(self, model: ModelSurface, camera: Camera, T_base_camera: np.ndarray) -> None:
        self._camera = camera
        self._T_camera_base = se3.invert(T_base_camera)
        self._cell_px = max(1, round(camera.width / COLUMNS))
        self._columns = camera.width // self._cell_px + 1
        cell, z, inside = self._cells(model.p_m)
        ids = np.flatnonzero(inside)
        order = ids[np.lexsort((-z[ids],))]  # the nearest is written last and stays
        self._nearest = np.full(self._columns * (camera.height // self._cell_px + 1), -1)
        self._nearest[cell[order]] = order

    def nearest(self, p_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        cell, _, inside = self._cells(p_m)
        index = np.where(inside, self._nearest[np.where(inside, cell, 0)], -1)
        return np.maximum(index, 0), index >= 0

    def _cells(self, p_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        camera = self._camera
        p = se3.apply(self._T_camera_base, p_m)
        z = np.maximum(p[:, 2], 1e-3)
        u = camera.fx * p[:, 0] / z + camera.cx
        v = camera.fy * p[:, 1] / z + camera.cy
        inside = (p[:, 2] > 0.05) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        row = np.where(inside, v, 0.0).astype(np.int64) // self._cell_px
        column = np.where(inside, u, 0.0).astype(np.int64) // self._cell_px
        return row * self._columns + column, p[:, 2], inside


def _solve(
    p: np.ndarray,
    q: np.ndarray,
    normals: np.ndarray,
    T_new_old: np.ndarray,
    view: TrainingView,
    tukey_m: float,
) -> np.ndarray:
    """One Gauss-Newton step, turning about the camera; returns the motion in the root frame."""
    centre = (T_new_old @ view.T_base_color)[:3, 3]
    residual = ((p - q) * normals).sum(axis=1)
    weight = tukey_weights(residual, tukey_m) * (INDEPENDENT / DEPTH_SIGMA_M**2)
    J = np.concatenate([np.cross(p - centre, normals), normals], axis=1)
    prior = np.repeat([1 / PRIOR_RAD**2, 1 / PRIOR_M**2], 3)
    so_far = np.concatenate(
        [se3.vector_from_rotation(T_new_old[:3, :3]), _camera_shift(T_new_old, view)]
    )
    H, gradient = normal_equations(J, residual, weight)
    x = -np.linalg.solve(H + np.diag(prior), gradient + prior * so_far)
    step = np.eye(4)
    step[:3, :3] = se3.rotation_from_vector(x[:3])
    step[:3, 3] = centre + x[3:] - step[:3, :3] @ centre
    return step


def _camera_shift(T_new_old: np.ndarray, view: TrainingView) -> np.ndarray:
    """How far the camera's centre moved [m]."""
    centre = view.T_base_color[:3, 3]
    return np.asarray(se3.apply(T_new_old, centre) - centre)


def _frame_points(T_base_camera: np.ndarray) -> Float[np.ndarray, "4 3"]:
    """The camera's centre and the tips of its axes, half a metre long."""
    return np.asarray(
        T_base_camera[:3, 3] + 0.5 * np.vstack([np.zeros(3), T_base_camera[:3, :3].T])
    )


def _moved_points(points: PointSet, T: np.ndarray) -> PointSet:
    return replace(
        points,
        p_m=as_float32(se3.apply(T, points.p_m.astype(np.float64))),
        normals=as_float32(points.normals.astype(np.float64) @ T[:3, :3].T),
    )
