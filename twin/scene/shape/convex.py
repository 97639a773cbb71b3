"""Convex hulls of points and of voxels."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import ConvexHull, QhullError

from twin.scene.shape.masked_view import ShapeError
from twin.scene.shape.mesh import Faces

_CUBE = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
NUM_DIRECTIONS = 160


@dataclass(frozen=True, kw_only=True)
class ConvexPart:
    """One convex solid."""

    vertices_m: Float[np.ndarray, "num_vertices 3"]
    faces: Faces
    """Counter-clockwise seen from outside."""
    planes: Float[np.ndarray, "num_planes 4"]
    """(unit normal, offset): inside where normal . p + offset <= 0."""
    volume_m3: float

    def contains(
        self, points_m: Float[np.ndarray, "num_points 3"], margin_m: float = 0.0
    ) -> Bool[np.ndarray, " num_points"]:
        """Say which points lie inside, or within a margin of every plane."""
        height = points_m @ self.planes[:, :3].T + self.planes[:, 3]
        return np.asarray((height <= margin_m).all(axis=1))


def hull_of_points(points_m: Float[np.ndarray, "num_points 3"]) -> ConvexPart:
    """Smallest convex solid that holds the points.

    Raises:
        ShapeError: When the points lie in a plane.
    """
    try:
        hull = ConvexHull(points_m)
    except (QhullError, ValueError) as error:
        message = f"{len(points_m)} points span no volume, so they have no convex hull."
        raise ShapeError(message) from error
    used = hull.vertices
    number = np.full(len(points_m), -1, dtype=np.int64)
    number[used] = np.arange(len(used))
    faces = hull.simplices.astype(np.int64)
    a, b, c = (points_m[faces[:, k]] for k in range(3))
    inwards = np.einsum("ni,ni->n", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    faces[inwards] = faces[inwards][:, ::-1]
    return ConvexPart(
        vertices_m=np.asarray(points_m[used], dtype=np.float64),
        faces=number[faces],
        planes=np.unique(hull.equations.round(12), axis=0),
        volume_m3=float(hull.volume),
    )


def thinned(points_m: Float[np.ndarray, "num_points 3"]) -> Float[np.ndarray, "num_kept 3"]:
    """The points that reach farthest in evenly spread directions: a hull of few vertices.

    Directions on a Fibonacci sphere; the axes are among them, so a box keeps its extents.
    """
    turn = np.arange(NUM_DIRECTIONS) * np.pi * (3.0 - np.sqrt(5.0))
    z = 1.0 - (2.0 * np.arange(NUM_DIRECTIONS) + 1.0) / NUM_DIRECTIONS
    r = np.sqrt(1.0 - z * z)
    directions = np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)
    directions = np.concatenate([directions, np.eye(3), -np.eye(3), 2.0 * _CUBE - 1.0])
    return np.asarray(points_m[np.unique((points_m @ directions.T).argmax(axis=0))])


def voxel_corners(voxels: Int[np.ndarray, "num_voxels 3"]) -> Int[np.ndarray, "num_corners 3"]:
    """Corners that can be vertices of the hull of voxels; voxel i covers [i, i + 1].

    A voxel between two others of its row is never extreme, so only the ends of rows are kept,
    along one axis after the other.
    """
    ends = voxels
    for axis in (2, 1, 0):
        ends = ends[_row_ends(ends, axis)]
    corners = (ends[:, None, :] + _CUBE).reshape(-1, 3)
    return np.asarray(np.unique(corners, axis=0))


def _row_ends(voxels: np.ndarray, axis: int) -> np.ndarray:
    others = [voxels[:, a] for a in range(3) if a != axis]
    order = np.lexsort((voxels[:, axis], *others))
    changed = np.zeros(len(voxels) + 1, dtype=bool)
    changed[[0, -1]] = True
    for rows in others:
        along = rows[order]
        changed[1:-1] |= along[1:] != along[:-1]
    keep = changed[:-1] | changed[1:]
    return np.asarray(order[keep])
