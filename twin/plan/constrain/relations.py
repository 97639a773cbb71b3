"""Constraints with a hard twin among the success predicates: how bodies stand to each other.

Bodies are the boxes of their outer extents, and the decisions are those of the predicates in
``bridge/task``. Heights are against gravity, along z of the base frame; sides are the robot's.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from bridge.errors import UsageError
from bridge.task.check import TABLE
from bridge.task.predicate import MOVED_TOLERANCE_M
from bridge.task.relations import (
    BESIDE_GAP_M,
    ON_TOLERANCE_M,
    SECTOR_RAD,
    SIDES,
    TILT_TOLERANCE_RAD,
    direction_of,
    footprint_gap_m,
)
from bridge.task.task_file import Task
from twin.plan.constrain.bodies import (
    Record,
    box_pose,
    half_extents_m,
    heights,
    millimetres,
    pose_of,
    seen_from,
)
from twin.plan.constrain.constraint import Constraint, Term
from twin.plan.problem import Array, Numbers, Problem, State


def _on(record: Record, problem: Problem) -> Constraint:
    obj, support = record["obj"], record["support"]
    tol = record.get("tol", ON_TOLERANCE_M)

    def gap(state: State) -> Array:
        bottom, _ = heights(state, obj, problem)
        return bottom - _top(state, support, problem)

    terms = [Term(what=f"the gap from {support} up to {obj}", measure=gap, low=-tol, high=tol)]
    if support != TABLE:
        terms.append(_over_support(record, problem, support, record.get("margin", 0.0)))
    return Constraint.of(record, *terms)


def _top(state: State, support: str, problem: Problem) -> Array:
    if support == TABLE:
        return problem.scene.table_height_m
    return heights(state, support, problem)[1]


def _over_support(record: Record, problem: Problem, support: str, margin: float) -> Term:
    """The middle of an object within its support's uppermost face: else it tips."""
    obj, half = record["obj"], half_extents_m(problem.model(support))

    def over(state: State) -> Array:
        T_object, T = box_pose(state, obj, problem), box_pose(state, support, problem)
        top = heights(state, support, problem)[1]
        x, y = T_object[:, 0, 3], T_object[:, 1, 3]
        contact = np.stack([x, y, top + 0.0 * x], axis=-1)
        excess = abs(seen_from(T, contact[:, None])[:, 0]) - half
        up = abs(T[:, 2, :3])
        upward = up == np.amax(up, axis=-1)[:, None]  # the face that looks up is no edge
        return np.amax(np.where(upward, -np.inf, excess), axis=-1)

    return Term(
        what=f"the middle of {obj} beyond the edge of {support}", measure=over, high=-margin
    )


def _inside(record: Record, problem: Problem) -> Constraint:
    obj, container = record["obj"], record["container"]
    model = problem.model(container)
    inner = np.array(model.inner_m)
    centre = np.array([0.0, 0.0, model.wall_m + inner[2] / 2])

    def excess(state: State) -> Array:
        middle = pose_of(state, obj)[:, None, :3, 3]
        q = seen_from(pose_of(state, container), middle)[:, 0] - centre
        return np.amax(abs(q) - inner / 2, axis=-1)

    return Constraint.of(
        record,
        Term(
            what=f"the middle of {obj} beyond the cavity of {container}",
            measure=excess,
            high=-record.get("margin", 0.0),
        ),
    )


def _outside(record: Record, problem: Problem) -> Constraint:
    obj, container = record["obj"], record["container"]
    return Constraint.of(
        record,
        Term(
            what=f"the gap between {obj} and {container} seen from above",
            measure=_outline_gap(obj, container, problem),
            low=record.get("margin", 0.0),
        ),
    )


def _outline_gap(a: str, b: str, problem: Problem) -> Callable[[State], Array]:
    """Gap between the boxes around two objects, seen from above; negative: overlap [m]."""
    half_a, half_b = (half_extents_m(problem.model(name)) for name in (a, b))

    def gap(state: State) -> Array:
        T_a, T_b = (box_pose(state, name, problem) for name in (a, b))
        return footprint_gap_m(T_a, half_a, T_b, half_b)

    return gap


def _beside(record: Record, problem: Problem) -> Constraint:
    obj, reference = record["obj"], record["reference"]
    terms = [
        Term(
            what=f"the gap between {obj} and {reference} seen from above",
            measure=_outline_gap(obj, reference, problem),
            low=record.get("min_gap", BESIDE_GAP_M[0]),
            high=record.get("max_gap", BESIDE_GAP_M[1]),
        ),
        _level(obj, reference, problem),
    ]
    if "direction" in record:
        x, y, _ = SIDES[record["direction"]]

        def off(state: State) -> Array:
            way = (box_pose(state, obj, problem) - box_pose(state, reference, problem))[:, :2, 3]
            side = np.array((x, y))
            across = way[:, 0] * side[1] - way[:, 1] * side[0]
            return np.arctan2(abs(across), (way * side).sum(-1))

        terms.append(
            Term(
                what=f"the side of {reference} it is on, off {record['direction']},",
                measure=off,
                high=SECTOR_RAD,
                unit="rad",
            )
        )
    return Constraint.of(record, *terms)


def _level(a: str, b: str, problem: Problem) -> Term:
    """Two boxes at a common height; negative where there is a gap between their heights [m]."""

    def common(state: State) -> Array:
        low_a, high_a = heights(state, a, problem)
        low_b, high_b = heights(state, b, problem)
        return np.minimum(high_a, high_b) - np.maximum(low_a, low_b)

    return Term(what=f"the height that {a} and {b} have in common", measure=common, low=0.0)


def _upright(record: Record, problem: Problem) -> Constraint:
    obj = record["obj"]
    is_cube = problem.model(obj).symmetry == "cube"

    def tilt(state: State) -> Array:
        R = pose_of(state, obj)[:, :3, :3]
        if not is_cube:
            up = R[:, :, 2]
            return np.arctan2(np.linalg.norm(up[:, :2], axis=-1), up[:, 2])
        up = abs(R[:, 2])  # of each axis, either way up
        flat = np.linalg.norm(R[:, :2].swapaxes(1, 2), axis=-1)
        return np.amin(np.arctan2(flat, up), axis=-1)

    return Constraint.of(
        record,
        Term(
            what=f"the tilt of {obj}",
            measure=tilt,
            high=float(np.radians(record["max_deg"]))
            if "max_deg" in record
            else TILT_TOLERANCE_RAD,
            unit="rad",
        ),
    )


def _moved(record: Record, problem: Problem) -> Constraint:
    obj = record["obj"]
    if obj not in problem.scene.Ts_base_object:
        message = f"moved {obj}: it was not localised, so nobody knows where it was before."
        raise UsageError(message)
    start = problem.scene.Ts_base_object[obj][:3, 3]
    named = record.get("way", record.get("vector"))
    direction = None if named is None else direction_of(named)

    def way(state: State) -> Array:
        return pose_of(state, obj)[:, :3, 3] - start

    def length(state: State) -> Array:
        if direction is None:
            return np.linalg.norm(way(state), axis=-1)
        return (way(state) * direction).sum(-1)

    terms = []
    if "at_least" in record or "at_most" in record:
        low, high = record.get("at_least", -np.inf), record.get("at_most", np.inf)
        terms.append(Term(what=f"the way {obj} was moved", measure=length, low=low, high=high))
    targets = []
    if "by" in record and direction is not None:
        targets.append((start + record["by"] * direction)[:2])
    if "target" in record:
        targets.append(np.array(record["target"], dtype=np.float64))
    terms += [_near_point(obj, target, record["tol"]) for target in targets]
    return Constraint.of(record, *terms)


def _near_point(obj: str, target: Numbers, tol: float) -> Term:
    """An object's origin near a point of the base frame; near one of two numbers from above."""

    def off(state: State) -> Array:
        return np.linalg.norm(pose_of(state, obj)[:, : len(target), 3] - target, axis=-1)

    return Term(what=f"the distance of {obj} from {millimetres(target)}", measure=off, high=tol)


RELATIONS: dict[str, Callable[[Record, Problem], Constraint]] = {
    "on": _on,
    "inside": _inside,
    "outside": _outside,
    "beside": _beside,
    "upright": _upright,
    "moved": _moved,
}

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


def predicate_of(record: Record) -> dict[str, Any]:
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
