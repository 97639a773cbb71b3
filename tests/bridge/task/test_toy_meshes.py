"""Meshes made from formulas: closed, outwards, of the size asked for, and always the same."""

from itertools import product

import numpy as np
import pytest

from bridge.errors import UsageError
from bridge.sources.standin.clutter import CLUTTER
from bridge.sources.standin.soft import cage_nodes, cage_weights
from bridge.task.meshes.catalogue import ToyMesh, basket_mesh, object_mesh, scaled_mesh, toy_mesh
from bridge.task.meshes.lattice import make_lattice, volumes_m3
from bridge.task.meshes.solids import OpenSurfaceError, is_closed, mesh_of
from bridge.task.meshes.toys import basket_parts
from bridge.task.task_file import load_task

SIZES = {
    "duck": (0.07, 0.05, 0.06),
    "sloth": (0.16, 0.10, 0.06),
    "mug": (0.08, 0.12, 0.095),
    "can": (0.076, 0.076, 0.11),
}
INNER_M, WALL_M = (0.24, 0.19, 0.085), 0.008


def all_meshes() -> dict[str, ToyMesh]:
    toys = {name: scaled_mesh(CLUTTER[name], size) for name, size in SIZES.items()}
    return {**toys, "basket": basket_mesh(INNER_M, WALL_M)}


def enclosed_m3(mesh: ToyMesh) -> float:
    """By the divergence theorem."""
    a, b, c = (mesh.vertices_m[mesh.triangles[:, k]] for k in range(3))
    return float(np.sum(np.einsum("ij,ij->i", a, np.cross(b, c))) / 6.0)


@pytest.mark.parametrize("name", [*SIZES, "basket"])
def test_every_edge_belongs_to_two_triangles_in_opposite_directions(name: str) -> None:
    triangles = all_meshes()[name].triangles
    assert is_closed(triangles)
    assert not is_closed(triangles[1:]), "a hole must be noticed"
    flipped = triangles.copy()
    flipped[0] = flipped[0][::-1]
    assert not is_closed(flipped), "a triangle seen from inside must be noticed"


def test_a_basket_that_many_grids_cut_badly_is_closed_on_another() -> None:
    """A drawn laboratory had it: the first five shifts of the grid give no closed surface."""
    scale = (0.9273804612549033, 1.0194105348968454, 1.1153609232615622)
    x_m, y_m, z_m = (size * part for size, part in zip((0.22, 0.17, 0.1), scale, strict=True))
    assert is_closed(basket_mesh((x_m, y_m, z_m), WALL_M).triangles)


def test_the_volume_is_that_of_the_solid_it_was_made_from() -> None:
    rng = np.random.default_rng(5)
    for mesh in all_meshes().values():
        low, high = mesh.vertices_m.min(axis=0), mesh.vertices_m.max(axis=0)
        points = rng.uniform(low, high, (60_000, 3))
        counted = float(np.mean(mesh.solid(points) < 0) * np.prod(high - low))
        assert counted == pytest.approx(enclosed_m3(mesh), rel=0.03)


@pytest.mark.parametrize("name", list(SIZES))
def test_a_toy_fills_its_outer_extents_around_the_origin(name: str) -> None:
    vertices = all_meshes()[name].vertices_m
    np.testing.assert_allclose(vertices.max(axis=0), np.array(SIZES[name]) / 2, atol=1e-12)
    np.testing.assert_allclose(vertices.min(axis=0), -np.array(SIZES[name]) / 2, atol=1e-12)


def test_the_solid_parts_of_the_basket_leave_its_cavity_free_and_close_its_walls() -> None:
    rng = np.random.default_rng(1)
    half = np.array(INNER_M) / 2
    points = rng.uniform(-1, 1, (4000, 3)) * (half - [0.012, 0.012, 0.001])
    points[:, 2] += WALL_M + half[2]
    rounded = (np.abs(points[:, 0]) > half[0] - 0.03) & (np.abs(points[:, 1]) > half[1] - 0.03)
    assert not inside_parts(points[~rounded]).any()
    angle = rng.uniform(0, 2 * np.pi, 100)
    # From the middle outwards in any direction, below the rim, something is in the way.
    reach = np.linspace(0.05, 0.2, 400)
    for a in angle:
        ray = np.stack([np.cos(a) * reach, np.sin(a) * reach, np.full(400, 0.05)], axis=1)
        assert inside_parts(ray).any()


def inside_parts(points: np.ndarray) -> np.ndarray:
    found = np.zeros(len(points), dtype=bool)
    for part in basket_parts(INNER_M, WALL_M):
        w, x, y, z = part.q_wxyz
        R = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        local = (points - part.centre_m) @ R
        found |= np.all(np.abs(local) < part.size_m / 2, axis=1)
    return found


def test_a_solid_that_leaves_its_grid_is_refused() -> None:
    with pytest.raises(OpenSurfaceError, match="no closed surface"):
        mesh_of(lambda p: p[:, 2] - 0.5, (0.0,) * 3, (1.0,) * 3, 0.2)


def test_an_unknown_mesh_and_a_box_without_one_are_refused() -> None:
    with pytest.raises(UsageError, match="basket, duck, sloth"):
        toy_mesh("elephant", (0.1, 0.1, 0.1))
    with pytest.raises(UsageError, match="not a mesh"):
        object_mesh(load_task("cube_into_box").objects["cube"])


@pytest.mark.parametrize(("name", "cell_m"), [("duck", 0.014), ("sloth", 0.016)])
def test_a_lattice_fills_its_body_without_folds(name: str, cell_m: float) -> None:
    mesh = toy_mesh(name, SIZES[name])
    lattice = make_lattice(mesh, cell_m)
    assert (volumes_m3(lattice.points_m, lattice.tetrahedra) > 0).all()
    filled_m3 = float(volumes_m3(lattice.points_m, lattice.tetrahedra).sum())
    assert filled_m3 == pytest.approx(enclosed_m3(mesh), rel=0.08)
    assert set(np.unique(lattice.tetrahedra)) == set(range(len(lattice.points_m)))
    assert np.ptp(lattice.points_m, axis=0) == pytest.approx(SIZES[name], rel=0.05)
    assert 50 < len(lattice.points_m) < 400


def test_neighbouring_cells_share_the_diagonals_of_their_faces() -> None:
    lattice = make_lattice(toy_mesh("duck", SIZES["duck"]), 0.014)
    faces: dict[tuple[int, ...], int] = {}
    for four in lattice.tetrahedra:
        for left_out in range(4):
            key = tuple(sorted(np.delete(four, left_out).tolist()))
            faces[key] = faces.get(key, 0) + 1
    assert max(faces.values()) == 2
    outer = np.array([key for key, count in faces.items() if count == 1])
    # A closed border: each of its edges has an even number of its triangles.
    edges = np.sort(np.concatenate([outer[:, [0, 1]], outer[:, [1, 2]], outer[:, [0, 2]]]), axis=1)
    _, counts = np.unique(edges, axis=0, return_counts=True)
    assert (counts % 2 == 0).all()


def test_cells_too_coarse_for_a_body_are_refused() -> None:
    with pytest.raises(UsageError, match="too coarse"):
        make_lattice(scaled_mesh(CLUTTER["mug"], SIZES["mug"]), 0.2)


def test_a_cage_reproduces_every_affine_motion_of_its_points() -> None:
    rng = np.random.default_rng(3)
    low, high = np.array([-0.1, -0.05, 0.0]), np.array([0.1, 0.06, 0.05])
    points = rng.uniform(low, high, (200, 3))
    nodes, weights = cage_nodes(low, high), cage_weights(points, low, high)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(weights @ nodes, points, atol=1e-12)
    A, b = rng.normal(size=(3, 3)), rng.normal(size=3)
    np.testing.assert_allclose(weights @ (nodes @ A.T + b), points @ A.T + b, atol=1e-12)
    assert [tuple(row) for row in (nodes - low) / (high - low)] == list(product((0, 1), repeat=3))
