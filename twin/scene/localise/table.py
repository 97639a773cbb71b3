"""The table as a witness: z = 0 is known, so where a camera sees it corrects that camera.

A camera that sees the table top too high or tilted has a wrong pose or a wrong depth scale. The
table alone cannot tell a camera that sits too high from depth that reads too short, so a prior on
each shares the blame (maximum a posteriori, linearised about the recorded pose).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from bridge.task.task_file import Task
from twin.scene.localise.colour import ColourConfig, likeness
from twin.scene.localise.points import PointConfig, View, moved


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
    views: Sequence[View],
    task: Task,
    config: TableConfig,
    points: PointConfig,
    colour: ColourConfig,
) -> tuple[list[View], dict[str, TableFit]]:
    """Move each view so that its table lies at z = 0; views that see too little stay."""
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
    view: View, task: Task, config: TableConfig, points: PointConfig, colour: ColourConfig
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
        ratio = centred / max(6.0 * spread, 1e-3)
        robust = np.where(np.abs(ratio) < 1, (1 - ratio**2) ** 2, 0.0) * weight
        H = (A * robust[:, None]).T @ A + np.diag(1 / sigma**2)
        x = np.linalg.solve(H, -(A * robust[:, None]).T @ p_base[:, 2])
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
