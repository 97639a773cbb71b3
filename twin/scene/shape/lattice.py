"""A lattice of points, springs and tetrahedra inside a shape, for soft bodies.

Cubes of 8-10 mm whose centre lies in the solid; nodes that stick out are drawn back to the
surface. Each cube is five tetrahedra, mirrored from cube to cube so that they fit together.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, Int, Int32
from scipy import ndimage
from scipy.spatial import cKDTree

from bridge.errors import refuse_outside
from twin.scene.shape.carve import ShapeError
from twin.scene.shape.reconstruct import ObjectShape
from twin.scene.shape.sdf import SdfGrid
from twin.scene.store.npz import UnreadableArraysError, read_npz, write_npz

MAX_BYTES = 64_000_000
_NAMES = ("nodes_m", "springs", "rest_lengths_m", "tets", "mass_fraction", "spacing_m")
_CORNERS = np.array([[n & 1, n >> 1 & 1, n >> 2 & 1] for n in range(8)])
"""Corner number = x + 2 y + 4 z."""
_EVEN = ((0, 3, 5, 6), (1, 0, 3, 5), (2, 0, 3, 6), (4, 0, 5, 6), (7, 3, 5, 6))
_ODD = ((1, 2, 4, 7), (0, 1, 2, 4), (3, 1, 2, 7), (5, 1, 4, 7), (6, 2, 4, 7))
MIN_VOLUME_SHARE = 0.2
"""A tetrahedron keeps at least this share of its volume when nodes are drawn to the surface."""


@dataclass(frozen=True, kw_only=True)
class LatticeConfig:
    """How fine the lattice is."""

    spacing_m: float = 0.009
    """Distance of neighbouring nodes."""
    neighbours: int = 12
    """Each node has springs to so many nearest others."""
    reach_spacings: float = 1.8
    """Springs are no longer than this."""

    def __post_init__(self) -> None:
        """Refuse lattices that are none."""
        allowed = {
            "spacing_m": (1e-3, 0.1),
            "neighbours": (3, 64),
            "reach_spacings": (1.0, 4.0),
        }
        refuse_outside(self, allowed)


@dataclass(frozen=True, kw_only=True)
class Lattice:
    """Nodes, springs and tetrahedra at rest, in the object's frame."""

    nodes_m: Float32[np.ndarray, "num_nodes 3"]
    springs: Int32[np.ndarray, "num_springs 2"]
    """Pairs of nodes, the lower number first; the edges of all tetrahedra are among them."""
    rest_lengths_m: Float32[np.ndarray, " num_springs"]
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
        """Read what ``save`` wrote.

        Raises:
            UnreadableArraysError: When it is damaged, too large, or no lattice.
        """
        found = read_npz(path, _NAMES, MAX_BYTES)
        num = len(found["nodes_m"])
        kinds = [found[n].dtype for n in ("springs", "tets")] == [np.dtype(np.int32)] * 2
        shapes = [found[n].shape[1:] for n in ("nodes_m", "springs", "tets")] == [(3,), (2,), (4,)]
        if not kinds or not shapes or found["spacing_m"].shape != ():
            raise UnreadableArraysError(path=path, found="arrays that are no lattice")
        numbers = np.concatenate([found["springs"].ravel(), found["tets"].ravel()])
        if len(numbers) and not (numbers.min() >= 0 and numbers.max() < num):
            raise UnreadableArraysError(path=path, found="a spring to a node that is not there")
        spacing = float(found.pop("spacing_m"))
        return Lattice(**found, spacing_m=spacing)


def tet_volumes_m3(
    nodes_m: Float[np.ndarray, "num_nodes 3"], tets: Int[np.ndarray, "num_tets 4"]
) -> Float[np.ndarray, " num_tets"]:
    """Signed volumes.

    Args:
        nodes_m: Where the nodes are.
        tets: Node indices of each tetrahedron; their order decides the sign.
    """
    a, b, c, d = (nodes_m[tets[:, k]] for k in range(4))
    return np.asarray(np.einsum("ni,ni->n", np.cross(b - a, c - a), d - a) / 6)


def lattice(shape: ObjectShape, config: LatticeConfig | None = None) -> Lattice:
    """Fill a shape with a lattice.

    Args:
        shape: From ``reconstruct``.
        config: Settings; the defaults when None.

    Raises:
        ShapeError: When the shape is thinner than the spacing everywhere.
    """
    config = LatticeConfig() if config is None else config
    cells, first = _cells(shape, config.spacing_m)
    corners = cells[:, None] + _CORNERS
    index, number = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    number = number.reshape(-1, 8)
    tets = _tets(cells, number)
    regular = first + config.spacing_m * index.astype(np.float64)
    nodes = _drawn_in(regular, tets, shape.sdf)
    springs = _springs(nodes, tets, shape.sdf, config)
    lengths = np.linalg.norm(nodes[springs[:, 0]] - nodes[springs[:, 1]], axis=1)
    shares = np.zeros(len(nodes))
    np.add.at(shares, tets, tet_volumes_m3(nodes, tets)[:, None] / 4)
    return Lattice(
        nodes_m=nodes.astype(np.float32),
        springs=springs.astype(np.int32),
        rest_lengths_m=lengths.astype(np.float32),
        tets=tets.astype(np.int32),
        mass_fraction=(shares / shares.sum()).astype(np.float32),
        spacing_m=config.spacing_m,
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


def _springs(
    nodes: Float[np.ndarray, "num_nodes 3"],
    tets: Int[np.ndarray, "num_tets 4"],
    sdf: SdfGrid,
    config: LatticeConfig,
) -> Int[np.ndarray, "num_springs 2"]:
    """Edges of the tetrahedra, and nearest neighbours with solid half way between them."""
    pairs = [tets[:, [a, b]] for a, b in ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))]
    count = min(config.neighbours + 1, len(nodes))
    reach = config.reach_spacings * config.spacing_m
    distance, other = cKDTree(nodes).query(nodes, k=count, distance_upper_bound=reach)
    found = np.isfinite(distance[:, 1:])
    near = np.stack([np.nonzero(found)[0], other[:, 1:][found]], axis=1)
    middle = nodes[near].mean(axis=1)
    # Without this an arm that hangs beside the body would be tied to it.
    pairs.append(near[sdf.distance(middle) < sdf.voxel_m])
    return np.asarray(np.unique(np.sort(np.concatenate(pairs), axis=1), axis=0))
