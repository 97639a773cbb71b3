"""From movements to a gst plan: the trajectory tau, the stages it goes through, what they leave."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from bridge.geometry import se3
from bridge.task.plan import Stage, Waypoint
from bridge.task.relations import RELATIONS
from bridge.task.task_file import Task
from twin.plan.path.planner import STEP_S, waypoints_of
from twin.plan.path.transfer import Leg
from twin.plan.problem import Grasp, NoPlanError, Pose
from twin.robot.model import RobotModel

Bounds = Mapping[str, tuple[int, int]]
"""When each stage begins and ends, from the start of the plan [ns]."""
KEPT_SHARE = 0.99
"""Of a speed limit that is driven at most, so that rounding breaks none."""
CLOSED_M = 0.0
"""Commanded width of the closed hand: its force, not its place, is what holds."""
SETTLE_S, CLOSE_S, OPEN_S = 0.2, 0.7, 0.5
"""Standing still before the hand moves, while it closes, and while it opens."""


@dataclass
class Trajectory:
    """Movements one after the other, with the hand's closing and opening in between."""

    robot: RobotModel
    tau: list[Waypoint] = field(default_factory=list)
    bounds: dict[str, tuple[int, int]] = field(default_factory=dict)
    end_s: float = 0.0

    def add_transfer(self, legs: Sequence[Leg], grasp: Grasp, stages: Mapping[str, str]) -> None:
        """Append a pick and place."""
        for leg in legs:
            stage = stage_of_leg(leg.name, stages)
            width_m = CLOSED_M if leg.g else grasp.open_m
            self.add(leg, stage, width_m)
            if leg.name == "approach":
                self.pause(stage, SETTLE_S, g=0, width_m=grasp.open_m)
                self.pause(stage, CLOSE_S, g=1, width_m=CLOSED_M)
            if leg.name == "lower":
                self.pause(stage, SETTLE_S, g=1, width_m=CLOSED_M)
                self.pause(stage, OPEN_S, g=0, width_m=grasp.open_m)

    def add(self, leg: Leg, stage: str, width_m: float) -> None:
        """Append one movement."""
        begin_s = self.end_s
        points = waypoints_of(self.robot, leg.path, g=leg.g, width_m=width_m, begin_s=begin_s)
        self.tau += points[1:] if self.tau else points
        self._ends(stage, begin_s, begin_s + float(leg.path.times_s[-1]))

    def pause(self, stage: str, seconds: float, *, g: int, width_m: float) -> None:
        """Stand still while the hand goes to a width, as fast as its fingers may at most."""
        here, begin_s = self.tau[-1], self.end_s
        before_m = width_m if here.width_m is None else here.width_m
        step_m = KEPT_SHARE * STEP_S * pads_speed_m_s(self.robot)
        count = max(1, math.ceil(abs(width_m - before_m) / step_m))
        seconds = max(seconds, (count + 1) * STEP_S)
        widths = np.linspace(before_m, width_m, count + 1)[1:].tolist()
        times_s = [STEP_S * number for number in range(1, count + 1)]
        for after_s, width in zip((*times_s, seconds), (*widths, width_m), strict=True):
            t_ns = round((begin_s + after_s) * 1e9)
            self.tau.append(replace(here, t_ns=t_ns, g=g, width_m=width))
        self._ends(stage, begin_s, begin_s + seconds)

    def _ends(self, stage: str, begin_s: float, end_s: float) -> None:
        begin_ns = self.bounds.get(stage, (round(begin_s * 1e9), 0))[0]
        self.bounds[stage] = (begin_ns, round(end_s * 1e9))
        self.end_s = end_s


def pads_speed_m_s(robot: RobotModel) -> float:
    """How fast the distance between the pads may change, by the limits of the fingers' joints."""
    gripper, model = robot.record.gripper, robot.model
    limits = [
        float(model.velocityLimit[model.joints[model.getJointId(finger.joint)].idx_v])
        / max(abs(finger.slope(share * gripper.max_width_m)) for share in (0.0, 0.25, 0.5, 0.75, 1))
        for finger in gripper.fingers
        if model.existJointName(finger.joint)
    ]
    return min((limit for limit in limits if limit > 0), default=np.inf)


def stages_of(task: Task, key: str) -> dict[str, str]:
    """Ids of the stages that grasp, carry, release and push an object, by their verb."""
    return {
        verb: str(table["id"])
        for table in task.stages
        for verb in ("grasp", "carry", "release", "push")
        if table.get(verb) == key
    }


def stage_of_leg(leg: str, stages: Mapping[str, str]) -> str:
    """Id of the stage to which a movement of a pick and place belongs."""
    if leg in ("around", "approach", "lift"):
        return stages["grasp"]
    return stages.get("carry", stages["release"]) if leg == "carry" else stages["release"]


def speed_limit(task: Task, stage: str) -> float:
    """How fast anything may be in a stage [m/s]; 0: nothing is said of it."""
    paths = (table.get("path", ()) for table in task.stages if str(table["id"]) == stage)
    found = [way["max"] for path in paths for way in path if way["kind"] == "speed"]
    return KEPT_SHARE * min(found, default=0.0)


def refuse_without_stages(task: Task) -> None:
    """Refuse a task without the stages that are needed, or that asks what no plan keeps."""
    if any(spec["kind"] == "between" for spec in task.success):
        raise NoPlanError(
            f"task {task.name} wants something between others, and the planner knows no such goal. "
            "Ask for it beside one of them."
        )
    for key in task.manipulated:
        verbs = stages_of(task, key).keys()
        lacking = [verb for verb in ("grasp", "release") if verb not in verbs]
        if "push" not in verbs and lacking:
            raise NoPlanError(
                f"task {task.name} moves {key}, and no stage says {' or '.join(lacking)} = "
                f'"{key}". Add it to the task file (docs/tasks.md).'
            )


def plan_stage(
    task: Task, table: Mapping[str, Any], bounds: Bounds, there: Mapping[str, Pose]
) -> Stage:
    """What a plan says of one stage of its task: when it is, what may touch, where it leads."""
    stage_id = str(table["id"])
    start_ns, end_ns = bounds.get(stage_id, (0, 0))
    release = table.get("release", table.get("push"))
    return Stage(
        id=stage_id,
        text=str(table.get("text", "")),
        subgoal=(
            *(goals_of(task, str(release)) if release is not None else ()),
            *(dict(goal) for goal in table.get("subgoal", ())),
        ),
        path=tuple(dict(way) for way in table.get("path", ())),
        grasp=table.get("grasp"),
        release=table.get("release"),
        push=table.get("push"),
        allowed_contacts=tuple((a, b) for a, b in table.get("allowed_contacts", ())),
        terminal=tuple(dict(item) for item in task.success) if table is task.stages[-1] else (),
        predicted_objects={}
        if release is None
        else {str(release): se3.pose_record(there[str(release)])},
        t_start_ns=start_ns,
        t_end_ns=end_ns,
    )


def goals_of(task: Task, key: str) -> list[dict[str, Any]]:
    """The success predicates about where an object is, which constraints say in the same words."""
    mine = (spec for spec in task.success if spec.get("object") == key)
    return [dict(spec) for spec in mine if spec["kind"] in RELATIONS]
