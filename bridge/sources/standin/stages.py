"""The stages that the scripted planner's plans state: those of the task, with what they predict."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.errors import UsageError
from bridge.geometry import se3
from bridge.sources.standin.trajectory import Leg
from bridge.task.plan import Stage
from bridge.task.task_file import Task


@dataclass(frozen=True, kw_only=True)
class StageIds:
    """The stages of a task that one object goes through."""

    pick: str
    carry: str
    place: str


def stage_ids(task: Task, object_id: str) -> StageIds:
    """The stages that grasp, carry and release an object; placing may cover the carrying.

    Raises:
        UsageError: When none grasps or none releases it.
    """

    def of(verb: str) -> str | None:
        return next((stage["id"] for stage in task.stages if stage.get(verb) == object_id), None)

    pick, carry, place = of("grasp"), of("carry"), of("release")
    if pick is None or place is None:
        message = (
            f"task {task.name} has no stage that grasps {object_id} or none that releases it: "
            "the scripted planner needs both. See docs/tasks.md."
        )
        raise UsageError(message)
    return StageIds(pick=pick, carry=carry or place, place=place)


def planned_stages(
    task: Task,
    legs_of: Mapping[str, Sequence[Leg]],
    bounds: Mapping[str, tuple[int, int]],
    seen: Mapping[str, Float[np.ndarray, "4 4"]],
) -> tuple[Stage, ...]:
    """What a plan says of each stage of its task: when it is, and where it leaves its object.

    Args:
        task: Its stages.
        legs_of: How each object is moved.
        bounds: When each stage begins and ends, from the start of the plan [ns].
        seen: Poses ``T_base_object`` as perceived.

    Raises:
        UsageError: When a stage handles no object.
    """
    stages = []
    for index, table in enumerate(task.stages):
        last = index == len(task.stages) - 1
        object_id = _object_of(task, table)
        predicted = _predicted(task, object_id, legs_of[object_id], seen, table)
        start_ns, end_ns = bounds[table["id"]]
        stages.append(
            Stage(
                id=table["id"],
                text=table["text"],
                grasp=table.get("grasp"),
                release=table.get("release"),
                allowed_contacts=tuple((a, b) for a, b in table.get("allowed_contacts", [])),
                terminal=tuple(dict(item) for item in task.success) if last else (),
                predicted_objects={object_id: pose_record(predicted)},
                t_start_ns=start_ns,
                t_end_ns=end_ns,
            )
        )
    return tuple(stages)


def _object_of(task: Task, stage: Mapping[str, Any]) -> str:
    """The object a stage handles."""
    for verb in ("grasp", "carry", "release"):
        if stage.get(verb) in task.manipulated:
            return str(stage[verb])
    message = (
        f"stage {stage['id']} of task {task.name} grasps, carries and releases nothing: the "
        "scripted planner cannot plan it. See docs/tasks.md."
    )
    raise UsageError(message)


def _predicted(
    task: Task,
    object_id: str,
    legs: Sequence[Leg],
    seen: Mapping[str, Float[np.ndarray, "4 4"]],
    table: Mapping[str, Any],
) -> Float[np.ndarray, "4 4"]:
    """Where a stage leaves its object: lifted, over the container, or on the container's floor."""
    place = {leg.name: leg.T_base_tcp[:3, 3] for leg in legs}
    T = seen[object_id].copy()
    if table.get("release"):
        container_id = task.containers[0]
        floor_m = task.objects[container_id].wall_m + task.objects[object_id].size_m[2] / 2
        T[:2, 3] = place["open"][:2]
        T[2, 3] = seen[container_id][2, 3] + floor_m
    else:
        T[:3, 3] += place["carry" if table.get("carry") else "lift"] - place["close"]
    return T


def pose_record(T: Float[np.ndarray, "4 4"]) -> dict[str, list[float]]:
    """A pose as plans write it."""
    q, p = se3.split(T)
    return {"p_m": [float(v) for v in p], "q_wxyz": [float(v) for v in q]}
