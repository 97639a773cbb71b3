"""A lattice finer than the task asks for is coarsened as it is loaded, and its surface follows."""

from collections.abc import Callable

import numpy as np
import pytest

from bridge.task.meshes.catalogue import toy_mesh
from bridge.task.meshes.lattice import volumes_m3
from bridge.task.task_file import ObjectModel, load_task
from twin.physics.soft import SoftModel, bind_points, coarse_lattice, health_of
from twin.physics.soft_solver import SoftSolver, add_body, box_piece
from twin.scene.shape.lattice import lattice
from twin.scene.shape.reconstruct import shape_of_mesh

Boxes = Callable[..., SoftModel]
PERIOD_S, SUBSTEPS = 1 / 240, 10


@pytest.fixture(scope="module")
def sloth() -> ObjectModel:
    return load_task("sloth_into_basket").objects["sloth"]


@pytest.fixture(scope="module")
def rebuilt(sloth: ObjectModel) -> dict[str, np.ndarray]:
    """The lattice of a sloth that was seen from all sides."""
    mesh = toy_mesh("sloth", sloth.size_m)
    return lattice(shape_of_mesh(mesh.vertices_m, mesh.triangles).sdf)


def test_a_fine_box_becomes_the_same_box_of_larger_cells(box_of_cells: Boxes) -> None:
    fine = box_of_cells((8, 6, 4), 0.007)
    found = coarse_lattice(fine.nodes_m, fine.tets, 0.014)
    assert found is not None
    coarse, spacing_m = found
    assert spacing_m == 0.014
    assert len(coarse.points_m) == 5 * 4 * 3
    volume_m3 = volumes_m3(coarse.points_m, coarse.tetrahedra).sum()
    assert volume_m3 == pytest.approx(fine.volume_m3(), rel=1e-3)
    np.testing.assert_allclose(np.ptp(coarse.points_m, axis=0), fine.size_m, atol=1e-5)


def test_what_is_not_finer_stays_as_it_is_whatever_its_label(box_of_cells: Boxes) -> None:
    model = box_of_cells((4, 3, 3), 0.012)
    assert coarse_lattice(model.nodes_m, model.tets, 0.014) is None


def test_a_thin_bridge_is_not_lost(box_of_cells: Boxes) -> None:
    fine = box_of_cells((15, 5, 5), 0.006)
    middle = fine.nodes_m[fine.tets].mean(axis=1)
    thick = (np.abs(middle[:, 0]) > 0.015) | (np.abs(middle[:, 1:]) < 0.003).all(axis=1)
    tets = np.ascontiguousarray(fine.tets[thick])
    used, index = np.unique(tets, return_inverse=True)
    found = coarse_lattice(fine.nodes_m[used], index.reshape(-1, 4).astype(np.int32), 0.020)
    if found is None:
        return
    ends = found[0].points_m[found[0].tetrahedra].mean(axis=1)[:, 0]
    between = np.abs(ends) < 0.010
    assert between.any(), "the halves came apart"
    assert found[1] < 0.020


def test_a_scene_lattice_is_taken_at_the_spacing_of_the_task(
    sloth: ObjectModel, rebuilt: dict[str, np.ndarray]
) -> None:
    assert sloth.soft is not None
    coarse, own = SoftModel.from_lattice(rebuilt, sloth), SoftModel.from_task(sloth)
    assert len(rebuilt["nodes_m"]) > 600
    assert len(coarse.nodes_m) < 1.5 * len(own.nodes_m)
    assert coarse.spacing_m == pytest.approx(sloth.soft.cell_m)
    volume = volumes_m3(rebuilt["nodes_m"].astype(np.float64), rebuilt["tets"]).sum()
    assert coarse.volume_m3() == pytest.approx(volume, rel=0.25)
    centre = coarse.mass_fraction @ coarse.nodes_m
    np.testing.assert_allclose(centre, rebuilt["mass_fraction"] @ rebuilt["nodes_m"], atol=0.003)
    assert SoftModel.from_lattice(rebuilt, sloth).nodes_m.tobytes() == coarse.nodes_m.tobytes()


def test_the_fine_surface_follows_the_coarse_nodes(
    sloth: ObjectModel, rebuilt: dict[str, np.ndarray]
) -> None:
    model = SoftModel.from_lattice(rebuilt, sloth)
    assert model.skin_m is not None
    np.testing.assert_allclose(
        np.ptp(model.skin_m, axis=0), np.ptp(rebuilt["nodes_m"], axis=0), atol=1e-6
    )
    rest = model.nodes_m.astype(np.float64)
    points = model.skin_m.astype(np.float64)
    skin = bind_points(points, rest, model.tets)
    np.testing.assert_allclose(skin.points_m(rest), points, atol=1e-6)
    np.testing.assert_allclose(skin.points_m(1.1 * rest + 0.2), 1.1 * points + 0.2, atol=1e-6)
    # No point hangs farther out than a cell: a lever would draw it wrongly.
    assert skin.weights.min() > -1.0


def dropped(model: SoftModel, height_m: float, steps: int) -> tuple[np.ndarray, int]:
    """Nodes after a fall onto a table, and the substeps that it took."""
    solver = SoftSolver(PERIOD_S, SUBSTEPS, 9.81)
    piece = box_piece(np.array([2.0, 2.0, 0.4]), np.eye(4))
    below = np.array([0, 0, -0.2, 0, 0, 0, 1.0])
    solver.add_collider(piece.planes, piece.corners_m, below, 0.8, 0.0, np.ones(3))
    T = np.eye(4)
    T[2, 3] = height_m
    index, _ = add_body(solver, model, T, young_pa=model.young_pa, friction=model.friction or 0.8)
    none = np.zeros(0, dtype=np.int32), np.zeros((0, 7))
    for _ in range(steps):
        solver.step(*none)
    return solver.nodes(index), solver.num_substeps()


@pytest.mark.parametrize(("young_pa", "mass_kg"), [(1e5, 0.02), (1e5, 0.1), (1e4, 0.02)])
def test_cells_of_half_the_size_get_twice_the_substeps_and_stay_sound(
    box_of_cells: Boxes, young_pa: float, mass_kg: float
) -> None:
    fine = box_of_cells((6, 6, 6), 0.007, young_pa=young_pa, mass_kg=mass_kg)
    coarse = box_of_cells((3, 3, 3), 0.014, young_pa=young_pa, mass_kg=mass_kg)
    nodes, substeps = dropped(fine, 0.06, 150)
    _, of_coarse = dropped(coarse, 0.06, 1)
    assert of_coarse >= SUBSTEPS
    assert substeps == pytest.approx(2 * of_coarse, rel=0.15)
    health = health_of(fine, nodes)
    assert health.sound, health.describe()
    assert health.max_stretch < 1.2
