"""Where an object belongs, as the scripted planner reads it from a task's success predicates.

Into or onto another object, beside one, or, where nothing of that is said, to a mark on the table.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.errors import UsageError
from bridge.sources.standin.kinematics import Pose, yaw_of
from bridge.task.check import TABLE
from bridge.task.relations import BESIDE_GAP_M, direction_of
from bridge.task.task_file import ObjectModel, Task

RELEASE_CLEARANCE_M = 0.018
"""Between the underside of the held object and the top of the container's walls."""
ON_CLEARANCE_M = 0.003
"""Between the underside of the held object and the top of what it is put on."""
AT = "at"
"""The relation to a spot on the table, which is where the object's own pose then is."""


@dataclass(frozen=True, kw_only=True)
class Destination:
    """What an object is put into or onto, or the spot where it is put, as the planner sees it."""

    id: str
    """Of the object it is put into, onto or beside; the table's for a mark."""
    relation: str
    """inside, on or at."""
    model: ObjectModel
    """Of what is there; of the object itself where that is a spot on the table."""
    T_base: Pose
    """Pose of what is there; of a spot its place on the table and the tool's turn there."""
    is_turned: bool = False
    """Whether the tool has to turn to how the spot lies: fingers on either side of the gap."""

    def resting_m(self, model: ObjectModel) -> float:
        """Height at which the middle of an object comes to lie there."""
        if self.relation == "inside":
            return float(self.T_base[2, 3]) + (self.model.wall_m + model.size_m[2] / 2)
        return self.top_m + model.size_m[2] / 2

    @property
    def top_m(self) -> float:
        """Height that the object has to pass: the rim of the walls, or what it is put on."""
        if self.relation == AT:
            return float(self.T_base[2, 3])
        above_origin = self.model.size_m[2] - self.model.rest_height_m
        return float(self.T_base[2, 3]) + above_origin

    @property
    def clearance_m(self) -> float:
        """Between the underside of the held object and that height when it is let go."""
        return RELEASE_CLEARANCE_M if self.relation == "inside" else ON_CLEARANCE_M

    @property
    def area_m(self) -> tuple[float, float]:
        """Extents of what objects may lie on, in its frame; a spot is for one object."""
        if self.relation == AT:
            return 0.0, 0.0
        x, y, _ = self.model.inner_m if self.relation == "inside" else self.model.size_m
        return x, y

    def turned_to(self, yaw: float) -> float:
        """The yaw of the tool when it lets go of what it took at ``yaw`` [rad].

        A spot beside something is approached with one finger on either side of the line to it:
        in the gap there is no room for one.
        """
        if not self.is_turned:
            return yaw
        lies = yaw_of(self.T_base)
        return lies + float(np.round((yaw - lies) / np.pi)) * np.pi


def destination_of(task: Task, object_id: str, seen: Mapping[str, Pose]) -> Destination:
    """Find where an object belongs by the success predicates, and where that is."""
    goal, mark = task.goal_of(object_id), task.mark_of(object_id)
    if goal in (None, ("on", TABLE)) and mark is not None:
        T = np.eye(4)
        T[:2, 3] = mark
        return Destination(id=TABLE, relation=AT, model=task.objects[object_id], T_base=T)
    if goal is None and task.containers:
        goal = ("inside", task.containers[0])
    if goal is not None and goal[0] == "beside":
        return _beside(task, object_id, seen)
    if goal is None or goal[0] not in ("inside", "on") or goal[1] not in task.objects:
        message = (
            f"nothing in the success predicates of task {task.name} says what {object_id} is to be "
            "inside or on, beside what, or at which mark: the scripted planner cannot plan it. See "
            "docs/tasks.md."
        )
        raise UsageError(message)
    relation, target = goal
    model = task.objects[target]
    return Destination(id=target, relation=relation, model=model, T_base=seen[target])


def _beside(task: Task, object_id: str, seen: Mapping[str, Pose]) -> Destination:
    """The spot before a side of the reference, in the middle of the gap that is asked for.

    The side is the one that looks most in the direction asked for, else towards where the object
    is. The object's own x axis comes to lie along the gap.
    """
    spec: Mapping[str, Any] = next(
        item
        for item in task.success
        if item["kind"] == "beside" and item.get("object") == object_id
    )
    reference = spec["reference"]
    T_reference = seen[reference]
    if "direction" in spec:
        way = direction_of(spec["direction"])[:2]
    else:
        way = (seen[object_id] - T_reference)[:2, 3]
    sides = [(sign * T_reference[:2, axis], axis) for axis in (0, 1) for sign in (1.0, -1.0)]
    normal, axis = max(sides, key=lambda side: float(side[0] @ way))
    model = task.objects[object_id]
    least, most = spec.get("gap_m", BESIDE_GAP_M)
    reach_m = task.objects[reference].size_m[axis] / 2 + model.size_m[0] / 2
    T = np.eye(4)
    T[:2, 0], T[:2, 1] = normal, (-normal[1], normal[0])
    T[:2, 3] = T_reference[:2, 3] + normal * (reach_m + (least + most) / 2)
    return Destination(id=reference, relation=AT, model=model, T_base=T, is_turned=True)


def slots_of(places: Mapping[str, Destination]) -> dict[str, Float[np.ndarray, "2"]]:
    """Share each destination among its objects: where on its area each goes [m]."""
    slots: dict[str, Any] = {}
    shared = {key: place for key, place in places.items() if place.relation != AT}
    for target in dict.fromkeys(place.id for place in shared.values()):
        keys = [key for key, place in shared.items() if place.id == target]
        area = shared[keys[0]].area_m
        slots |= dict(zip(keys, release_slots(len(keys), area), strict=True))
    return slots | {key: np.zeros(2) for key in places if key not in shared}


def release_slots(count: int, area_m: tuple[float, float]) -> list[Float[np.ndarray, "2"]]:
    """Where on an area several objects go: two rows along its x axis, from its middle [m].

    An odd last one lies between the rows; a single one goes to the middle.
    """
    x, y = area_m
    columns = -(-count // 2)
    slots = []
    for index in range(count):
        alone = index == count - 1 and count % 2 == 1
        across = 0.0 if alone else (index % 2 - 0.5) * y / 2
        slots.append(np.array([x * ((index // 2 + 0.5) / columns - 0.5), across]))
    return slots
