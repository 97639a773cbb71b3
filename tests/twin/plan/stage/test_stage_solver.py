"""Stage optimisation: against SciPy, against torch, and its own promises."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

from bridge.errors import UsageError
from bridge.geometry import se3
from twin.plan.constrain.arrays import like, namespace
from twin.plan.problem import State
from twin.plan.stage.motion import interpolated, moved, rotation_vector
from twin.plan.stage.objective import (
    ANGLE_RAD,
    LENGTH_M,
    CostTerm,
    StageProblem,
    Zeta,
    worst_of,
    zeta_of,
)
from twin.plan.stage.solver import (
    NumpyBackend,
    SolveConfig,
    TorchBackend,
    distinct,
    draw_starts,
    solve,
)

DOWN = np.diag([1.0, -1.0, -1.0, 1.0])
DOWN[:3, 3] = (0.5, 0.2, 0.12)
CENTRE = np.array([0.56, 0.2])


def height(state: State) -> object:
    return abs(state.T_base_tcp[:, 2, 3] - 0.1) - 0.005


def inside(state: State) -> object:
    """Two parts: along x and along y."""
    return abs(state.T_base_tcp[:, :2, 3] - like(CENTRE, state.T_base_tcp)) - 0.03


def leaning(state: State) -> object:
    z = state.T_base_tcp[:, :3, 2]
    flat = (z[:, 0] ** 2 + z[:, 1] ** 2 + 1e-12) ** 0.5
    return namespace(z).arctan2(flat, -z[:, 2]) - np.radians(5.0)


def wide(state: State) -> object:
    return 0.07 - state.width_m


SUBGOAL = (
    CostTerm(name="height", violation=height),
    CostTerm(name="inside", violation=inside, weight=2.0),
    CostTerm(name="leaning", violation=leaning, scale=ANGLE_RAD),
    CostTerm(name="wide", violation=wide, penalty="huber"),
)
STAGE = StageProblem(nominal_T_base_tcp=DOWN, nominal_width_m=0.05, subgoal=SUBGOAL)


def test_it_finds_what_slsqp_finds() -> None:
    """What is allowed lies beside the nominal pose, so there is one nearest point."""

    def cost(x: np.ndarray) -> float:
        T = moved(DOWN[None], x[None, :6])
        return float(STAGE.cost(Zeta(T_base_tcp=T, width_m=x[6:7]))[0])

    start = np.array([0.04, 0.0, -0.02, 0.0, 0.0, 0.0, 0.07])
    reference = minimize(cost, start, method="SLSQP", options={"ftol": 1e-14, "maxiter": 500})
    solution = solve(STAGE)
    assert solution.candidates[0].cost <= reference.fun * (1 + 1e-6)
    assert solution.candidates[0].cost == pytest.approx(reference.fun, rel=1e-3)
    assert solution.candidates[0].T_base_tcp[0, 3] == pytest.approx(0.53, abs=1e-3)
    assert solution.feasible.sum() >= 28
    assert np.isclose(solution.costs, reference.fun, rtol=1e-3).sum() >= 28


def test_answers_are_feasible_distinct_and_ordered() -> None:
    solution = solve(STAGE)
    assert len(solution.candidates) >= 5
    costs = [candidate.cost for candidate in solution.candidates]
    assert costs == sorted(costs)
    for index, one in enumerate(solution.candidates):
        assert one.feasible
        zeta = zeta_of([one.T_base_tcp], [one.width_m])
        assert all((parts <= 0).all() for parts in STAGE.violations(zeta))
        assert STAGE.cost(zeta)[0] == pytest.approx(one.cost)
        for other in solution.candidates[:index]:
            away = np.linalg.norm(one.T_base_tcp[:3, 3] - other.T_base_tcp[:3, 3])
            R = one.T_base_tcp[:3, :3].T @ other.T_base_tcp[:3, :3]
            assert away > LENGTH_M or se3.rotation_angle_rad(R) > ANGLE_RAD


def test_the_same_seed_gives_the_same_bytes() -> None:
    first, again, other = (solve(STAGE, seed=seed) for seed in (3, 3, 4))
    poses = [c.T_base_tcp.tobytes() for c in first.candidates]
    assert poses == [c.T_base_tcp.tobytes() for c in again.candidates]
    assert first.work == again.work
    assert poses != [c.T_base_tcp.tobytes() for c in other.candidates]


def test_j_is_the_sum_of_the_paper() -> None:
    """Weights, penalties of the positive part, and the regulariser, written out."""
    T = DOWN.copy()
    T[:3, 3] += (0.1, 0.0, 0.03)
    T[:3, :3] = T[:3, :3] @ se3.rotation_from_vector(np.array([0.0, 0.3, 0.0]))
    zeta = zeta_of([T], [0.04])
    problem = replace(STAGE, margin=0.0, lambda_reg=0.01)
    f = [0.15 - 0.1 - 0.005, 0.6 - 0.56 - 0.03, 0.3 - np.radians(5.0), 0.07 - 0.04]
    x = np.array(f) / (0.01, 0.01, ANGLE_RAD, 0.01)
    penalties = x[0] ** 2 + 2.0 * x[1] ** 2 + x[2] ** 2 + (2 * x[3] - 1)
    omega = (0.1**2 + 0.03**2 + 0.01**2) / 0.01**2 + (0.3 / ANGLE_RAD) ** 2
    assert problem.cost(zeta)[0] == pytest.approx(penalties + 0.01 * omega, rel=1e-5)


def test_what_contradicts_itself_has_no_answer_and_says_what_is_wrong() -> None:
    high = CostTerm(name="high", violation=lambda state: 0.2 - state.T_base_tcp[:, 2, 3])
    solution = solve(replace(STAGE, subgoal=(*SUBGOAL, high)))
    assert solution.candidates == ()
    assert not solution.feasible.any()
    wrong = {name for name, f in solution.nearest.violations.items() if f > 0}
    assert wrong == {"height", "high"}


def ball(state: State) -> object:
    """Positive inside of a ball that lies on the straight way."""
    p = state.T_base_tcp[:, :3, 3] - np.array([0.53, 0.05, 0.105])
    return 0.02 - np.linalg.norm(p, axis=1)


def test_a_constraint_on_the_way_counts_at_its_worst() -> None:
    start = DOWN.copy()
    start[:3, 3] = (0.53, -0.1, 0.105)
    free = replace(STAGE, start_T_base_tcp=start, num_path_steps=20)
    term = CostTerm(name="around the ball", violation=worst_of(ball))
    with_way = replace(free, path=(term,))

    def deepest(T_end: np.ndarray) -> float:
        share = np.linspace(0.05, 1.0, 20)[:, None]
        p = start[:3, 3] + share * (T_end[:3, 3] - start[:3, 3])
        return float((0.02 - np.linalg.norm(p - (0.53, 0.05, 0.105), axis=1)).max())

    one, other = solve(free).candidates[0], solve(with_way)
    assert deepest(one.T_base_tcp) > 0.015
    assert other.candidates
    assert all(deepest(c.T_base_tcp) <= 1e-9 for c in other.candidates)
    assert other.nearest.violations["around the ball"] == pytest.approx(
        deepest(other.nearest.T_base_tcp), abs=1e-9
    )
    assert other.nearest.cost > one.cost


def test_poses_on_the_way_are_those_of_quaternions() -> None:
    rng = np.random.default_rng(0)
    ends = np.stack([moved(DOWN[None], rng.uniform(-0.8, 0.8, (1, 6)))[0] for _ in range(5)])
    fractions = np.array([0.25, 0.5, 1.0])
    found = interpolated(DOWN, ends, fractions)
    assert found.shape == (5, 3, 4, 4)
    q0, q1 = se3.quaternion_from_rotation(DOWN[:3, :3]), se3.split(ends)[0]
    for index, share in enumerate(fractions):
        q = se3.interpolate_quaternion(np.repeat(q0[None], 5, 0), q1, np.full(5, share))
        R = se3.rotation_from_quaternion(q)
        np.testing.assert_allclose(found[:, index, :3, :3], R, atol=1e-9)
    np.testing.assert_allclose(found[:, 2], ends, atol=1e-12)


def test_what_is_carried_moves_with_the_tool() -> None:
    T_tcp_object = moved(np.eye(4)[None], np.array([[0.01, 0.0, 0.03, 0.2, 0.0, 0.5]]))[0]
    seen = {}

    def look(state: State) -> object:
        seen.update(state.Ts_base_object)
        return state.T_base_tcp[:, 0, 3] - 1.0

    problem = StageProblem(
        nominal_T_base_tcp=DOWN,
        nominal_width_m=0.05,
        subgoal=(CostTerm(name="look", violation=look),),
        Ts_base_object={"box": np.eye(4)},
        Ts_tcp_object={"cube": T_tcp_object},
    )
    zeta = draw_starts(problem, SolveConfig(), 0)
    problem.violations(zeta)
    np.testing.assert_allclose(seen["cube"], zeta.T_base_tcp @ T_tcp_object)
    assert seen["box"].shape == (32, 4, 4)


def test_torch_has_the_same_derivatives_and_the_same_answer() -> None:
    pytest.importorskip("torch")
    zeta = draw_starts(STAGE, SolveConfig(), 1)
    f, r, J = NumpyBackend().linearise(STAGE, zeta)
    f_torch, r_torch, J_torch = TorchBackend("cpu").linearise(STAGE, zeta)
    np.testing.assert_allclose(f_torch, f, atol=1e-12)
    np.testing.assert_allclose(r_torch, r, atol=1e-9)
    np.testing.assert_allclose(J_torch, J, atol=5e-3 * max(1.0, float(np.abs(J).max())) / 10)
    ours, theirs = (solve(STAGE, SolveConfig(backend=name)) for name in ("numpy", "torch"))
    assert theirs.candidates[0].cost == pytest.approx(ours.candidates[0].cost, rel=1e-5)
    np.testing.assert_allclose(
        theirs.candidates[0].T_base_tcp, ours.candidates[0].T_base_tcp, atol=1e-5
    )


def test_rotation_vectors_are_the_same_in_torch() -> None:
    torch = pytest.importorskip("torch")
    v = np.random.default_rng(2).normal(size=(200, 3))
    v[0] = 0.0
    R = se3.rotation_from_vector(v)
    found = rotation_vector(torch.as_tensor(R)).numpy()
    np.testing.assert_allclose(found, se3.vector_from_rotation(R), atol=1e-7)


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
    assert distinct(Ts, np.array([0, 1, 2, 3]), SolveConfig()) == [0, 2, 3]
    assert distinct(Ts, np.array([1, 0, 2, 3]), SolveConfig()) == [1, 3]
    assert distinct(Ts, np.array([1, 3]), SolveConfig(max_candidates=1)) == [1]


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: replace(STAGE, subgoal=()), "without constraints"),
        (lambda: replace(STAGE, path=SUBGOAL), "start_T_base_tcp"),
        (lambda: replace(SUBGOAL[0], weight=0.0), "above zero"),
        (lambda: solve(STAGE, starts=zeta_of([DOWN * np.nan], [0.05])), "not finite"),
    ],
)
def test_what_is_no_stage_is_refused(make: object, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        make()


def test_settings_out_of_range_are_refused() -> None:
    with pytest.raises(UsageError):
        SolveConfig(num_starts=0)
