"""What one view saw of an object and of the plane around it: points in the camera's frame."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from twin.scene.shape.masked_view import MaskedView

MAX_POINTS = 500
"""Points of one view that are compared."""
MAX_HEIGHTS = 400
"""Points of the plane that one view contributes."""
NORMAL_PX = 2
"""Normals come from pixels this far to each side."""
FLAT_M = 0.015
"""Pixels whose neighbours differ by more have no normal."""
BENT_M = 0.004
"""Across an edge depth bends by more, and a normal would be that of neither side."""
PLANE_AROUND_M = 0.08
"""How far around the object the plane is looked at."""


@dataclass(frozen=True)
class SeenSurface:
    """Oriented points of one view, and points of the plane around, all in the camera's frame."""

    T_base_camera: Float[np.ndarray, "4 4"]
    points: Float[np.ndarray, "num_points 3"]
    normals: Float[np.ndarray, "num_points 3"]
    """Unit length, towards the camera."""
    plane: Float[np.ndarray, "num_plane 3"]


def seen_surface(view: MaskedView, *, with_plane: bool) -> SeenSurface:
    """Pick the object's oriented points evenly, and what was measured around it.

    Args:
        view: Depth with the object's pixels.
        with_plane: There is a plane; otherwise no points around the object are returned.
    """
    camera, depth = view.camera, view.known_depth_m().astype(np.float64)
    p = camera.unproject(depth)
    n = NORMAL_PX
    inner = (slice(n, -n), slice(n, -n))
    ok = view.mask[inner] & (depth[inner] > 0)
    ends, seen = [], []
    for rows, columns in ((0, n), (0, -n), (n, 0), (-n, 0)):
        part = (
            slice(n + rows, camera.height - n + rows),
            slice(n + columns, camera.width - n + columns),
        )
        ok &= view.mask[part] & (np.abs(depth[part] - depth[inner]) < FLAT_M)
        ends.append(p[part])
        seen.append(depth[part])
    for before, after in ((0, 1), (2, 3)):
        ok &= np.abs(seen[before] + seen[after] - 2 * depth[inner]) < BENT_M
    row, column = np.nonzero(ok)
    step = max(1, len(row) // MAX_POINTS)
    row, column = row[::step], column[::step]
    right, left, below, above = (end[row, column] for end in ends)
    normals = np.cross(below - above, right - left)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    points = p[inner][row, column]
    normals[np.einsum("ni,ni->n", normals, points) > 0] *= -1
    plane = np.zeros((0, 3))
    if with_plane and len(points):
        plane = _around(view, p, points)
    return SeenSurface(view.T_base_camera, points, normals, plane)


def _around(
    view: MaskedView,
    p_camera: Float[np.ndarray, "height width 3"],
    points: Float[np.ndarray, "num_points 3"],
) -> Float[np.ndarray, "num_around 3"]:
    """Measured points around the object that are not the object's, in the camera's frame."""
    row, column = np.nonzero(~view.mask & (p_camera[..., 2] > 0))
    around = p_camera[row, column]
    xy = se3.apply(view.T_base_camera, around)[:, :2]
    own = se3.apply(view.T_base_camera, points)[:, :2]
    low, high = own.min(axis=0) - PLANE_AROUND_M, own.max(axis=0) + PLANE_AROUND_M
    around = around[np.all((xy > low) & (xy < high), axis=1)]
    return np.asarray(around[:: max(1, len(around) // MAX_HEIGHTS)])
