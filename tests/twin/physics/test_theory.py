"""Both engines against mechanics that can be worked out by hand, at the settings of replays.

One step is 1/240 s in PyBullet and half of that in MuJoCo. Both go by semi-implicit Euler, which is
of first order: a speed or a place is wrong by about the acceleration times half a step. Tolerances
are about twice what was measured; docs/replay.md holds the measured errors.
"""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from cells import ENGINES, HOME, at, cell, pendulum_urdf, poses, push, rotations

from bridge.geometry import se3
from twin.physics.soft import SoftModel
from twin.physics.soft_solver import SoftSolver, surface_samples

RATE_HZ = 240
G = 9.81
CUBE = np.array([0.04, 0.04, 0.04])
SLAB = np.array([0.06, 0.06, 0.02])
"""Flat: it slides before it tips, up to a friction of 3."""
STEP_S = {"pybullet": 1 / 240, "mujoco": 1 / 480}

each_engine = pytest.mark.parametrize("engine", ENGINES)


@each_engine
def test_what_falls_has_fallen_by_half_g_t_squared(engine: str) -> None:
    with cell(engine) as world:
        world.add_free("cube", CUBE, 0.05, at(2, 2, 2))
        fallen = 2 - poses(world, "cube", RATE_HZ // 2)[-1, 2]
    t = 0.5
    # Semi-implicit Euler falls by g t dt / 2 too far, and by nothing else.
    assert fallen == pytest.approx(G * t * t / 2 + G * t * STEP_S[engine] / 2, rel=1e-9)


@each_engine
@pytest.mark.parametrize(("mu", "speed_m_s"), [(0.3, 1.0), (0.09, 0.5)])
def test_what_slides_stops_after_v_squared_over_two_mu_g(
    engine: str, mu: float, speed_m_s: float
) -> None:
    root = mu**0.5  # coefficients of two partners are multiplied
    with cell(engine, object_friction=root, surface_friction=root) as world:
        world.add_table(0.0)
        world.add_free("slab", SLAB, 0.05, at(0.8, 0.3, 0.0101))
        world.reset_robot(HOME, 0.08)
        poses(world, "slab", RATE_HZ // 4)
        push(world, "slab", (speed_m_s, 0, 0), (0, 0, 0))
        x = poses(world, "slab", 2 * RATE_HZ)[:, 0]
    theory = speed_m_s**2 / (2 * mu * G)
    # Friction acts from the first step on, before anything has moved: v dt / 2 too short.
    assert x[-1] - x[0] == pytest.approx(theory - speed_m_s * STEP_S[engine] / 2, rel=2e-3)
    assert abs(x[-1] - x[-RATE_HZ // 4]) < 1e-6, "it creeps"


@each_engine
@pytest.mark.parametrize("mu", [0.09, 0.5])
@pytest.mark.parametrize("steeper_deg", [-2.0, 2.0, 5.0])
def test_an_incline_holds_below_the_friction_angle_and_not_above(
    engine: str, mu: float, steeper_deg: float
) -> None:
    slope, root = np.arctan(mu) + np.deg2rad(steeper_deg), mu**0.5
    R = se3.rotation_from_vector(np.array([0.0, slope, 0.0]))
    with cell(engine, object_friction=root, surface_friction=root) as world:
        world.add_static([(np.zeros(3), np.array([4.0, 1.0, 0.1]))], at(2, 0, 1, R))
        place = np.array([2, 0, 1]) + R @ np.array([-1.0, 0.0, 0.0601])
        world.add_free("slab", SLAB, 0.05, at(*place.tolist(), R))
        down = poses(world, "slab", RATE_HZ)[:, :3] @ R[:, 0]
    slid = down[-1] - down[0]
    if steeper_deg < 0:
        assert abs(slid) < 1e-4, "it begins 0.1 mm above the slope, and sinks in"
    else:
        # MuJoCo lifts what slides, by about mu v dt: it hops, and only its mean friction is mu.
        assert slid == pytest.approx(G * (np.sin(slope) - mu * np.cos(slope)) / 2, rel=0.015)


@each_engine
@pytest.mark.parametrize("swing_rad", [0.1, 1.0])
def test_a_pendulum_has_its_period_and_keeps_its_swing(engine: str, swing_rad: float) -> None:
    mass_kg, length_m, inertia = 1.0, 0.4, 0.02
    with cell(engine, pendulum_urdf(mass_kg, length_m, inertia)) as world:
        start = np.array([0, 0, 0, 0, 0, swing_rad])
        world.reset_robot(start, 0.05)
        angle = [swing_rad]
        for _ in range(6 * RATE_HZ):
            world.robot.command(np.zeros(6), np.zeros(6), 0.05)
            world.step()
            angle.append(float(world.robot.posture()[0][-1]))
    swing = np.array(angle)
    up = np.flatnonzero((swing[:-1] < 0) & (swing[1:] >= 0))
    crossed_s = (up - swing[up] / (swing[up + 1] - swing[up])) / RATE_HZ
    small_s = 2 * np.pi * np.sqrt((inertia + mass_kg * length_m**2) / (mass_kg * G * length_m))
    # The arithmetic-geometric mean gives the elliptic integral of a wide swing.
    period_s = small_s / _agm(1.0, float(np.cos(swing_rad / 2)))
    assert np.diff(crossed_s).mean() == pytest.approx(period_s, rel=5e-5)
    assert np.abs(swing[-RATE_HZ:]).max() == pytest.approx(swing_rad, rel=2e-3)


def _agm(a: float, b: float) -> float:
    return a if abs(a - b) < 1e-12 else _agm((a + b) / 2, (a * b) ** 0.5)


@each_engine
def test_a_collision_keeps_momentum_and_does_not_spring_back(engine: str) -> None:
    with cell(engine, gravity_m_s2=0.0) as world:
        world.add_free("light", CUBE, 0.05, at(1.0, 1, 1))
        world.add_free("heavy", CUBE, 0.1, at(1.1, 1, 1))
        push(world, "light", (0.5, 0, 0), (0, 0, 0))
        tracks = {"light": [], "heavy": []}
        for _ in range(RATE_HZ):
            world.step()
            for name, track in tracks.items():
                track.append(world.object_pose(name)[:3])
    speeds = {name: (np.array(t[-1]) - np.array(t[-2])) * RATE_HZ for name, t in tracks.items()}
    momentum = 0.05 * speeds["light"] + 0.1 * speeds["heavy"]
    np.testing.assert_allclose(momentum, [0.05 * 0.5, 0, 0], atol=1e-9)
    # No restitution is asked for; what a soft contact gives back of the speed is 2 and 9 %.
    assert 0 <= speeds["heavy"][0] - speeds["light"][0] < 0.1 * 0.5


@each_engine
def test_a_spinning_box_keeps_its_energy_for_three_seconds(engine: str) -> None:
    """Bullet's own damping takes 83 % of it."""
    size = np.array([0.04, 0.06, 0.1])
    with cell(engine, gravity_m_s2=0.0) as world:
        world.add_free("box", size, 0.05, at(1, 1, 1))
        push(world, "box", (0.5, 0, 0), (10.0, 0, 0))
        rows = poses(world, "box", 3 * RATE_HZ)
    energy, momentum = _spin(rows, size, 0.05)
    np.testing.assert_allclose(energy, energy[0], rtol=1e-6)
    np.testing.assert_allclose(momentum, np.tile(momentum[0], (len(momentum), 1)), atol=1e-9)
    assert rows[-1, 0] == pytest.approx(1 + 0.5 * 3, abs=1e-9)


@each_engine
def test_a_box_flips_about_its_middle_axis_when_euler_says(engine: str) -> None:
    """Dzhanibekov: rotation about the axis of middle inertia turns over, again and again."""
    size, mass_kg, omega = np.array([0.04, 0.06, 0.1]), 0.05, np.array([0.05, 8.0, 0.05])
    with cell(engine, gravity_m_s2=0.0) as world:
        world.add_free("box", size, mass_kg, at(1, 1, 1))
        push(world, "box", (0, 0, 0), omega)
        rows = poses(world, "box", 3 * RATE_HZ)
    energy, momentum = _spin(rows, size, mass_kg)
    about_middle = np.einsum("ni,ni->n", rotations(rows)[:-1, :, 1], momentum)
    flips_s = np.flatnonzero(np.diff(np.sign(about_middle))) / RATE_HZ
    np.testing.assert_allclose(flips_s[:1], _first_flip_s(size, mass_kg, omega), rtol=5e-3)
    # Of first order: 3 and 1.5 % of the energy, 1.5 and 0.8 % of the momentum with the flip.
    assert np.abs(energy / energy[0] - 1).max() < 0.045
    drift = np.linalg.norm(momentum - momentum[0], axis=1) / np.linalg.norm(momentum[0])
    assert drift.max() < 0.03


def _inertia(size: np.ndarray, mass_kg: float) -> np.ndarray:
    x, y, z = size**2
    return mass_kg / 12 * np.array([y + z, x + z, x + y])


def _spin(rows: np.ndarray, size: np.ndarray, mass_kg: float) -> tuple[np.ndarray, np.ndarray]:
    """Energy of rotation and angular momentum between poses, base frame."""
    R = rotations(rows)
    turn = np.array([se3.vector_from_rotation(b @ a.T) for a, b in pairwise(R)])
    local = np.einsum("nji,nj->ni", R[:-1], turn * RATE_HZ)
    L = _inertia(size, mass_kg) * local
    return (L * local).sum(axis=1) / 2, np.einsum("nij,nj->ni", R[:-1], L)


def _first_flip_s(size: np.ndarray, mass_kg: float, omega: np.ndarray) -> float:
    """When Euler's equations, by a Runge-Kutta of fourth order, turn the middle axis over."""
    inertia, t, h = _inertia(size, mass_kg), 0.0, 1e-3

    def rate(w: np.ndarray) -> np.ndarray:
        return -np.cross(w, inertia * w) / inertia

    while omega[1] > 0:
        a = rate(omega)
        b = rate(omega + h / 2 * a)
        c = rate(omega + h / 2 * b)
        omega = omega + h / 6 * (a + 2 * b + 2 * c + rate(omega + h * c))
        t += h
    return t


@each_engine
def test_a_stack_of_five_boxes_stays(engine: str) -> None:
    names = [f"box_{level}" for level in range(5)]
    with cell(engine) as world:
        world.add_table(0.0)
        for level, name in enumerate(names):
            # Staggered by a tenth of a box; each lies 0.2 mm above the next.
            x = 0.8 + 0.002 * (-1) ** level
            world.add_free(name, CUBE, 0.05, at(x, 0.3, 0.02 + 0.0402 * level))
        world.reset_robot(HOME, 0.08)
        poses(world, names[0], RATE_HZ)
        before = np.array([world.object_pose(name) for name in names])
        poses(world, names[0], 4 * RATE_HZ)
        after = np.array([world.object_pose(name) for name in names])
    # Bodies lie in each other by what carries them: PyBullet's slop, MuJoCo's softness.
    np.testing.assert_allclose(after[:, 2], 0.02 + 0.04 * np.arange(5), atol=8e-4)
    np.testing.assert_allclose(after[:, :3], before[:, :3], atol=1e-5)


# A cantilever of the soft solver. Tetrahedra whose strain is constant bend too stiffly: the error
# falls with the square of the cells across, not with shorter steps.


def _beam(
    box_of_cells: Callable[..., SoftModel], cells: tuple[int, int, int], cell_m: float
) -> tuple[float, float, float]:
    """What the end of a beam sinks by under a load [m]: here, by Euler and Bernoulli, with shear.

    The load is a kick in each step, which is small against the beam's own time: 0.1 m/s^2 times a
    step on the whole of it.
    """
    young_pa, load_N, poisson = 6e5, 0.02, 0.2
    length, width, height = (cell_m * n for n in cells)
    mass_kg = 300 * length * width * height
    model = box_of_cells(cells, cell_m, mass_kg=mass_kg, young_pa=young_pa, poisson=poisson)
    rest, surface = model.nodes_m.astype(np.float64), model.surface()
    clamped, end = (abs(rest[:, 0] - x) < 1e-6 for x in (-length / 2, length / 2))
    share = model.mass_fraction.astype(np.float64)
    masses = np.where(clamped, 1e5, mass_kg * share / share.sum())
    solver = SoftSolver(1 / RATE_HZ, 10, 0.0)
    body = solver.add_body(
        rest, rest, np.ascontiguousarray(model.tets), masses, surface_samples(surface),
        np.ascontiguousarray(surface), young_pa, poisson, 0.02, 0.0, 0.0, cell_m,
    )  # fmt: skip
    edge = np.isclose(np.abs(rest[end, 1:]), np.array([width, height]) / 2, atol=1e-6)
    area = np.prod(np.where(edge, 0.5, 1.0), axis=1)
    kick, sunk = load_N * area / area.sum() / masses[end] / RATE_HZ, []
    for step in range(5 * RATE_HZ // 2):
        v = np.array(solver.velocities(body))
        v[end, 2] -= kick * min(1.0, step / RATE_HZ)
        solver.set_velocities(body, v)
        solver.step(np.zeros(0, dtype=np.int32), np.zeros((0, 7)))
        sunk.append(float((rest[end, 2] - solver.nodes(body)[end, 2]).mean()))
    bent = load_N * length**3 / (3 * young_pa * width * height**3 / 12)
    sheared = load_N * length / (5 / 6 * young_pa / (2 + 2 * poisson) * width * height)
    return float(np.mean(sunk[-RATE_HZ // 2 :])), bent, bent + sheared


def test_a_cantilever_bends_with_the_cube_of_its_length(
    box_of_cells: Callable[..., SoftModel],
) -> None:
    short, _, _ = _beam(box_of_cells, (8, 2, 2), 0.014)
    long, _, _ = _beam(box_of_cells, (16, 2, 2), 0.014)
    assert np.log2(long / short) == pytest.approx(3.0, abs=0.05)


def test_a_cantilever_bends_as_euler_and_bernoulli_say_the_finer_the_better(
    box_of_cells: Callable[..., SoftModel],
) -> None:
    coarse, bent, sheared = _beam(box_of_cells, (8, 2, 2), 0.014)
    fine, _, _ = _beam(box_of_cells, (16, 4, 4), 0.007)
    assert coarse / bent == pytest.approx(0.66, abs=0.05), "two cells across"
    assert fine / bent == pytest.approx(0.91, abs=0.05), "four cells across"
    too_stiff = [sheared / measured - 1 for measured in (coarse, fine)]
    assert too_stiff[1] / too_stiff[0] == pytest.approx(0.25, abs=0.05)
