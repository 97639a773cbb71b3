"""Soft bodies obey mechanics: momentum, gravity, stiffness, friction, volume, the same bits."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from bridge.geometry import se3
from bridge.task.meshes.lattice import volumes_m3
from twin.physics.soft import BURST_STRETCH, MAX_STRETCH, SoftModel, health_of, rigid_fit
from twin.physics.soft_solver import SoftSolver, add_body, box_piece

PERIOD_S = 1 / 240
SUBSTEPS = 10
GRAVITY = 9.81
NONE = np.zeros(0, dtype=np.int32), np.zeros((0, 7))
Boxes = Callable[..., SoftModel]


def pose(x: float, y: float, z: float, turn_rad: float = 0.0) -> np.ndarray:
    """Position and a turn about y, as the solver takes it."""
    return np.array([x, y, z, 0, np.sin(turn_rad / 2), 0, np.cos(turn_rad / 2)])


def empty(gravity: float = GRAVITY, substeps: int = SUBSTEPS) -> SoftSolver:
    return SoftSolver(PERIOD_S, substeps, gravity)


def slab(solver: SoftSolver, at: np.ndarray, size_m: tuple[float, ...], friction: float) -> int:
    piece = box_piece(np.array(size_m), np.eye(4))
    return solver.add_collider(piece.planes, piece.corners_m, at, friction, 0.0, np.ones(3))


def put(
    solver: SoftSolver,
    model: SoftModel,
    *at: float,
    R: np.ndarray | None = None,
    friction: float = 1.0,
) -> tuple[int, np.ndarray]:
    T = np.eye(4)
    T[:3, :3] = np.eye(3) if R is None else R
    T[:3, 3] = at
    return add_body(solver, model, T, friction=friction)


def run(solver: SoftSolver, steps: int) -> None:
    for _ in range(steps):
        solver.step(*NONE)


def test_free_fall_is_half_g_t_squared(box_of_cells: Boxes) -> None:
    solver = empty()
    index, _ = put(solver, box_of_cells((3, 2, 2)), 0.4, -0.2, 1.0)
    before = solver.nodes(index)
    run(solver, 48)
    h, n = PERIOD_S / SUBSTEPS, 48 * SUBSTEPS
    fallen = GRAVITY * h * h * n * (n + 1) / 2  # semi-implicit Euler
    np.testing.assert_allclose(before[:, 2] - solver.nodes(index)[:, 2], fallen, rtol=1e-4)
    np.testing.assert_allclose(solver.velocities(index)[:, 2], -GRAVITY * 0.2, rtol=1e-4)
    assert fallen == pytest.approx(GRAVITY * 0.2**2 / 2, rel=0.01)


@pytest.mark.parametrize("damping_s", [0.0, 0.01])
def test_momentum_is_kept_without_contact(box_of_cells: Boxes, damping_s: float) -> None:
    solver = empty(gravity=0.0)
    model = box_of_cells((4, 2, 2), damping_s=damping_s)
    index, masses = put(solver, model, 0.0, 0.0, 0.0)
    v = np.random.default_rng(0).normal([0.3, 0.0, 0.0], 0.3, (len(masses), 3))
    solver.set_velocities(index, v)

    def momenta() -> np.ndarray:
        x, v = solver.nodes(index), solver.velocities(index)
        spin = masses[:, None] * np.cross(x, v)
        return np.concatenate([(masses[:, None] * v).sum(axis=0), spin.sum(axis=0)])

    before = momenta()
    run(solver, 120)
    scale = np.array([0.03 * 0.3] * 3 + [0.03 * 0.3 * 0.03] * 3)
    # The stress turns with the body one visit late: angular momentum is kept to a percent.
    np.testing.assert_allclose(momenta() / scale, before / scale, atol=0.02)


def test_rigid_motion_costs_nothing(box_of_cells: Boxes) -> None:
    solver = empty(gravity=0.0)
    model = box_of_cells((4, 4, 2))
    index, _ = put(solver, model, 0.0, 0.0, 0.0)
    omega, v0 = np.array([0.0, 0.0, 3.0]), np.array([0.1, 0.2, 0.0])
    solver.set_velocities(index, v0 + np.cross(omega, solver.nodes(index)))
    run(solver, 240)
    T = rigid_fit(
        model.nodes_m.astype(np.float64), solver.nodes(index), model.mass_fraction.astype(float)
    )
    np.testing.assert_allclose(T[:3, 3], v0, atol=2e-3)
    turned = se3.vector_from_rotation(T[:3, :3])
    np.testing.assert_allclose(turned, omega, atol=0.04)
    off = solver.nodes(index) - se3.apply(T, model.nodes_m.astype(np.float64))
    assert np.abs(off).max() < 1e-4


@pytest.mark.parametrize(
    ("young_pa", "mass_kg", "substeps"),
    [(6e4, 0.03, 5), (6e4, 0.03, 10), (6e4, 0.03, 20), (1e4, 0.1, 10), (1e5, 0.02, 10)],
)
def test_a_pressed_block_pushes_back_by_its_modulus(
    box_of_cells: Boxes, young_pa: float, mass_kg: float, substeps: int
) -> None:
    model = box_of_cells((4, 4, 3), young_pa=young_pa, mass_kg=mass_kg)
    solver = empty(gravity=0.0, substeps=substeps)
    slab(solver, pose(0, 0, -0.2), (2.0, 2.0, 0.4), 0.0)
    put(solver, model, 0.0, 0.0, 0.021)
    plate = slab(solver, pose(0, 0, 0.052), (0.2, 0.2, 0.02), 0.0)
    squeeze_m, speed_m_s, forces = 0.0021, 0.05, []
    for step in range(96):
        z = 0.052 - min(squeeze_m, (step + 1) * speed_m_s * PERIOD_S)
        solver.step(np.array([plate], dtype=np.int32), pose(0, 0, z)[None])
        forces.append(solver.pushes()[plate, 2] / PERIOD_S)
    strain = squeeze_m / 0.042
    # Neo-Hookean compression by 5 % is some percent stiffer than Hooke's line.
    measured = np.mean(forces[-24:]) / (0.056**2 * strain)
    assert measured == pytest.approx(young_pa, rel=0.15)


@pytest.mark.parametrize(("slope", "slides"), [(0.45, False), (0.55, True)])
def test_friction_holds_below_its_cone_and_slides_above(
    box_of_cells: Boxes, slope: float, slides: bool
) -> None:
    solver = empty()
    turn = np.arctan(slope)
    R = se3.rotation_from_vector(np.array([0.0, turn, 0.0]))
    slab(solver, np.concatenate([R @ [0, 0, -0.2], pose(0, 0, 0, turn)[3:]]), (4.0, 2.0, 0.4), 0.5)
    model = box_of_cells((4, 4, 2))
    index, _ = put(solver, model, *(R @ [0, 0, 0.014]), R=R)
    run(solver, 60)
    before = solver.nodes(index).mean(axis=0)
    run(solver, 120)
    moved = np.linalg.norm(solver.nodes(index).mean(axis=0) - before)
    if slides:
        speeding = GRAVITY * (np.sin(turn) - 0.5 * np.cos(turn))
        assert moved > 0.25 * speeding * 0.5**2 / 2
    else:
        assert moved < 5e-4


@pytest.mark.parametrize("young_pa", [1e4, 1e5])
@pytest.mark.parametrize("mass_kg", [0.02, 0.1])
def test_a_dropped_body_comes_to_rest_as_it_was(
    box_of_cells: Boxes, young_pa: float, mass_kg: float
) -> None:
    model = box_of_cells((4, 3, 4), young_pa=young_pa, mass_kg=mass_kg)
    solver = empty()
    table = slab(solver, pose(0, 0, -0.2), (2.0, 2.0, 0.4), 0.8)
    R = se3.rotation_from_vector(np.array([0.5, 0.3, 0.2]))
    index, _ = put(solver, model, 0.0, 0.0, 0.25, R=R)
    run(solver, 960)
    nodes = solver.nodes(index)
    assert np.linalg.norm(solver.velocities(index), axis=1).max() < 0.02
    assert nodes[:, 2].min() > -1e-3, "it sank into the table"
    assert table in solver.touched(index)
    health = health_of(model, nodes)
    assert health.sound, health.describe()
    volume = volumes_m3(nodes, model.tets).sum()
    assert volume == pytest.approx(model.volume_m3(), rel=0.05)
    T = rigid_fit(model.nodes_m.astype(np.float64), nodes, model.mass_fraction.astype(float))
    off = se3.apply(se3.invert(T), nodes) - model.nodes_m
    assert np.abs(off).max() < 0.005


def test_a_fast_body_does_not_pass_a_thin_wall(box_of_cells: Boxes) -> None:
    solver = empty(gravity=0.0)
    slab(solver, pose(0, 0, 0), (0.3, 0.3, 0.008), 0.5)
    index, masses = put(solver, box_of_cells((3, 3, 3)), 0.0, 0.0, 0.05)
    solver.set_velocities(index, np.tile([0.0, 0.0, -3.0], (len(masses), 1)))
    run(solver, 60)
    assert solver.nodes(index)[:, 2].min() > 0.003


def test_a_finger_that_comes_down_dents_a_toy_and_does_not_burst_it(box_of_cells: Boxes) -> None:
    solver = empty()
    slab(solver, pose(0, 0, -0.2), (2.0, 2.0, 0.4), 0.8)
    model = box_of_cells((5, 4, 4), young_pa=8e4)
    index, _ = put(solver, model, 0.0, 0.0, 0.028, friction=0.8)
    high, low, steps = 0.056 + 0.036, 0.016 + 0.035, 28
    finger = slab(solver, pose(0, 0.012, high), (0.02, 0.012, 0.07), 0.0)
    worst = 0.0
    for share in np.sin(np.linspace(0, np.pi, 2 * steps)) ** 2:
        at = pose(0, 0.012, high + share * (low - high))
        solver.step(np.array([finger], dtype=np.int32), at[None])
        worst = max(worst, health_of(model, solver.nodes(index)).max_stretch)
    run(solver, 120)
    assert MAX_STRETCH < worst < BURST_STRETCH, "far from rest, and a dent explains it"
    assert health_of(model, solver.nodes(index)).sound
    assert np.ptp(solver.nodes(index), axis=0) == pytest.approx(model.size_m, rel=0.05)


def test_bodies_stack_and_do_not_pass_each_other(box_of_cells: Boxes) -> None:
    solver = empty()
    slab(solver, pose(0, 0, -0.2), (2.0, 2.0, 0.4), 0.8)
    model = box_of_cells((4, 4, 3))
    first, _ = put(solver, model, 0.0, 0.0, 0.022)
    second, _ = put(solver, model, 0.004, 0.003, 0.085)
    run(solver, 360)
    low, high = solver.nodes(first), solver.nodes(second)
    gap = high[:, 2].min() - low[:, 2].max()
    assert abs(gap) < 2e-3
    assert np.linalg.norm(solver.velocities(second), axis=1).max() < 0.02


def test_a_soft_body_carries_a_rigid_one(box_of_cells: Boxes) -> None:
    solver = empty()
    slab(solver, pose(0, 0, -0.2), (2.0, 2.0, 0.4), 0.8)
    put(solver, box_of_cells((4, 4, 3)), 0.0, 0.0, 0.021)
    piece = box_piece(np.full(3, 0.04), np.eye(4))
    mass = 0.05
    cube = solver.add_collider(
        piece.planes, piece.corners_m, pose(0, 0, 0.063), 0.8, mass, np.full(3, 1.3e-5)
    )
    z, v, weights = 0.063, 0.0, []
    for _ in range(240):
        v -= GRAVITY * PERIOD_S
        z += v * PERIOD_S
        solver.step(np.array([cube], dtype=np.int32), pose(0, 0, z)[None])
        v += solver.pushes()[cube, 8]
        z += solver.pushes()[cube, 14]
        weights.append(solver.pushes()[cube, 2] / PERIOD_S)
    assert abs(v) < 0.05
    assert 0.055 < z < 0.0635
    assert np.mean(weights[-120:]) == pytest.approx(mass * GRAVITY, rel=0.1)


def test_a_body_that_burst_is_said_to_have_burst(box_of_cells: Boxes) -> None:
    model = box_of_cells((3, 2, 2))
    solver = empty()
    index, masses = put(solver, model, 0.0, 0.0, 0.1)
    solver.set_velocities(index, np.full((len(masses), 3), np.inf))
    run(solver, 2)
    health = health_of(model, solver.nodes(index))
    assert not health.sound
    assert "burst" in health.describe()
    stretched = model.nodes_m.astype(np.float64).copy()
    stretched[0] += 0.1
    assert not health_of(model, stretched).sound
    mirrored = health_of(model, model.nodes_m.astype(np.float64) * [-1, 1, 1])
    assert mirrored.num_inverted == len(model.tets)
    assert health_of(replace(model, young_pa=1.0), model.nodes_m.astype(np.float64)).sound
