"""What the device layer hands on: calibration and frames, without the camera library's types."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8, UInt16

from bridge.geometry.camera import Camera


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """Intrinsics of both streams and how they are mounted to each other."""

    color_camera: Camera
    depth_camera: Camera
    T_color_depth: Float[np.ndarray, "4 4"]


@dataclass(frozen=True, kw_only=True)
class ColorFrame:
    """An undistorted colour image (sRGB)."""

    number: int
    """The device's frame counter of this stream."""
    stamp_ns: int
    image_u8: UInt8[np.ndarray, "height width 3"]


@dataclass(frozen=True, kw_only=True)
class DepthFrame:
    """Depth along the optical axis in whole millimetres; 0 is "no measurement"."""

    number: int
    stamp_ns: int
    depth_mm: UInt16[np.ndarray, "height width"]


Frame = ColorFrame | DepthFrame
