"""Executing a plan on the cell, with the events that say what was going on."""

from itertools import pairwise

import numpy as np

from bridge.sources.standin.cell import StandinCell
from bridge.task.plan import Plan
from bridge.task.robot import MAX_WIDTH_M

SETTLE_S = 0.8
"""The arm waits after a plan, so that the final state is seen at rest."""


def execute_plan(cell: StandinCell, plan: Plan) -> None:
    """Move as ``joints_rad`` says; events mark the plan, its stages and the gripper."""
    streams = cell.streams
    times = plan.times_ns()
    joints = np.array([waypoint.joints_rad for waypoint in plan.tau], dtype=np.float64)
    streams.event("execution_started", cell.now_ns, plan_id=plan.id)
    stage_id: str | None = None
    gripper: tuple[int, float | None] | None = None
    for first, last in _pieces(plan):
        stage = plan.stage_at(int(times[first]))
        if stage is not None and stage.id != stage_id:
            _end_stage(cell, plan, stage_id)
            stage_id = stage.id
            streams.event("stage_started", cell.now_ns, plan_id=plan.id, stage_id=stage_id)
        waypoint = plan.tau[last]
        if (waypoint.g, waypoint.width_m) != gripper:
            g, width = gripper = (waypoint.g, waypoint.width_m)
            cell.grip((0.0 if g else MAX_WIDTH_M) if width is None else width)
            streams.event(
                "gripper",
                cell.now_ns,
                plan_id=plan.id,
                text="close" if g else "open",
                data={"width_m": width},
            )
        cell.follow(times[first : last + 1] - times[first], joints[first : last + 1])
    _end_stage(cell, plan, stage_id)
    streams.event("execution_ended", cell.now_ns, plan_id=plan.id)
    cell.wait(SETTLE_S)


def _end_stage(cell: StandinCell, plan: Plan, stage_id: str | None) -> None:
    if stage_id is not None:
        cell.streams.event("stage_ended", cell.now_ns, plan_id=plan.id, stage_id=stage_id)


def _pieces(plan: Plan) -> list[tuple[int, int]]:
    """Cut the trajectory where the gripper's command or the stage changes.

    A waypoint's ``g`` and width hold for the time before it: the piece that ends there runs under
    them.
    """
    times = plan.times_ns()
    stages = [plan.stage_at(int(t)) for t in times]
    cuts = [0]
    for k in range(1, len(plan.tau) - 1):
        after, here = plan.tau[k + 1], plan.tau[k]
        gripper_changes = (after.g, after.width_m) != (here.g, here.width_m)
        stage_changes = stages[k] is not stages[k - 1]
        if gripper_changes or stage_changes:
            cuts.append(k)
    cuts.append(len(plan.tau) - 1)
    return list(pairwise(cuts))
