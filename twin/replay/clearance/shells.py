"""Points that cover the surface of convex pieces, coarse ones with fine ones below them.

A grid is asked about points. Few coarse points, each with the radius of the fine ones it stands
for, bound the distance of a whole robot in one look-up; where that bound is near, the fine points
of the nearest coarse ones give the distance. Fine points lie so close that no point of a surface
is farther from one than a few millimetres, which are subtracted: distances are never too large.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull, cKDTree

from bridge.task.robot import GRIPPER_LINKS
from twin.replay.clearance.grid import GridLookup
from twin.robot.collision import RobotHulls

FINE_M, ARM_FINE_M = 0.002, 0.004
"""For the gripper and what it carries, and for the arm."""
SLOPE = 1.1
"""Between voxels an interpolated distance changes by a little more than the way that is gone."""
COARSE_RATIO = 6.0
"""Radius of the patch of fine points below one coarse point, at most, by the fine distance."""


@dataclass(frozen=True, kw_only=True)
class Shell:
    """The surface of one convex piece, in the frame of its body."""

    coarse_m: Float[np.ndarray, "num_coarse 3"]
    radius_m: Float[np.ndarray, " num_coarse"]
    """How far the surface that a coarse point stands for reaches from it."""
    fine_m: Float[np.ndarray, "num_fine 3"]
    """In the order of the coarse points they belong to."""
    starts: Int[np.ndarray, " num_starts"]
    """Where each coarse point's fine ones begin, and the end."""
    cover_m: float
    """No point of the surface is farther from a fine one."""

    def distance_m(
        self,
        lookup: GridLookup,
        R: Float[np.ndarray, "3 3"],
        t: Float[np.ndarray, "3"],
        coarse_distance_m: Float[np.ndarray, " num_coarse"],
    ) -> float:
        """Distance of the placed piece to the grid's surface [m], never too large.

        Args:
            lookup: The grid.
            R: Rotation of the body's frame.
            t: Its origin.
            coarse_distance_m: What the grid says of the coarse points.
        """
        best = coarse_distance_m.min() + self.cover_m
        near = np.flatnonzero(coarse_distance_m - self.radius_m < best)
        picked = np.concatenate(
            [np.arange(self.starts[i], self.starts[i + 1]) for i in near.tolist()]
        )
        return float(lookup.distance(self.fine_m[picked] @ R.T + t).min()) - self.cover_m


def shell_of(corners_m: Float[np.ndarray, "num_points 3"], fine_m: float = FINE_M) -> Shell:
    """Cover the convex hull of points so that nothing is farther from a fine one than asked."""
    hull = ConvexHull(corners_m)
    # A triangle with edges of at most e leaves nothing farther from its corners than e / sqrt(3).
    fine = _divided(corners_m[hull.simplices], fine_m * np.sqrt(3.0))
    tree = cKDTree(fine)
    free = np.ones(len(fine), dtype=bool)
    chosen = []
    for index in range(len(fine)):
        if free[index]:
            chosen.append(index)
            free[tree.query_ball_point(fine[index], COARSE_RATIO * fine_m)] = False
    coarse = fine[chosen]
    distance, owner = cKDTree(coarse).query(fine)
    order = np.argsort(owner, kind="stable")
    starts = np.searchsorted(owner[order], np.arange(len(coarse) + 1))
    radius = SLOPE * np.maximum.reduceat(distance[order], starts[:-1]) + fine_m
    return Shell(
        coarse_m=coarse, radius_m=radius, fine_m=fine[order], starts=starts, cover_m=fine_m
    )


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


class RobotShell:
    """The shells of a robot's links, looked up together."""

    def __init__(self, hulls: RobotHulls) -> None:
        """Cover every hull; ``shell_of_robot`` remembers."""
        self.shells = [
            shell_of(hull.points_m, FINE_M if hull.link in GRIPPER_LINKS else ARM_FINE_M)
            for hull in hulls.hulls
        ]
        counts = [len(shell.coarse_m) for shell in self.shells]
        self.starts = np.concatenate([[0], np.cumsum(counts)])
        self._link = np.repeat(np.arange(len(counts)), counts)
        self._coarse = np.concatenate([shell.coarse_m for shell in self.shells])
        self._radius = np.concatenate([shell.radius_m for shell in self.shells])

    def coarse_distances_m(
        self,
        lookup: GridLookup,
        R: Float[np.ndarray, "num_links 3 3"],
        t: Float[np.ndarray, "num_links 3"],
    ) -> Float[np.ndarray, " num_coarse"]:
        """What a grid says of the coarse points of all links; link i's begin at ``starts[i]``."""
        placed = np.einsum("nij,nj->ni", R[self._link], self._coarse) + t[self._link]
        return lookup.distance(placed).astype(np.float64)

    def bounds_m(
        self, coarse_distance_m: Float[np.ndarray, " num_coarse"]
    ) -> Float[np.ndarray, " num_links"]:
        """For each link a distance that it certainly keeps [m]."""
        return np.asarray(np.minimum.reduceat(coarse_distance_m - self._radius, self.starts[:-1]))


@lru_cache(maxsize=4)
def shell_of_robot(hulls: RobotHulls) -> RobotShell:
    """Return the shells of a robot, made once."""
    return RobotShell(hulls)
