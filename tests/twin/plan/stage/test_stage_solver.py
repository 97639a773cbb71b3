"""Stage optimisation: against SciPy, and its own promises."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

from bridge.geometry import se3
from twin.plan.problem import State
from twin.plan.stage import objective
from twin.plan.stage.solver import SolveConfig, distinct, draw_starts, solve

DOWN = np.diag([1.0, -1.0, -1.0, 1.0])
DOWN[:3, 3] = (0.5, 0.2, 0.12)
CENTRE = np.array([0.56, 0.2])


def height(state: State) -> object:
    return abs(state.T_base_tcp[:, 2, 3] - 0.1) - 0.005


def inside(state: State) -> object:
    """Two parts: along x and along y."""
    return abs(state.T_base_tcp[:, :2, 3] - CENTRE) - 0.03


def leaning(state: State) -> object:
    z = state.T_base_tcp[:, :3, 2]
    flat = (z[:, 0] ** 2 + z[:, 1] ** 2 + 1e-12) ** 0.5
    return np.arctan2(flat, -z[:, 2]) - np.radians(5.0)


def wide(state: State) -> object:
    return 0.07 - state.width_m


SUBGOAL = (
    objective.CostTerm(name="height", violation=height),
    objective.CostTerm(name="inside", violation=inside),
    objective.CostTerm(name="leaning", violation=leaning, scale=objective.ANGLE_RAD),
    objective.CostTerm(name="wide", violation=wide),
)
STAGE = objective.StageProblem(nominal_T_base_tcp=DOWN, nominal_width_m=0.05, subgoal=SUBGOAL)


def test_it_finds_what_slsqp_finds() -> None:
    """What is allowed lies beside the nominal pose, so there is one nearest point."""

    def cost(x: np.ndarray) -> float:
        T = objective.moved(DOWN[None], x[None, :6])
        return float(STAGE.cost(objective.Zeta(T_base_tcp=T, width_m=x[6:7]))[0])

    start = np.array([0.04, 0.0, -0.02, 0.0, 0.0, 0.0, 0.07])
    reference = minimize(cost, start, method="SLSQP", options={"ftol": 1e-14, "maxiter": 500})
    solution = solve(STAGE)
    assert solution.candidates[0].cost <= reference.fun * (1 + 1e-6)
    assert solution.candidates[0].cost == pytest.approx(reference.fun, rel=1e-3)
    assert solution.candidates[0].T_base_tcp[0, 3] == pytest.approx(0.53, abs=1e-3)
    assert solution.feasible.sum() >= 28


def test_answers_are_feasible_distinct_and_ordered() -> None:
    solution = solve(STAGE)
    assert len(solution.candidates) >= 5
    costs = [candidate.cost for candidate in solution.candidates]
    assert costs == sorted(costs)
    for index, one in enumerate(solution.candidates):
        assert max(one.violations) <= 0
        zeta = objective.Zeta(T_base_tcp=one.T_base_tcp[None], width_m=np.array([one.width_m]))
        assert all((parts <= 0).all() for parts in STAGE.violations(zeta))
        assert STAGE.cost(zeta)[0] == pytest.approx(one.cost)
        for other in solution.candidates[:index]:
            away = np.linalg.norm(one.T_base_tcp[:3, 3] - other.T_base_tcp[:3, 3])
            R = one.T_base_tcp[:3, :3].T @ other.T_base_tcp[:3, :3]
            assert away > objective.LENGTH_M or se3.rotation_angle_rad(R) > objective.ANGLE_RAD


def test_the_same_seed_gives_the_same_bytes() -> None:
    first, again, other = (solve(STAGE, seed=seed) for seed in (3, 3, 4))
    poses = [c.T_base_tcp.tobytes() for c in first.candidates]
    assert poses == [c.T_base_tcp.tobytes() for c in again.candidates]
    assert poses != [c.T_base_tcp.tobytes() for c in other.candidates]


def test_j_is_the_sum_of_the_paper() -> None:
    """Penalties of the positive part, tightened by the margin, and the regulariser, written out."""
    T = DOWN.copy()
    T[:3, 3] += (0.1, 0.0, 0.03)
    T[:3, :3] = T[:3, :3] @ se3.rotation_from_vector(np.array([0.0, 0.3, 0.0]))
    zeta = objective.Zeta(T_base_tcp=T[None], width_m=np.array([0.04]))
    f = [0.15 - 0.1 - 0.005, 0.6 - 0.56 - 0.03, 0.3 - np.radians(5.0), 0.07 - 0.04]
    x = np.array(f) / (0.01, 0.01, objective.ANGLE_RAD, 0.01) + objective.MARGIN
    omega = (0.1**2 + 0.03**2 + 0.01**2) / 0.01**2 + (0.3 / objective.ANGLE_RAD) ** 2
    wanted = (np.clip(x, 0.0, None) ** 2).sum() + objective.LAMBDA_REG * omega
    assert STAGE.cost(zeta)[0] == pytest.approx(wanted, rel=1e-5)


def test_what_contradicts_itself_has_no_answer_and_says_what_is_wrong() -> None:
    high = objective.CostTerm(name="high", violation=lambda state: 0.2 - state.T_base_tcp[:, 2, 3])
    solution = solve(replace(STAGE, subgoal=(*SUBGOAL, high)))
    assert solution.candidates == ()
    assert not solution.feasible.any()
    terms = zip((*SUBGOAL, high), solution.nearest.violations, strict=True)
    wrong = {term.name for term, f in terms if f > 0}
    assert wrong == {"height", "high"}


def test_what_is_carried_moves_with_the_tool() -> None:
    T_tcp_object = objective.moved(np.eye(4)[None], np.array([[0.01, 0.0, 0.03, 0.2, 0.0, 0.5]]))[0]
    seen = {}

    def look(state: State) -> object:
        seen.update(state.Ts_base_object)
        return state.T_base_tcp[:, 0, 3] - 1.0

    problem = objective.StageProblem(
        nominal_T_base_tcp=DOWN,
        nominal_width_m=0.05,
        subgoal=(objective.CostTerm(name="look", violation=look),),
        Ts_base_object={"box": np.eye(4)},
        Ts_tcp_object={"cube": T_tcp_object},
    )
    zeta = draw_starts(problem, SolveConfig(), 0)
    problem.violations(zeta)
    np.testing.assert_allclose(seen["cube"], zeta.T_base_tcp @ T_tcp_object)
    assert seen["box"].shape == (32, 4, 4)


def test_starts_come_from_above_where_that_is_asked() -> None:
    config = SolveConfig(only_above=True, num_starts=200)
    starts = draw_starts(STAGE, config, 0)
    assert (starts.T_base_tcp[:, 2, 3] >= DOWN[2, 3]).all()
    np.testing.assert_array_equal(starts.T_base_tcp[0], DOWN)
    assert np.ptp(draw_starts(STAGE, SolveConfig(), 0).T_base_tcp[:, 2, 3]) > 0.06


def test_the_first_of_those_that_are_alike_is_kept() -> None:
    Ts = np.repeat(np.eye(4)[None], 4, axis=0)
    Ts[1, 0, 3], Ts[2, 0, 3] = 0.009, 0.011
    Ts[3, :3, :3] = se3.rotation_from_vector(np.array([0.0, 0.0, np.radians(11.0)]))
    assert distinct(Ts, np.array([0, 1, 2, 3]), 16) == [0, 2, 3]
    assert distinct(Ts, np.array([1, 0, 2, 3]), 16) == [1, 3]
    assert distinct(Ts, np.array([1, 3]), 1) == [1]
