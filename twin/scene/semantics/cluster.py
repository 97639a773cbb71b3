"""Points in voxels, and voxels that hang together."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from twin.scene.semantics.colour import lab_from_srgb


@dataclass(frozen=True, kw_only=True)
class SurfacePoints:
    """Coloured, oriented points of visible surfaces in the root frame."""

    p_m: Float[np.ndarray, "num_points 3"]
    normals: Float[np.ndarray, "num_points 3"]
    """Unit vectors out of the surface, towards whoever saw it."""
    colors: Float[np.ndarray, "num_points 3"]
    """sRGB, 0..1."""

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.p_m)

    def take(self, index: np.ndarray) -> "SurfacePoints":
        """Select points by a mask or by ids."""
        return SurfacePoints(
            p_m=self.p_m[index], normals=self.normals[index], colors=self.colors[index]
        )


@dataclass(frozen=True, kw_only=True)
class Voxels:
    """Means of the points of each occupied voxel."""

    p_m: Float[np.ndarray, "num_voxels 3"]
    normals: Float[np.ndarray, "num_voxels 3"]
    """Unit length where the normals of a voxel agree at all, else zero."""
    lab: Float[np.ndarray, "num_voxels 3"]
    count: Int[np.ndarray, " num_voxels"]
    of_point: Int[np.ndarray, " num_points"]
    """The voxel of each point."""

    def __len__(self) -> int:
        """Return the number of voxels."""
        return len(self.p_m)


def make_voxels(points: SurfacePoints, voxel_m: float) -> Voxels:
    """Average the points of each occupied voxel."""
    cells = np.floor(points.p_m / voxel_m).astype(np.int64)
    _, index, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    index = index.reshape(-1)
    normals = means_of(points.normals, index, len(count))
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return Voxels(
        p_m=means_of(points.p_m, index, len(count)),
        normals=np.where(length > 0.1, normals / np.maximum(length, 1e-9), 0.0),
        lab=means_of(lab_from_srgb(points.colors), index, len(count)),
        count=count,
        of_point=index,
    )


def means_of(
    values: Float[np.ndarray, "num_rows num_columns"],
    group: Int[np.ndarray, " num_rows"],
    num_groups: int,
) -> Float[np.ndarray, "num_groups num_columns"]:
    """Average the rows of each group; a group without rows gives zero."""
    count = np.maximum(np.bincount(group, minlength=num_groups), 1)
    sums = [np.bincount(group, weights=column, minlength=num_groups) for column in values.T]
    return np.asarray(np.stack(sums, axis=1) / count[:, None])


def neighbour_pairs(
    p_m: Float[np.ndarray, "num_voxels 3"], reach_m: float
) -> Int[np.ndarray, "num_pairs 2"]:
    """Pairs of points nearer than a distance, each once."""
    if len(p_m) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    pairs = cKDTree(p_m).query_pairs(reach_m, output_type="ndarray")
    return np.asarray(pairs, dtype=np.int64)


def components(
    num_nodes: int, pairs: Int[np.ndarray, "num_pairs 2"]
) -> Int[np.ndarray, " num_nodes"]:
    """Number the connected groups of a graph from 0, in the order of their first node."""
    weights = np.ones(len(pairs), dtype=np.int8)
    graph = coo_matrix((weights, (pairs[:, 0], pairs[:, 1])), shape=(num_nodes, num_nodes))
    _, labels = connected_components(graph, directed=False)
    return numbered(np.asarray(labels, dtype=np.int64))


def numbered(labels: Int[np.ndarray, " num_nodes"]) -> Int[np.ndarray, " num_nodes"]:
    """Renumber labels from 0 in the order in which they first appear."""
    _, first, index = np.unique(labels, return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[index.reshape(-1)]


def make_patches(
    voxels: Voxels, size_m: float
) -> tuple[
    Int[np.ndarray, " num_voxels"],
    Float[np.ndarray, "num_patches 3"],
    Float[np.ndarray, "num_patches 3"],
]:
    """Group voxels that are near and face the same way: patch of each, centres, normals."""
    cells = np.floor(voxels.p_m / size_m).astype(np.int64)
    axis = np.abs(voxels.normals).argmax(axis=1)
    forward = np.take_along_axis(voxels.normals, axis[:, None], axis=1)[:, 0] > 0
    keys = np.concatenate([cells, (2 * axis + forward)[:, None]], axis=1)
    _, patch = np.unique(keys, axis=0, return_inverse=True)
    patch = patch.reshape(-1)
    num = int(patch.max(initial=-1)) + 1
    normals = means_of(voxels.normals, patch, num)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return patch, means_of(voxels.p_m, patch, num), normals / np.maximum(length, 1e-9)
