"""Distances of soft bodies, which are given by their nodes.

A node inside a convex piece lies behind all of its planes; outside, the largest height over a
plane is a lower bound of the distance, exact over the faces. Between nodes nothing is known: a
body is as large as its nodes say.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull

from bridge.geometry import se3
from twin.replay.clearance.unnamed import Panel
from twin.robot.collision import RobotHulls


@dataclass(frozen=True, kw_only=True)
class Planes:
    """The faces of a convex piece, in the frame of its link."""

    normals: Float[np.ndarray, "num_planes 3"]
    """Outward, unit length."""
    offsets_m: Float[np.ndarray, " num_planes"]

    def distance_m(
        self,
        points_m: Float[np.ndarray, "num_points 3"],
        R: Float[np.ndarray, "3 3"],
        t: Float[np.ndarray, "3"],
    ) -> float:
        """Smallest signed distance of points to the placed piece [m], never too large outside."""
        local = (points_m - t) @ R
        return float((local @ self.normals.T + self.offsets_m).max(axis=1).min())


@lru_cache(maxsize=4)
def planes_of(hulls: RobotHulls) -> tuple[Planes, ...]:
    """Return the planes of each of a robot's hulls."""
    found = []
    for hull in hulls.hulls:
        equations = np.unique(ConvexHull(hull.points_m).equations.round(9), axis=0)
        found.append(Planes(normals=equations[:, :3], offsets_m=equations[:, 3]))
    return tuple(found)


def distance_to_box_m(points_m: Float[np.ndarray, "num_points 3"], panel: Panel) -> float:
    """Smallest signed distance of points to a box [m]."""
    T, extents = panel
    q = np.abs(se3.apply(se3.invert(T), points_m)) - extents / 2
    outside = np.linalg.norm(np.maximum(q, 0.0), axis=1)
    return float((outside + np.minimum(q.max(axis=1), 0.0)).min())
