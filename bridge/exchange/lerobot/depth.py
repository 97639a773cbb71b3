"""Depth as LeRobot 0.6 keeps it: 12-bit codes, by default on a logarithmic scale.

Source: ``huggingface/lerobot`` (``configs/video.py`` and ``datasets/depth_utils.py``, pull request
3644): a code stands for a depth between ``depth_min`` and ``depth_max``, spaced evenly in
``log(depth + shift)``. Code 0 is also what no measurement becomes; it is read as none.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from jaxtyping import UInt16

MOST_CODE = 4095
NO_MEASUREMENT = 0
SUFFIX = "_depth"
"""Ends the name of a camera's depth among the features."""


@dataclass(frozen=True, kw_only=True)
class DepthCoding:
    """How depth becomes a code; all lengths in metres."""

    min_m: float = 0.01
    """Depth of code 0."""
    max_m: float = 10.0
    """Depth of code 4095; what is further away becomes this."""
    shift_m: float = 3.5
    """Added before the logarithm."""
    use_log: bool = True

    def __post_init__(self) -> None:
        """Refuse what has no inverse."""
        numbers = (self.min_m, self.max_m, self.shift_m)
        low_m = self.min_m + (self.shift_m if self.use_log else 0.0)
        if not all(map(math.isfinite, numbers)) or self.max_m <= self.min_m or self.min_m < 0:
            message = f"depth from {self.min_m} to {self.max_m} m makes no scale"
            raise ValueError(message)
        if self.use_log and low_m <= 0:
            message = f"the logarithm of {low_m} m does not exist"
            raise ValueError(message)

    @staticmethod
    def from_info(info: Mapping[str, Any]) -> "DepthCoding | None":
        """Read the ``info`` of a feature; None for a video of colours."""
        if not (info.get("is_depth_map") is True or info.get("video.is_depth_map") is True):
            return None
        if "video.depth_min" not in info:  # an older depth video, of another kind
            message = "a depth video without video.depth_min; lerobot 0.6 and later write it"
            raise ValueError(message)
        return DepthCoding(
            min_m=float(info["video.depth_min"]),
            max_m=float(info["video.depth_max"]),
            shift_m=float(info.get("video.shift", 0.0)),
            use_log=bool(info.get("video.use_log", True)),
        )

    def to_info(self) -> dict[str, Any]:
        """What ``meta/info.json`` says of it."""
        return {
            "is_depth_map": True,
            "video.is_depth_map": True,
            "video.depth_min": self.min_m,
            "video.depth_max": self.max_m,
            "video.shift": self.shift_m,
            "video.use_log": self.use_log,
            "depth_unit": "mm",
        }

    def encode(self, depth_mm: UInt16[np.ndarray, "height width"]) -> UInt16[np.ndarray, "h w"]:
        """Turn millimetres into codes; 0 stays 0."""
        codes: UInt16[np.ndarray, "h w"] = _codes(self)[depth_mm]
        return codes

    def decode(self, codes: UInt16[np.ndarray, "height width"]) -> UInt16[np.ndarray, "h w"]:
        """Turn codes into millimetres; 0 stays 0, no measurement."""
        depth_mm: UInt16[np.ndarray, "h w"] = _depths_mm(self)[np.minimum(codes, MOST_CODE)]
        return depth_mm


@cache
def _codes(coding: DepthCoding) -> UInt16[np.ndarray, " num_depths"]:
    depth_m = np.arange(65536) * 1e-3
    if coding.use_log:
        low, high = (math.log(end + coding.shift_m) for end in (coding.min_m, coding.max_m))
        position = (np.log(np.maximum(depth_m + coding.shift_m, 1e-9)) - low) / (high - low)
    else:
        position = (depth_m - coding.min_m) / (coding.max_m - coding.min_m)
    codes: UInt16[np.ndarray, " num_depths"] = (
        np.rint(position * MOST_CODE).clip(0, MOST_CODE).astype(np.uint16)
    )
    codes[0] = NO_MEASUREMENT
    return codes


@cache
def _depths_mm(coding: DepthCoding) -> UInt16[np.ndarray, " num_codes"]:
    position = np.arange(MOST_CODE + 1) / MOST_CODE
    if coding.use_log:
        low, high = (math.log(end + coding.shift_m) for end in (coding.min_m, coding.max_m))
        depth_m = np.exp(low + position * (high - low)) - coding.shift_m
    else:
        depth_m = coding.min_m + position * (coding.max_m - coding.min_m)
    depths_mm = np.rint(depth_m * 1000).clip(0, 65535).astype(np.uint16)
    depths_mm[NO_MEASUREMENT] = 0
    return depths_mm
