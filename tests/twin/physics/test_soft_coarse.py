"""Soft bodies: lattices too fine are coarsened with their surface, and what two pads hold."""

from collections.abc import Callable
from dataclasses import dataclass

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
    index, _ = add_body(solver, model, T, friction=0.8)
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


PAD_M = (0.022, 0.014, 0.022)
TALL_M = (0.022, 0.014, 0.4)
WIDE_M = (0.2, 0.014, 0.022)
CLOSING, RESTING = 60, 30


def at(x: float, y: float, z: float) -> np.ndarray:
    return np.array([x, y, z, 0, 0, 0, 1.0])


@dataclass(frozen=True, kw_only=True)
class Held:
    """What became of a toy between two pads when the table under it went away."""

    fell_m: float
    pressed_N: float
    """By each pad, at the end."""
    carried_N: float
    """By both pads, at the end."""


def let_hang(
    model: SoftModel,
    *,
    friction: float,
    gravity: float,
    squeeze_m: float,
    pad_m: tuple[float, float, float] = PAD_M,
    hang_s: float = 0.25,
) -> Held:
    """Close two pads on a toy that lies on a smooth table, and take the table away."""
    _, width, height = model.size_m
    solver = SoftSolver(PERIOD_S, 10, gravity)
    pieces = [box_piece(np.array(size), np.eye(4)) for size in (pad_m, pad_m, (2.0, 2.0, 0.4))]
    mu = (friction, friction, 0.0)
    z, apart = height / 2, (width + pad_m[1]) / 2 + 0.001
    places = [at(0, apart, z), at(0, -apart, z), at(0, 0, -0.2)]
    ids = [
        solver.add_collider(p.planes, p.corners_m, place, f, 0.0, np.ones(3))
        for p, place, f in zip(pieces, places, mu, strict=True)
    ]
    T = np.eye(4)
    T[2, 3] = z
    index, _ = add_body(solver, model, T, friction=1.0)
    before = np.nan
    for step in range(CLOSING + RESTING + round(hang_s / PERIOD_S)):
        y = apart - (squeeze_m + 0.001) * min(1.0, (step + 1) / CLOSING)
        down = 0.4 * max(0, step - CLOSING - RESTING) * PERIOD_S
        if step == CLOSING + RESTING:
            before = solver.nodes(index)[:, 2].mean()
        solver.step(
            np.array(ids, dtype=np.int32),
            np.array([at(0, y, z), at(0, -y, z), at(0, 0, -0.2 - down)]),
        )
    pushes = solver.pushes()[ids[:2], :3] / PERIOD_S
    return Held(
        fell_m=float(before - solver.nodes(index)[:, 2].mean()),
        pressed_N=float(np.abs(pushes[:, 1]).mean()),
        carried_N=float(-pushes[:, 2].sum()),
    )


@pytest.mark.parametrize("friction", [0.3, 0.8])
@pytest.mark.parametrize("pad_m", [PAD_M, WIDE_M, TALL_M], ids=["finger", "wide", "tall"])
def test_a_toy_slips_when_it_weighs_more_than_friction_gives(
    box_of_cells: Boxes, friction: float, pad_m: tuple[float, float, float]
) -> None:
    model = box_of_cells((6, 3, 3), mass_kg=0.06)
    how = {"friction": friction, "squeeze_m": 0.003, "pad_m": pad_m}
    light = let_hang(model, gravity=1.0, **how)
    most = 2 * friction * light.pressed_N / model.mass_kg
    held, slips = (let_hang(model, gravity=share * most, **how) for share in (0.9, 1.1))
    assert held.fell_m < 0.01
    assert held.carried_N == pytest.approx(0.9 * most * model.mass_kg, rel=0.05)
    assert slips.fell_m > 0.05


def test_what_bulges_above_a_finger_does_not_hang_on_its_edge(box_of_cells: Boxes) -> None:
    model = box_of_cells((6, 3, 3), mass_kg=0.06)
    assert let_hang(model, friction=0.0, gravity=9.81, squeeze_m=0.0015).fell_m > 0.05


def test_a_toy_that_slides_is_held_back_by_friction_alone(box_of_cells: Boxes) -> None:
    model = box_of_cells((6, 3, 3), mass_kg=0.06)
    light = let_hang(model, friction=0.5, gravity=1.0, squeeze_m=0.003, pad_m=TALL_M)
    most = 2 * 0.5 * light.pressed_N / model.mass_kg
    slides = let_hang(
        model, friction=0.5, gravity=1.3 * most, squeeze_m=0.003, pad_m=TALL_M, hang_s=0.1
    )
    assert slides.carried_N == pytest.approx(2 * 0.5 * slides.pressed_N, rel=0.05)
