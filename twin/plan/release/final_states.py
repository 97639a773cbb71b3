"""Final states of a carried object: solved for, perturbed, checked, ranked."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import ConvexHull

from bridge.geometry import se3
from bridge.task.relations import Measured
from twin.plan.constrain.bodies import surface_points
from twin.plan.constrain.constraint import Constraint, violated
from twin.plan.constrain.kinds import compile_constraint
from twin.plan.constrain.schema import values_of
from twin.plan.problem import Array, Grasp, Miss, NoPlanError, Pose, Poses, Problem, Release, State
from twin.plan.release.obstacles import hand_points, obstacles_of
from twin.plan.release.resting import (
    Target,
    resting_poses,
    settled,
    sideways_sigma_m,
    support_m,
    target_of,
)
from twin.plan.stage.solver import ANGLE_RAD, StageProblem, StageState, distinct, perturbed, solve
from twin.robot.collision import hulls_of

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
        self._hand_m = hand_points(problem.robot, self._width_m, HAND_POINTS)
        self._obstacles = obstacles_of(problem, hulls, {grasp.object_id})
        self._pairs = problem.contacts_of("release", grasp.object_id)
        self._T_tcp_object = se3.invert(grasp.T_object_tcp)
        self._sigma_m = sideways_sigma_m(problem, grasp.object_id)

    def stage(self, T_rest: Pose, target: Target | None) -> StageProblem:
        """Write one way to rest as a stage problem.

        Args:
            T_rest: Pose ``T_base_object`` a little above where it would lie.
            target: What it is put into or onto; None: goals alone say it.
        """
        name, scene = self._grasp.object_id, self._problem.scene
        terms = [Constraint(record={"kind": "clear"}, measured=self._clear)]
        if target is not None:
            terms += self._placed(T_rest, target)
        terms += [replace(goal, measured=self._at_rest(goal)) for goal in self._goals]
        terms += self._wishes
        return StageProblem(
            nominal_T_base_tcp=self._miss.undone(T_rest) @ self._grasp.T_object_tcp,
            width_m=self._width_m,
            subgoal=tuple(terms),
            Ts_base_object={key: T for key, T in scene.Ts_base_object.items() if key != name},
            Ts_tcp_object={name: self._T_tcp_object},
        )

    def _at_rest(self, goal: Constraint) -> Callable[[State], Sequence[Measured]]:
        """Measure where the object comes to lie that is let go."""
        name = self._grasp.object_id
        height_m = support_m(self._problem, name)

        def measured(state: State) -> Sequence[Measured]:
            T = settled(state.Ts_base_object[name], self._outline_m, height_m, self._miss)
            return goal.measured(replace(state, Ts_base_object={**state.Ts_base_object, name: T}))

        return measured

    def _clear(self, state: State) -> list[Measured]:
        """Object and open hand against everything that stands still."""
        name, hand = self._grasp.object_id, self._problem.robot.record.gripper.name
        found = []
        for body, points_m, Ts in (
            (name, self._points_m, state.Ts_base_object[name]),
            (hand, self._hand_m, state.T_base_tcp),
        ):
            for other, away in self._obstacles.items():
                low_m = 0.0 if frozenset((body, other)) in self._pairs else EPS_COL_M
                what = f"the distance of {body} from {other}"
                found.append(Measured(what, away(points_m, Ts), low=low_m))
        return found

    def _placed(self, T_rest: Pose, target: Target) -> list[Constraint]:
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

        most_m = np.inf if self._wishes else MOST_DROP_M + target.rim_m

        def over(state: State) -> Array:
            T = state.Ts_base_object[name]
            return (T[:, 2, :3] @ self._outline_m.T).min(axis=1) + T[:, 2, 3] - target.T_base[2, 3]

        def leaning(state: State) -> Array:
            z = state.Ts_base_object[name][:, :3, :3] @ up
            return np.arctan2(np.hypot(z[:, 0], z[:, 1]), z[:, 2])

        def placed(state: State) -> list[Measured]:
            return [
                Measured(f"the reach of {name}", beyond(state), high=0.0, beyond=target.name),
                Measured(
                    f"the height of {name} over {target.name}",
                    over(state),
                    low=DROP_M / 2,
                    high=most_m,
                ),
                Measured(f"the lean of {name}", leaning(state), high=MOST_TILT_RAD, unit="rad"),
            ]

        return [Constraint(record={"kind": "placed"}, measured=placed)]

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
            free, J = stage.judged(drawn)
            Ts.append(drawn[free])
            costs.append(J[free])
        every, J = np.concatenate(Ts), np.concatenate(costs)
        return tuple(
            Release(
                object_id=self._grasp.object_id,
                T_base_object=every[index] @ self._T_tcp_object,
                T_base_tcp=every[index],
                cost=float(J[index]),
            )
            for index in distinct(every, np.argsort(J, kind="stable"), MAX_RELEASES)
        )

    def _nothing(self, stage: StageProblem, nearest: StageState) -> NoPlanError:
        """Say what was in the way where the least was."""
        told = "; ".join(violated(stage.subgoal, stage.state(nearest.T_base_tcp[None])))
        message = (
            f"no final state of {self._grasp.object_id} was found. In the best one {told}. Clear "
            "the place, or name another one."
        )
        return NoPlanError(message, cause="no_free_pose")


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
            {"kind": "clearance", "object": key, "against": name, "min": gap_m}, problem
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
        raise NoPlanError(message, cause="no_free_pose")
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
