"""Geometry over many states at once: batches are the first axis.

Lengths are smooth at zero, where a root of exactly nothing has no derivative.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

Array = Any
"""``np.ndarray``, or a number for all states."""
_NOTHING_M2 = 1e-24
_FAR_M = 1e6
_PARALLEL_M = 1e-9


def norm(v: Array) -> Array:
    """Lengths of the vectors along the last axis."""
    return np.sqrt((v * v).sum(-1) + _NOTHING_M2)


def cross(a: Array, b: Array) -> Array:
    """Vector products along the last axis, of length 3."""
    parts = [
        a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1],
        a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2],
        a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0],
    ]
    return np.stack(parts, axis=-1)


def angle(a: Array, b: Array, *, undirected: bool = False) -> Array:
    """Angles between directions, with a derivative wherever they are not parallel [rad].

    Args:
        undirected: Directions that are opposite count as the same.
    """
    along = (a * b).sum(-1)
    return np.arctan2(norm(cross(a, b)), abs(along) if undirected else along)


def carried(T: Array, points_m: Array) -> Array:
    """Points of a body in the frame of its pose, ``(num_states, num_points, 3)``.

    Args:
        points_m: ``(num_points, 3)``, the same in all states, or one list for each state.
    """
    return points_m @ T[:, :3, :3].swapaxes(-1, -2) + T[:, None, :3, 3]


def seen_from(T: Array, points_m: Array) -> Array:
    """Points ``(num_states, num_points, 3)`` in the frame of a body with this pose."""
    return (points_m - T[:, None, :3, 3]) @ T[:, :3, :3]


def box_distance(points_m: Array, half_m: Array, centre_m: Array | None = None) -> Array:
    """Signed distances of points to the surface of a box along the axes, negative inside [m]."""
    middles = [((0.0,) * len(half_m)) if centre_m is None else centre_m]
    return boxes_distance(points_m, middles, [half_m])


def boxes_distance(points_m: Array, centres_m: Sequence[Array], halves_m: Sequence[Array]) -> Array:
    """Signed distances of points to the nearest of several boxes; inside one, its own depth [m]."""
    axes = [points_m[..., k] for k in range(points_m.shape[-1])]
    outside2: Array = None
    inside: Array = 0.0
    for centre, half in zip(centres_m, halves_m, strict=True):
        beyond = [abs(axis - centre[k]) - half[k] for k, axis in enumerate(axes)]
        deepest, ahead2 = beyond[0], 0.0
        for value in beyond:
            deepest = np.maximum(deepest, value)
            clipped = np.clip(value, 0.0, None)
            ahead2 = ahead2 + clipped * clipped
        inside = np.clip(deepest, None, 0.0) if outside2 is None else np.minimum(inside, deepest)
        outside2 = ahead2 if outside2 is None else np.minimum(outside2, ahead2)
    return np.sqrt(outside2 + _NOTHING_M2) + inside


def footprint_gap(T_a: Array, half_a: Array, T_b: Array, half_b: Array) -> Array:
    """Horizontal gap between two boxes seen from above; negative: how deep they overlap [m].

    The difference of two projected boxes is a polygon with a pair of parallel edges for each edge
    direction (a zonotope, see Ziegler, Lectures on Polytopes, 7.3): the gap is the distance of the
    origin from it.
    """
    T_a, T_b = np.broadcast_arrays(T_a, T_b)
    centre = (T_a[:, :2, 3] - T_b[:, :2, 3])[:, None]
    halves = [T_a[:, :2, :3] * half_a, T_b[:, :2, :3] * half_b]
    edges = np.concatenate(halves, axis=2).swapaxes(1, 2)  # (num_states, 6, 2)
    long = norm(edges)
    flat = long > _PARALLEL_M  # an edge that points straight up has no direction from above
    along = edges / np.where(flat, long, 1.0)[..., None]
    normals = np.stack((-along[..., 1], along[..., 0]), axis=-1)
    across = normals @ edges.swapaxes(1, 2)  # of each edge, along the normal of each edge
    parallel = abs(across) < _PARALLEL_M
    across = np.where(parallel, 0.0, across)
    depth = abs((normals * centre).sum(-1)) - abs(across).sum(-1)
    overlap = np.amax(np.where(flat, depth, -_FAR_M), axis=-1)
    lengths = np.where(parallel, abs(along @ edges.swapaxes(1, 2)), 0.0).sum(-1)
    to_middle = np.sign(across) @ edges
    gaps = []
    for sign in (1.0, -1.0):
        from_middle = -(centre + sign * to_middle)
        t = np.maximum(np.minimum((from_middle * along).sum(-1), lengths), -lengths)
        gaps.append(np.where(flat, norm(from_middle - t[..., None] * along), _FAR_M))
    clear = np.amin(np.concatenate(gaps, axis=1), axis=-1)
    return np.where(overlap <= 0, overlap, clear)
