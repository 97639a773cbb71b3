"""Both engines against mechanics that can be worked out by hand, at the settings of replays."""

from collections.abc import Callable

import numpy as np
import pytest
from cells import ENGINES, HOME, at, cell, poses, push

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


def test_a_cantilever_bends_as_euler_and_bernoulli_say_the_finer_the_better(
    box_of_cells: Callable[..., SoftModel],
) -> None:
    coarse, bent, sheared = _beam(box_of_cells, (8, 2, 2), 0.014)
    fine, _, _ = _beam(box_of_cells, (16, 4, 4), 0.007)
    assert coarse / bent == pytest.approx(0.66, abs=0.05), "two cells across"
    assert fine / bent == pytest.approx(0.91, abs=0.05), "four cells across"
    too_stiff = [sheared / measured - 1 for measured in (coarse, fine)]
    assert too_stiff[1] / too_stiff[0] == pytest.approx(0.25, abs=0.05)
