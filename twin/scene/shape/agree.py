"""Shift views that disagree by millimetres onto what all of them saw, and onto the plane."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from bridge.geometry import se3
from twin.scene.shape.masked_view import MaskedView

MIN_POINTS = 30
MAX_POINTS = 700
"""Points of one view that are compared."""
NORMAL_PX = 2
"""Normals come from pixels this far to each side."""
FLAT_M = 0.015
"""Pixels whose neighbours differ by more have no normal."""
NORMAL_M = 0.02
"""A normal turned by one radian counts like this distance: two sides of a wall do not meet."""
NEIGHBOURS = 24
REACH_M = 0.012
"""Points farther from what others saw, or from the plane, are not asked."""
HOLD = 0.02
"""Pull to where the view was, against directions its points do not determine."""
PLANE_AROUND_M = 0.08
"""How far around the object the plane is looked at."""


@dataclass(frozen=True)
class _Surface:
    """Oriented points of one view, and heights of the plane around."""

    points: Float[np.ndarray, "num_points 3"]
    normals: Float[np.ndarray, "num_points 3"]
    heights: Float[np.ndarray, " num_heights"]


def laid_together(
    views: Sequence[MaskedView], support_z_m: float | None, rounds: int
) -> tuple[list[MaskedView], float]:
    """Shift each view so that its points lie on those of the others, and its plane on the plane.

    Robust point-to-plane steps, translation only. Compared with the mean of points that face the
    same way, not with a carved shape: where views disagree carving takes away more than it
    leaves, and views laid onto that would shrink the object further. All together the views may
    not move along the plane (nothing but their poses says where the object is); the plane is
    known.

    Args:
        views: What a shape will be made from.
        support_z_m: Height of the plane; None without one.
        rounds: How many steps; 0 changes nothing.

    Returns:
        The shifted views, and the root mean square of the whole shifts [m].
    """
    if rounds == 0:
        return list(views), 0.0
    surfaces = [_surface(view, support_z_m) for view in views]
    total = np.zeros((len(views), 3))
    for _ in range(rounds):
        total += _shifts(surfaces, total)
        mean = total.mean(axis=0)
        if support_z_m is not None:
            mean[2] = 0.0
        total -= mean
    moved = []
    for view, shift in zip(views, total, strict=True):
        T = view.T_base_camera.copy()
        T[:3, 3] += shift
        moved.append(replace(view, T_base_camera=T))
    return moved, float(np.sqrt(np.square(total).sum(axis=1).mean()))


def _shifts(
    surfaces: Sequence[_Surface], moved_m: Float[np.ndarray, "num_views 3"]
) -> Float[np.ndarray, "num_views 3"]:
    """One step for every view, all against where the others are now."""
    points = np.concatenate([s.points + m for s, m in zip(surfaces, moved_m, strict=True)])
    normals = np.concatenate([s.normals for s in surfaces])
    owner = np.repeat(np.arange(len(surfaces)), [len(s.points) for s in surfaces])
    places = np.concatenate([points, NORMAL_M * normals], axis=1)
    count = min(NEIGHBOURS, len(points))
    away, index = cKDTree(places).query(places, k=count, distance_upper_bound=REACH_M)
    index = np.minimum(index, len(points) - 1)
    others = np.isfinite(away) & (owner[index] != owner[:, None])
    weight = others / np.maximum(others.sum(axis=1, keepdims=True), 1)
    middle = np.einsum("nk,nki->ni", weight, points[index])
    slope = np.einsum("nk,nki->ni", weight, normals[index])
    slope /= np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-9)
    distance = np.einsum("ni,ni->n", slope, points - middle)
    known: Bool[np.ndarray, " num_points"] = others.sum(axis=1) >= 3
    steps = np.zeros_like(moved_m)
    for view, surface in enumerate(surfaces):
        mine = known & (owner == view)
        if int(mine.sum()) < MIN_POINTS:
            continue
        A, b = _normal_equations(slope[mine], distance[mine])
        heights = surface.heights + moved_m[view, 2]
        heights = heights[np.abs(heights) < REACH_M]
        if len(heights) >= MIN_POINTS:
            up = np.tile([0.0, 0.0, 1.0], (len(heights), 1))
            A_plane, b_plane = _normal_equations(up, heights)
            A, b = A + A_plane, b + b_plane
        steps[view] = np.clip(-np.linalg.solve(A + HOLD * np.eye(3), b), -REACH_M, REACH_M)
    return steps


def _normal_equations(
    slope: Float[np.ndarray, "num_rows 3"], distance: Float[np.ndarray, " num_rows"]
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """Mean over rows of robustly weighted (Cauchy) point-to-plane equations."""
    scale = max(float(np.median(np.abs(distance))), 1e-4)
    weight = 1.0 / (1.0 + (distance / (2 * scale)) ** 2)
    A = (slope * weight[:, None]).T @ slope / weight.sum()
    return A, slope.T @ (weight * distance) / weight.sum()


def _surface(view: MaskedView, support_z_m: float | None) -> _Surface:
    """Oriented points of the object, evenly picked, and heights of what lies around it."""
    camera, depth = view.camera, view.known_depth_m().astype(np.float64)
    p = camera.unproject(depth)
    n = NORMAL_PX
    inner = (slice(n, -n), slice(n, -n))
    ok = view.mask[inner] & (depth[inner] > 0)
    ends = []
    for rows, columns in ((0, n), (0, -n), (n, 0), (-n, 0)):
        part = (
            slice(n + rows, camera.height - n + rows),
            slice(n + columns, camera.width - n + columns),
        )
        ok &= view.mask[part] & (np.abs(depth[part] - depth[inner]) < FLAT_M)
        ends.append(p[part])
    row, column = np.nonzero(ok)
    step = max(1, len(row) // MAX_POINTS)
    row, column = row[::step], column[::step]
    right, left, below, above = (end[row, column] for end in ends)
    normals = np.cross(below - above, right - left)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    points = p[inner][row, column]
    away = np.einsum("ni,ni->n", normals, points) > 0
    normals[away] *= -1
    T = view.T_base_camera
    points = se3.apply(T, points)
    heights = np.zeros(0)
    if support_z_m is not None and len(points):
        heights = _heights(view, p, points) - support_z_m
    return _Surface(points, normals @ T[:3, :3].T, heights)


def _heights(
    view: MaskedView,
    p_camera: Float[np.ndarray, "height width 3"],
    points: Float[np.ndarray, "num_points 3"],
) -> Float[np.ndarray, " num_heights"]:
    """Heights of measured points around the object that are not the object's."""
    row, column = np.nonzero(~view.mask & (p_camera[..., 2] > 0))
    step = max(1, len(row) // 8000)
    around = se3.apply(view.T_base_camera, p_camera[row[::step], column[::step]])
    low, high = points.min(axis=0) - PLANE_AROUND_M, points.max(axis=0) + PLANE_AROUND_M
    inside = np.all((around[:, :2] > low[:2]) & (around[:, :2] < high[:2]), axis=1)
    return np.asarray(around[inside, 2])
