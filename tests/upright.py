"""Poses of things that stand, turned about the vertical."""

import numpy as np

from bridge.geometry import se3


def upright(x_m: float, y_m: float, z_m: float, yaw_rad: float = 0.0) -> np.ndarray:
    q = np.array([np.cos(yaw_rad / 2), 0.0, 0.0, np.sin(yaw_rad / 2)])
    return se3.transform_from(q, np.array([x_m, y_m, z_m], dtype=np.float64))
