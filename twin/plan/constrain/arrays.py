"""Geometry over many states at once, written once for NumPy and torch.

Batches are the first axis. Constants are NumPy and are made like the states by ``like``; functions
that both libraries have are called on what ``namespace`` returns. Lengths are smooth at zero, where
a root of exactly nothing has no derivative.
"""

import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

from twin.scene.shape.sdf import SdfGrid

Array = Any
"""``np.ndarray`` or ``torch.Tensor``, all of one call alike."""
_NOTHING_M2 = 1e-24
_FAR_M = 1e6
_PARALLEL_M = 1e-9


def namespace(array: Array) -> Any:
    """The library that an array is from."""
    return np if isinstance(array, np.ndarray) else sys.modules["torch"]


def like(value: Any, array: Array) -> Array:
    """A constant as an array of the same library, type and device."""
    if isinstance(array, np.ndarray):
        return np.asarray(value, dtype=array.dtype)
    return namespace(array).as_tensor(value, dtype=array.dtype, device=array.device)


def norm(v: Array) -> Array:
    """Lengths of the vectors along the last axis."""
    return namespace(v).sqrt((v * v).sum(-1) + _NOTHING_M2)


def cross(a: Array, b: Array) -> Array:
    """Vector products along the last axis, of length 3."""
    parts = [
        a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1],
        a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2],
        a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0],
    ]
    return namespace(a).stack(parts, axis=-1)


def angle(a: Array, b: Array, *, undirected: bool = False) -> Array:
    """Angles between directions, with a derivative wherever they are not parallel [rad].

    Args:
        a: Directions along the last axis, of any length but 0.
        b: Likewise.
        undirected: Directions that are opposite count as the same.
    """
    along = (a * b).sum(-1)
    return namespace(a).arctan2(norm(cross(a, b)), abs(along) if undirected else along)


def turn(R: Array) -> Array:
    """Angles of rotations ``(num_states, 3, 3)``, 0 to pi [rad]."""
    skew = [R[..., i, j] - R[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0))]
    trace = R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2]
    xp = namespace(R)
    return xp.arctan2(norm(xp.stack(skew, axis=-1)), trace - 1.0)


def carried(T: Array, points_m: Array) -> Array:
    """Points of a body in the frame of its pose, ``(num_states, num_points, 3)``.

    Args:
        T: ``(num_states, 4, 4)``.
        points_m: ``(num_points, 3)``, the same in all states, or one list for each state.
    """
    return points_m @ T[:, :3, :3].swapaxes(-1, -2) + T[:, None, :3, 3]


def seen_from(T: Array, points_m: Array) -> Array:
    """Points ``(num_states, num_points, 3)`` in the frame of a body with this pose."""
    return (points_m - T[:, None, :3, 3]) @ T[:, :3, :3]


def box_distance(points_m: Array, half_m: Array, centre_m: Array | None = None) -> Array:
    """Signed distances of points to the surface of a box along the axes, negative inside [m].

    Args:
        points_m: ``(..., 3)``, or seen from above ``(..., 2)``.
        half_m: Half its extents.
        centre_m: Its middle; None: the origin.
    """
    middles = [like((0.0,) * len(half_m), points_m) if centre_m is None else centre_m]
    return boxes_distance(points_m, middles, [half_m])


def boxes_distance(points_m: Array, centres_m: Sequence[Array], halves_m: Sequence[Array]) -> Array:
    """Signed distances of points to the nearest of several boxes; inside one, its own depth [m].

    Args:
        points_m: ``(..., num_axes)``.
        centres_m: Middles of the boxes, each ``(num_axes,)``.
        halves_m: Half their extents.
    """
    xp = namespace(points_m)
    axes = [points_m[..., k] for k in range(points_m.shape[-1])]
    outside2: Array = None
    inside: Array = 0.0
    for centre, half in zip(centres_m, halves_m, strict=True):
        beyond = [abs(axis - centre[k]) - half[k] for k, axis in enumerate(axes)]
        deepest, ahead2 = beyond[0], 0.0
        for value in beyond:
            deepest = xp.maximum(deepest, value)
            clipped = xp.clip(value, 0.0, None)
            ahead2 = ahead2 + clipped * clipped
        inside = xp.clip(deepest, None, 0.0) if outside2 is None else xp.minimum(inside, deepest)
        outside2 = ahead2 if outside2 is None else xp.minimum(outside2, ahead2)
    return xp.sqrt(outside2 + _NOTHING_M2) + inside


def grid_distance(grid: SdfGrid, points_m: Array) -> Array:
    """``SdfGrid.distance`` for either library: trilinear, beyond the grid never too large [m].

    Args:
        grid: In the frame of the points.
        points_m: ``(..., 3)``.
    """
    xp = namespace(points_m)
    counts = grid.values_m.shape
    where = (points_m - like(grid.origin_m, points_m)) / grid.voxel_m
    held = xp.stack([xp.clip(where[..., k], 0.0, float(counts[k] - 1)) for k in range(3)], axis=-1)
    known = xp.nan_to_num(held)  # what is no number still has no distance, by what it is beyond
    corner = [xp.clip(xp.floor(known[..., k]), 0.0, float(counts[k] - 2)) for k in range(3)]
    share = [held[..., k] - corner[k] for k in range(3)]
    flat = (corner[0] * counts[1] + corner[1]) * counts[2] + corner[2]
    flat = flat.astype(np.int64) if xp is np else flat.long()
    rows = like(grid.values_m.reshape(-1), points_m)
    value = 0.0
    for i in (0, 1):
        for j in (0, 1):
            for k in (0, 1):
                weight = 1.0
                for axis, upper in enumerate((i, j, k)):
                    weight = weight * (share[axis] if upper else 1.0 - share[axis])
                value = value + weight * rows[flat + (i * counts[1] + j) * counts[2] + k]
    beyond = (where - held) * grid.voxel_m
    away = norm(beyond)
    ahead = xp.clip(value, 0.0, None)
    far = xp.sqrt(ahead * ahead + away * away) if grid.closed else value - away
    return xp.where((beyond != 0).any(-1), far, value)


def footprint_gap(T_a: Array, half_a: Array, T_b: Array, half_b: Array) -> Array:
    """Horizontal gap between two boxes seen from above; negative: how deep they overlap [m].

    The difference of two projected boxes is a polygon with a pair of parallel edges for each edge
    direction (a zonotope, see Ziegler, Lectures on Polytopes, 7.3): the gap is the distance of the
    origin from it.

    Args:
        T_a: Poses of the one box's middle, ``(num_states, 4, 4)``.
        half_a: Half its extents, ``(3,)``.
        T_b: Poses of the other one's middle.
        half_b: Half its extents.
    """
    xp = namespace(T_a)
    T_a, T_b = xp.broadcast_tensors(T_a, T_b) if xp is not np else np.broadcast_arrays(T_a, T_b)
    centre = (T_a[:, :2, 3] - T_b[:, :2, 3])[:, None]
    halves = [T_a[:, :2, :3] * half_a, T_b[:, :2, :3] * half_b]
    edges = xp.concatenate(halves, axis=2).swapaxes(1, 2)  # (num_states, 6, 2)
    long = norm(edges)
    flat = long > _PARALLEL_M  # an edge that points straight up has no direction from above
    along = edges / xp.where(flat, long, 1.0)[..., None]
    normals = xp.stack((-along[..., 1], along[..., 0]), axis=-1)
    across = normals @ edges.swapaxes(1, 2)  # of each edge, along the normal of each edge
    parallel = abs(across) < _PARALLEL_M
    across = xp.where(parallel, 0.0, across)
    depth = abs((normals * centre).sum(-1)) - abs(across).sum(-1)
    overlap = xp.amax(xp.where(flat, depth, -_FAR_M), axis=-1)
    lengths = xp.where(parallel, abs(along @ edges.swapaxes(1, 2)), 0.0).sum(-1)
    to_middle = xp.sign(across) @ edges
    gaps = []
    for sign in (1.0, -1.0):
        from_middle = -(centre + sign * to_middle)
        t = xp.maximum(xp.minimum((from_middle * along).sum(-1), lengths), -lengths)
        gaps.append(xp.where(flat, norm(from_middle - t[..., None] * along), _FAR_M))
    clear = xp.amin(xp.concatenate(gaps, axis=1), axis=-1)
    return xp.where(overlap <= 0, overlap, clear)


def blocked_length(starts_m: Array, ends_m: Array, T_box: Array, half_m: Array) -> Array:
    """How long straight lines run inside a box; negative where they miss it [m].

    Slabs: a line is inside between the last plane it enters by and the first it leaves by.

    Args:
        starts_m: The point all lines of a state start from, ``(num_states, 1, 3)``.
        ends_m: ``(num_states, num_points, 3)``.
        T_box: Poses of the box's middle, ``(num_states, 4, 4)``.
        half_m: Half its extents, ``(3,)``.
    """
    xp = namespace(ends_m)
    start = seen_from(T_box, starts_m)
    way = seen_from(T_box, ends_m) - start
    steep = xp.where(abs(way) < _PARALLEL_M, _PARALLEL_M, way)
    first, last = (-half_m - start) / steep, (half_m - start) / steep
    enter = xp.clip(xp.amax(xp.minimum(first, last), axis=-1), 0.0, None)
    leave = xp.clip(xp.amin(xp.maximum(first, last), axis=-1), None, 1.0)
    return (leave - enter) * norm(way)
