"""Goals in the two forms they have: success predicates of task files, and constraints.

What they measure is defined once, in ``bridge/task/relations.py``.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from bridge.errors import UsageError
from bridge.geometry import se3
from bridge.task.check import REFERENCES, TABLE
from bridge.task.relations import (
    BESIDE_GAP_M,
    MOVED_TOLERANCE_M,
    TILT_TOLERANCE_RAD,
    Box,
    Measured,
)
from bridge.task.relations import RELATIONS as OF_BOXES
from bridge.task.task_file import Task
from twin.plan.constrain.bodies import Record, box_of
from twin.plan.constrain.constraint import Constraint
from twin.plan.problem import Problem, State

RELATIONS = ("on", "inside", "outside", "beside", "upright", "moved")
"""Constraints that success predicates decide too."""


def relation_of(record: Record, problem: Problem) -> Constraint:
    """Measure what the success predicate measures that decides the same."""
    spec = predicate_of(record)
    kind, obj = spec["kind"], spec["object"]
    if kind == "moved" and obj not in problem.scene.Ts_base_object:
        message = f"moved {obj}: it was not localised, so nobody knows where it was before."
        raise UsageError(message)

    def measured(state: State) -> list[Measured]:
        names = {spec[key] for key in REFERENCES if key in spec} - {TABLE}
        boxes = {name: box_of(state, name, problem) for name in names}
        top = se3.transform_from(np.eye(4)[0], np.array([0, 0, problem.scene.table_height_m]))
        table = Box(T_base_box=top, half_m=np.zeros(3))
        return OF_BOXES[kind](spec, {TABLE: table, **boxes})

    unit = "rad" if kind == "upright" else "m"
    return Constraint(record=dict(record), measured=measured, unit=unit)


PLACES = ("inside", "on", "outside", "beside", "moved")
_KEYS = {
    "object": "obj",
    "margin_m": "margin",
    "tolerance_m": "tol",
    "at_least_m": "at_least",
    "at_most_m": "at_most",
    "by_m": "by",
    "target_m": "target",
}


def constraint_of(predicate: Record, task: Task) -> dict[str, Any] | None:
    """Write a success predicate as the constraint that decides the same; None: about no pose."""
    kind = predicate["kind"]
    if kind == "aligned":
        return _aligned(predicate, task)
    if kind not in RELATIONS:
        return None
    record = {_KEYS.get(key, key): value for key, value in predicate.items()}
    if kind == "beside" and "gap_m" in record:
        record["min_gap"], record["max_gap"] = record.pop("gap_m")
    if kind == "upright":
        record["max_deg"] = np.degrees(record.pop("tolerance_rad", TILT_TOLERANCE_RAD)).item()
        record.pop("tol", None)
    if kind == "moved":
        if "direction" in record:
            key = "way" if isinstance(record["direction"], str) else "vector"
            record[key] = record.pop("direction")
        if "by" in record:
            record.setdefault("tol", MOVED_TOLERANCE_M)
    return record


def predicate_of(record: Mapping[str, Any]) -> dict[str, Any]:
    """Write a constraint about where an object ends as the success predicate that decides the same.

    The other way round of ``constraint_of``.
    """
    names = {value: key for key, value in _KEYS.items()} | {"way": "direction"}
    names["vector"] = "direction"
    found = {names.get(key, key): value for key, value in record.items()}
    if "min_gap" in found or "max_gap" in found:
        low, high = BESIDE_GAP_M
        low, high = found.pop("min_gap", low), found.pop("max_gap", high)
        found["gap_m"] = [low, max(low, high)]
    if "max_deg" in found:
        found["tolerance_rad"] = np.radians(found.pop("max_deg")).item()
    return found


def _aligned(predicate: Record, task: Task) -> dict[str, Any]:
    sides = {}
    for side, key, axis in (("a", "object", "axis"), ("b", "reference", "reference_axis")):
        name = predicate[key]
        is_cube = task.objects[name].symmetry == "cube"
        sides[side] = {"obj": name, "axis": "any" if is_cube else predicate.get(axis, "x")}
    most_deg = np.degrees(predicate.get("tolerance_rad", TILT_TOLERANCE_RAD)).item()
    return {"kind": "align", **sides, "max_deg": most_deg, "undirected": True}
