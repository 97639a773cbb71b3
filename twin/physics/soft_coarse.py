"""A coarser lattice for a body whose own is finer than physics can pay for.

Substeps shorten with the cells and their number grows with the cube: a lattice of half the spacing
costs about sixteen times as much. What is drawn keeps its detail: the fine surface follows as skin.
"""

from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from bridge.errors import UsageError
from bridge.task.meshes.lattice import Lattice, fill, volumes_m3
from twin.physics.soft_shape import surface_triangles

FINER = 0.75
"""Lattices are made coarser whose spacing is less than this share of the wanted one."""
_SPLIT = 6
"""Parts of a triangle's edge at which its surface is sampled."""
_NEAREST = 48
"""Tetrahedra by their middles among which the one that holds a point is looked for: in a lattice of
cubes, five each, it is among the 32 nearest."""
_ROUNDED = 1.00001
"""Nodes are in single precision: what is four cells long would else get five."""
_SHRINK = 0.85
"""Cells get smaller by this factor until the body is in one piece."""


def coarse_lattice(
    nodes_m: Float32[np.ndarray, "num_nodes 3"],
    tets: Int32[np.ndarray, "num_tets 4"],
    cell_m: float,
) -> tuple[Lattice, float] | None:
    """Fill the solid that a lattice fills with larger cells.

    Args:
        nodes_m: Nodes of the fine lattice at rest [m].
        tets: Its tetrahedra.
        cell_m: What the distance of neighbouring nodes should be [m].

    Returns:
        The coarse lattice in one piece and its spacing [m]; None where the fine one is the
        coarsest that is in one piece, or is not finer.
    """
    return _coarse_lattice(
        np.ascontiguousarray(nodes_m).tobytes(),
        np.ascontiguousarray(tets).tobytes(),
        cell_m,
    )


@lru_cache(maxsize=16)
def _coarse_lattice(nodes: bytes, tets: bytes, cell_m: float) -> tuple[Lattice, float] | None:
    points = np.frombuffer(nodes, dtype=np.float32).reshape(-1, 3).astype(np.float64)
    fours = np.frombuffer(tets, dtype=np.int32).reshape(-1, 4)
    # A cube of five tetrahedra: the label of a lattice may be any number.
    spacing_m = float(np.cbrt(5 * volumes_m3(points, fours).mean()))
    if spacing_m >= FINER * cell_m:
        return None
    distance = _SignedDistance(points, fours)
    while spacing_m < FINER * cell_m:
        try:
            found = fill(distance, points.min(axis=0), points.max(axis=0), cell_m * _ROUNDED)
        except UsageError:
            found = None
        if found is not None and _in_one_piece(found):
            return found, cell_m
        cell_m *= _SHRINK
    return None


def _in_one_piece(lattice: Lattice) -> bool:
    tets = lattice.tetrahedra
    pairs = np.concatenate([tets[:, [0, k]] for k in (1, 2, 3)])
    graph = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(lattice.points_m),) * 2)
    return int(connected_components(graph, directed=False)[0]) == 1


class _SignedDistance:
    """Distance to the surface of a lattice, negative inside.

    To samples of the surface, a sixth of an edge apart: what is as far as a cell is off by a
    hundredth of one.
    """

    def __init__(
        self, nodes_m: Float[np.ndarray, "num_nodes 3"], tets: Int32[np.ndarray, "num_tets 4"]
    ) -> None:
        corners = nodes_m[surface_triangles(tets)]
        steps = [(i, j) for i in range(_SPLIT + 1) for j in range(_SPLIT + 1 - i)]
        weights = np.array([(i, j, _SPLIT - i - j) for i, j in steps]) / _SPLIT
        self._surface = cKDTree(np.einsum("sk,tkc->tsc", weights, corners).reshape(-1, 3))
        self._middles = cKDTree(nodes_m[tets].mean(axis=1))
        self._corner = nodes_m[tets[:, 0]]
        edges = nodes_m[tets[:, 1:]] - self._corner[:, None]
        self._to_weights = np.linalg.inv(np.swapaxes(edges, 1, 2))

    def __call__(
        self, points_m: Float[np.ndarray, "num_points 3"]
    ) -> Float[np.ndarray, " num_points"]:
        distance, _ = self._surface.query(points_m)
        return np.asarray(np.where(self._inside(points_m), -distance, distance))

    def _inside(
        self, points_m: Float[np.ndarray, "num_points 3"]
    ) -> Bool[np.ndarray, " num_points"]:
        _, near = self._middles.query(points_m, k=min(_NEAREST, self._middles.n))
        near = near.reshape(len(points_m), -1)
        local = points_m[:, None] - self._corner[near]
        inner = np.einsum("nkij,nkj->nki", self._to_weights[near], local)
        least = np.minimum(inner.min(axis=2), 1.0 - inner.sum(axis=2))
        return np.asarray((least >= -1e-9).any(axis=1))
