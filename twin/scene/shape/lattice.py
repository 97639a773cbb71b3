"""A lattice of points and tetrahedra inside a shape, for soft bodies.

Cubes of 8-10 mm whose centre lies in the solid; nodes that stick out are drawn back to the
surface. Each cube is five tetrahedra, mirrored from cube to cube so that they fit together.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, Int, Int32
from scipy import ndimage

from twin.npz import UnreadableArraysError, read_npz, write_npz
from twin.scene.shape.carve import ShapeError
from twin.scene.shape.reconstruct import ObjectShape
from twin.scene.shape.sdf import SdfGrid

MAX_BYTES = 64_000_000
_NAMES = ("nodes_m", "tets", "mass_fraction", "spacing_m")
_CORNERS = np.array([[n & 1, n >> 1 & 1, n >> 2 & 1] for n in range(8)])
"""Corner number = x + 2 y + 4 z."""
_EVEN = ((0, 3, 5, 6), (1, 0, 3, 5), (2, 0, 3, 6), (4, 0, 5, 6), (7, 3, 5, 6))
_ODD = ((1, 2, 4, 7), (0, 1, 2, 4), (3, 1, 2, 7), (5, 1, 4, 7), (6, 2, 4, 7))
MIN_VOLUME_SHARE = 0.2
"""A tetrahedron keeps at least this share of its volume when nodes are drawn to the surface."""
SPACING_M = 0.009
"""Distance of neighbouring nodes."""


@dataclass(frozen=True, kw_only=True)
class Lattice:
    """Nodes and tetrahedra at rest, in the object's frame."""

    nodes_m: Float32[np.ndarray, "num_nodes 3"]
    tets: Int32[np.ndarray, "num_tets 4"]
    """Four nodes each; the volume is positive."""
    mass_fraction: Float32[np.ndarray, " num_nodes"]
    """Share of the object's mass at each node, by the volume around it; the sum is 1."""
    spacing_m: float

    def save(self, path: Path) -> None:
        """Write an npz file."""
        arrays = {name: np.asarray(getattr(self, name)) for name in _NAMES}
        write_npz(path, arrays)

    @staticmethod
    def load(path: Path) -> "Lattice":
        """Read what ``save`` wrote."""
        found = read_npz(path, _NAMES, MAX_BYTES)
        num = len(found["nodes_m"])
        shapes = [found[n].shape[1:] for n in ("nodes_m", "tets")] == [(3,), (4,)]
        is_number = found["tets"].dtype == np.int32 and found["spacing_m"].shape == ()
        if not shapes or not is_number:
            raise UnreadableArraysError(path=path, found="arrays that are no lattice")
        numbers = found["tets"].ravel()
        if len(numbers) and not (numbers.min() >= 0 and numbers.max() < num):
            raise UnreadableArraysError(path=path, found="a node that is not there")
        spacing = float(found.pop("spacing_m"))
        return Lattice(**found, spacing_m=spacing)


def tet_volumes_m3(
    nodes_m: Float[np.ndarray, "num_nodes 3"], tets: Int[np.ndarray, "num_tets 4"]
) -> Float[np.ndarray, " num_tets"]:
    """Signed volumes."""
    a, b, c, d = (nodes_m[tets[:, k]] for k in range(4))
    return np.asarray(np.einsum("ni,ni->n", np.cross(b - a, c - a), d - a) / 6)


def lattice(shape: ObjectShape, spacing_m: float = SPACING_M) -> Lattice:
    """Fill a shape with a lattice."""
    cells, first = _cells(shape, spacing_m)
    corners = cells[:, None] + _CORNERS
    index, number = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    number = number.reshape(-1, 8)
    tets = _tets(cells, number)
    regular = first + spacing_m * index.astype(np.float64)
    nodes = _drawn_in(regular, tets, shape.sdf)
    shares = np.zeros(len(nodes))
    np.add.at(shares, tets, tet_volumes_m3(nodes, tets)[:, None] / 4)
    return Lattice(
        nodes_m=nodes.astype(np.float32),
        tets=tets.astype(np.int32),
        mass_fraction=(shares / shares.sum()).astype(np.float32),
        spacing_m=spacing_m,
    )


def _cells(
    shape: ObjectShape, spacing_m: float
) -> tuple[Int[np.ndarray, "num_cells 3"], Float[np.ndarray, "3"]]:
    """Cubes whose centre is inside, the largest connected set, and the lattice's first node."""
    low, high = shape.vertices_m.min(axis=0), shape.vertices_m.max(axis=0)
    counts = np.maximum(np.rint((high - low) / spacing_m), 1.0).astype(int)
    first = (low + high) / 2 - counts * spacing_m / 2
    steps = [first[a] + (np.arange(counts[a]) + 0.5) * spacing_m for a in range(3)]
    centres = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1)
    solid = shape.sdf.distance(centres) < 0
    pieces, count = ndimage.label(solid)
    if count == 0:
        message = (
            f"no cube of {spacing_m * 1e3:.1f} mm has its centre in the shape, which is at most "
            f"{-2e3 * float(shape.sdf.values_m.min()):.1f} mm thick: choose a finer lattice."
        )
        raise ShapeError(message)
    sizes = np.bincount(pieces.ravel())
    sizes[0] = 0
    return np.argwhere(pieces == sizes.argmax()), first


def _tets(
    cells: Int[np.ndarray, "num_cells 3"], number: Int[np.ndarray, "num_cells 8"]
) -> Int[np.ndarray, "num_tets 4"]:
    odd = cells.sum(axis=1) % 2 == 1
    tets = np.concatenate(
        [
            number[rows][:, np.array(pattern)].reshape(-1, 4)
            for rows, pattern in ((~odd, _positive(_EVEN)), (odd, _positive(_ODD)))
        ]
    )
    return np.asarray(tets)


def _positive(pattern: tuple[tuple[int, ...], ...]) -> Int[np.ndarray, "5 4"]:
    """Order the corners of each tetrahedron so that its volume is positive."""
    tets = np.array(pattern)
    wrong = tet_volumes_m3(_CORNERS.astype(np.float64), tets) < 0
    tets[wrong] = tets[wrong][:, [0, 1, 3, 2]]
    return tets


def _drawn_in(
    nodes: Float[np.ndarray, "num_nodes 3"],
    tets: Int[np.ndarray, "num_tets 4"],
    sdf: SdfGrid,
) -> Float[np.ndarray, "num_nodes 3"]:
    """Move nodes outside of the solid to its surface, as far as no tetrahedron collapses."""
    target = nodes.copy()
    for _ in range(3):
        out = np.maximum(sdf.distance(target), 0.0)
        target -= out[:, None] * sdf.gradient(target)
    least = MIN_VOLUME_SHARE * tet_volumes_m3(nodes, tets)
    share = np.ones(len(nodes))
    moved = target
    while (bad := tet_volumes_m3(moved, tets) < least).any():
        share[np.unique(tets[bad])] *= 0.7
        share[share < 0.01] = 0.0
        moved = nodes + share[:, None] * (target - nodes)
    return np.asarray(moved)
