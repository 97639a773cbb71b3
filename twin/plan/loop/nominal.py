"""The planner: grasps by margin, final states of each, collision-free timed ways between them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import erfc, sqrt
from typing import Any

import numpy as np

from bridge.geometry import se3
from bridge.task.check import TABLE
from bridge.task.model_policy import MODEL_POLICY
from bridge.task.plan import Plan, Ranking, SteeredBy
from bridge.task.relations import SHOWN
from twin.plan.constrain.constraint import Constraint, violated
from twin.plan.constrain.kinds import compile_constraint
from twin.plan.grasp.search import GraspSearcher, turned
from twin.plan.loop.propose import Candidate, refuse_lost
from twin.plan.loop.push import push, push_choices
from twin.plan.loop.steer import Steer
from twin.plan.loop.tau import (
    OPEN_S,
    Trajectory,
    goals_of,
    plan_stage,
    refuse_without_stages,
    speed_limit,
    stage_of_leg,
    stages_of,
)
from twin.plan.path.planner import BUDGET_SPENT, START_TOUCHES, Mover, NoPathError, PathConfig
from twin.plan.path.transfer import LEGS, LIFT_M, Leg, PickAndPlace, left_with
from twin.plan.problem import Grasp, Miss, NoPlanError, Problem, Release, State
from twin.plan.release.final_states import MAX_RELEASES, final_states, places_on_table
from twin.plan.release.resting import lying_there
from twin.replay.clearance.bodies import SCENE

PLANNER = "gst_planner"
GRASPS = 6
WIDER_M = 0.003
"""Kept beyond what was asked for where a path was refused."""
SLOWER = 0.7
"""Share of speeds and accelerations that is kept where a limit was passed."""
NOT_KEPT = "not kept on the way"
_HINTS = {
    NOT_KEPT: "Ask less of the way, or put the objects elsewhere.",
    BUDGET_SPENT: "Clear the way from where it lies to where it goes.",
}
MOST_TRIED = 16
"""Pairs of grasp and final state of one object that a way is sought for."""
_PLACED = ("inside", "on")
"""Relations that final states are found for without a place to begin at."""
_OF_GRASP = ("approach", "around", "lift")


_WAYS: tuple[tuple[float, bool, int], ...] = (
    (LIFT_M, False, 0),
    (LIFT_M, True, 0),
    (0.10, False, 1),
    (0.10, True, 0),
    (0.14, False, 2),
)
"""In which order ways are tried where the first does not keep what holds on the way: how far it is
lifted [m], whether it is carried straight, and what the seed grows by."""

NOMINAL = "nominal"
POLICIES = (NOMINAL, MODEL_POLICY)
"""Planned alike; the second of a problem to whose stages a model added constraints."""


@dataclass(frozen=True, kw_only=True)
class Transfer:
    """One object moved."""

    grasp: Grasp
    legs: tuple[Leg, ...]
    after: Problem
    """When it was moved: it lies there, and the arm stands where it left."""
    cost: float
    """J of the final state, plus the chance that the grasp misses."""
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True)
class PlanProposer:
    """Offers plans of one policy; see ``Proposer``."""

    policy: str = NOMINAL

    def propose(
        self, problem: Problem, *, plan_id: str, seed: int, steer: Steer | None
    ) -> Iterator[Candidate]:
        """Offer plans, the surest grasps first; see ``Proposer``."""
        task = problem.scene.task
        refuse_lost(problem.scene)
        refuse_without_stages(task)
        pushing = any(table.get("push") for table in task.stages)
        offers = _pushes(problem) if pushing else _transfers(problem, seed, steer)
        rank = 0
        try:
            for cost, trajectory, after, remarks in offers:
                told = (*remarks, *_go_home(after, trajectory, seed))
                plan = replace(
                    _written(problem, after, trajectory),
                    id=plan_id,
                    policy=self.policy,
                    candidate=Ranking(rank=rank, cost=cost, seed=seed),
                    steered_by=None
                    if steer is None
                    else SteeredBy(clause=steer.clause, bodies=steer.bodies),
                )
                yield Candidate(plan=plan, rank=rank, cost=cost, remarks=told)
                rank += 1
        except NoPlanError:
            if not rank:
                raise


Offer = tuple[float, Trajectory, Problem, tuple[str, ...]]
"""Its cost, the way, how everything is after it, and remarks."""


def _pushes(problem: Problem) -> Iterator[Offer]:
    why = ""
    for choice in push_choices():
        trajectory, after, key = Trajectory(robot=problem.robot), problem, ""
        try:
            for key in problem.scene.task.manipulated:  # the message names it
                after = push(after, key, choice, trajectory)
        except NoPathError as error:
            why = _why_not_moved(problem, key, error)
            continue
        yield choice[0], trajectory, after, ("pushed straight, tool down",)
    raise NoPlanError(why)


def _transfers(problem: Problem, seed: int, steer: Steer | None) -> Iterator[Offer]:
    for transfers in _sequences(problem, problem.scene.task.manipulated, seed, steer):
        trajectory, after = Trajectory(robot=problem.robot), problem
        for each in transfers:
            stages = stages_of(problem.scene.task, each.grasp.object_id)
            trajectory.add_transfer(each.legs, each.grasp, stages)
            after = each.after
        remarks = tuple(text for each in transfers for text in each.remarks)
        yield sum(each.cost for each in transfers), trajectory, after, remarks


def _sequences(
    problem: Problem, keys: Sequence[str], seed: int, steer: Steer | None
) -> Iterator[list[Transfer]]:
    """Ways to move all objects one after the other; the last one's change first."""
    if not keys:
        yield []
        return
    mine = steer if steer is not None and steer.object_id in (None, keys[0]) else None
    for transfer in _Moves(problem, keys[0], seed, mine).transfers():
        for rest in _sequences(transfer.after, keys[1:], seed, steer):
            yield [transfer, *rest]


def _why_not_moved(problem: Problem, key: str, error: NoPathError) -> str:
    """Why an object cannot be moved so, and what would help."""
    if error.reason == START_TOUCHES and error.leg == "around":
        return (
            f"the arm starts in collision: {' touches '.join(error.bodies)}. Move it clear, and "
            "record the start again: robot-gst record RUN."
        )
    around = {*problem.scene.task.objects, TABLE, SCENE}
    hint = "Move apart what touches, or put the objects elsewhere."
    if error.reason in _HINTS:
        hint = _HINTS[error.reason]
    elif not error.bodies:
        hint = "Move the object, or where it goes, nearer to the arm."
    elif around.isdisjoint(error.bodies):
        hint = "The arm is in its own way: move the object, or where it goes."
    return f"{key}: {error}. {hint}"


class _Moves:
    """Ways to move one object: its grasps with their final states, as a refusal wants them."""

    def __init__(self, problem: Problem, key: str, seed: int, steer: Steer | None) -> None:
        self._problem, self._key, self._seed, self._steer = problem, key, seed, steer
        found = GraspSearcher(problem).search(key)
        kept = _kept_at_the_grasp(problem, found.grasps)
        self._grasps = self._ordered(kept)[:GRASPS]
        self._about_grasps = found.remarks
        self._num_grasps = len(found.grasps)
        task = problem.scene.task
        self._relation = task.goal_of(key)
        self._goals = [
            compile_constraint(record, problem)
            for record in goals_of(task, key)
            if record["kind"] not in _PLACED or record.get("support") == TABLE
        ]
        self._wishes = _subgoals(problem, key, "release")
        self._states: dict[int, tuple[Release, ...]] = {}
        self._why = "" if self._grasps else f"no grasp of {key} is left that was not refused"

    def transfers(self) -> Iterator[Transfer]:
        """Grasp by grasp with the cheapest final state, then with the next one."""
        found, blocked = False, "no candidate is left that was not refused"
        for tried, (grasp, release) in enumerate(self._pairs()):
            if tried == MOST_TRIED:
                self._why = f"of {MOST_TRIED} ways to move {self._key} none is free: {blocked}"
                break
            try:
                transfer = self._moved(grasp, release)
            except NoPathError as error:
                blocked = _why_not_moved(self._problem, self._key, error)
                if error.leg in _OF_GRASP:  # no final state helps
                    self._states[id(grasp)] = ()
                continue
            found = True
            yield transfer
        if not found:
            raise NoPlanError(self._why or blocked)

    def _moved(self, grasp: Grasp, release: Release) -> Transfer:
        """The first way that keeps what holds on the way."""
        problem, task, steer = self._problem, self._problem.scene.task, self._steer
        start = problem.scene.start_rad
        stages = stages_of(task, self._key)
        limits = {leg: speed_limit(task, stage_of_leg(leg, stages)) for leg in LEGS}
        ways, base = _WAYS, PathConfig(seed=self._seed % 2**31)
        if steer is not None and steer.change == "path":
            eps_m = base.replay.eps_col_m + WIDER_M + steer.lacking_m
            wider = replace(base.replay, eps_col_m=eps_m)
            ways, base = _WAYS[2:], replace(base, replay=wider, seed=base.seed + len(steer.refused))
        elif steer is not None and steer.change == "slower":
            speed, acceleration = base.speed_share * SLOWER, base.acceleration_share * SLOWER
            base = replace(base, speed_share=speed, acceleration_share=acceleration)
        failures: list[NoPathError] = []
        for lift_m, straight, more_seed in ways:
            try:
                legs = PickAndPlace(
                    problem=problem,
                    grasp=grasp,
                    release=release,
                    config=replace(base, seed=base.seed + more_seed),
                    lift_m=lift_m,
                    straight=straight,
                    tool_m_s=limits,
                ).legs(problem.robot.home_rad if start is None else start)
                _refuse_unkept(problem, grasp, legs)
            except NoPathError as error:
                failures.append(error)
                if error.reason != NOT_KEPT and not straight:
                    break  # where nothing is free, another height is not either
                continue
            lies = lying_there(problem, release, self._miss_with(grasp))
            return Transfer(
                grasp=grasp,
                legs=legs,
                after=left_with(problem, self._key, lies, legs[-1].path.joints_rad[-1]),
                cost=release.cost + erfc(grasp.margin / sqrt(2.0)) / 2,
                remarks=self._remarks(grasp, release),
            )
        raise failures[0]

    def _ordered(self, grasps: list[Grasp]) -> list[Grasp]:
        """Leave out what was refused, or begin with what is to be kept."""
        steer, key = self._steer, self._key
        if steer is None:
            return grasps

        def refused(grasp: Grasp) -> bool:
            T = grasp.T_object_tcp
            return steer.has_grasp_like(key, T) or steer.has_grasp_like(key, turned(T[None])[0])

        if steer.change == "grasp":
            return [grasp for grasp in grasps if not refused(grasp)]
        return sorted(grasps, key=lambda each: not refused(each))

    def _pairs(self) -> Iterator[tuple[Grasp, Release]]:
        """Every grasp with its cheapest final state, then every grasp with the next, and so on."""
        for rank in range(MAX_RELEASES):
            for grasp in self._grasps:
                if id(grasp) not in self._states:
                    self._states[id(grasp)] = self._releases(grasp)
                if rank < len(self._states[id(grasp)]):
                    yield grasp, self._states[id(grasp)][rank]

    def _releases(self, grasp: Grasp) -> tuple[Release, ...]:
        try:
            releases = self._final_states(grasp)
        except NoPlanError as error:
            self._why = str(error)
            return ()
        steer = self._steer
        if steer is None or steer.change != "release" or self._miss_with(grasp) is not None:
            return releases  # a measured miss changes where they are
        return tuple(each for each in releases if not steer.has_end_like(each))

    def _miss_with(self, grasp: Grasp) -> Miss | None:
        """How far beside it is known to let the object go with a grasp."""
        return None if self._steer is None else self._steer.miss_with(grasp)

    def _final_states(self, grasp: Grasp) -> tuple[Release, ...]:
        problem = self._problem
        relation = self._relation
        placed = relation is None or (relation[0] in _PLACED and relation[1] != TABLE)
        near = None
        if not placed or (relation is None and problem.scene.task.mark_of(self._key) is None):
            near = places_on_table(problem, self._key, self._goals, seed=self._seed)
        return final_states(
            problem, grasp, goals=self._goals, wishes=self._wishes, near=near,
            miss=self._miss_with(grasp), seed=self._seed,
        )  # fmt: skip

    def _remarks(self, grasp: Grasp, release: Release) -> tuple[str, ...]:
        """Where the numbers of a transfer come from, in words."""
        return (
            f"{self._key}: grasp of {self._num_grasps}, {grasp.width_m * 1e3:.0f} mm wide, bears "
            f"{grasp.margin:.1f} standard deviations",
            *(f"{self._key}: {text}" for text in self._about_grasps),
            f"{self._key}: final state of J {release.cost:.4f}",
        )


def _subgoals(problem: Problem, key: str, verb: str) -> list[Constraint]:
    """What somebody added for the end of the stage in which an object is grasped or the like."""
    stage = stages_of(problem.scene.task, key).get(verb)
    return [
        compile_constraint(goal, problem)
        for table in problem.scene.task.stages
        if str(table["id"]) == stage
        for goal in table.get("subgoal", ())
    ]


def _kept_at_the_grasp(problem: Problem, grasps: Sequence[Grasp]) -> list[Grasp]:
    """Those that satisfy what was added for the end of the grasp."""
    asked = _subgoals(problem, grasps[0].object_id, "grasp")
    if not asked:
        return list(grasps)
    Ts = problem.scene.Ts_base_object
    states = [
        State.single(Ts, Ts[grasp.object_id] @ grasp.T_object_tcp, grasp.width_m)
        for grasp in grasps
    ]
    violations = [violated(asked, state) for state in states]
    kept = [grasp for grasp, wrong in zip(grasps, violations, strict=True) if not wrong]
    if not kept:
        message = (
            f"no grasp of {grasps[0].object_id} keeps what is asked: {violations[0][0]}. Ask for "
            "less of the grasp."
        )
        raise NoPlanError(message)
    return kept


def _refuse_unkept(problem: Problem, grasp: Grasp, legs: tuple[Leg, ...]) -> None:
    """Ask the constraints of the object's stages of each leg that belongs to them."""
    task, key = problem.scene.task, grasp.object_id
    ids = stages_of(task, key)
    tables = {str(table["id"]): table for table in task.stages}
    for leg in legs:
        if not leg.g:
            continue  # it lies where it lay; the time law keeps speeds there
        way = tables[stage_of_leg(leg.name, ids)].get("path", ())
        along = [compile_constraint(record, problem) for record in way]
        at_the_end = _subgoals(problem, key, "carry") if leg.name == "carry" else []
        states = _states_along(problem, grasp, leg)
        asked = [(each, each.worst_along(states, leg.path.times_s)) for each in along]
        asked += [(each, float(each.violation(states)[-1])) for each in at_the_end]
        for constraint, f in asked:
            if f > 0:
                factor, unit = SHOWN[constraint.unit]
                detail = f"{constraint.kind} is violated by {f * factor:.3g} {unit}"
                error = NoPathError(reason=NOT_KEPT, detail=detail)
                error.leg = leg.name
                raise error


def _states_along(problem: Problem, grasp: Grasp, leg: Leg) -> State:
    """What is where in each step of a leg that carries."""
    T_tcp = problem.robot.Ts_base_tcp(leg.path.joints_rad)
    Ts: dict[str, Any] = {name: T[None] for name, T in problem.scene.Ts_base_object.items()}
    Ts[grasp.object_id] = T_tcp @ se3.invert(grasp.T_object_tcp)
    widths = np.full(len(T_tcp), leg.width_m)
    return State(Ts_base_object=Ts, T_base_tcp=T_tcp, width_m=widths)


def _go_home(after: Problem, trajectory: Trajectory, seed: int) -> tuple[str, ...]:
    """At the end the arm goes back to where it stood, its hand open."""
    task, robot, last = after.scene.task, after.robot, trajectory.tau[-1]
    home_rad, end_rad = (np.array(at.joints_rad) for at in (trajectory.tau[0], last))
    stage, open_m = str(task.stages[-1]["id"]), float(last.width_m or 0.0)
    if last.g:
        open_m = robot.record.gripper.max_width_m
        trajectory.pause(stage, OPEN_S, g=0, width_m=open_m)
    config = PathConfig(seed=seed % 2**31, tool_m_s=speed_limit(task, stage))
    try:
        home = Mover(problem=after, config=config, width_m=open_m).around(end_rad, home_rad[None])
    except NoPathError as error:
        return (f"the arm stays where it let go: {error}",)
    trajectory.add(Leg(name="home", path=home, g=0, width_m=open_m), stage, open_m)
    return ()


def _written(problem: Problem, after: Problem, trajectory: Trajectory) -> Plan:
    """A plan of a trajectory that leaves its objects so."""
    task, record = problem.scene.task, problem.robot.record
    return Plan(
        id="",
        planner=PLANNER,
        policy="",
        condition="without_replanning",
        robot=record.name,
        frame=record.base_frame,
        task=task.name,
        scene_hash=problem.scene.scene_hash,
        instruction=task.instruction,
        entities={key: se3.pose_record(T) for key, T in problem.scene.Ts_base_object.items()},
        joint_names=record.joints,
        stages=tuple(
            plan_stage(task, table, trajectory.bounds, after.scene.Ts_base_object)
            for table in task.stages
        ),
        tau=tuple(trajectory.tau),
    )
