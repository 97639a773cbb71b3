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


def distances_to_boxes_m(
    points_m: Float[np.ndarray, "num_points 3"],
    R_box_base: Float[np.ndarray, "num_boxes 3 3"],
    p_box_base: Float[np.ndarray, "num_boxes 3"],
    half_m: Float[np.ndarray, "num_boxes 3"],
) -> Float[np.ndarray, " num_boxes"]:
    """Smallest signed distance of points to each box around the origin of its frame [m]."""
    local = R_box_base @ points_m.T + p_box_base[:, :, None]
    q = np.abs(local) - half_m[:, :, None]
    out = np.maximum(q, 0.0)
    outside = np.sqrt(np.einsum("bcn,bcn->bn", out, out))
    return np.asarray((outside + np.minimum(q.max(axis=1), 0.0)).min(axis=1))
