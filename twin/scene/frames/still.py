"""When two poses of a camera count as one."""

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3


def same_pose(
    T_base_a: Float[np.ndarray, "4 4"],
    T_base_b: Float[np.ndarray, "4 4"],
    *,
    distance_m: float,
    angle_rad: float,
) -> bool:
    """Say whether two poses lie nearer to each other than both limits."""
    near = np.linalg.norm(T_base_a[:3, 3] - T_base_b[:3, 3]) < distance_m
    return bool(near and se3.rotation_angle_rad(T_base_a[:3, :3].T @ T_base_b[:3, :3]) < angle_rad)
