"""Takes lens distortion out of colour images, as the episode's cameras have none.

D415 and D435 send undistorted colour (all coefficients 0). D405 and D455 do not.
"""

from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from bridge.sources.realsense.library import rs

ONE = 256
"""Weights are eight-bit fixed point and sum to this: 255 times it still fits into 16 bits."""
TWO_LANES = 0x00FF00FF
HALF = 0x00800080


class Rectifier:
    """Resamples distorted images bilinearly; pixels that see outside the image become black.

    Two colours are weighted at once, each in 16 bits of one 32-bit number: a third of the time
    that NumPy needs for bytes. Not for several threads: the buffers are kept.
    """

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
        corner = (top * width + left).ravel()
        right_part, bottom_part = u - left, v - top
        shares = [
            right_part * (1 - bottom_part),
            (1 - right_part) * bottom_part,
            right_part * bottom_part,
        ]
        weights = [np.where(inside, np.floor(share * ONE), 0.0) for share in shares]
        weights.insert(0, np.where(inside, ONE - sum(weights), 0.0))
        self._taps = [
            (corner + step, weight.astype(np.uint32).ravel())
            for step, weight in zip((0, 1, width, width + 1), weights, strict=True)
        ]
        self._pixels = np.zeros((height, width, 4), np.uint8)
        self._read, self._work, self._outer, self._inner = np.zeros(
            (4, height * width), dtype=np.uint32
        )

    def apply(self, image_u8: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "h w 3"]:
        """Return the image an ideal camera of the same focal lengths would have taken."""
        self._pixels[..., :3] = image_u8
        packed = self._pixels.view(np.uint32).ravel()
        self._outer[:] = HALF
        self._inner[:] = HALF
        for places, weight in self._taps:
            np.take(packed, places, out=self._read, mode="clip")
            self._add(self._outer, weight)
            np.right_shift(self._read, 8, out=self._read)
            self._add(self._inner, weight)
        np.right_shift(self._outer, 8, out=self._outer)
        np.bitwise_and(self._outer, TWO_LANES, out=self._outer)
        np.bitwise_and(self._inner, TWO_LANES << 8, out=self._inner)
        np.bitwise_or(self._outer, self._inner, out=self._outer)
        return np.array(self._outer.view(np.uint8).reshape(self._pixels.shape)[..., :3])

    def _add(self, total: np.ndarray, weight: np.ndarray) -> None:
        np.bitwise_and(self._read, TWO_LANES, out=self._work)
        np.multiply(self._work, weight, out=self._work)
        np.add(total, self._work, out=total)


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
