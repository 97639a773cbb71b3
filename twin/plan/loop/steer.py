"""What a refusal asks the planner to change: the failing clause chooses."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from bridge.errors import InvalidRecordError
from bridge.geometry import se3
from bridge.task.causes import Cause
from bridge.task.plan import Plan, Waypoint
from bridge.task.plan_request import Refusal
from bridge.task.task_file import Task
from bridge.task.verdict import Factor, Verdict
from twin.plan.problem import Grasp, Miss, Pose, Problem, Release
from twin.plan.stage.solver import alike
from twin.replay.config import ReplayConfig

Change = Literal["grasp", "release", "path", "slower", "any"]
MOST_MISS_M, MOST_MISS_RAD = 0.04, np.radians(30.0)
"""An object that ends farther from where it was let go fell, or was knocked over."""
_SQUEEZED = (Cause.EXPLODED, Cause.SHAPE, Cause.PROBABILITY)
_IN_OBJECT = (Cause.DEEP_CONTACT, Cause.PRE_GRASP_PENETRATION)


@dataclass(frozen=True, kw_only=True)
class Tried:
    """How a plan took hold of an object and let it go."""

    object_id: str
    T_object_tcp: Pose
    """Tool where the gripper is told to close, in the object's frame at the start."""
    T_base_release: Pose | None = None
    """Tool where the gripper is told to open; None where it never is."""

    @property
    def T_base_object(self) -> Pose | None:
        """Where the object was meant to be then; None where it is never let go."""
        T = self.T_base_release
        return None if T is None else T @ se3.invert(self.T_object_tcp)


@dataclass(frozen=True, kw_only=True)
class Steer:
    """The change a refusal asks for, and everything that was refused before."""

    change: Change
    """``grasp``: another one; ``release``: another final state; ``path``: another way or approach;
    ``slower``: the same at less speed; ``any``: nothing in particular."""
    clause: str
    """Factor and cause: ``terminal.inside``."""
    bodies: tuple[str, ...] = ()
    object_id: str | None = None
    """Whose grasp or release is meant; None: none in particular."""
    miss: Miss | None = None
    """How far beside the newest refused release the object came to lie, held in that grasp."""
    lacking_m: float = 0.0
    """How much farther apart the nearest bodies should have been."""
    refused: tuple[Tried, ...] = ()

    def miss_with(self, grasp: Grasp) -> Miss | None:
        """The miss that was measured with a grasp; None: with this one none was."""
        newest = [tried for tried in self.refused if tried.object_id == grasp.object_id][-1:]
        is_same = newest and alike(newest[0].T_object_tcp[None], grasp.T_object_tcp)[0]
        return self.miss if is_same else None

    def has_grasp_like(self, object_id: str, T_object_tcp: Pose) -> bool:
        """Whether a grasp was refused that is the same within 1 cm and 10 degrees."""
        mine = [tried.T_object_tcp for tried in self.refused if tried.object_id == object_id]
        return bool(mine) and bool(alike(np.array(mine), T_object_tcp).any())

    def has_end_like(self, release: Release) -> bool:
        """Whether a release was refused that leaves the object within 1 cm and 10 degrees of it."""
        mine = [
            tried.T_base_object for tried in self.refused if tried.object_id == release.object_id
        ]
        there = [T for T in mine if T is not None]
        return bool(there) and bool(alike(np.array(there), release.T_base_object).any())


def steer_by(refusals: Sequence[Refusal], problem: Problem) -> Steer:
    """Let the first failing clause of the newest refusal choose what changes, and by how much."""
    task, verdict = problem.scene.task, refusals[-1].verdict
    name = verdict.first_failing
    factor = Factor(value=None) if name is None else verdict.factors()[name]
    moved = [body for body in factor.bodies if body in task.manipulated]
    object_id = moved[0] if moved else None
    gripper = problem.robot.record.gripper
    change = _change(name, factor, verdict, task, ("gripper", gripper.name, *gripper.links))
    lacking_m = 0.0
    if name == "clearance" and verdict.nearest is not None:
        lacking_m = max(0.0, ReplayConfig().eps_col_m - float(verdict.nearest["distance_m"]))
    return Steer(
        change=change,
        clause=f"{name}.{factor.cause}" if factor.cause else name or "undecided",
        bodies=factor.bodies,
        object_id=object_id,
        miss=_miss_of(refusals, object_id) if change == "release" else None,
        lacking_m=lacking_m,
        refused=tuple(tried for refusal in refusals for tried in tried_in(refusal.plan)),
    )


def _miss_of(refusals: Sequence[Refusal], object_id: str | None) -> Miss | None:
    """How far beside where it was let go an object lies in the end; None: it was not carried there.

    Of the last two plans with the newest grasp, half way: an object may leave either finger last.
    Seen in the twin, or measured after an execution; a verdict keeps both alike.
    """
    found: list[tuple[Pose, Miss | None]] = []
    for refusal in refusals:
        for tried in tried_in(refusal.plan):
            if tried.object_id == object_id:
                found.append((tried.T_object_tcp, _measured(tried, refusal.verdict)))
    if not found or found[-1][1] is None:
        return None
    same = [miss for T, miss in found if miss is not None and alike(T[None], found[-1][0])[0]][-2:]
    shift_m = np.mean([miss.shift_m for miss in same], axis=0)
    return Miss(shift_m=shift_m, turn_rad=float(np.mean([miss.turn_rad for miss in same])))


def _measured(tried: Tried, verdict: Verdict) -> Miss | None:
    T_meant = tried.T_base_object
    for item in verdict.grasps:
        ended = item.get("T_base_object")
        if T_meant is not None and item["object"] == tried.object_id and item["held"] and ended:
            miss = Miss.measured(T_meant, se3.pose_from_record(ended))
            far_m = float(np.linalg.norm(miss.shift_m))
            if far_m < MOST_MISS_M and abs(miss.turn_rad) < MOST_MISS_RAD:
                return miss
    return None


def _change(
    name: str | None, factor: Factor, verdict: Verdict, task: Task, fingers: Collection[str]
) -> Change:
    cause = factor.cause or ""
    if name == "limits" or cause == Cause.JOINT_SPEED:
        return "slower"
    if name == "ik":
        return "grasp"  # which brings other postures
    if name in ("clearance", "audit"):
        return _change_of_contact(cause, factor.bodies, task, fingers)
    if name == "terminal":
        return _change_of_outcome(cause, factor.bodies, verdict, task)
    return "any"  # it starts elsewhere, or asks for what its task does not give


def _change_of_contact(
    cause: str, bodies: Sequence[str], task: Task, fingers: Collection[str]
) -> Change:
    moved = {body for body in bodies if body in task.manipulated}
    others = set(bodies) - moved
    if moved and (cause in _IN_OBJECT or others & set(fingers)):
        return "grasp"
    targets = {goal[1] for each in moved if (goal := task.goal_of(each)) is not None}
    return "release" if others & (targets | set(task.containers)) and moved else "path"


def _change_of_outcome(cause: str, bodies: Sequence[str], verdict: Verdict, task: Task) -> Change:
    if cause in _SQUEEZED:
        return "grasp"
    if cause == "allowed_contacts":
        return "path"
    named = set(bodies) & set(task.manipulated)
    slipped = any(item["object"] in named and not item["held"] for item in verdict.grasps)
    return "grasp" if slipped else "release"


def tried_in(plan: Plan) -> tuple[Tried, ...]:
    """Read from a plan how it grasps and releases each object; unreadable poses are left out."""
    found = []
    for stage in plan.stages:
        closing = None if stage.grasp is None else _first(plan, stage.t_start_ns, g=1)
        if stage.grasp is None or closing is None or stage.grasp not in plan.entities:
            continue
        try:
            T_base_object = se3.pose_from_record(plan.entities[stage.grasp])
        except InvalidRecordError:
            continue
        opening = _first(plan, closing.t_ns, g=0)
        found.append(
            Tried(
                object_id=stage.grasp,
                T_object_tcp=se3.invert(T_base_object) @ tool_at(closing),
                T_base_release=None if opening is None else tool_at(opening),
            )
        )
    return tuple(found)


def _first(plan: Plan, from_ns: int, *, g: int) -> Waypoint | None:
    return next((each for each in plan.tau if each.t_ns >= from_ns and each.g == g), None)


def tool_at(waypoint: Waypoint) -> Pose:
    """Pose of the tool that is commanded."""
    return se3.transform_from(np.array(waypoint.q_wxyz), np.array(waypoint.p_m))
