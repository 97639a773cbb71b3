"""Soft bodies as lattices of tetrahedra: geometry, coarser lattices, material, and health."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from jaxtyping import Float, Float32, Int, Int32
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from bridge.errors import UsageError
from bridge.geometry import se3
from bridge.task.meshes.catalogue import toy_mesh
from bridge.task.meshes.lattice import Lattice, fill, make_lattice, volumes_m3
from bridge.task.meshes.solids import Solid
from bridge.task.task_file import ObjectModel, SoftMaterial
from twin.errors import TwinError


def rigid_fit(
    rest_m: Float[np.ndarray, "num_nodes 3"],
    nodes_m: Float[np.ndarray, "num_nodes 3"],
    mass_fraction: Float[np.ndarray, " num_nodes"],
) -> Float[np.ndarray, "4 4"]:
    """Rigid motion that brings the nodes at rest nearest to where they are.

    Squared distances are weighted by mass. Nodes that are no numbers give a pose that is none.
    """
    if not np.isfinite(nodes_m).all():
        T = np.eye(4)
        T[:3] = np.nan
        return T
    return se3.align_rigid(rest_m, nodes_m, mass_fraction)


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


# A coarser lattice for a body whose own is finer than physics can pay for.
# Substeps shorten with the cells and their number grows with the cube: a lattice of half the
# spacing costs about sixteen times as much. What is drawn keeps its detail: the fine surface
# follows as skin.

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
    """Fill a lattice's solid with larger cells in one piece, spacing [m]; None: none are larger."""
    return _coarse_lattice(
        np.ascontiguousarray(nodes_m).tobytes(), np.ascontiguousarray(tets).tobytes(), cell_m
    )


@lru_cache(maxsize=16)
def _coarse_lattice(nodes: bytes, tets: bytes, cell_m: float) -> tuple[Lattice, float] | None:
    points = np.frombuffer(nodes, dtype=np.float32).reshape(-1, 3).astype(np.float64)
    fours = np.frombuffer(tets, dtype=np.int32).reshape(-1, 4)
    # A cube of five tetrahedra: the label of a lattice may be any number.
    spacing_m = float(np.cbrt(5 * volumes_m3(points, fours).mean()))
    if spacing_m >= FINER * cell_m:
        return None
    distance = _signed_distance(points, fours)
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


def _signed_distance(
    nodes_m: Float[np.ndarray, "num_nodes 3"], tets: Int32[np.ndarray, "num_tets 4"]
) -> Solid:
    """Distance to the surface of a lattice, negative inside.

    To samples of the surface, a sixth of an edge apart: what is as far as a cell is off by a
    hundredth of one.
    """
    corners = nodes_m[surface_triangles(tets)]
    steps = [(i, j) for i in range(_SPLIT + 1) for j in range(_SPLIT + 1 - i)]
    weights = np.array([(i, j, _SPLIT - i - j) for i, j in steps]) / _SPLIT
    surface = cKDTree(np.einsum("sk,tkc->tsc", weights, corners).reshape(-1, 3))
    middles = cKDTree(nodes_m[tets].mean(axis=1))
    corner = nodes_m[tets[:, 0]]
    to_weights = np.linalg.inv(np.swapaxes(nodes_m[tets[:, 1:]] - corner[:, None], 1, 2))

    def distance(p: Float[np.ndarray, "num_points 3"]) -> Float[np.ndarray, " num_points"]:
        away, _ = surface.query(p)
        _, near = middles.query(p, k=min(_NEAREST, middles.n))
        near = near.reshape(len(p), -1)
        inner = np.einsum("nkij,nkj->nki", to_weights[near], p[:, None] - corner[near])
        least = np.minimum(inner.min(axis=2), 1.0 - inner.sum(axis=2))
        return np.asarray(np.where((least >= -1e-9).any(axis=1), -away, away))

    return distance


POISSON_RANGE = (0.0, 0.45)
"""Beyond, a lattice of linear tetrahedra locks."""
MAX_STRETCH = 2.0
"""Edges longer than this many times their rest length belong to no sound body."""
BURST_STRETCH = 4.0
"""Edges longer than this many times their rest length belong to a body that burst. Toys are about
four cells thick: no finger that comes down on one can press a node farther away than that from its
neighbours."""
_EDGES = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))


class SoftBodyError(TwinError):
    """A soft body cannot be simulated."""

    def __init__(self, *, found: str) -> None:
        """Remember what was found."""
        self.found = found
        super().__init__(
            f"a soft body has {found}. Check the object's size, mass and soft table in the task "
            "file, or rebuild its lattice."
        )


@dataclass(frozen=True, kw_only=True)
class SoftModel:
    """A soft body at rest, in the frame of its object."""

    nodes_m: Float32[np.ndarray, "num_nodes 3"]
    tets: Int32[np.ndarray, "num_tets 4"]
    """Four nodes each, positively oriented."""
    mass_fraction: Float32[np.ndarray, " num_nodes"]
    """Share of the mass at each node; the sum is 1."""
    spacing_m: float
    """Distance of neighbouring nodes."""
    mass_kg: float
    young_pa: float
    poisson: float
    damping_s: float
    """Rayleigh damping: the stiffness times this resists the speed of deformation [s]."""
    size_m: tuple[float, float, float]
    """Outer extents at rest."""
    skin_m: Float32[np.ndarray, "num_points 3"] | None = None
    """Points of the true surface, which may lie outside of the lattice; None: the nodes."""

    def __post_init__(self) -> None:
        """Refuse what cannot be simulated."""
        low, high = POISSON_RANGE
        numbers = (self.mass_kg, self.young_pa, self.spacing_m)
        if len(self.tets) == 0:
            raise SoftBodyError(found="no tetrahedra")
        if not np.isfinite(self.nodes_m).all():
            raise SoftBodyError(found="nodes that are no numbers")
        if int(self.tets.min()) < 0 or int(self.tets.max()) >= len(self.nodes_m):
            raise SoftBodyError(found="a tetrahedron with a node that is not there")
        if not (volumes_m3(self.nodes_m.astype(np.float64), self.tets) > 0).all():
            raise SoftBodyError(found="tetrahedra without volume or turned inside out at rest")
        if not all(np.isfinite(value) and value > 0 for value in numbers):
            raise SoftBodyError(found=f"mass, stiffness and spacing of {numbers}")
        if not low <= self.poisson <= high:
            raise SoftBodyError(
                found=f"Poisson's ratio {self.poisson}; {low} to {high} can be simulated"
            )
        if not (np.isfinite(self.damping_s) and self.damping_s >= 0):
            raise SoftBodyError(found=f"a damping time of {self.damping_s} s")
        if not (self.mass_fraction > 0).all():
            raise SoftBodyError(found="nodes without mass")

    @staticmethod
    def from_task(model: ObjectModel) -> "SoftModel":
        """Fill the mesh that a task names with its own lattice (``bridge.task.meshes``)."""
        cell_m = _material(model).cell_m
        mesh = toy_mesh(model.mesh or "", model.size_m)
        skin = mesh.vertices_m.astype(np.float32)
        return _filled(model, make_lattice(mesh, cell_m), cell_m, skin)

    @staticmethod
    def from_lattice(arrays: Mapping[str, np.ndarray], model: ObjectModel) -> "SoftModel":
        """Take the lattice of a rebuilt scene (``twin.scene.shape.lattice``).

        One that is finer than the task asks for (``soft.cell_m``) is replaced by a coarser lattice
        of the same solid, with the fine surface as skin: docs/decisions/0017-contact-physics.md.
        """
        cell_m = _material(model).cell_m
        missing = [
            name for name in ("nodes_m", "tets", "mass_fraction", "spacing_m") if name not in arrays
        ]
        if missing:
            raise SoftBodyError(found=f"a lattice without {', '.join(missing)}")
        fine = _soft_model(
            model,
            np.asarray(arrays["nodes_m"], dtype=np.float32),
            np.asarray(arrays["tets"], dtype=np.int32),
            np.asarray(arrays["mass_fraction"], dtype=np.float32),
            float(arrays["spacing_m"]),
        )
        coarse = coarse_lattice(fine.nodes_m, fine.tets, cell_m)
        if coarse is None:
            return fine
        return _filled(model, *coarse, skin=fine.nodes_m[np.unique(fine.surface())])

    def volume_m3(self) -> float:
        """Volume of the tetrahedra at rest."""
        return float(volumes_m3(self.nodes_m.astype(np.float64), self.tets).sum())

    def surface(self) -> Int32[np.ndarray, "num_triangles 3"]:
        """Triangles of the surface, counter-clockwise seen from outside."""
        return surface_triangles(self.tets)

    @cached_property
    def rest_edges(self) -> tuple[Int[np.ndarray, "num_edges 2"], Float[np.ndarray, " num_edges"]]:
        """Edges of all tetrahedra, once each, the lower number first; and their lengths [m]."""
        # Asked for with every state of a replay: sorting them anew was a third of its time.
        pairs = np.concatenate([self.tets[:, list(pair)] for pair in _EDGES])
        edges = np.asarray(np.unique(np.sort(pairs, axis=1), axis=0))
        lengths = _lengths_m(self.nodes_m.astype(np.float64), edges)
        edges.setflags(write=False)
        lengths.setflags(write=False)
        return edges, lengths

    def slowest_mode_rad_s(self) -> float:
        """Estimate of the lowest frequency of deformation: a bar as long as the body.

        A free bar's first longitudinal mode, pi / length * sqrt(young / density).
        """
        density = self.mass_kg / self.volume_m3()
        return float(np.pi / max(self.size_m) * np.sqrt(self.young_pa / density))


def shape_of(model: ObjectModel, arrays: Mapping[str, np.ndarray] | None) -> SoftModel:
    """The lattice that a scene found of an object; without one the task's mesh, filled."""
    if arrays is None:
        return SoftModel.from_task(model)
    return SoftModel.from_lattice(arrays, model)


@dataclass(frozen=True, kw_only=True)
class SoftHealth:
    """Whether a soft body is still what it was."""

    num_inverted: int
    """Tetrahedra turned inside out."""
    max_stretch: float
    """Longest edge relative to its length at rest; infinite for a body that burst."""
    is_finite: bool

    @property
    def burst(self) -> bool:
        """It is no body any more; what comes after is noise."""
        return not self.is_finite or not self.max_stretch < BURST_STRETCH

    @property
    def sound(self) -> bool:
        """Nothing burst and nothing is inside out."""
        return self.is_finite and self.num_inverted == 0 and self.max_stretch < MAX_STRETCH

    def describe(self) -> str:
        """Say about what is wrong; empty when nothing is."""
        if not self.is_finite:
            return "it burst: its nodes are no numbers any more"
        if self.max_stretch >= MAX_STRETCH:
            return f"it burst: an edge is {self.max_stretch:.1f} times as long as at rest"
        if self.num_inverted:
            return f"{self.num_inverted} of its tetrahedra are turned inside out"
        return ""


def health_of(model: SoftModel, nodes_m: Float[np.ndarray, "num_nodes 3"]) -> SoftHealth:
    """Compare a body's nodes with its rest state."""
    if not np.isfinite(nodes_m).all():
        return SoftHealth(num_inverted=0, max_stretch=np.inf, is_finite=False)
    edges, rest_m = model.rest_edges
    now_m = _lengths_m(nodes_m, edges)
    return SoftHealth(
        num_inverted=_num_inverted(np.asarray(nodes_m, dtype=np.float64), model.tets),
        max_stretch=float((now_m / rest_m).max()),
        is_finite=True,
    )


def _lengths_m(
    points_m: Float[np.ndarray, "num_points 3"], edges: Int[np.ndarray, "num_edges 2"]
) -> Float[np.ndarray, " num_edges"]:
    between = points_m[edges[:, 0]] - points_m[edges[:, 1]]
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", between, between)))


def _num_inverted(
    nodes_m: Float[np.ndarray, "num_nodes 3"], tets: Int32[np.ndarray, "num_tets 4"]
) -> int:
    # By components: a cross product of NumPy costs more than everything else a state is asked.
    columns = np.ascontiguousarray(nodes_m.T)
    corner = columns[:, tets[:, 0]]
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = (columns[:, tets[:, k]] - corner for k in (1, 2, 3))
    volumes = (ay * bz - az * by) * cx + (az * bx - ax * bz) * cy + (ax * by - ay * bx) * cz
    return int((volumes <= 0).sum())


def _filled(
    model: ObjectModel,
    lattice: Lattice,
    spacing_m: float,
    skin: Float32[np.ndarray, "num_points 3"],
) -> SoftModel:
    """A body as heavy everywhere: a quarter of a tetrahedron's mass at each of its nodes."""
    nodes, tets = lattice.points_m.astype(np.float32), lattice.tetrahedra.astype(np.int32)
    shares = np.zeros(len(nodes))
    np.add.at(shares, tets, volumes_m3(nodes.astype(np.float64), tets)[:, None] / 4)
    mass_fraction = (shares / shares.sum()).astype(np.float32)
    return _soft_model(model, nodes, tets, mass_fraction, spacing_m, skin)


def _material(model: ObjectModel) -> SoftMaterial:
    if model.soft is None:
        raise SoftBodyError(found=f"no soft table: {model.id} is rigid")
    return model.soft


def _soft_model(
    model: ObjectModel,
    nodes: Float32[np.ndarray, "num_nodes 3"],
    tets: Int32[np.ndarray, "num_tets 4"],
    mass_fraction: Float32[np.ndarray, " num_nodes"],
    spacing_m: float,
    skin: Float32[np.ndarray, "num_points 3"] | None = None,
) -> SoftModel:
    soft = _material(model)
    return SoftModel(
        nodes_m=nodes,
        tets=tets,
        mass_fraction=mass_fraction,
        spacing_m=spacing_m,
        mass_kg=model.mass_kg,
        young_pa=soft.young_pa,
        poisson=soft.poisson,
        damping_s=soft.damping_s,
        size_m=model.size_m,
        skin_m=skin,
    )
