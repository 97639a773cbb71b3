"""A lattice of points and tetrahedra inside a shape, for soft bodies."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, Int, Int32
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from bridge.errors import UsageError
from bridge.task.meshes.lattice import fill, volumes_m3
from twin.npz import UnreadableArraysError, read_npz, write_npz
from twin.scene.shape.carve import ShapeError
from twin.scene.shape.reconstruct import ObjectShape

MAX_BYTES = 64_000_000
_NAMES = ("nodes_m", "tets", "mass_fraction", "spacing_m")
SPACING_M = 0.009
"""Distance of neighbouring nodes, at most."""


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


def lattice(shape: ObjectShape) -> Lattice:
    """Fill a shape as the bodies of tasks are filled; of what hangs apart, the largest piece.

    Raises:
        ShapeError: When it is thinner than a cube of the lattice.
    """
    ends = shape.vertices_m.min(axis=0), shape.vertices_m.max(axis=0)
    try:
        filled = fill(shape.sdf.distance, *ends, SPACING_M)
    except UsageError as error:
        message = f"no lattice of {SPACING_M * 1e3:.1f} mm fits into the shape: choose a finer one."
        raise ShapeError(message) from error
    nodes, tets = _largest_piece(filled.points_m, filled.tetrahedra)
    shares = np.zeros(len(nodes))
    np.add.at(shares, tets, np.abs(volumes_m3(nodes, tets))[:, None] / 4)
    return Lattice(
        nodes_m=nodes.astype(np.float32),
        tets=tets.astype(np.int32),
        mass_fraction=(shares / shares.sum()).astype(np.float32),
        spacing_m=SPACING_M,
    )


def _largest_piece(
    nodes_m: Float[np.ndarray, "num_nodes 3"], tets: Int[np.ndarray, "num_tets 4"]
) -> tuple[Float[np.ndarray, "num_kept 3"], Int[np.ndarray, "num_kept_tets 4"]]:
    links = (np.ones(3 * len(tets)), (np.repeat(tets[:, 0], 3), tets[:, 1:].ravel()))
    _, piece = connected_components(coo_array(links, shape=(len(nodes_m), len(nodes_m))))
    kept = tets[piece[tets[:, 0]] == np.bincount(piece).argmax()]
    used, index = np.unique(kept, return_inverse=True)
    return nodes_m[used], index.reshape(-1, 4)
