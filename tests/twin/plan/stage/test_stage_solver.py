"""Stage optimisation: against SciPy, and its own promises."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

from bridge.geometry import se3
from bridge.task.relations import Measured
from twin.plan.constrain.constraint import Constraint, violated
from twin.plan.problem import State
from twin.plan.stage import solver

DOWN = np.diag([1.0, -1.0, -1.0, 1.0])
DOWN[:3, 3] = (0.5, 0.2, 0.12)
CENTRE = np.array([0.56, 0.2])


def height(state: State) -> list[Measured]:
    return [Measured("height", state.T_base_tcp[:, 2, 3], low=0.095, high=0.105)]


def inside(state: State) -> list[Measured]:
    """Two parts: along x and along y."""
    x, y = abs(state.T_base_tcp[:, :2, 3] - CENTRE).T
    return [Measured("x", x, high=0.03), Measured("y", y, high=0.03)]


def leaning(state: State) -> list[Measured]:
    z = state.T_base_tcp[:, :3, 2]
    flat = (z[:, 0] ** 2 + z[:, 1] ** 2 + 1e-12) ** 0.5
    off_rad = np.arctan2(flat, -z[:, 2])
    return [Measured("lean", off_rad, high=np.radians(5.0), unit="rad")]


def asked(measured: Callable[[State], list[Measured]], unit: str = "m") -> Constraint:
    return Constraint(record={"kind": "test"}, measured=measured, unit=unit)


SUBGOAL = (asked(height), asked(inside), asked(leaning, "rad"))
STAGE = solver.StageProblem(nominal_T_base_tcp=DOWN, subgoal=SUBGOAL)


def test_it_finds_what_slsqp_finds() -> None:
    """What is allowed lies beside the nominal pose, so there is one nearest point."""

    def cost(x: np.ndarray) -> float:
        return float(STAGE.judged(solver.moved(DOWN[None], x[None]))[1][0])

    start = np.array([0.04, 0.0, -0.02, 0.0, 0.0, 0.0])
    reference = minimize(cost, start, method="SLSQP", options={"ftol": 1e-14, "maxiter": 500})
    best = solver.solve(STAGE)[0]
    assert best.cost == pytest.approx(reference.fun, rel=1e-3)
    assert best.T_base_tcp[0, 3] == pytest.approx(0.53, abs=1e-3)


def test_answers_are_distinct_and_those_that_satisfy_everything_come_first() -> None:
    found = solver.solve(STAGE)
    assert found[0].is_feasible
    ranks = [(not state.is_feasible, state.cost) for state in found]
    assert ranks == sorted(ranks)
    for index, one in enumerate(found):
        holds, J = STAGE.judged(one.T_base_tcp[None])
        assert holds[0] == one.is_feasible
        assert J[0] == pytest.approx(one.cost)
        for other in found[:index]:
            away = np.linalg.norm(one.T_base_tcp[:3, 3] - other.T_base_tcp[:3, 3])
            R = one.T_base_tcp[:3, :3].T @ other.T_base_tcp[:3, :3]
            assert away > solver.LENGTH_M or se3.rotation_angle_rad(R) > solver.ANGLE_RAD


def test_the_same_seed_gives_the_same_bytes() -> None:
    first, again, other = (solver.drawn_around(DOWN, 8, seed).tobytes() for seed in (3, 3, 4))
    assert first == again != other
    one, two = (solver.solve(STAGE, seed=3)[0].T_base_tcp.tobytes() for _ in range(2))
    assert one == two


def test_j_is_the_sum_of_the_paper() -> None:
    """Penalties of the positive part, tightened by the margin, and the regulariser, written out."""
    T = DOWN.copy()
    T[:3, 3] += (0.1, 0.0, 0.03)
    T[:3, :3] = T[:3, :3] @ se3.rotation_from_vector(np.array([0.0, 0.3, 0.0]))
    f = [0.15 - 0.1 - 0.005, 0.6 - 0.56 - 0.03, 0.3 - np.radians(5.0)]
    x = np.array(f) / (0.01, 0.01, solver.ANGLE_RAD) + solver.MARGIN
    omega = (0.1**2 + 0.03**2) / 0.01**2 + (0.3 / solver.ANGLE_RAD) ** 2
    wanted = (np.clip(x, 0.0, None) ** 2).sum() + solver.LAMBDA_REG * omega
    holds, J = STAGE.judged(T[None])
    assert J[0] == pytest.approx(wanted, rel=1e-5)
    assert not holds[0]


def test_what_contradicts_itself_has_no_answer_and_says_what_is_wrong() -> None:
    high = asked(lambda state: [Measured("high", state.T_base_tcp[:, 2, 3], low=0.2)])
    found = solver.solve(replace(STAGE, subgoal=(*SUBGOAL, high)))
    assert not any(state.is_feasible for state in found)
    told = violated((*SUBGOAL, high), STAGE.state(found[0].T_base_tcp[None]))
    assert [text.split()[0] for text in told] == ["height", "high"]


def test_what_is_carried_moves_with_the_tool() -> None:
    T_tcp_object = solver.moved(np.eye(4)[None], np.array([[0.01, 0.0, 0.03, 0.2, 0.0, 0.5]]))[0]
    seen = {}

    def look(state: State) -> list[Measured]:
        seen.update(state.Ts_base_object)
        return [Measured("look", state.T_base_tcp[:, 0, 3], high=1.0)]

    problem = solver.StageProblem(
        nominal_T_base_tcp=DOWN,
        subgoal=(asked(look),),
        Ts_base_object={"box": np.eye(4)},
        Ts_tcp_object={"cube": T_tcp_object},
    )
    Ts = solver.drawn_around(DOWN, 32, 0)
    problem.judged(Ts)
    np.testing.assert_allclose(seen["cube"], Ts @ T_tcp_object)
    assert seen["box"].shape == (32, 4, 4)


def test_states_are_drawn_from_above_and_hardly_lean() -> None:
    Ts = solver.drawn_around(DOWN, 200, 0)
    assert (Ts[:, 2, 3] >= DOWN[2, 3]).all()
    assert (Ts[:, 2, 2] <= -np.cos(solver.SPREAD_RAD) + 1e-9).all()
    np.testing.assert_array_equal(Ts[0], DOWN)


def test_the_first_of_those_that_are_alike_is_kept() -> None:
    Ts = np.repeat(np.eye(4)[None], 4, axis=0)
    Ts[1, 0, 3], Ts[2, 0, 3] = 0.009, 0.011
    Ts[3, :3, :3] = se3.rotation_from_vector(np.array([0.0, 0.0, np.radians(11.0)]))
    assert solver.distinct(Ts, np.array([0, 1, 2, 3]), 16) == [0, 2, 3]
    assert solver.distinct(Ts, np.array([1, 0, 2, 3]), 16) == [1, 3]
    assert solver.distinct(Ts, np.array([1, 3]), 1) == [1]
