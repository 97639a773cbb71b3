"""Depth images that show the robot in known postures, and the level surfaces it may stand on."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int64

from bridge.geometry import se3
from bridge.geometry.camera import Camera
from twin.robot.posture import Posture
from twin.scene.frames.rgbd import DepthLimits, oriented, trusted_depth_mask


@dataclass(frozen=True, kw_only=True)
class RobotView:
    """One depth image, the camera's pose in the frame to be aligned, and the robot's posture."""

    camera: Camera
    depth_m: Float[np.ndarray, "height width"]
    """0 is "no measurement"."""
    T_source_camera: Float[np.ndarray, "4 4"]
    """Camera pose in the source frame: the scene's root, or the camera itself."""
    posture: Posture

    @cached_property
    def cloud(self) -> "ViewCloud":
        """Points and normals of the trusted pixels; computed once."""
        p = np.moveaxis(self.camera.unproject(self.depth_m.astype(np.float64)), -1, 0)
        trusted = trusted_depth_mask(self.depth_m, DepthLimits(max_depth_m=6.0))
        row, column, normals = oriented(p, trusted, trusted)
        return ViewCloud(p_m=p[:, row, column].T, normals=normals.T)


@dataclass(frozen=True, kw_only=True)
class ViewCloud:
    """Trusted measurements of one view, in its camera's frame."""

    p_m: Float[np.ndarray, "num_points 3"]
    normals: Float[np.ndarray, "num_points 3"]
    """Unit length, from central differences; they face the camera."""

    def take(self, index: Int64[np.ndarray, " num_kept"]) -> "ViewCloud":
        """Select points by number."""
        return ViewCloud(p_m=self.p_m[index], normals=self.normals[index])


NUM_POINTS = 6000
NUM_TRIALS = 400
NEAR_M = 0.008
NEAR_FRACTION = 0.006
"""A point within 8 mm + 0.6 % of its distance to the camera lies on the plane."""
MIN_SHARE = 0.05
"""Of all points; smaller planes are parts of things."""
MAX_PLANES = 3
UPRIGHT = 0.2
LOOKING_DOWN = 0.9
"""Cosines: a level surface faces a camera's upper edge, or a camera that looks straight down."""


@dataclass(frozen=True, kw_only=True)
class LevelPlane:
    """A plane seen from above, with a frame ``level`` in it: z up, z = 0 in the plane."""

    T_level_source: Float[np.ndarray, "4 4"]
    low_m: Float[np.ndarray, "2"]
    high_m: Float[np.ndarray, "2"]
    """Where its points lie, in x and y of ``level``."""


def find_planes(views: Sequence[RobotView]) -> list[LevelPlane]:
    """Find the largest planes that can be level, largest first (Fischler and Bolles, 1981).

    Gravity is not known: a wall that faces the camera is told from a table by the camera's upper
    edge, which points up, and what is left over is told by where the robot fits.
    """
    step = max(1, sum(len(view.cloud.p_m) for view in views) // NUM_POINTS)
    clouds = [view.cloud.take(np.arange(0, len(view.cloud.p_m), step)) for view in views]
    p = np.concatenate(
        [se3.apply(v.T_source_camera, c.p_m) for v, c in zip(views, clouds, strict=True)]
    )
    range_m = np.concatenate([np.linalg.norm(c.p_m, axis=1) for c in clouds])
    up = -np.mean([view.T_source_camera[:3, 1] for view in views], axis=0)
    back = -np.mean([view.T_source_camera[:3, 2] for view in views], axis=0)
    eye = np.mean([view.T_source_camera[:3, 3] for view in views], axis=0)
    rng = np.random.default_rng(0)
    planes: list[LevelPlane] = []
    left = np.ones(len(p), dtype=bool)
    for _ in range(2 * MAX_PLANES):
        if left.sum() < 50 or len(planes) == MAX_PLANES:
            break
        normal, offset, on = _largest(p, range_m, left, eye, rng)
        if on.mean() < MIN_SHARE:
            break
        left &= ~on
        if normal @ up > UPRIGHT or normal @ back > LOOKING_DOWN:
            planes.append(_level(p[on], normal, offset, eye))
    return planes


def _largest(
    p: np.ndarray, range_m: np.ndarray, left: np.ndarray, eye: np.ndarray, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "3"], float, Bool[np.ndarray, " num_points"]]:
    """Normal towards the eye, offset (normal @ p = offset), and the points on the plane."""
    ids = np.flatnonzero(left)
    near = NEAR_M + NEAR_FRACTION * range_m
    triples = p[ids[rng.integers(len(ids), size=(NUM_TRIALS, 3))]]
    normals = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    offsets = np.einsum("ij,ij->i", normals, triples[:, 0])
    some = ids[:: max(1, len(ids) // 2000)]
    counts = (np.abs(p[some] @ normals.T - offsets) < near[some, None]).sum(axis=0)
    normal, offset = normals[int(np.argmax(counts))], float(offsets[int(np.argmax(counts))])
    on = left & (np.abs(p @ normal - offset) < near)
    for _ in range(3):
        centre = p[on].mean(axis=0)
        _, _, Vt = np.linalg.svd(p[on] - centre, full_matrices=False)
        normal, offset = Vt[2], float(Vt[2] @ centre)
        on = left & (np.abs(p @ normal - offset) < near)
    if normal @ eye < offset:
        normal, offset = -normal, -offset
    return normal, offset, on


def _level(p: np.ndarray, normal: np.ndarray, offset: float, eye: np.ndarray) -> LevelPlane:
    aside = np.eye(3)[int(np.argmin(np.abs(normal)))]
    x = np.cross(aside, normal)
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(normal, x), normal])
    T = se3.from_rotation(R, -R @ (eye - normal * (normal @ eye - offset)))
    xy = se3.apply(T, p)[:, :2]
    low, high = np.quantile(xy, [0.02, 0.98], axis=0)
    return LevelPlane(T_level_source=T, low_m=low, high_m=high)
