"""A soft body: tetrahedra that fill its shape."""

from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Bool, Float, Int

from bridge.errors import UsageError
from bridge.task.meshes.catalogue import ToyMesh
from bridge.task.meshes.solids import Solid, project

KEPT_DISTANCE = 0.20
"""A cell belongs to the body when its centre is less than this many cells outside."""
MOVED_FRACTION = 0.12
"""Largest step of one projection, in cells: the outer corners reach the surface, no cell folds."""
FLAT_FRACTION = 0.02
"""A tetrahedron with less than this share of a cell's volume is left out."""
CORNERS = tuple(product((0, 1), repeat=3))
# Five tetrahedra of a cube by its corners (x, y, z); every other cube is mirrored so that
# neighbours share the diagonals of their faces.
_EVEN = ((0, 3, 5, 6), (1, 0, 3, 5), (2, 0, 3, 6), (4, 0, 5, 6), (7, 3, 5, 6))
_ODD = tuple(tuple(7 - corner for corner in four) for four in _EVEN)


@dataclass(frozen=True, kw_only=True)
class Lattice:
    """Tetrahedra that fill a body at rest, in the frame of its object."""

    points_m: Float[np.ndarray, "num_points 3"]
    tetrahedra: Int[np.ndarray, "num_tetrahedra 4"]


def make_lattice(mesh: ToyMesh, cell_m: float) -> Lattice:
    """Fill a body with cells of about this size whose outer corners lie on its surface."""
    return fill(mesh.solid, mesh.vertices_m.min(axis=0), mesh.vertices_m.max(axis=0), cell_m)


def fill(
    solid: Solid, low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"], cell_m: float
) -> Lattice:
    """Fill a solid that a box just holds, as ``make_lattice``; the box is divided evenly."""
    counts = np.maximum(np.ceil((high - low) / cell_m).astype(int), 1)
    step = (high - low) / counts
    centres = np.stack(np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), axis=-1)
    distance = solid(low + step * (centres.reshape(-1, 3) + 0.5)).reshape(*counts)
    kept = distance < KEPT_DISTANCE * float(step.min())
    if not kept.any():
        raise UsageError(f"cells of {cell_m} m are too coarse for a body of {high - low} m.")
    cells = np.argwhere(kept)
    nodes = _node_ids(cells, counts + 1)
    used, index = np.unique(nodes, return_inverse=True)
    grid = np.stack(np.unravel_index(used, tuple(counts + 1)), axis=1)
    points = low + step * grid
    outer = _on_the_border(kept, grid)
    points[outer] = project(solid, points[outer], MOVED_FRACTION * float(step.min()))
    points = np.clip(points, low, high)
    tetrahedra = _tetrahedra(index.reshape(nodes.shape), cells)
    volume = volumes_m3(points, tetrahedra)
    flipped = volume < 0
    tetrahedra[flipped] = tetrahedra[flipped][:, [1, 0, 2, 3]]
    thick = np.abs(volume) > FLAT_FRACTION * float(np.prod(step))
    used, index = np.unique(tetrahedra[thick], return_inverse=True)
    return Lattice(points_m=points[used], tetrahedra=index.reshape(-1, 4))


def volumes_m3(
    points_m: Float[np.ndarray, "num_points 3"], tetrahedra: Int[np.ndarray, "num_tetrahedra 4"]
) -> Float[np.ndarray, " num_tetrahedra"]:
    """Signed volume of each tetrahedron; negative where the order of its corners is mirrored."""
    a, b, c, d = (points_m[tetrahedra[:, k]] for k in range(4))
    return np.asarray(np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a) / 6.0)


def _node_ids(
    cells: Int[np.ndarray, "num_cells 3"], shape: Int[np.ndarray, "3"]
) -> Int[np.ndarray, "num_cells 8"]:
    corners = cells[:, None, :] + np.array(CORNERS)
    return np.asarray(np.ravel_multi_index(tuple(np.moveaxis(corners, -1, 0)), tuple(shape)))


def _on_the_border(
    kept: Bool[np.ndarray, "nx ny nz"], grid: Int[np.ndarray, "num_nodes 3"]
) -> Bool[np.ndarray, " num_nodes"]:
    """Whether fewer than eight kept cells meet at a node."""
    padded = np.pad(kept, 1).astype(np.int64)
    around = np.zeros(len(grid), dtype=np.int64)
    for corner in CORNERS:
        i, j, k = (grid + np.array(corner)).T
        around += padded[i, j, k]
    return np.asarray(around < len(CORNERS))


def _tetrahedra(
    nodes: Int[np.ndarray, "num_cells 8"], cells: Int[np.ndarray, "num_cells 3"]
) -> Int[np.ndarray, "num_tetrahedra 4"]:
    odd = cells.sum(axis=1) % 2 == 1
    return np.concatenate(
        [nodes[~odd][:, four] for four in _EVEN] + [nodes[odd][:, four] for four in _ODD]
    )
