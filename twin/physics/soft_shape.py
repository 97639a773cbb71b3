"""Shapes of tetrahedra in motion: surface, rigid fit, and points that follow."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int, Int32
from scipy.sparse import csr_array


def rigid_fit(
    rest_m: Float[np.ndarray, "num_nodes 3"],
    nodes_m: Float[np.ndarray, "num_nodes 3"],
    mass_fraction: Float[np.ndarray, " num_nodes"],
) -> Float[np.ndarray, "4 4"]:
    """Rigid motion that brings the nodes at rest nearest to where they are: Kabsch (1976).

    Squared distances are weighted by mass. Nodes that are no numbers give a pose that is none.
    """
    T = np.eye(4)
    if not np.isfinite(nodes_m).all():
        T[:3] = np.nan
        return T
    weight = mass_fraction / mass_fraction.sum()
    middle_rest, middle = weight @ rest_m, weight @ nodes_m
    cross = ((nodes_m - middle) * weight[:, None]).T @ (rest_m - middle_rest)
    left, _, right = np.linalg.svd(cross)
    flip = np.diag([1.0, 1.0, float(np.sign(np.linalg.det(left @ right)))])
    T[:3, :3] = left @ flip @ right
    T[:3, 3] = middle - T[:3, :3] @ middle_rest
    return T


def surface_triangles(
    tets: Int32[np.ndarray, "num_tets 4"],
) -> Int32[np.ndarray, "num_triangles 3"]:
    """Faces that belong to one tetrahedron only, outward for positively oriented tetrahedra."""
    faces = np.concatenate([tets[:, list(f)] for f in ((1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1))])
    _, first, count = np.unique(
        np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True
    )
    return np.ascontiguousarray(faces[np.sort(first[count == 1])])


@dataclass(frozen=True, kw_only=True)
class Skin:
    """Points that follow the tetrahedra they lie in or nearest to."""

    node_ids: Int[np.ndarray, "num_points 4"]
    weights: Float[np.ndarray, "num_points 4"]

    def points_m(
        self, nodes_m: Float[np.ndarray, "num_nodes 3"]
    ) -> Float[np.ndarray, "num_points 3"]:
        """Where the points are."""
        return np.asarray(self._followed @ nodes_m[: self._followed.shape[1]])

    @cached_property
    def _followed(self) -> csr_array:
        rows = np.repeat(np.arange(len(self.node_ids)), 4)
        shape = (len(self.node_ids), int(self.node_ids.max()) + 1)
        return csr_array((self.weights.ravel(), (rows, self.node_ids.ravel())), shape=shape)


def bind_points(
    points_m: Float[np.ndarray, "num_points 3"],
    nodes_m: Float[np.ndarray, "num_nodes 3"],
    tets: Int32[np.ndarray, "num_tets 4"],
) -> Skin:
    """Barycentric coordinates in the tetrahedron that holds a point, or leaves it out the least."""
    corner = nodes_m[tets[:, 0]]
    to_weights = np.linalg.inv(np.swapaxes(nodes_m[tets[:, 1:]] - corner[:, None], 1, 2))
    best = np.full(len(points_m), -np.inf)
    weights, owner = np.zeros((len(points_m), 4)), np.zeros(len(points_m), dtype=np.int64)
    for index in range(len(tets)):
        inner = (points_m - corner[index]) @ to_weights[index].T
        found = np.concatenate([1.0 - inner.sum(axis=1, keepdims=True), inner], axis=1)
        least = found.min(axis=1)
        better = least > best
        best[better], owner[better], weights[better] = least[better], index, found[better]
    return Skin(node_ids=tets[owner].astype(np.int64), weights=weights)
