"""Takes lens distortion out of colour images, as the episode's cameras have none.

D415 and D435 send undistorted colour (all coefficients 0). D405 and D455 do not.
"""

from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from bridge.sources.realsense.library import rs

ONE = 1 << 7
"""Weights are seven-bit fixed point: four products of 8 and 14 bits fit into 32."""


class Rectifier:
    """Resamples distorted images bilinearly; pixels that see outside the image become black."""

    def __init__(self, intrinsics: Any) -> None:
        """Ask the library once where each ideal pixel lies in the distorted image.

        Args:
            intrinsics: ``rs.intrinsics`` of the colour stream.
        """
        u, v = np.moveaxis(_distorted_pixels(intrinsics), -1, 0)
        width, height = intrinsics.width, intrinsics.height
        inside = (u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1)
        left = np.clip(np.floor(u), 0, width - 2).astype(np.intp)
        top = np.clip(np.floor(v), 0, height - 2).astype(np.intp)
        self._shape = (height, width, 3)
        self._corner = (top * width + left).ravel()
        self._steps = (0, 1, width, width + 1)
        across = np.rint((u - left) * ONE).astype(np.int32)
        down = np.rint((v - top) * ONE).astype(np.int32)
        weights = [
            (ONE - across) * (ONE - down),
            across * (ONE - down),
            (ONE - across) * down,
            across * down,
        ]
        self._weights = [np.where(inside, w, 0).astype(np.uint32).reshape(-1, 1) for w in weights]

    def apply(self, image_u8: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "h w 3"]:
        """Return the image an ideal camera of the same focal lengths would have taken."""
        pixels = image_u8.reshape(-1, 3)
        total = np.full(pixels.shape, ONE * ONE // 2, np.uint32)
        for step, weight in zip(self._steps, self._weights, strict=True):
            total += weight * pixels[self._corner + step]
        return (total // (ONE * ONE)).astype(np.uint8).reshape(self._shape)


def is_distorted(intrinsics: Any) -> bool:
    """Say whether images of a stream differ from those of an ideal pinhole camera."""
    return intrinsics.model != rs.distortion.none and any(intrinsics.coeffs)


def _distorted_pixels(intrinsics: Any) -> Float[np.ndarray, "height width 2"]:
    """Where the point seen by each ideal pixel lies in the distorted image [px]."""
    x = (np.arange(intrinsics.width) - intrinsics.ppx) / intrinsics.fx
    y = (np.arange(intrinsics.height) - intrinsics.ppy) / intrinsics.fy
    project = rs.rs2_project_point_to_pixel
    rows = [[project(intrinsics, [float(a), float(b), 1.0]) for a in x] for b in y]
    return np.asarray(rows, dtype=np.float64)
