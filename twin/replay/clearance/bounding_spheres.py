"""Points that cover the surface of convex pieces: few coarse ones, with finer ones below them.

A grid is asked about points. A coarse point, with the radius of the patch it stands for, bounds the
distance of all the points below it, so of some ten thousand points a few hundred are looked at. The
finest lie so close that no point of a surface is farther from one than a few millimetres, which
are subtracted: distances are never too large.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Int, Int32
from scipy.spatial import ConvexHull, cKDTree

from twin.replay._clearance import nearest, surface_to_grid
from twin.robot.collision import RobotHulls
from twin.scene.shape.sdf import SdfGrid

FINE_M, ARM_FINE_M = 0.002, 0.004
"""For the gripper and what it carries, and for the arm."""
PATCHES_M = (0.032, 0.015, 0.007)
"""Radii of patches, coarsest first."""
SLOPE = 1.15
"""Most that an interpolated distance changes per way that is gone, but for a tenth of a millimetre
at ridges: less than the cover that is subtracted."""


@dataclass(frozen=True, kw_only=True)
class BoundingSphereTree:
    """The surface of one convex piece as a tree of points, in the frame of its body."""

    points_m: Float[np.ndarray, "num_points 3"]
    """Level by level, coarsest first."""
    radius_m: Float[np.ndarray, " num_points"]
    """How far the surface below a point reaches from it."""
    children: Int32[np.ndarray, "num_points 2"]
    """Where a point's own begin and end in the next level; nothing below the finest."""
    num_roots: int
    """Points of the coarsest level."""
    cover_m: float
    """No point of the surface is farther from one of the finest."""


class BoundingSpheres:
    """Pieces that are asked for together."""

    def __init__(self, trees: list[BoundingSphereTree]) -> None:
        """Put their trees into one."""
        points = np.concatenate([tree.points_m for tree in trees])
        radius = np.concatenate([tree.radius_m for tree in trees])
        starts = np.concatenate([[0], np.cumsum([len(tree.points_m) for tree in trees])])
        children = [tree.children + start for tree, start in zip(trees, starts, strict=False)]
        ends = starts[:-1] + [tree.num_roots for tree in trees]
        roots = np.stack([starts[:-1], ends], axis=1).astype(np.int32)
        self._trees = points, radius, np.concatenate(children).astype(np.int32), roots
        self._cover = np.array([tree.cover_m for tree in trees])

    def distances_m(
        self,
        grid: SdfGrid,
        R: Float[np.ndarray, "num_pieces 3 3"],
        t: Float[np.ndarray, "num_pieces 3"],  # origin of each piece's link, grid's frame [m]
    ) -> Float[np.ndarray, " num_pieces"]:
        """Signed distance of each placed piece to the grid's surface [m].

        Never too large; too small by what the finest points leave uncovered, and by 2 % of it.
        """
        answers = np.empty(len(R))
        nearest(grid.values_m, grid.origin_m, grid.voxel_m, R, t, *self._trees, answers)
        return np.asarray(answers - self._cover)


def grid_distances_m(
    grid: SdfGrid, points_m: Float[np.ndarray, "num_points 3"]
) -> Float[np.ndarray, " num_points"]:
    """Signed distances of points in a grid's frame [m].

    All solid lies inside the grid or nobody knows of it: beyond the grid, the nearest grid point at
    distance e with d bounds them by sqrt(d^2 + e^2); solid that reaches the edge is taken to end
    behind it as deep as it was.
    """
    answers, unturned = np.empty(len(points_m)), np.tile(np.eye(3), (len(points_m), 1, 1))
    where = unturned, np.ascontiguousarray(points_m), np.zeros((1, 3))
    surface_to_grid(grid.values_m, grid.origin_m, grid.voxel_m, *where, answers)
    return answers


def bounding_spheres_of(
    corners_m: Float[np.ndarray, "num_points 3"], fine_m: float = FINE_M
) -> BoundingSphereTree:
    """Cover the hull of points, in their frame: no part is over ``fine_m`` from a finest one."""
    levels = [surface_points(corners_m, fine_m)]
    parents: list[Int[np.ndarray, " num_points"]] = []
    for radius in reversed(PATCHES_M):
        chosen = levels[0][_spread(levels[0], radius)]
        parents.insert(0, cKDTree(chosen).query(levels[0])[1])
        levels.insert(0, chosen)
    order = np.arange(len(levels[0]))
    begin, starts = 0, []
    for level, parent in enumerate(parents):
        # Each level goes into the order of the one above it.
        rank = np.empty(len(order), dtype=np.int64)
        rank[order] = np.arange(len(order))
        levels[level] = levels[level][order]
        below = rank[parent]
        begin += len(order)
        starts.append(begin + np.searchsorted(np.sort(below), np.arange(len(order) + 1)))
        order = np.argsort(below, kind="stable")
    levels[-1] = levels[-1][order]
    children = [np.stack([ends[:-1], ends[1:]], axis=1) for ends in starts]
    children.append(np.zeros((len(levels[-1]), 2), dtype=np.int64))
    return BoundingSphereTree(
        points_m=np.concatenate(levels),
        radius_m=_radii(levels, starts, fine_m),
        children=np.concatenate(children).astype(np.int32),
        num_roots=len(levels[0]),
        cover_m=fine_m,
    )


def surface_points(
    corners_m: Float[np.ndarray, "num_corners 3"], fine_m: float = FINE_M
) -> Float[np.ndarray, "num_points 3"]:
    """Points on the surface of a convex hull: no part is over ``fine_m`` from all of them."""
    # A triangle with edges of at most e leaves nothing farther from its corners than e / sqrt(3).
    return _divided(corners_m[ConvexHull(corners_m).simplices], fine_m * np.sqrt(3.0))


def _radii(
    levels: list[Float[np.ndarray, "_ 3"]], starts: list[Int[np.ndarray, " _"]], cover_m: float
) -> Float[np.ndarray, " num_points"]:
    """Measure how far the finest points below each one are from it."""
    finest = levels[-1]
    radii = [np.full(len(finest), cover_m)]
    ends = np.arange(len(finest) + 1)
    for points, rows in zip(reversed(levels[:-1]), reversed(starts), strict=True):
        ends = ends[rows - rows[0]]  # where each point's own begin among the finest
        away = np.linalg.norm(finest - np.repeat(points, np.diff(ends), axis=0), axis=1)
        radii.insert(0, SLOPE * np.maximum.reduceat(away, ends[:-1]) + cover_m)
    return np.concatenate(radii)


def _spread(points_m: Float[np.ndarray, "num_points 3"], radius_m: float) -> list[int]:
    """Choose points so that every other one is within a radius of one of them."""
    tree = cKDTree(points_m)
    free = np.ones(len(points_m), dtype=bool)
    chosen = []
    for index in range(len(points_m)):
        if free[index]:
            chosen.append(index)
            free[tree.query_ball_point(points_m[index], radius_m)] = False
    return chosen


def _divided(
    triangles_m: Float[np.ndarray, "num_triangles 3 3"], edge_m: float
) -> Float[np.ndarray, "num_points 3"]:
    """Corners of the parts after halving longest edges until none is longer than asked."""
    points = [triangles_m.reshape(-1, 3)]
    rows = triangles_m
    while len(rows):
        edges = np.linalg.norm(np.roll(rows, -1, axis=1) - rows, axis=2)
        longest = edges.argmax(axis=1)
        keep = edges.max(axis=1) > edge_m
        rows, longest = rows[keep], longest[keep]
        each = np.arange(len(rows))
        a, b, c = (rows[each, (longest + k) % 3] for k in range(3))
        middle = (a + b) / 2
        points.append(middle)
        rows = np.concatenate([np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)])
    # Corners and edges belong to several triangles.
    return np.unique(np.concatenate(points).round(9), axis=0)


@lru_cache(maxsize=4)
def robot_bounding_spheres(hulls: RobotHulls, left_out: frozenset[str]) -> BoundingSpheres:
    """Cover the hulls of a robot but those of some links; made once."""
    gripper = hulls.robot.record.gripper.links
    return BoundingSpheres(
        [
            bounding_spheres_of(hull.points_m, FINE_M if hull.link in gripper else ARM_FINE_M)
            for hull in hulls.hulls
            if hull.link not in left_out
        ]
    )
