"""Depth images that show the robot in known postures: what alignment starts from."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int64

from bridge.episode.streams import RgbdFrame
from bridge.geometry.camera import Camera
from twin.robot.posture import Posture
from twin.scene.frames.points import NORMAL_REACH_PX, DepthLimits, trusted_depth_mask


@dataclass(frozen=True, kw_only=True)
class RobotView:
    """One depth image, the camera's pose in the frame to be aligned, and the robot's posture."""

    camera: Camera
    depth_m: Float[np.ndarray, "height width"]
    """0 is "no measurement"."""
    T_source_camera: Float[np.ndarray, "4 4"]
    """Camera pose in the source frame: the scene's root, or the camera itself."""
    posture: Posture

    @staticmethod
    def from_frame(
        frame: RgbdFrame, posture: Posture, T_source_camera: Float[np.ndarray, "4 4"]
    ) -> "RobotView":
        """Take the depth image of a frame."""
        return RobotView(
            camera=frame.depth_camera,
            depth_m=np.where(np.isfinite(frame.depth_m), frame.depth_m, 0.0),
            T_source_camera=T_source_camera,
            posture=posture,
        )

    @cached_property
    def cloud(self) -> "ViewCloud":
        """Points and normals of the trusted pixels; computed once."""
        return _cloud(self)


@dataclass(frozen=True, kw_only=True)
class ViewCloud:
    """Trusted measurements of one view, in its camera's frame."""

    p_m: Float[np.ndarray, "num_points 3"]
    normals: Float[np.ndarray, "num_points 3"]
    """Unit length, from central differences; they face the camera."""

    def take(self, index: Int64[np.ndarray, " num_kept"]) -> "ViewCloud":
        """Select points by number."""
        return ViewCloud(p_m=self.p_m[index], normals=self.normals[index])


def _cloud(view: RobotView) -> ViewCloud:
    points = view.camera.unproject(view.depth_m.astype(np.float64))
    inner = _interior(
        trusted_depth_mask(view.depth_m, DepthLimits(max_depth_m=6.0, flying_fraction=0.03))
    )
    row, column = np.nonzero(inner)
    reach = NORMAL_REACH_PX
    across = points[row, column + reach] - points[row, column - reach]
    down = points[row + reach, column] - points[row - reach, column]
    normals = np.cross(down, across)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    p = points[row, column]
    away = np.einsum("ij,ij->i", normals, p) > 0
    normals[away] *= -1.0
    return ViewCloud(p_m=p, normals=normals)


def _interior(trusted: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    """Trusted pixels whose neighbours at the normal's reach are trusted too."""
    reach = NORMAL_REACH_PX
    inner = np.zeros_like(trusted)
    middle = (slice(reach, -reach), slice(reach, -reach))
    inner[middle] = trusted[middle]
    for rows, columns in (
        (slice(2 * reach, None), middle[1]),
        (slice(None, -2 * reach), middle[1]),
        (middle[0], slice(2 * reach, None)),
        (middle[0], slice(None, -2 * reach)),
    ):
        inner[middle] &= trusted[rows, columns]
    return inner


def thin(views: Sequence[RobotView], count: int) -> list[ViewCloud]:
    """Every n-th point of each view, about ``count`` of all views together."""
    total = sum(len(view.cloud.p_m) for view in views)
    step = max(1, total // max(count, 1))
    return [view.cloud.take(np.arange(0, len(view.cloud.p_m), step)) for view in views]
