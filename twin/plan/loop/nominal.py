"""The planner: grasps by margin, final states of each, collision-free timed ways between them."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from math import erfc, sqrt
from typing import Any

import numpy as np

from bridge.geometry import se3
from bridge.task.check import TABLE
from bridge.task.model_policy import MODEL_POLICY
from bridge.task.plan import Plan
from bridge.task.relations import SHOWN
from twin.plan.constrain.constraint import Constraint, violated
from twin.plan.constrain.kinds import compile_constraint
from twin.plan.grasp.reach import nearest_solutions
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
from twin.plan.problem import (
    Grasp,
    Joints,
    Miss,
    NoPlanError,
    Problem,
    Release,
    State,
    Vector,
)
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
MOST_TRIED = 16
"""Pairs of grasp and final state of one object that a way is sought for."""
_PLACED = ("inside", "on")
"""Relations that final states are found for without a place to begin at."""
_HOPELESS = ("nowhere_said", "not_localised")
_OF_GRASP = ("approach", "around", "lift")


@dataclass(frozen=True, kw_only=True)
class Way:
    """How an object is carried."""

    lift_m: float = LIFT_M
    straight: bool = False
    more_seed: int = 0


_WAYS: tuple[Way, ...] = (
    Way(),
    Way(straight=True),
    Way(lift_m=0.10, more_seed=1),
    Way(lift_m=0.10, straight=True),
    Way(lift_m=0.14, more_seed=2),
)
"""In which order ways are tried where the first does not keep what holds on the way."""


NOMINAL = "nominal"
POLICIES = (NOMINAL, MODEL_POLICY)
"""Planned alike; the second of a problem to whose stages a model added constraints."""


@dataclass(frozen=True, kw_only=True)
class Transfer:
    """One object moved."""

    key: str
    grasp: Grasp
    release: Release
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
        self, problem: Problem, *, plan_id: str, seed: int, count: int, steer: Steer | None
    ) -> list[Candidate]:
        """Offer plans, the surest grasps first; see ``Proposer``."""
        task = problem.scene.task
        refuse_lost(problem.scene)
        refuse_without_stages(task)
        pushing = any(table.get("push") for table in task.stages)
        search = _Search(problem, seed, steer)
        offers = _pushes(problem, search) if pushing else _transfers(problem, search)
        found: list[Candidate] = []
        for cost, trajectory, after, remarks in offers:
            told = (*remarks, *_go_home(after, trajectory, seed))
            plan = _written(problem, after, trajectory, self.policy, plan_id)
            found.append(Candidate(plan=plan, rank=len(found), cost=cost, remarks=told))
            if len(found) == count:
                break
        if not found:
            raise NoPlanError(search.why)
        return found


Offer = tuple[float, Trajectory, Problem, tuple[str, ...]]
"""Its cost, the way, how everything is after it, and remarks."""


def _pushes(problem: Problem, search: "_Search") -> Iterator[Offer]:
    for choice in push_choices():
        trajectory, after, key = Trajectory(robot=problem.robot), problem, ""
        try:
            for key in problem.scene.task.manipulated:  # the message names it
                after = push(after, key, choice, trajectory)
        except NoPathError as error:
            search.why = _why_not_moved(problem, key, error)
            continue
        yield choice[0], trajectory, after, ("pushed straight, tool down",)


def _transfers(problem: Problem, search: "_Search") -> Iterator[Offer]:
    for transfers in search.sequences():
        trajectory, after = Trajectory(robot=problem.robot), problem
        for each in transfers:
            stages = stages_of(problem.scene.task, each.key)
            trajectory.add_transfer(each.legs, each.grasp, stages)
            after = each.after
        remarks = tuple(text for each in transfers for text in each.remarks)
        yield sum(each.cost for each in transfers), trajectory, after, remarks


class _Search:
    """Ways to move all objects, the best first."""

    def __init__(self, problem: Problem, seed: int, steer: Steer | None) -> None:
        self._problem, self._seed, self._steer = problem, seed, steer
        self._known: dict[tuple[int, ...], tuple[Iterator[Transfer], list[Transfer]]] = {}
        """By what was moved before: transfers of the next object as they are asked for."""
        self.why = "no candidate is left that was not refused"

    def sequences(self) -> Iterator[list[Transfer]]:
        """Each candidate takes of every object the next transfer; the last ones are kept."""
        before: list[list[int]] = []
        for number in range(MOST_TRIED):
            transfers = self._sequence(number)
            if transfers is None or list(map(id, transfers)) in before:
                return
            before.append(list(map(id, transfers)))
            yield transfers

    def _sequence(self, number: int) -> list[Transfer] | None:
        transfers: list[Transfer] = []
        problem = self._problem
        for key in self._problem.scene.task.manipulated:
            prefix = tuple(id(each) for each in transfers)
            if prefix not in self._known:
                self._known[prefix] = self._transfers(problem, key), []
            making, made = self._known[prefix]
            made += islice(making, max(0, number + 1 - len(made)))
            if not made:
                return None
            transfers.append(made[min(number, len(made) - 1)])
            problem = transfers[-1].after
        return transfers

    def _transfers(self, problem: Problem, key: str) -> Iterator[Transfer]:
        """One object's: grasp by grasp with the cheapest final state, then with the next one."""
        start = problem.scene.start_rad
        start_rad = problem.robot.home_rad if start is None else start
        try:
            options = _Options(problem, key, self._seed, self._mine(key))
            pairs = options.pairs()
            found = False
            for tried, (grasp, release) in enumerate(pairs):
                if tried == MOST_TRIED:
                    self.why = f"of {MOST_TRIED} ways to move {key} none is free: {self.why}"
                    return
                try:
                    transfer = self._moved(problem, grasp, release, start_rad, options)
                except NoPathError as error:
                    self.why = _why_not_moved(problem, key, error)
                    if error.leg in _OF_GRASP:
                        options.give_up(grasp)
                    continue
                found = True
                yield transfer
            if not found and options.why:
                self.why = options.why
        except NoPlanError as error:
            self.why = str(error)

    def _mine(self, key: str) -> Steer | None:
        steer = self._steer
        return steer if steer is not None and steer.object_id in (None, key) else None

    def _moved(
        self,
        problem: Problem,
        grasp: Grasp,
        release: Release,
        start_rad: Joints,
        options: "_Options",
    ) -> Transfer:
        """The first way that keeps what holds on the way."""
        kept = _kept_on_the_way(problem, grasp)
        task, stages = problem.scene.task, stages_of(problem.scene.task, grasp.object_id)
        limits = {leg: speed_limit(task, stage_of_leg(leg, stages)) for leg in LEGS}
        ways, base = _WAYS, PathConfig()
        steer = self._mine(grasp.object_id)
        if steer is not None and steer.change == "path":
            ways = ways[2:]
            eps_m = base.replay.eps_col_m + WIDER_M + steer.lacking_m
            base = replace(base, replay=replace(base.replay, eps_col_m=eps_m))
            base = replace(base, seed=len(steer.refused))
        elif steer is not None and steer.change == "slower":
            speed, acceleration = base.speed_share * SLOWER, base.acceleration_share * SLOWER
            base = replace(base, speed_share=speed, acceleration_share=acceleration)
        failures: list[NoPathError] = []
        for way in ways:
            config = replace(base, seed=base.seed + self._seed % 2**31 + way.more_seed)
            try:
                legs = PickAndPlace(
                    problem=problem, grasp=grasp, release=release, config=config,
                    lift_m=way.lift_m, straight=way.straight, tool_m_s=limits,
                ).legs(start_rad)  # fmt: skip
                kept(legs)
            except NoPathError as error:
                failures.append(error)
                if error.reason != NOT_KEPT and not way.straight:
                    break  # where nothing is free, another height is not either
                continue
            lies = lying_there(problem, release, options.miss_with(grasp))
            return Transfer(
                key=grasp.object_id,
                grasp=grasp,
                release=release,
                legs=legs,
                after=left_with(problem, grasp.object_id, lies, legs[-1].path.joints_rad[-1]),
                cost=release.cost + erfc(grasp.margin / sqrt(2.0)) / 2,
                remarks=options.remarks_of(grasp, release),
            )
        raise failures[0]


def _why_not_moved(problem: Problem, key: str, error: NoPathError) -> str:
    """Why an object cannot be moved so, and what would help."""
    if error.reason == START_TOUCHES and error.leg == "around":
        return (
            f"the arm starts in collision: {' touches '.join(error.bodies)}. Move it clear, and "
            "record the start again: robot-gst record RUN."
        )
    around = {*problem.scene.task.objects, TABLE, SCENE}
    if error.reason == NOT_KEPT:
        hint = "Ask less of the way, or put the objects elsewhere."
    elif error.reason == BUDGET_SPENT:
        hint = "Clear the way from where it lies to where it goes."
    elif not error.bodies:
        hint = "Move the object, or where it goes, nearer to the arm."
    elif around.isdisjoint(error.bodies):
        hint = "The arm is in its own way: move the object, or where it goes."
    else:
        hint = "Move apart what touches, or put the objects elsewhere."
    return f"{key}: {error}. {hint}"


class _Options:
    """Grasps of one object with their final states, as a refusal wants them."""

    def __init__(self, problem: Problem, key: str, seed: int, steer: Steer | None) -> None:
        self._problem, self._key, self._seed, self._steer = problem, key, seed, steer
        found = GraspSearcher(problem).search(key)
        self._remarks = found.remarks
        kept = _kept_at_the_grasp(problem, found.grasps)
        self.grasps = self._ordered(kept)[:GRASPS]
        self.num_grasps = len(found.grasps)
        records = goals_of(problem.scene.task, key)
        self._relation = problem.scene.task.goal_of(key)
        self._goals = [
            compile_constraint(record, problem)
            for record in records
            if record["kind"] not in _PLACED or record.get("support") == TABLE
        ]
        self._wishes = _subgoals(problem, key, "release")
        self.why = ""
        self._given_up: list[Grasp] = []

    def give_up(self, grasp: Grasp) -> None:
        """No final state helps this grasp: the arm does not get there."""
        self._given_up.append(grasp)

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
        if steer.change == "grasp_shift" and steer.toward_m is not None:
            toward = np.array(steer.toward_m)
            near = sorted(
                grasps, key=lambda each: float(np.linalg.norm(each.T_object_tcp[:3, 3] - toward))
            )
            fresh = [grasp for grasp in near if not refused(grasp)]
            shifted = self._shifted(next((g for g in grasps if refused(g)), grasps[0]), toward)
            return [*shifted, *fresh]
        return sorted(grasps, key=lambda each: not refused(each))

    def _shifted(self, grasp: Grasp, toward_m: Vector) -> list[Grasp]:
        """The refused grasp moved along its pads to where a finger met the object."""
        T = grasp.T_object_tcp.copy()
        way = toward_m - T[:3, 3]
        T[:3, 3] += way - T[:3, 1] * (way @ T[:3, 1])  # between the pads it stays in the middle
        if self._steer is not None and self._steer.has_grasp_like(self._key, T):
            return []
        goal = self._problem.scene.Ts_base_object[self._key] @ T
        joints = nearest_solutions(self._problem.robot, goal, grasp.joints_rad)
        return [replace(grasp, T_object_tcp=T, joints_rad=joints[0])] if joints else []

    def pairs(self) -> Iterator[tuple[Grasp, Release]]:
        """Every grasp with its cheapest final state, then every grasp with the next, and so on."""
        states: dict[int, tuple[Release, ...]] = {}
        for rank in range(MAX_RELEASES):
            for number, grasp in enumerate(self.grasps):
                if any(grasp is each for each in self._given_up):
                    continue
                if number not in states:
                    states[number] = self._releases(grasp)
                if rank < len(states[number]):
                    yield grasp, states[number][rank]
        if not self.grasps:
            self.why = f"no grasp of {self._key} is left that was not refused"

    def _releases(self, grasp: Grasp) -> tuple[Release, ...]:
        try:
            releases = self._final_states(grasp)
        except NoPlanError as error:
            self.why = str(error)
            if error.cause in _HOPELESS:
                raise
            return ()
        steer = self._steer
        if steer is None or steer.change != "release" or self.miss_with(grasp) is not None:
            return releases  # a measured miss changes where they are
        return tuple(each for each in releases if not steer.has_end_like(each))

    def miss_with(self, grasp: Grasp) -> Miss | None:
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
            miss=self.miss_with(grasp), seed=self._seed,
        )  # fmt: skip

    def remarks_of(self, grasp: Grasp, release: Release) -> tuple[str, ...]:
        """Where the numbers of a transfer come from, in words."""
        return (
            f"{self._key}: grasp of {self.num_grasps}, {grasp.width_m * 1e3:.0f} mm wide, bears "
            f"{grasp.margin:.1f} standard deviations",
            *(f"{self._key}: {text}" for text in self._remarks),
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


def _kept_on_the_way(problem: Problem, grasp: Grasp) -> Callable[[tuple[Leg, ...]], None]:
    """Ask the constraints of the object's stages of each leg that belongs to them."""
    task, key = problem.scene.task, grasp.object_id
    ids = stages_of(task, key)
    tables = {str(table["id"]): table for table in task.stages}
    of_stage: dict[str, list[Constraint]] = {
        stage: [compile_constraint(way, problem) for way in tables[stage].get("path", ())]
        for stage in ids.values()
    }
    at_the_end = _subgoals(problem, key, "carry")

    def check(legs: tuple[Leg, ...]) -> None:
        for leg in legs:
            if not leg.g:
                continue  # it lies where it lay; the time law keeps speeds there
            stage = stage_of_leg(leg.name, ids)
            states = _states_along(problem, grasp, leg)
            times_s = leg.path.times_s
            asked = [(each, each.worst_along(states, times_s)) for each in of_stage[stage]]
            if leg.name == "carry":
                asked += [(each, float(each.violation(states)[-1])) for each in at_the_end]
            for constraint, f in asked:
                if f > 0:
                    factor, unit = SHOWN[constraint.unit]
                    detail = f"{constraint.kind} is violated by {f * factor:.3g} {unit}"
                    error = NoPathError(reason=NOT_KEPT, detail=detail)
                    error.leg = leg.name
                    raise error

    return check


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


def _written(
    problem: Problem, after: Problem, trajectory: Trajectory, policy: str, plan_id: str
) -> Plan:
    """A plan of a trajectory that leaves its objects so."""
    task, record = problem.scene.task, problem.robot.record
    return Plan(
        id=plan_id,
        planner=PLANNER,
        policy=policy,
        condition="without_replanning",
        robot=record.name,
        frame=record.base_frame,
        task=task.name,
        instruction=task.instruction,
        entities={key: se3.pose_record(T) for key, T in problem.scene.Ts_base_object.items()},
        joint_names=record.joints,
        stages=tuple(
            plan_stage(task, table, trajectory.bounds, after.scene.Ts_base_object)
            for table in task.stages
        ),
        tau=tuple(trajectory.tau),
    )
