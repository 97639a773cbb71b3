"""The kinds of constraints: from a record to the numbers it is about.

Here are points and directions, distances and regions, and what is asked of a path; relations
between bodies, which predicates decide too, are beside this in ``relations``.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from bridge.errors import UsageError
from bridge.task.check import TABLE
from bridge.task.task_file import ObjectModel
from twin.plan.constrain import arrays
from twin.plan.constrain.arrays import Array, norm
from twin.plan.constrain.bodies import (
    Record,
    box_pose,
    directions_of,
    half_extents_m,
    heights,
    point_of,
    pose_of,
    surface_points,
)
from twin.plan.constrain.constraint import Constraint, Term, flattened
from twin.plan.constrain.relations import RELATIONS
from twin.plan.constrain.schema import SCENE, Vocabulary, check_constraint
from twin.plan.problem import Problem, State


def compile_constraint(record: Record, problem: Problem) -> Constraint:
    """Make a constraint of a record that fits the schema of constraints.

    Args:
        record: With ``kind`` and what belongs to it; lengths in metres, angles in degrees.
    """
    check_constraint(record, Vocabulary.of_task(problem.scene.task))
    for name in _named(record):
        if name in problem.scene.missing():
            reason = problem.scene.reasons.get(name, "not found")
            message = f"{record['kind']}: {name} was not localised ({reason}). Look again."
            raise UsageError(message)
    return _KINDS[record["kind"]](record, problem)


_ID_KEYS = ("obj", "container", "support", "reference", "against", "over")


def _named(record: Record) -> Iterator[str]:
    """Ids of the objects that a record names anywhere."""
    for key, value in record.items():
        if isinstance(value, dict):
            yield from _named(value)
        elif key in (*_ID_KEYS, "frame"):
            yield value


def _distance(record: Record, problem: Problem) -> Constraint:
    (a, a_name), (b, b_name) = (point_of(record[key], problem) for key in "ab")
    low, high = float(record.get("min", -np.inf)), float(record.get("max", np.inf))
    term = Term(
        what=f"the distance from {a_name} to {b_name}",
        measure=lambda state: norm(a(state) - b(state)),
    )
    terms = []
    if "target" in record:
        target, tol = record["target"], record["tol"]
        least = target - tol if target > tol else -np.inf
        terms.append(replace(term, low=least, high=target + tol))
    if "min" in record or "max" in record:
        terms.append(replace(term, low=low, high=high))
    return Constraint.of(record, *terms)


def _above(record: Record, problem: Problem) -> Constraint:
    (a, a_name), (b, b_name) = (point_of(record[key], problem) for key in "ab")
    height, tol = record["height"], record["tol"]
    return Constraint.of(
        record,
        Term(
            what=f"the height of {a_name} over {b_name}",
            measure=lambda state: (a(state) - b(state))[:, 2],
            low=height - tol,
            high=height + tol,
        ),
        Term(
            what=f"its distance aside from {b_name}",
            measure=lambda state: norm((a(state) - b(state))[:, :2]),
            high=record["xy_tol"],
        ),
    )


def _align(record: Record, problem: Problem) -> Constraint:
    (a, a_name), (b, b_name) = (directions_of(record[key], problem) for key in "ab")
    either = any(record[key].get("axis") == "any" for key in "ab")
    undirected = either or record.get("undirected", False)

    def off(state: State) -> Array:
        pairs = arrays.angle(a(state)[:, :, None], b(state)[:, None], undirected=undirected)
        return np.amin(np.amin(pairs, axis=2), axis=1)

    term = Term(
        what=f"the angle between {a_name} and {b_name}",
        measure=off,
        high=float(np.radians(record["max_deg"])),
        unit="rad",
    )
    return Constraint.of(record, term)


def _clearance(record: Record, problem: Problem) -> Constraint:
    obj, against = record["obj"], record["against"]
    return Constraint.of(
        record,
        Term(
            what=f"the least distance between {obj} and {against}",
            measure=_least_distance(obj, against, problem),
            low=record["min"],
        ),
    )


def _least_distance(obj: str, against: str, problem: Problem) -> Callable[[State], Array]:
    points = surface_points(problem, obj)
    if against == TABLE:
        height = problem.scene.table_height_m

        def over_table(state: State) -> Array:
            T = pose_of(state, obj)
            z = arrays.carried(T, points)[..., 2]
            return np.amin(z, axis=-1) - height

        return over_table
    if against == SCENE:
        if problem.scene.static_sdf is None:
            message = (
                f"clearance of {obj} against scene: there is no rebuilt scene. "
                "Rebuild it first, or name an object or the table."
            )
            raise UsageError(message)
        grid = problem.scene.static_sdf.conservative

        def over_scene(state: State) -> Array:
            T = pose_of(state, obj)
            found = grid.distance(arrays.carried(T, points))
            return np.amin(found, axis=-1)

        return over_scene
    others = surface_points(problem, against)

    def between(state: State) -> Array:
        T, T_other = pose_of(state, obj), pose_of(state, against)
        there = arrays.seen_from(T_other, arrays.carried(T, points))
        back = arrays.seen_from(T, arrays.carried(T_other, others))
        return np.minimum(
            np.amin(_panel_distance(problem.model(against), there), axis=-1),
            np.amin(_panel_distance(problem.model(obj), back), axis=-1),
        )

    return between


def _panel_distance(model: ObjectModel, points: Array) -> Array:
    """Signed distances of points in an object's frame to the boxes it is made of [m]."""
    centres, sizes = zip(*model.panels(), strict=True)
    return arrays.boxes_distance(
        points,
        centres,
        [np.array(size) / 2 for size in sizes],
    )


def _keepout(record: Record, problem: Problem) -> Constraint:
    """Out of the upright column over the box around an object that stands upright."""
    obj, over = record["obj"], record["region"]["over"]
    points = surface_points(problem, obj)
    half = half_extents_m(problem.model(over))

    def least(state: State) -> Array:
        surface = arrays.carried(pose_of(state, obj), points)
        q = arrays.seen_from(box_pose(state, over, problem), surface)[..., :2]
        return np.amin(arrays.box_distance(q, half[:2]), axis=-1)

    return Constraint.of(
        record,
        Term(
            what=f"the distance of {obj} from what is over {over}",
            measure=least,
            low=record.get("margin", 0.0),
        ),
    )


def _height(record: Record, problem: Problem) -> Constraint:
    table = problem.scene.table_height_m
    if "obj" in record:
        obj, name = record["obj"], f"the lowest point of {record['obj']}"

        def measure(state: State) -> Array:
            return heights(state, obj, problem)[0] - table
    else:
        point, name = point_of(record["a"], problem)

        def measure(state: State) -> Array:
            return point(state)[:, 2] - table

    return Constraint.of(
        record,
        Term(
            what=f"the height of {name} over the table",
            measure=measure,
            low=record.get("min", -np.inf),
            high=record.get("max", np.inf),
        ),
    )


def _speed(record: Record, problem: Problem) -> Constraint:
    point, name = point_of(record.get("a", {"ee": True}), problem)
    limit = record["max"]

    def along(states: State, times_s: Array | None) -> Array:
        num_states, num_steps = states.T_base_tcp.shape[:2]
        if times_s is None or num_steps < 2:
            return np.full(num_states, -limit)
        p = point(flattened(states)).reshape(num_states, num_steps, 3)
        seconds = times_s[1:] - times_s[:-1]
        speeds = norm(p[:, 1:] - p[:, :-1]) / seconds
        return np.amax(speeds, axis=-1) - limit

    term = Term(what=f"the speed of {name}", measure=_nothing, high=limit, unit="m/s")
    return replace(Constraint.of(record, term), along=along)


def _nothing(state: State) -> Array:
    """What a single state has of a number that only a path has."""
    return 0.0 * state.T_base_tcp[:, 0, 0]


_KINDS: dict[str, Callable[[Record, Problem], Constraint]] = {
    **RELATIONS,
    "distance": _distance,
    "above": _above,
    "align": _align,
    "clearance": _clearance,
    "keepout": _keepout,
    "height": _height,
    "speed": _speed,
}
KINDS = tuple(_KINDS)
