"""What a robot did without a plan, told in the words of one: stages, grips, start and end.

Nobody said what was meant, so there is nothing planned to replay. What was executed is followed as
it is with a plan; which contacts the task allows when follows from the fingers and the tool.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from bridge.episode.executions import NO_PLAN
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.streams import JointTrack
from bridge.geometry import se3
from bridge.task.plan import Plan, Stage, Waypoint
from bridge.task.task_file import Task
from twin.robot.model import RobotModel

PLATEAU_M = 0.002
"""Finger distances that differ by less are the same: one this close to the smallest belongs to the
grasp."""
LEFT_M = 0.05
"""A stage that grasps or releases ends when the tool is this far from where the fingers did it."""

Grip = tuple[int, int, int]
"""When the fingers begin to close, when they hold, and when they begin to open again."""


def observed_plan(
    arm: JointTrack, widths: JointTrack, robot: RobotModel, task: Task, info: EpisodeInfo
) -> Plan:
    """Describe an execution that nobody planned; times count from the tracks' first sample."""
    start_ns, end_ns = int(arm.stamps_ns[0]), int(arm.stamps_ns[-1])
    times_ns = widths.stamps_ns - start_ns
    grips = find_grips(times_ns, widths.position[:, 0])
    marks = {0: 0, end_ns - start_ns: 0}
    for closing_ns, _, opening_ns in grips:
        marks |= {closing_ns: 1, min(opening_ns, end_ns - start_ns): 0}
    if grips and grips[-1][2] >= end_ns - start_ns:
        marks[end_ns - start_ns] = 1
    at_ns = np.array(sorted(marks), dtype=np.int64)
    q_wxyz, p_m = se3.split(robot.Ts_base_tcp(arm.at(start_ns + at_ns)))
    tau = tuple(
        Waypoint(
            t_ns=t_ns,
            p_m=tuple(p),
            q_wxyz=tuple(q),
            g=marks[t_ns],
            width_m=0.0 if marks[t_ns] else None,
        )
        for t_ns, p, q in zip(at_ns.tolist(), p_m.tolist(), q_wxyz.tolist(), strict=True)
    )
    tool_ns = arm.stamps_ns - start_ns
    p_tool_m = robot.Ts_base_tcp(arm.position)[:, :3, 3]
    return Plan(
        id=NO_PLAN,
        planner="",
        policy=info.policy,
        condition=info.condition,
        robot=robot.name,
        frame=robot.record.base_frame,
        instruction=info.instruction or task.instruction,
        stages=observed_stages(task.stages, grips, tool_ns, p_tool_m),
        tau=tau,
        task=task.name,
        start_id=info.start_id,
    )


def find_grips(
    times_ns: Int[np.ndarray, " num_samples"], width_m: Float[np.ndarray, " num_samples"]
) -> list[Grip]:
    """Every time the fingers closed by more than 2 mm, until they opened again or all ended.

    They hold from when they are within 2 mm of the narrowest they got.
    """
    found: list[Grip] = []
    widest, first, narrowest = -np.inf, None, np.inf

    def grip(first: int, last: int) -> Grip:
        held = first + int(np.argmax(width_m[first : last + 1] <= narrowest + PLATEAU_M))
        return int(times_ns[first]), int(times_ns[held]), int(times_ns[last])

    for index, width in enumerate(width_m.tolist()):
        if first is None:
            widest = max(widest, width)
            if width < widest - PLATEAU_M:
                first, narrowest = index, width
            continue
        narrowest = min(narrowest, width)
        if width > narrowest + PLATEAU_M:
            found.append(grip(first, index))
            widest, first, narrowest = width, None, np.inf
    if first is not None:
        found.append(grip(first, len(times_ns) - 1))
    return found


def observed_stages(
    tables: Sequence[Mapping[str, Any]],
    grips: Sequence[Grip],
    times_ns: Int[np.ndarray, " num_samples"],
    p_tool_m: Float[np.ndarray, "num_samples 3"],  # base frame
) -> tuple[Stage, ...]:
    """Lay a task's stages over an execution.

    A stage that grasps ends when the tool leaves with what the fingers hold, one that releases when
    it leaves after they opened; stages that do neither share the time up to the next that does.
    What never happens lasts to the end.
    """
    end_ns, begun_ns = int(times_ns[-1]), 0
    waiting: list[Mapping[str, Any]] = []
    stages: list[Stage] = []
    for number, table in enumerate(tables):
        waiting.append(table)
        instants = [grip[1 if table.get("grasp") else 2] for grip in grips]
        done = [each for each in instants if each >= begun_ns]
        is_last = number == len(tables) - 1
        if not is_last and not (table.get("grasp") or table.get("release")):
            continue
        until_ns = end_ns if is_last or not done else _left(done[0], times_ns, p_tool_m)
        shares = np.linspace(begun_ns, until_ns, len(waiting) + 1).round().astype(int).tolist()
        spans = zip(waiting, pairwise(shares), strict=True)
        stages += [_stage(each, first_ns, last_ns) for each, (first_ns, last_ns) in spans]
        waiting, begun_ns = [], until_ns
    return tuple(stages)


def _left(
    t_ns: int,
    times_ns: Int[np.ndarray, " num_samples"],
    p_tool_m: Float[np.ndarray, "num_samples 3"],
) -> int:
    """When the tool is away from where it was at an instant."""
    at = min(int(np.searchsorted(times_ns, t_ns)), len(times_ns) - 1)
    away = np.linalg.norm(p_tool_m[at:] - p_tool_m[at], axis=1) > LEFT_M
    return int(times_ns[at + int(np.argmax(away))] if away.any() else times_ns[-1])


def _stage(table: Mapping[str, Any], start_ns: int, end_ns: int) -> Stage:
    pairs = table.get("allowed_contacts") or ()
    return Stage(
        id=str(table["id"]),
        text=str(table.get("text", "")),
        grasp=table.get("grasp"),
        release=table.get("release"),
        push=table.get("push"),
        allowed_contacts=tuple((str(a), str(b)) for a, b in pairs),
        t_start_ns=start_ns,
        t_end_ns=end_ns,
    )
