"""Final states of a carried object: solved for, perturbed, checked, ranked."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from scipy.spatial import ConvexHull

from bridge.geometry import se3
from bridge.task.relations import SHOWN
from twin.plan.constrain.bodies import surface_points
from twin.plan.constrain.constraint import Constraint
from twin.plan.constrain.kinds import compile_constraint
from twin.plan.constrain.schema import values_of
from twin.plan.problem import Array, Grasp, Miss, Numbers, Pose, Poses, Problem, Release, State
from twin.plan.release.obstacles import allowed_with, hand_points, obstacles_of
from twin.plan.release.resting import (
    NoFinalStateError,
    Target,
    resting_poses,
    settled,
    sideways_sigma_m,
    support_m,
    target_of,
)
from twin.plan.stage.solver import ANGLE_RAD, CostTerm, StageProblem, StageState, distinct, solve
from twin.robot.collision import hulls_of

NEAR_M = 0.02
"""Margins above this are not told apart while a stage is solved."""
TAU_P_M = 0.02
"""Bound of the shifts of Eq. 8, along each axis."""
TAU_R_RAD = ANGLE_RAD
"""Bound of the turns of Eq. 9."""
NUM_SAMPLES, NUM_NOMINAL = 2048, 4
"""Poses that are drawn, around so many answers of the optimisation."""
NUM_WAYS = 4
"""Ways to rest that are tried, those nearest to how the object lies now first."""
MAX_RELEASES = 16
EPS_COL_M = 0.002
"""Least distance between what may not touch, the paper's epsilon_col."""
SIGMAS = 2.0
"""Standard deviations of localisation that the object stays away from the edge of the area."""
HAND_POINTS = 200
DROP_M, MOST_DROP_M = 0.004, 0.03
"""Wanted between the underside and what the object will lie on; most of it, over a rim that the
object may have to stay above, where nothing is asked of the release itself."""
MOST_TILT_RAD = float(np.deg2rad(12.0))
"""Most that the object may lean from how it will rest."""
MOST_TOOL_TILT_RAD = float(np.deg2rad(60.0))
"""Most that the tool may lean from straight down where the object is let go."""
OPEN_MORE_M = 0.01
"""The hand opens at least this much wider than it held."""
_AREA_M = ((0.28, 0.68), (-0.36, 0.36))
"""Where an arm at the origin reaches with the tool down, in its base frame."""
_STEP_M = 0.02
_LEAST_GAP_M = 0.012
"""To what no goal names."""
_NEARLY = 1.5
"""Violations in sum, in units of 1 cm and 10 degrees, that an optimisation is trusted to mend."""
_PLACES = 4
_SPACING_M = 0.03


def final_states(
    problem: Problem,
    grasp: Grasp,
    *,
    goals: Sequence[Constraint] = (),
    wishes: Sequence[Constraint] = (),
    near: Sequence[Pose] | None = None,
    miss: Miss | None = None,
    seed: int = 0,
) -> tuple[Release, ...]:
    """Find where a held object may be let go: distinct final states, the cheapest first.

    Args:
        goals: What must hold where the object comes to lie, straight below (Eq. 7).
        wishes: What must hold as it is let go; no other height is then asked for.
        near: Poses ``T_base_object`` to look around instead of what the success predicates ask
            for; goals then say what is wanted.
        miss: How far from there it is known to come to lie.
    """
    search = ReleaseSearch(problem, grasp, goals, wishes, miss or Miss())
    target = target_of(problem, grasp.object_id) if near is None else None
    if target is not None:
        ways = resting_poses(
            problem, grasp, target, drop_m=DROP_M, most_tilted_rad=MOST_TOOL_TILT_RAD
        )[:NUM_WAYS]
    else:
        ways = list(near or ())
    return search.answer([search.stage(T, target) for T in ways], seed)


class ReleaseSearch:
    """What all ways to rest have in common."""

    def __init__(
        self,
        problem: Problem,
        grasp: Grasp,
        goals: Sequence[Constraint],
        wishes: Sequence[Constraint],
        miss: Miss,
    ) -> None:
        """Collect obstacles and points."""
        self._problem, self._grasp = problem, grasp
        self._goals, self._wishes, self._miss = goals, wishes, miss
        hulls = hulls_of(problem.robot)
        gripper = problem.robot.record.gripper
        self._width_m = min(max(grasp.open_m, grasp.width_m + OPEN_MORE_M), gripper.max_width_m)
        self._points_m = surface_points(problem, grasp.object_id)
        self._outline_m = self._points_m[ConvexHull(self._points_m).vertices]
        self._hand_m = hand_points(hulls, self._width_m, HAND_POINTS)
        self._obstacles = obstacles_of(problem, hulls, {grasp.object_id})
        pairs = problem.contacts_of("release", grasp.object_id)
        names = self._obstacles.names
        self._allowed = allowed_with(grasp.object_id, pairs, names)
        self._hand_allowed = allowed_with(gripper.name, pairs, names)
        self._T_tcp_object = se3.invert(grasp.T_object_tcp)
        self._sigma_m = sideways_sigma_m(problem, grasp.object_id)

    def stage(self, T_rest: Pose, target: Target | None) -> StageProblem:
        """Write one way to rest as a stage problem.

        Args:
            T_rest: Pose ``T_base_object`` a little above where it would lie.
            target: What it is put into or onto; None: goals alone say it.
        """
        name, scene = self._grasp.object_id, self._problem.scene
        terms = [
            CostTerm(name=f"{name} clear of what is around", violation=self._object_too_near),
            CostTerm(name="the open hand clear of what is around", violation=self._hand_too_near),
        ]
        if target is not None:
            terms += self._placed(T_rest, target)
        terms += [CostTerm.of(goal, self._settled) for goal in self._goals]
        terms += [CostTerm.of(wish) for wish in self._wishes]
        return StageProblem(
            nominal_T_base_tcp=self._miss.undone(T_rest) @ self._grasp.T_object_tcp,
            width_m=self._width_m,
            subgoal=tuple(terms),
            Ts_base_object={key: T for key, T in scene.Ts_base_object.items() if key != name},
            Ts_tcp_object={name: self._T_tcp_object},
        )

    @cached_property
    def _support_m(self) -> float:
        return support_m(self._problem, self._grasp.object_id)

    def _settled(self, state: State) -> State:
        """What comes of states in which the object is let go: it lies straight below."""
        name = self._grasp.object_id
        T = state.Ts_base_object[name]
        T = settled(T, self._outline_m, self._support_m, self._miss)
        return replace(state, Ts_base_object={**state.Ts_base_object, name: T})

    def _object_too_near(self, state: State) -> Array:
        T, keep_m = state.Ts_base_object[self._grasp.object_id], _keep_m(self._allowed)
        return -self._obstacles.margins(self._points_m, T, keep_m, most_m=NEAR_M)

    def _hand_too_near(self, state: State) -> Array:
        keep_m = _keep_m(self._hand_allowed)
        return -self._obstacles.margins(self._hand_m, state.T_base_tcp, keep_m, most_m=NEAR_M)

    def _placed(self, T_rest: Pose, target: Target) -> list[CostTerm]:
        """Inside of the area, at a small height, level."""
        name = self._grasp.object_id
        margin = SIGMAS * float(np.hypot(target.sigma_m, self._sigma_m))
        whole = target.relation == "inside"
        half = np.array(target.half_m)
        R_area = target.T_base[:2, :2]
        extents = np.ptp(self._outline_m @ T_rest[:2, :3].T @ R_area, axis=0)
        room = half - margin - extents / 2 * whole
        if target.relation == "at":
            half, margin = half + TAU_P_M, 0.0
        elif (room < 0).any():
            margin = max(0.0, margin + float(room.min()))  # as much as there is
        up = T_rest[:3, :3].T[:, 2]
        outline = self._outline_m if whole else self._outline_m.mean(axis=0, keepdims=True)

        def beyond(state: State) -> Array:
            T = self._miss.applied(state.Ts_base_object[name])
            axes = (R_area.T @ T[:, :2, :3]).reshape(-1, 3) @ outline.T
            middle = ((T[:, :2, 3] - target.T_base[:2, 3]) @ R_area).reshape(-1, 1)
            reach = np.abs(axes + middle).max(axis=1).reshape(-1, 2)
            return (reach - half + margin).max(axis=1)

        def off_height(state: State) -> Array:
            T = state.Ts_base_object[name]
            over = (T[:, 2, :3] @ self._outline_m.T).min(axis=1) + T[:, 2, 3] - target.T_base[2, 3]
            most = np.inf if self._wishes else MOST_DROP_M + target.rim_m
            return np.maximum(over - most, DROP_M / 2 - over)

        def leaning(state: State) -> Array:
            z = state.Ts_base_object[name][:, :3, :3] @ up
            return np.arctan2(np.hypot(z[:, 0], z[:, 1]), z[:, 2]) - MOST_TILT_RAD

        return [
            CostTerm(name=f"{name} within {target.name}", violation=beyond),
            CostTerm(name=f"{name} a little above {target.name}", violation=off_height),
            CostTerm(name=f"{name} level", violation=leaning, scale=ANGLE_RAD, unit="rad"),
        ]

    def answer(self, stages: Sequence[StageProblem], seed: int) -> tuple[Release, ...]:
        """Solve each way to rest, perturb the best, keep the distinct feasible ones."""
        rng = np.random.default_rng(seed)
        found = [(stage, state) for stage in stages for state in solve(stage, seed=seed)]
        solved = [each for each in found if each[1].is_feasible]
        if not solved:
            raise self._nothing(*min(found, key=lambda pair: pair[1].cost))
        solved.sort(key=lambda pair: pair[1].cost)
        Ts = [state.T_base_tcp[None] for _, state in solved]
        costs = [np.array([state.cost]) for _, state in solved]
        for stage, state in solved[:NUM_NOMINAL]:
            count = NUM_SAMPLES // min(NUM_NOMINAL, len(solved))
            drawn = perturbed(
                state.T_base_tcp, tau_p_m=TAU_P_M, tau_r_rad=TAU_R_RAD, count=count, rng=rng
            )
            violations, J = stage.judged(drawn)
            free = (violations <= 0).all(axis=1)
            Ts.append(drawn[free])
            costs.append(J[free])
        return self._releases(np.concatenate(Ts), np.concatenate(costs))

    def _releases(self, Ts: Poses, costs: Numbers) -> tuple[Release, ...]:
        order = np.argsort(costs, kind="stable")
        chosen = distinct(Ts, order, MAX_RELEASES)
        Ts_object = Ts[chosen] @ self._T_tcp_object
        distances = self._obstacles.distances(self._points_m, Ts_object)
        counted = np.where(self._allowed > 0, np.inf, distances).min(axis=1, initial=np.inf)
        return tuple(
            Release(
                object_id=self._grasp.object_id,
                T_base_object=T_object,
                T_base_tcp=Ts[index],
                clearance_m=float(clearance),
                cost=float(costs[index]),
            )
            for index, T_object, clearance in zip(chosen, Ts_object, counted, strict=True)
        )

    def _nothing(self, stage: StageProblem, nearest: StageState) -> NoFinalStateError:
        """Say what was in the way where the least was."""
        told = "; ".join(
            f"{term.name}: by {f * SHOWN[term.unit][0]:.1f} {SHOWN[term.unit][1]}"
            for f, term in zip(nearest.violations, stage.subgoal, strict=True)
            if f > 0
        )
        near = ", ".join(self._in_the_way(nearest.T_base_tcp))
        message = (
            f"no final state of {self._grasp.object_id} was found. In the best one this does not "
            f"hold: {told or 'nothing stands out'}{f' (too near: {near})' if near else ''}. Clear "
            "the place, or name another one."
        )
        return NoFinalStateError(cause="no_free_pose", message=message)

    def _in_the_way(self, T_base_tcp: Pose) -> list[str]:
        """What the object or the open hand would be too near to."""
        bodies = (
            (self._points_m, T_base_tcp @ self._T_tcp_object, self._allowed),
            (self._hand_m, T_base_tcp, self._hand_allowed),
        )
        short = np.zeros(len(self._obstacles.names), dtype=np.bool_)
        for points_m, T, allowed in bodies:
            short |= self._obstacles.distances(points_m, T[None])[0] < _keep_m(allowed)
        return [name for name, is_near in zip(self._obstacles.names, short, strict=True) if is_near]


def _keep_m(allowed: Array) -> Numbers:
    return np.asarray(EPS_COL_M * (1.0 - allowed))


def perturbed(
    T_base_tcp: Pose, *, tau_p_m: float, tau_r_rad: float, count: int, rng: np.random.Generator
) -> Poses:
    """Draw end-effector poses around a nominal one, Eq. 8 and 9 of the paper.

    The position moves by a vector uniform in a box. The paper bounds the rotation vector and says
    neither how it is drawn nor in which frame; here its axis is uniform on the sphere, its angle
    uniform in [0, tau_r], and it turns the tool in the tool's own frame (errata, resolution 7).
    """
    shift = rng.uniform(-tau_p_m, tau_p_m, (count, 3))
    axis = rng.normal(size=(count, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    turn = axis * rng.uniform(0.0, tau_r_rad, (count, 1))
    T = np.repeat(T_base_tcp[None], count, axis=0)
    T[:, :3, :3] = T[:, :3, :3] @ se3.rotation_from_vector(turn)
    T[:, :3, 3] += shift
    return T


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
