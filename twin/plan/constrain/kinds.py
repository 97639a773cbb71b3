"""The kinds of constraints: from a record to the numbers it is about.

Relations between bodies are the success predicates of task files and are measured by the same
rules (``bridge/task/relations.py``); here are points, directions, distances and speeds besides.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from bridge.errors import UsageError
from bridge.geometry import se3
from bridge.task.check import REFERENCES, TABLE
from bridge.task.predicate import bodies_of
from bridge.task.relations import RELATIONS, Box, Measured
from twin.plan.constrain.bodies import (
    Record,
    box_of,
    carried,
    direction_of,
    point_of,
    pose_of,
    surface_points,
)
from twin.plan.constrain.constraint import Constraint
from twin.plan.constrain.distances import boxes_clearance
from twin.plan.constrain.schema import SCENE, Vocabulary, check_constraint, values_of
from twin.plan.problem import Array, Numbers, Problem, State


def compile_constraint(record: Record, problem: Problem) -> Constraint:
    """Make a constraint of a record that fits the schema of constraints."""
    check_constraint(record, Vocabulary.of_task(problem.scene.task))
    for name in values_of(record, (*REFERENCES, "frame")):
        if name in problem.scene.missing():
            reason = problem.scene.reasons.get(name, "not found")
            message = f"{record['kind']}: {name} was not localised ({reason}). Look again."
            raise UsageError(message)
    return _KINDS[record["kind"]](dict(record), problem)


_STRAIGHT = np.eye(1, 4)[0]


def _relation(record: Record, problem: Problem) -> Constraint:
    """Measure what the success predicate of that kind measures."""
    kind, names = record["kind"], bodies_of(record)
    if kind == "moved" and names[0] not in problem.scene.Ts_base_object:
        message = f"moved {names[0]}: it was not localised, so nobody knows where it was before."
        raise UsageError(message)
    top = se3.transform_from(_STRAIGHT, np.array([0, 0, problem.scene.table_height_m]))
    table = {TABLE: Box(T_base_box=top, half_m=np.zeros(3))}

    def measured(state: State) -> list[Measured]:
        boxes = {name: box_of(state, name, problem) for name in names}
        return RELATIONS[kind](record, table | boxes)

    unit = "rad" if kind in ("upright", "aligned") else "m"
    return Constraint(record=record, measured=measured, unit=unit)


def _distance(record: Record, problem: Problem) -> Constraint:
    (a, a_name), (b, b_name) = (point_of(record[key], problem) for key in "ab")
    what, low, high = f"the distance from {a_name} to {b_name}", *_limits(record)
    return _one(
        record, what, lambda state: np.linalg.norm(a(state) - b(state), axis=-1), low=low, high=high
    )


def _limits(record: Record) -> tuple[float, float]:
    return record.get("min", -np.inf), record.get("max", np.inf)


def _above(record: Record, problem: Problem) -> Constraint:
    (a, a_name), (b, b_name) = (point_of(record[key], problem) for key in "ab")
    height, tol = record["height"], record["tolerance_m"]

    def measured(state: State) -> list[Measured]:
        way, what = a(state) - b(state), f"the height of {a_name} over {b_name}"
        aside = np.linalg.norm(way[:, :2], axis=-1)
        return [
            Measured(what, way[:, 2], low=height - tol, high=height + tol),
            Measured(f"its distance aside from {b_name}", aside, high=record["aside_m"]),
        ]

    return Constraint(record=record, measured=measured)


def _align(record: Record, _: Problem) -> Constraint:
    (a, a_name), (b, b_name) = (direction_of(record[key]) for key in "ab")
    what, most_rad = f"the angle between {a_name} and {b_name}", float(record["tolerance_rad"])

    def measured(state: State) -> list[Measured]:
        one, other = a(state), b(state)
        across, along = np.linalg.norm(np.cross(one, other), axis=-1), (one * other).sum(-1)
        return [Measured(what, np.arctan2(across, along), high=most_rad, unit="rad")]

    return Constraint(record=record, measured=measured, unit="rad")


def _one(
    record: Record,
    what: str,
    measure: Callable[[State], Array],
    *,
    low: float,
    high: float = np.inf,
) -> Constraint:
    """A constraint of one length."""
    return Constraint(
        record=record,
        measured=lambda state: [Measured(what, measure(state), low=low, high=high)],
    )


def _clearance(record: Record, problem: Problem) -> Constraint:
    obj, against = record["object"], record["against"]
    what = f"the least distance between {obj} and {against}"
    return _one(record, what, _least_distance(obj, against, problem), low=record["min"])


def _least_distance(obj: str, against: str, problem: Problem) -> Callable[[State], Array]:
    points = surface_points(problem, obj)
    if against == TABLE:
        height = problem.scene.table_height_m
        return lambda state: carried(pose_of(state, obj), points)[..., 2].min(axis=-1) - height
    if against == SCENE:
        if problem.scene.static_sdf is None:
            message = (
                f"clearance of {obj} against scene: there is no rebuilt scene. "
                "Rebuild it first, or name an object or the table."
            )
            raise UsageError(message)
        grid = problem.scene.static_sdf.conservative
        return lambda state: grid.distance(carried(pose_of(state, obj), points)).min(axis=-1)
    others = surface_points(problem, against)
    there, here = (
        boxes_clearance([(se3.transform_from(_STRAIGHT, p), size) for p, size in model.panels()])
        for model in (problem.model(against), problem.model(obj))
    )

    def between(state: State) -> Array:
        T_against_obj = se3.invert(pose_of(state, against)) @ pose_of(state, obj)
        T_obj_against = se3.invert(T_against_obj)
        return np.minimum(there(points, T_against_obj), here(others, T_obj_against))

    return between


def _keepout(record: Record, problem: Problem) -> Constraint:
    """Out of the upright column over the box around an object that stands upright."""
    obj, over = record["object"], record["over"]
    points = surface_points(problem, obj)

    def least(state: State) -> Array:
        surface, box = carried(pose_of(state, obj), points), box_of(state, over, problem)
        beyond = replace(box, T_base_box=box.T_base_box[:, None]).beyond_m(surface)[..., :2]
        outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=-1)
        return np.amin(outside + np.minimum(beyond.max(axis=-1), 0.0), axis=-1)

    what = f"the distance of {obj} from what is over {over}"
    return _one(record, what, least, low=record.get("margin_m", 0.0))


def _height(record: Record, problem: Problem) -> Constraint:
    table = problem.scene.table_height_m
    low, high = _limits(record)
    if "object" in record:
        obj = record["object"]
        what = f"the height of the lowest point of {obj} over the table"

        def lowest(state: State) -> Array:
            return box_of(state, obj, problem).heights_m[0] - table

        return _one(record, what, lowest, low=low, high=high)
    point, name = point_of(record["a"], problem)
    what = f"the height of {name} over the table"
    return _one(record, what, lambda state: point(state)[:, 2] - table, low=low, high=high)


def _speed(record: Record, problem: Problem) -> Constraint:
    point, name = point_of(record.get("a", {"ee": True}), problem)
    limit = record["max"]

    def along(steps: State, times_s: Numbers) -> float:
        if len(times_s) < 2:
            return -float(limit)
        p = point(steps)
        speeds = np.linalg.norm(p[1:] - p[:-1], axis=-1) / (times_s[1:] - times_s[:-1])
        return float(speeds.max() - limit)

    def at_once(state: State) -> list[Measured]:  # a single state has no speed
        value = 0.0 * state.T_base_tcp[:, 0, 0]
        return [Measured(f"the speed of {name}", value, high=limit, unit="m/s")]

    return Constraint(record=record, measured=at_once, unit="m/s", along=along)


_KINDS: dict[str, Callable[[Record, Problem], Constraint]] = {
    **dict.fromkeys(RELATIONS, _relation),
    "distance": _distance,
    "above": _above,
    "align": _align,
    "clearance": _clearance,
    "keepout": _keepout,
    "height": _height,
    "speed": _speed,
}
