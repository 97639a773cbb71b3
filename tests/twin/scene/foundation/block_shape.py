"""A lopsided thing of three blocks, as triangles and as what a depth camera measures of it."""

import numpy as np

from bridge.geometry import se3
from bridge.geometry.camera import Camera

BLOCKS = (
    ((0.0, 0.0, 0.2), (1.0, 0.6, 0.4)),
    ((-0.3, 0.1, 0.65), (0.3, 0.3, 0.5)),
    ((0.4, -0.2, 0.5), (0.2, 0.2, 0.2)),
)
"""Centre and size of each block; z is up and the lowest point is at 0."""
CAMERA = Camera(width=96, height=72, fx=110.0, fy=110.0, cx=48.0, cy=36.0)


def block_mesh() -> tuple[np.ndarray, np.ndarray]:
    corner = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    triangles = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    vertices = [np.array(centre) + corner * np.array(size) / 2 for centre, size in BLOCKS]
    faces = [triangles + 8 * index for index in range(len(BLOCKS))]
    return np.concatenate(vertices), np.concatenate(faces)


def block_depth(T_base_shape: np.ndarray, scale: float, T_base_camera: np.ndarray) -> np.ndarray:
    """Depth along the optical axis by the slab test, 0 where the ray meets nothing."""
    T_shape_camera = se3.invert(T_base_shape) @ T_base_camera
    rays = CAMERA.rays().reshape(-1, 3) @ T_shape_camera[:3, :3].T
    eye = T_shape_camera[:3, 3]
    depth = np.full(len(rays), np.inf)
    for centre, size in BLOCKS:
        low = scale * (np.array(centre) - np.array(size) / 2)
        high = scale * (np.array(centre) + np.array(size) / 2)
        with np.errstate(divide="ignore"):
            first, second = (low - eye) / rays, (high - eye) / rays
        enter = np.minimum(first, second).max(axis=1)
        leave = np.maximum(first, second).min(axis=1)
        depth = np.where((enter < leave) & (enter > 0), np.minimum(depth, enter), depth)
    depth = np.where(np.isfinite(depth), depth, 0.0)
    return depth.reshape(CAMERA.height, CAMERA.width).astype(np.float32)


def placed(
    yaw_rad: float = 0.4, x_m: float = 0.5, y_m: float = 0.05, z_m: float = 0.02
) -> np.ndarray:
    """Standing upright on a table of height ``z_m``."""
    T = np.eye(4)
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    T[:3, :3] = [[c, -s, 0], [s, c, 0], [0, 0, 1]]
    T[:3, 3] = x_m, y_m, z_m
    return T


def camera_pose() -> np.ndarray:
    """From the front and above, looking at where ``placed`` puts it."""
    eye, target = np.array([0.1, -0.15, 0.35]), np.array([0.5, 0.05, 0.06])
    return se3.look_at(eye, target, np.array([0.0, 0.0, 1.0]))
