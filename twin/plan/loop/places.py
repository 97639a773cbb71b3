"""Places on the table that fit a goal, or nearly: final states are looked for around them."""

from collections.abc import Sequence

import numpy as np

from bridge.geometry import se3
from twin.plan.constrain.bodies import surface_points
from twin.plan.constrain.constraint import Constraint
from twin.plan.constrain.kinds import compile_constraint
from twin.plan.constrain.schema import values_of
from twin.plan.problem import Pose, Poses, Problem, State
from twin.plan.release.final_states import EPS_COL_M
from twin.plan.release.resting import NoFinalStateError

_AREA_M = ((0.28, 0.68), (-0.36, 0.36))
"""Where an arm at the origin reaches with the tool down, in its base frame."""
_STEP_M = 0.02
_LEAST_GAP_M = 0.012
"""To what no goal names."""
_NEARLY = 1.5
"""Violations in sum, in units of 1 cm and 10 degrees, that an optimisation is trusted to mend."""
_PLACES = 4
_SPACING_M = 0.03


def places_on_table(
    problem: Problem, key: str, goals: Sequence[Constraint], *, seed: int
) -> list[Pose]:
    """Poses on the table, as the object lies now or along others, that nearly satisfy goals."""
    T_now = problem.scene.Ts_base_object[key]
    points = se3.apply(T_now, surface_points(problem, key))
    Ts = _grid(problem, T_now, float(T_now[2, 3] - points[:, 2].min()), seed)
    state = State(
        Ts_base_object={
            name: Ts if name == key else np.broadcast_to(T, Ts.shape)
            for name, T in problem.scene.Ts_base_object.items()
        },
        T_base_tcp=Ts,
        width_m=np.zeros(len(Ts)),
    )
    named = {name for goal in goals for name in values_of(goal.record, ("reference", "against"))}
    gaps = [
        compile_constraint(
            {"kind": "clearance", "obj": key, "against": name, "min": gap_m}, problem
        )
        for name in problem.scene.Ts_base_object
        if name != key
        for gap_m in (EPS_COL_M if name in named else _LEAST_GAP_M,)
    ]
    excess = np.array([c.violation(state) / c.scale for c in (*goals, *gaps)])
    total = np.maximum(excess, 0.0).sum(axis=0) if len(excess) else np.zeros(len(Ts))
    if total.min() > _NEARLY:
        best = int(total.argmin())
        worst = (*goals, *gaps)[int(excess[:, best].argmax())]
        one = State.single({k: T[best] for k, T in state.Ts_base_object.items()}, Ts[best], 0.0)
        message = (
            f"no free place on the table fits {key}. In the best one {worst.explain(one)}. Clear "
            "the table there, or ask for less."
        )
        raise NoFinalStateError(cause="no_free_pose", message=message)
    near = np.flatnonzero(total <= (0.0 if (total <= 0).any() else _NEARLY))
    slack = np.minimum(-excess[:, near].max(axis=0), 1.0)
    travel = np.linalg.norm(Ts[near, :2, 3] - T_now[:2, 3], axis=1)
    return _spaced(Ts[near[np.argsort(travel + total[near] - 0.2 * slack, kind="stable")]])


def _grid(problem: Problem, T_now: Pose, rest_m: float, seed: int) -> Poses:
    """Places all over the table: turned as now, and along the sides of the other objects."""
    shift = np.random.default_rng(seed).uniform(0.0, _STEP_M, 2)
    axes = [np.arange(low, high, _STEP_M) for low, high in _AREA_M]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2) + shift
    now = float(np.arctan2(T_now[1, 0], T_now[0, 0]))
    yaws = [0.0]
    for T in problem.scene.Ts_base_object.values():
        turn = float(np.arctan2(T[1, 0], T[0, 0])) - now
        yaws.append((turn + np.pi / 4) % (np.pi / 2) - np.pi / 4)
    found = []
    for yaw in dict.fromkeys(round(turn, 6) for turn in yaws):
        Ts = np.tile(np.eye(4), (len(places), 1, 1))
        Ts[:, :3, :3] = se3.rotation_from_vector(np.array([0.0, 0.0, yaw])) @ T_now[:3, :3]
        Ts[:, :2, 3] = places
        Ts[:, 2, 3] = problem.scene.table_height_m + rest_m + 0.003
        found.append(Ts)
    return np.concatenate(found)


def _spaced(Ts: Poses) -> list[Pose]:
    """The first few that are not next to each other."""
    kept: list[Pose] = []
    for T in Ts:
        if all(np.linalg.norm(T[:2, 3] - other[:2, 3]) > _SPACING_M for other in kept):
            kept.append(T)
        if len(kept) == _PLACES:
            break
    return kept
