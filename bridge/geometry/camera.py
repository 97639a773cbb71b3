"""Pinhole cameras: OpenCV axes (+Z forward, +Y down), pixel centres at +0.5.

A pixel in column i and row j covers [i, i+1) x [j, j+1); its centre is (i + 0.5, j + 0.5).
ROS and OpenCV put the centre at (i, j): ``from_ros`` and ``to_ros`` shift the principal point.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, kw_only=True)
class Camera:
    """An undistorted pinhole camera; all lengths in pixels."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    @staticmethod
    def from_ros(
        *, width: int, height: int, fx: float, fy: float, cx: float, cy: float
    ) -> "Camera":
        """Read intrinsics whose pixel centres are at whole numbers (ROS, OpenCV)."""
        return Camera(width=width, height=height, fx=fx, fy=fy, cx=cx + 0.5, cy=cy + 0.5)

    def to_ros(self) -> tuple[float, float, float, float]:
        """Return (fx, fy, cx, cy) with pixel centres at whole numbers."""
        return self.fx, self.fy, self.cx - 0.5, self.cy - 0.5

    def scaled(self, factor: float) -> "Camera":
        """The camera of an image resized by ``factor``; exact because centres are at +0.5."""
        width, height = round(self.width * factor), round(self.height * factor)
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=self.cx * sx,
            cy=self.cy * sy,
        )

    def project(
        self, p_camera: Float[np.ndarray, "*batch 3"]
    ) -> tuple[Float[np.ndarray, "*batch 2"], Float[np.ndarray, "*batch"]]:
        """Project points to pixel coordinates and depth along the optical axis [m]."""
        z = p_camera[..., 2]
        u = self.fx * p_camera[..., 0] / z + self.cx
        v = self.fy * p_camera[..., 1] / z + self.cy
        return np.stack([u, v], axis=-1), z

    def unproject(
        self, depth_m: Float[np.ndarray, "height width"]
    ) -> Float[np.ndarray, "height width 3"]:
        """Turn a depth image into points in the camera frame [m]; invalid depth stays 0 or NaN."""
        height, width = depth_m.shape
        u = (np.arange(width) + 0.5 - self.cx) / self.fx
        v = (np.arange(height) + 0.5 - self.cy) / self.fy
        return np.stack([u[None, :] * depth_m, v[:, None] * depth_m, depth_m], axis=-1)

    def rays(self) -> Float[np.ndarray, "height width 3"]:
        """Directions through all pixel centres with z = 1 (not normalised)."""
        return self.unproject(np.ones((self.height, self.width)))
