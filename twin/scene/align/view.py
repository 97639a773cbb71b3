"""Depth images that show the robot in known postures, and the level surfaces it may stand on."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int64

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


NUM_POINTS, NUM_TRIALS = 6000, 400
NEAR_M = 0.012
"""A point this near to a plane lies on it."""
MIN_SHARE = 0.05
"""Of all points; smaller planes are parts of things."""
MAX_PLANES = 3
UPRIGHT = 0.2
LOOKING_DOWN = 0.9
"""Cosines: a level surface faces a camera's upper edge, or a camera that looks straight down."""


def find_levels(views: Sequence[RobotView]) -> list[Float[np.ndarray, "4 4"]]:
    """Find the largest planes that can be level, largest first (Fischler and Bolles, 1981).

    Each as ``T_level_source``: z = 0 in the plane, z up, the origin amid what is seen of it.

    Gravity is not known: a wall that faces the camera is told from a table by the camera's upper
    edge, which points up, and what is left over is told by where the robot fits.
    """
    import open3d  # noqa: PLC0415  # heavy, and only a camera that nobody placed needs it

    step = max(1, sum(len(view.cloud.p_m) for view in views) // NUM_POINTS)
    clouds = [view.cloud.take(np.arange(0, len(view.cloud.p_m), step)) for view in views]
    p = np.concatenate(
        [se3.apply(v.T_source_camera, c.p_m) for v, c in zip(views, clouds, strict=True)]
    )
    up = -np.mean([view.T_source_camera[:3, 1] for view in views], axis=0)
    back = -np.mean([view.T_source_camera[:3, 2] for view in views], axis=0)
    eye = np.mean([view.T_source_camera[:3, 3] for view in views], axis=0)
    levels: list[np.ndarray] = []
    open3d.utility.random.seed(0)
    left = p
    for _ in range(2 * MAX_PLANES):
        if len(left) < 50 or len(levels) == MAX_PLANES:
            break
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(left))
        plane, on = cloud.segment_plane(NEAR_M, 3, NUM_TRIALS)
        if len(on) < MIN_SHARE * len(p):
            break
        plane = plane if plane[:3] @ eye + plane[3] > 0 else -plane
        if plane[:3] @ up > UPRIGHT or plane[:3] @ back > LOOKING_DOWN:
            normal, centre = plane[:3], np.median(left[on], axis=0)
            x = np.cross(np.eye(3)[int(np.argmin(np.abs(normal)))], normal)
            x /= np.linalg.norm(x)
            R = np.stack([x, np.cross(normal, x), normal])
            levels.append(se3.from_rotation(R, [*-(R @ centre)[:2], float(plane[3])]))
        left = np.delete(left, on, axis=0)
    return levels
