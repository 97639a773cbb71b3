"""What a plan must keep beside I(tau): start where the robot is, stay in its task and the limits.

Each check names its cause and both numbers, found and allowed. Where joints are, and that they do
not jump, belongs to the factor ``ik``; what is beyond the robot's other limits to ``limits``.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from bridge.robots.robot import Robot
from bridge.robots.stop import PressedStop
from bridge.task.causes import Cause
from bridge.task.plan import Plan, Stage
from bridge.task.task_file import Task
from twin.replay.config import START_M, START_RAD
from twin.replay.failure import Failure
from twin.replay.path import JointPath
from twin.robot.model import RobotModel


def start_failures(
    plan: Plan, path: JointPath, measured_rad: Float[np.ndarray, " num_joints"], robot: RobotModel
) -> list[Failure]:
    """Say how far a plan's first waypoint is from where the robot stands."""
    off_rad = np.abs(path.joints_rad[0] - measured_rad)
    joint = int(np.argmax(off_rad))
    place_m = robot.T_base_tcp(measured_rad)[:3, 3]
    off_m = float(np.linalg.norm(np.array(plan.tau[0].p_m) - place_m))
    if off_rad[joint] <= START_RAD and off_m <= START_M:
        return []
    return [
        Failure(
            t_ns=0,
            cause=Cause.START_ELSEWHERE,
            bodies=(robot.record.joints[joint],),
            detail=f"the plan starts {off_m * 1e3:.1f} mm and {off_rad[joint]:.3f} rad "
            f"({robot.record.joints[joint]}) from where the robot is; the limits are "
            f"{START_M * 1e3:.0f} mm and {START_RAD:g} rad",
        )
    ]


# Only the task file decides what may touch and what success is. A plan says when its stages are; it
# may allow fewer contacts than its task, never more, and its own terminal predicates mean nothing.


def task_failures(plan: Plan, task: Task) -> list[Failure]:
    """Find what a plan's stages ask for that its task does not give them."""
    tables = {str(table["id"]): table for table in task.stages}
    failures: list[Failure] = []
    begun: dict[str, int] = {}
    for stage in plan.stages:
        table = tables.get(stage.id)
        latest_ns = max(begun.values(), default=0)
        if table is None:
            detail = f"stage {stage.id!r} is not one of task {task.name}: {', '.join(tables)}"
            failures.append(_stage_failure(stage, Cause.UNKNOWN_STAGE, detail))
            continue
        if stage.id in begun:
            detail = f"{stage.id!r} is there twice"
            failures.append(_stage_failure(stage, Cause.REPEATED_STAGE, detail))
        elif stage.t_start_ns < latest_ns or stage.t_end_ns < stage.t_start_ns:
            detail = (
                f"stage {stage.id!r} runs from {_s(stage.t_start_ns)} to {_s(stage.t_end_ns)}, the "
                f"one before it begins at {_s(latest_ns)}"
            )
            failures.append(_stage_failure(stage, Cause.STAGE_TIMES, detail))
        extra = [pair for pair in stage.allowed_contacts if set(pair) not in _pairs(table)]
        if extra:
            one, other = extra[0]
            detail = f"the plan lets {one} touch {other} in stage {stage.id!r}; the task does not"
            bodies = (one, other)
            failures.append(_stage_failure(stage, Cause.CONTACT_NOT_ALLOWED, detail, bodies))
        begun[stage.id] = stage.t_start_ns
        failures += _grasp_failures(plan, stage, tables, begun)
    return failures


def _grasp_failures(
    plan: Plan, stage: Stage, tables: Mapping[str, Mapping[str, object]], begun: Mapping[str, int]
) -> list[Failure]:
    """A stage that carries or releases begins after the gripper has closed in the one that grasps.

    Otherwise a plan could be in its last stage, with all that may touch there, from the beginning.
    """
    table = tables[stage.id]
    name = table.get("release") or table.get("carry")
    grasping = [key for key, item in tables.items() if name and item.get("grasp") == name]
    if not grasping or stage.id in grasping:
        return []
    grasped_ns = begun.get(grasping[0])
    closed = grasped_ns is not None and any(
        waypoint.g == 1 and grasped_ns <= waypoint.t_ns <= stage.t_start_ns for waypoint in plan.tau
    )
    if closed:
        return []
    detail = (
        f"stage {stage.id!r} begins at {_s(stage.t_start_ns)}, before the gripper has closed in "
        f"{grasping[0]!r}"
    )
    return [_stage_failure(stage, Cause.STAGE_ORDER, detail)]


def _stage_failure(
    stage: Stage, cause: Cause, detail: str, bodies: tuple[str, ...] = ()
) -> Failure:
    return Failure(t_ns=max(0, stage.t_start_ns), cause=cause, detail=detail, bodies=bodies)


def _pairs(table: Mapping[str, object]) -> list[set[str]]:
    pairs = table.get("allowed_contacts")
    return [set(pair) for pair in pairs] if isinstance(pairs, list | tuple) else []


def _s(t_ns: int) -> str:
    return f"{t_ns * 1e-9:.2f} s"


def limited_to_task(plan: Plan, task: Task) -> Plan:
    """The same plan with the contacts that its task allows too, and its task's grasps and releases.

    Stages that the task does not know allow nothing.
    """
    tables = {str(table["id"]): table for table in task.stages}
    stages = []
    for stage in plan.stages:
        table = tables.get(stage.id, {})
        pairs = tuple(pair for pair in stage.allowed_contacts if set(pair) in _pairs(table))
        grasp, release = table.get("grasp"), table.get("release")
        stages.append(replace(stage, allowed_contacts=pairs, grasp=grasp, release=release))
    return replace(plan, stages=tuple(stages))


def stops_of_arm(
    stamps_ns: Int[np.ndarray, " num_states"],
    off_rad: Float[np.ndarray, "num_states num_joints"],
    force_N: Float[np.ndarray, " _"],
    record: Robot,
) -> list[Failure]:
    """Find where an arm would stop by itself: too far from its command, or pressed too hard."""
    failures, limit_rad = [], record.tracking_error_rad
    over = [] if limit_rad is None else np.argwhere(~(np.abs(off_rad) <= limit_rad)).tolist()
    for index, joint in over[:1]:
        name, t_ns = record.joints[joint], int(stamps_ns[index])
        detail = (
            f"{name} is {abs(off_rad[index, joint]):.3f} rad from where it is commanded, the limit "
            f"is {limit_rad:g} rad"
        )
        bodies, cause = (name,), Cause.TRACKING_ERROR
        failures.append(Failure(t_ns=t_ns, cause=cause, bodies=bodies, detail=detail))
    pressed = PressedStop(record.contact_force_N)
    lasted_ns = np.diff(stamps_ns, prepend=stamps_ns[:1])
    for t_ns, newton, each_ns in zip(stamps_ns.tolist(), force_N, lasted_ns, strict=False):
        if detail := pressed.found(float(newton), int(each_ns)):
            return [*failures, Failure(t_ns=t_ns, cause=Cause.CONTACT_FORCE, detail=detail)]
    return failures
