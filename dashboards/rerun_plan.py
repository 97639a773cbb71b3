"""What a planner had in mind, in Rerun: the grasps it looked at, its way, where things should end.

``/plans/<id>`` is one plan of the recording, from when it was published on: ``tool_path`` in the
colour of its verdict, ``grasps/<object>/<rank>`` as open hands, the chosen one strong,
``predicted/<object>`` where the object should lie at the end of a stage. ``/planned_arm`` follows
the plan that counts. Of a plan that was steered, those refused before it are shown too.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rerun as rr
from jaxtyping import Float

from bridge.episode.reader import Episode
from bridge.episode.run_folder import PLAN_REPLAY, RunFolder
from bridge.episode.streams import JointTrack, plans, verdicts
from bridge.errors import GstError, InvalidRecordError
from bridge.geometry import se3
from bridge.geometry.trajectory import PoseTrajectory
from bridge.task.plan import CandidateGrasp, Plan
from bridge.task.task_file import Task
from bridge.task.verdict import Verdict
from dashboards.recording import PageClock, Recording
from dashboards.rerun_entities import log_robot
from dashboards.rerun_file import RerunFile
from dashboards.rerun_objects import log_object
from dashboards.wording import verdict_word

NOT_IN_A_PATH = r"[^A-Za-z0-9_.-]"
ROOT = "plans"
ARM = "planned_arm"
"""One part: Rerun's robot descriptions take a prefix of several for one with strokes in it."""
ACCEPTED, REFUSED, UNDECIDED = (38, 154, 82), (205, 52, 52), (128, 137, 153)
CHOSEN, OTHER = (38, 154, 82), (150, 160, 175)
PATH_RADIUS_M, CHOSEN_RADIUS_M, OTHER_RADIUS_M = 0.002, 0.0025, 0.0009
FINGER_M, PALM_M = 0.045, 0.04
"""Length of a drawn finger, and of the line that the hand comes along."""
MOST_BEFORE = 20
"""Refused plans that are looked for before one."""
GRIPPER_WIDTH = "gripper_width"


@dataclass(frozen=True, kw_only=True)
class ShownPlan:
    """One plan, when it begins to be shown, and what the twin said."""

    plan: Plan
    stamp_ns: int
    start_ns: int
    """When its first waypoint is due: as executed, else when it was published."""
    verdict: Verdict | None

    @property
    def entity(self) -> str:
        """Everything of it is below."""
        return f"{ROOT}/{re.sub(NOT_IN_A_PATH, '_', self.plan.id)}"

    @property
    def tool_path(self) -> str:
        """Its way."""
        return f"{self.entity}/tool_path"

    @property
    def color(self) -> tuple[int, int, int]:
        """By what the twin said."""
        accepted = None if self.verdict is None else self.verdict.accepted
        return {True: ACCEPTED, False: REFUSED, None: UNDECIDED}[accepted]

    def line(self) -> str:
        """What it is, in words."""
        plan, verdict = self.plan, self.verdict
        words = [f"`{plan.id}`: {plan.planner}, policy {plan.policy}, round {plan.round}"]
        if plan.candidate is not None:
            words.append(f"rank {plan.candidate.rank}, J {plan.candidate.cost:.4f}")
        if plan.grasps:
            words.append(f"{len(plan.grasps)} grasps looked at")
        if plan.parent_id is not None:
            words.append(f"after `{plan.parent_id}`")
        if plan.steered_by is not None:
            words.append(f"steered by {plan.steered_by.clause}")
        judged = "not judged" if verdict is None else verdict_word(verdict.accepted)
        name = None if verdict is None else verdict.first_failing
        if verdict is not None and name is not None:
            judged += f" by {name}.{verdict.factors()[name].cause}"
        return ", ".join([*words, judged])


def shown_plans(
    file: RerunFile, recording: Recording, clock: PageClock, run: RunFolder | None
) -> list[ShownPlan]:
    """Every plan of a recording with its verdict; before a plan's replay, those it was steered by.

    Args:
        file: Notes what could not be read.
        recording: An episode, or a replay.
        clock: Knows when which plan was executed.
        run: Where refused plans lie; None: nowhere.
    """
    verdicts_of = {verdict.plan_id: verdict for _, verdict in recording.verdicts}
    found = [
        ShownPlan(
            plan=plan,
            stamp_ns=stamp_ns,
            start_ns=clock.starts_ns.get(plan.id, stamp_ns),
            verdict=verdicts_of.get(plan.id),
        )
        for stamp_ns, plan in recording.plans
    ]
    if run is None or not run.holds_plan(recording.path) or not found:
        return found
    return [*_before(file, run, found[0]), *found]


def _before(file: RerunFile, run: RunFolder, shown: ShownPlan) -> list[ShownPlan]:
    """The refused plans that led to one, oldest first."""
    before: list[ShownPlan] = []
    parent_id = shown.plan.parent_id
    while parent_id is not None and len(before) < MOST_BEFORE:
        path = run.plans_dir / f"{Path(parent_id).name}{PLAN_REPLAY}"
        try:
            episode = Episode.open(path)
            plan = plans(episode)[-1][1]
            verdict = verdicts(episode)[-1][1]
        except (GstError, IndexError) as error:
            file.note(f"plan {parent_id}, refused before, is not shown: {error}")
            break
        start_ns = shown.start_ns
        before.append(ShownPlan(plan=plan, stamp_ns=start_ns, start_ns=start_ns, verdict=verdict))
        parent_id = plan.parent_id
    return before[::-1]


def log_plans(
    file: RerunFile, shown: Sequence[ShownPlan], task: Task | None, urdf: str | None
) -> bool:
    """Log plans; return whether the arm is drawn along the one that counts, the last.

    Args:
        file: The Rerun file being written.
        shown: Oldest first.
        task: Knows the shapes of objects; None draws axes instead.
        urdf: Robot description; None where there is none.
    """
    for each in shown:
        _log_way(file, each)
        _log_grasps(file, each)
        for name, track in _predicted(file, each):
            log_object(file, f"{each.entity}/predicted/{name}", track, task)
    if not shown:
        return False
    last = counted_plan(shown)
    joints, widths = _tracks(last)
    if joints is None:
        file.note(f"plan {last.plan.id} says nothing of the arm's joints")
        return False
    return log_robot(file, urdf, ARM, joints=joints, widths=widths)


def counted_plan(shown: Sequence[ShownPlan]) -> ShownPlan:
    """The last plan that was executed, else the last one."""
    return next((each for each in shown[::-1] if each.start_ns != each.stamp_ns), shown[-1])


def _log_way(file: RerunFile, shown: ShownPlan) -> None:
    """The tool's way, and where the hand closes and opens."""
    plan = shown.plan
    stamps = np.array([shown.stamp_ns])
    way = rr.LineStrips3D.columns(
        strips=[plan.positions_m()], radii=[PATH_RADIUS_M], colors=[shown.color]
    )
    file.rows(shown.tool_path, stamps, way)
    changes = [
        (one.p_m, "closes" if one.g else "opens")
        for before, one in zip(plan.tau, plan.tau[1:], strict=False)
        if one.g != before.g
    ]
    if changes:
        points, labels = zip(*changes, strict=True)
        count = len(points)
        columns = rr.Points3D.columns(
            positions=np.array(points),
            radii=[3 * PATH_RADIUS_M] * count,
            colors=[shown.color] * count,
            labels=list(labels),
        ).partition([count])
        file.rows(f"{shown.entity}/hand", stamps, columns)


def _log_grasps(file: RerunFile, shown: ShownPlan) -> None:
    """Candidate grasps as open hands at the object's place, in the order they were to be tried."""
    counts: dict[str, int] = {}
    for grasp in shown.plan.grasps:
        rank = counts.get(grasp.object, 0)
        counts[grasp.object] = rank + 1
        try:
            T_base_object = se3.pose_from_record(shown.plan.entities.get(grasp.object))
        except InvalidRecordError:
            file.note(f"plan {shown.plan.id} does not say where {grasp.object} is")
            continue
        T = T_base_object @ se3.transform_from(np.array(grasp.q_wxyz), np.array(grasp.p_m))
        columns = rr.LineStrips3D.columns(
            strips=list(_hand(T, grasp)),
            radii=[CHOSEN_RADIUS_M if grasp.chosen else OTHER_RADIUS_M] * 2,
            colors=[CHOSEN if grasp.chosen else OTHER] * 2,
            labels=[f"{rank}: {grasp.margin:.1f} sd{', chosen' if grasp.chosen else ''}", ""],
        ).partition([2])
        entity = f"{shown.entity}/grasps/{grasp.object}/{rank}"
        file.rows(entity, np.array([shown.stamp_ns]), columns)
        file.always(entity, rr.LineStrips3D.from_fields(show_labels=grasp.chosen))


def _hand(
    T_base_tcp: Float[np.ndarray, "4 4"], grasp: CandidateGrasp
) -> tuple[Float[np.ndarray, "4 3"], Float[np.ndarray, "2 3"]]:
    """Two fingers with the palm, and the line that the hand comes along; fingers close along y."""
    half = grasp.width_m / 2
    fingers = np.array([[0, -half, 0], [0, -half, -FINGER_M], [0, half, -FINGER_M], [0, half, 0]])
    approach = np.array([[0, 0, -FINGER_M], [0, 0, -FINGER_M - PALM_M]])
    return se3.apply(T_base_tcp, fingers), se3.apply(T_base_tcp, approach)


def _predicted(file: RerunFile, shown: ShownPlan) -> Iterator[tuple[str, PoseTrajectory]]:
    """Where objects should lie, from the end of the stage that leaves them there."""
    for stage in shown.plan.stages:
        for name, record in stage.predicted_objects.items():
            try:
                q, p = se3.split(se3.pose_from_record(record))
            except InvalidRecordError as error:
                file.note(f"plan {shown.plan.id}, {name}: {error}")
                continue
            stamps = np.array([shown.start_ns + stage.t_end_ns])
            yield name, PoseTrajectory(stamps, p[None], q[None])


def _tracks(shown: ShownPlan) -> tuple[JointTrack | None, JointTrack | None]:
    """Arm and hand along a plan; None where it does not say."""
    plan = shown.plan
    stamps = shown.start_ns + plan.times_ns()
    rows = [each.joints_rad for each in plan.tau]
    joints = None
    if plan.joint_names and all(row is not None for row in rows):
        joints = JointTrack(
            stamps_ns=stamps, names=plan.joint_names, position=np.array(rows, dtype=np.float64)
        )
    widths = [each.width_m for each in plan.tau]
    if any(width is None for width in widths):
        return joints, None
    column = np.array(widths, dtype=np.float64)[:, None]
    return joints, JointTrack(stamps_ns=stamps, names=(GRIPPER_WIDTH,), position=column)
