"""The kinds of constraints: from a record to the numbers it is about.

Each kind has a hard twin among the success predicates where one asks the same: bodies are then the
boxes of their outer extents, and the decisions are equal. Heights are against gravity, along z of
the base frame; directions are the robot's, x away from its base, y to its left.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.errors import UsageError
from bridge.geometry import se3
from bridge.geometry.mesh import sample_triangles
from bridge.task.task_file import ObjectModel
from twin.plan.constrain import arrays
from twin.plan.constrain.arrays import Array, like, namespace, norm
from twin.plan.constrain.constraint import SCALES, Constraint, Term, flattened
from twin.plan.problem import Problem, State

TABLE, SCENE, BASE = "table", "scene", "world"
ON_TOLERANCE_M = 0.008
BESIDE_GAP_M = (0.0, 0.1)
BETWEEN_TOLERANCE_M = 0.03
SECTOR_RAD = np.pi / 4
SIDES = {
    "left": (0.0, 1.0),
    "right": (0.0, -1.0),
    "in_front": (-1.0, 0.0),
    "behind": (1.0, 0.0),
}
HOLD_TOLERANCE_M, HOLD_TOLERANCE_DEG = 0.005, 5.0
NUM_POINTS = 200
"""Of an object's surface; its corners first."""

Record = Mapping[str, Any]
Point = Callable[[State], Array]
"""A point of each state in the base frame, ``(num_states, 3)``."""


def compile_constraint(record: Record, problem: Problem) -> Constraint:
    """Make a constraint of a record that ``check_constraint`` lets pass.

    Args:
        record: With ``kind`` and what belongs to it; lengths in metres, angles in degrees.
        problem: Where the objects are, how large, and what the robot is.

    Raises:
        UsageError: When it asks for what the problem does not have, such as a rebuilt scene.
    """
    return _KINDS[record["kind"]](record, problem)


def _made(record: Record, *terms: Term) -> Constraint:
    return Constraint(kind=record["kind"], record=dict(record), terms=terms)


# Poses, boxes, points and directions of a state


def _pose(state: State, object_id: str) -> Array:
    return like(state.Ts_base_object[object_id], state.T_base_tcp)


def _half_m(model: ObjectModel) -> Float[np.ndarray, "3"]:
    return np.array(model.size_m) / 2


def _middle_m(model: ObjectModel) -> Float[np.ndarray, "3"]:
    """Of the outer extents, in the object frame."""
    return np.array([0.0, 0.0, 0.0 if model.origin_at_centre else model.size_m[2] / 2])


def _box_pose(state: State, object_id: str, problem: Problem) -> Array:
    """Poses of the middle of the box around an object, ``(num_states, 4, 4)``."""
    T = _pose(state, object_id)
    model = problem.model(object_id)
    if model.origin_at_centre:
        return T
    shift = np.eye(4)
    shift[:3, 3] = _middle_m(model)
    return T @ like(shift, T)


def _heights(state: State, object_id: str, problem: Problem) -> tuple[Array, Array]:
    """Of the lowest and of the highest point of the box around an object [m]."""
    T = _box_pose(state, object_id, problem)
    reach = (abs(T[:, 2, :3]) * like(_half_m(problem.model(object_id)), T)).sum(-1)
    return T[:, 2, 3] - reach, T[:, 2, 3] + reach


def _common_height(a: str, b: str, problem: Problem) -> Callable[[State], Array]:
    """Height that two boxes have in common; negative: the gap between their heights [m]."""

    def measure(state: State) -> Array:
        low_a, high_a = _heights(state, a, problem)
        low_b, high_b = _heights(state, b, problem)
        xp = namespace(low_a)
        return xp.minimum(high_a, high_b) - xp.maximum(low_a, low_b)

    return measure


def _anchor_m(model: ObjectModel, anchor: str) -> Float[np.ndarray, "3"]:
    """A named point of an object, in its frame."""
    up = np.array([0.0, 0.0, model.size_m[2] / 2])
    places = {
        "centroid": _middle_m(model),
        "origin": np.zeros(3),
        "top": _middle_m(model) + up,
        "bottom": _middle_m(model) - up,
        "opening": _middle_m(model) + up,
        "handle": np.array(model.grasp_m),
    }
    return places[anchor]


def _point(spec: Record, problem: Problem) -> tuple[Point, str]:
    """A point of each state, and its name in words."""
    offset = np.array(spec.get("offset", (0.0, 0.0, 0.0)), dtype=np.float64)
    aside = f" offset by {_millimetres(offset)}" if offset.any() else ""
    if "ee" in spec:
        return lambda state: _at(state.T_base_tcp, offset), f"the tool{aside}"
    if "obj" in spec:
        name, anchor = spec["obj"], spec.get("anchor", "centroid")
        p_object = _anchor_m(problem.model(name), anchor) + offset
        return lambda state: _at(_pose(state, name), p_object), f"{name}'s {anchor}{aside}"
    if "xyz" in spec:
        p, frame = np.array(spec["xyz"], dtype=np.float64) + offset, spec.get("frame", BASE)
        if frame == BASE:
            return lambda state: like(p, state.T_base_tcp)[None], f"the point {_millimetres(p)}"
        return lambda state: _at(_pose(state, frame), p), f"the point {_millimetres(p)} of {frame}"
    ids = [spec["kp"]] if "kp" in spec else list(spec["mean"])
    points = [problem.keypoints[index] for index in ids]

    def mean(state: State) -> Array:
        places = [
            like(point.p_m, state.T_base_tcp)[None]
            if point.object_id is None
            else _at(_pose(state, point.object_id), point.p_m)
            for point in points
        ]
        return sum(places) / len(places) + like(offset, state.T_base_tcp)

    said = f"keypoint {ids[0]}" if "kp" in spec else f"the middle of keypoints {ids}"
    return mean, said + aside


def _at(T: Array, p_m: Float[np.ndarray, "3"]) -> Array:
    return arrays.carried(T, like(p_m, T)[None])[:, 0]


def _millimetres(p_m: Float[np.ndarray, "3"]) -> str:
    return "(" + ", ".join(f"{value * 1e3:.0f}" for value in p_m) + ") mm"


_AXES = {"x": 0, "y": 1, "z": 2}


def _direction(spec: Record, problem: Problem) -> tuple[Point, str]:
    """A direction of each state in the base frame, and its name in words."""
    if "from" in spec:
        (start, start_name), (end, end_name) = (_point(spec[k], problem) for k in ("from", "to"))
        return lambda state: end(state) - start(state), f"the way from {start_name} to {end_name}"
    if "ee" in spec:
        column = {"approach": 2, "closing": 1}[spec["ee"]]
        return lambda state: state.T_base_tcp[:, :3, column], f"the tool's {spec['ee']} direction"
    name = spec["axis"] if "obj" in spec else spec["world"]
    sign, column = (-1.0 if name[0] == "-" else 1.0), _AXES[name[-1]]
    if "obj" in spec:
        object_id = spec["obj"]
        return (
            lambda state: sign * _pose(state, object_id)[:, :3, column],
            f"{object_id}'s {name} axis",
        )
    axis = sign * np.eye(3)[column]
    return lambda state: like(axis, state.T_base_tcp)[None], f"the base frame's {name} axis"


def surface_points(problem: Problem, object_id: str) -> Float[np.ndarray, "num_points 3"]:
    """Points of an object's surface in its frame: corners, and more spread evenly over it [m]."""
    shape = problem.shapes[object_id]
    corners = shape.vertices_m[np.unique(shape.triangles)]
    corners = corners[:: max(1, -(-2 * len(corners) // NUM_POINTS))]
    a, b, c = (shape.vertices_m[shape.triangles[:, k]] for k in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    rng = np.random.default_rng(0)
    chosen, u, v = sample_triangles(areas, NUM_POINTS - len(corners), rng, in_order=True)
    spread = a[chosen] + u * (b - a)[chosen] + v * (c - a)[chosen]
    return np.concatenate([corners, spread])


# Kinds


def _distance(record: Record, problem: Problem) -> Constraint:
    (a, a_name), (b, b_name) = (_point(record[key], problem) for key in "ab")
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
    return _made(record, *terms)


def _above(record: Record, problem: Problem) -> Constraint:
    (a, a_name), (b, b_name) = (_point(record[key], problem) for key in "ab")
    height, tol = record["height"], record["tol"]
    return _made(
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


def _on(record: Record, problem: Problem) -> Constraint:
    obj, support = record["obj"], record["support"]
    tol = record.get("tol", ON_TOLERANCE_M)

    def gap(state: State) -> Array:
        bottom, _ = _heights(state, obj, problem)
        return bottom - _top(state, support, problem)

    terms = [Term(what=f"the gap from {support} up to {obj}", measure=gap, low=-tol, high=tol)]
    if support != TABLE:
        terms.append(_over_support(record, problem, support, record.get("margin", 0.0)))
    return _made(record, *terms)


def _top(state: State, support: str, problem: Problem) -> Array:
    if support == TABLE:
        return like(problem.scene.table_height_m, state.T_base_tcp)
    return _heights(state, support, problem)[1]


def _over_support(record: Record, problem: Problem, support: str, margin: float) -> Term:
    """The middle of an object within its support's uppermost face: else it tips."""
    obj, half = record["obj"], _half_m(problem.model(support))

    def over(state: State) -> Array:
        T_object, T = _box_pose(state, obj, problem), _box_pose(state, support, problem)
        xp = namespace(state.T_base_tcp)
        top = _heights(state, support, problem)[1]
        x, y = T_object[:, 0, 3], T_object[:, 1, 3]
        contact = xp.stack([x, y, top + 0.0 * x], axis=-1)
        excess = abs(arrays.seen_from(T, contact[:, None])[:, 0]) - like(half, T)
        up = abs(T[:, 2, :3])
        upward = up == xp.amax(up, axis=-1)[:, None]  # the face that looks up is no edge
        return xp.amax(xp.where(upward, -np.inf, excess), axis=-1)

    return Term(
        what=f"the middle of {obj} beyond the edge of {support}", measure=over, high=-margin
    )


def _cavity_excess(container: str, points: Point, problem: Problem) -> Callable[[State], Array]:
    """How far each of ``(num_states, num_points, 3)`` leaves a cavity; negative inside [m]."""
    model = problem.model(container)
    inner = np.array(model.inner_m)
    centre = np.array([0.0, 0.0, model.wall_m + inner[2] / 2])

    def excess(state: State) -> Array:
        T = _pose(state, container)
        q = arrays.seen_from(T, points(state)) - like(centre, T)
        return namespace(T).amax(abs(q) - like(inner / 2, T), axis=-1)

    return excess


def _inside(record: Record, problem: Problem) -> Constraint:
    container, margin = record["container"], record.get("margin", 0.0)
    if "frac" in record:
        return _made(record, _share_inside(record, problem, margin))
    if "obj" in record:
        point, name = _point({"obj": record["obj"], "anchor": "origin"}, problem)
        name = f"the middle of {record['obj']}"
    else:
        point, name = _point(record["a"], problem)
    excess = _cavity_excess(container, lambda state: point(state)[:, None], problem)
    term = Term(
        what=f"{name} beyond the cavity of {container}",
        measure=lambda state: excess(state)[:, 0],
        high=-margin,
    )
    return _made(record, term)


def _share_inside(record: Record, problem: Problem, margin: float) -> Term:
    """The share of a surface that is inside, as the excess of the point that decides it [m]."""
    obj, share = record["obj"], record["frac"]
    points = surface_points(problem, obj)
    excess = _cavity_excess(
        record["container"],
        lambda state: arrays.carried(_pose(state, obj), like(points, state.T_base_tcp)),
        problem,
    )
    return Term(
        what=f"{share:.0%} of the surface of {obj} beyond the cavity of {record['container']}",
        measure=lambda state: _quantile(excess(state), share),
        high=-margin,
    )


def _quantile(values: Array, share: float) -> Array:
    """The value that this share of each row does not exceed."""
    xp = namespace(values)
    count = values.shape[-1]
    index = min(max(int(np.ceil(share * count)) - 1, 0), count - 1)
    ordered = np.sort(values, axis=-1) if xp is np else xp.sort(values, axis=-1)[0]
    return ordered[..., index]


def _outline_gap(a: str, b: str, problem: Problem) -> Callable[[State], Array]:
    """Gap between the boxes around two objects, seen from above; negative: overlap [m]."""
    half_a, half_b = (_half_m(problem.model(name)) for name in (a, b))

    def gap(state: State) -> Array:
        T_a, T_b = (_box_pose(state, name, problem) for name in (a, b))
        return arrays.footprint_gap(T_a, like(half_a, T_a), T_b, like(half_b, T_b))

    return gap


def _outside(record: Record, problem: Problem) -> Constraint:
    obj, container = record["obj"], record["container"]
    return _made(
        record,
        Term(
            what=f"the gap between {obj} and {container} seen from above",
            measure=_outline_gap(obj, container, problem),
            low=record.get("margin", 0.0),
        ),
    )


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
        x, y = SIDES[record["direction"]]

        def off(state: State) -> Array:
            way = (_box_pose(state, obj, problem) - _box_pose(state, reference, problem))[:, :2, 3]
            side = like((x, y), way)
            across = way[:, 0] * side[1] - way[:, 1] * side[0]
            return namespace(way).arctan2(norm(across[:, None]), (way * side).sum(-1))

        terms.append(
            Term(
                what=f"the side of {reference} it is on, off {record['direction']},",
                measure=off,
                high=SECTOR_RAD,
                unit="rad",
            )
        )
    return _made(record, *terms)


def _level(a: str, b: str, problem: Problem) -> Term:
    return Term(
        what=f"the height that {a} and {b} have in common",
        measure=_common_height(a, b, problem),
        low=0.0,
    )


def _between(record: Record, problem: Problem) -> Constraint:
    obj, first, second = (record[key] for key in ("obj", "first", "second"))

    def line(state: State) -> tuple[Array, Array, Array]:
        """Way between the two, its length, and the object's place from the first, from above."""
        p, p_first, p_second = (
            _box_pose(state, name, problem)[:, :2, 3] for name in (obj, first, second)
        )
        way = p_second - p_first
        length = norm(way)
        return way / length[:, None], length, p - p_first

    def reach(state: State, name: str, along: Array) -> Array:
        """How far a box extends along a horizontal unit vector."""
        T = _box_pose(state, name, problem)
        shares = (along[:, None] @ T[:, :2, :3])[:, 0]
        return (abs(shares) * like(_half_m(problem.model(name)), T)).sum(-1)

    def before(state: State) -> Array:
        along, _, offset = line(state)
        at = (along * offset).sum(-1)
        return at - reach(state, obj, along) - reach(state, first, along)

    def after(state: State) -> Array:
        along, length, offset = line(state)
        at = (along * offset).sum(-1)
        return length - at - reach(state, obj, along) - reach(state, second, along)

    def aside(state: State) -> Array:
        along, _, offset = line(state)
        return norm((along[:, 0] * offset[:, 1] - along[:, 1] * offset[:, 0])[:, None])

    return _made(
        record,
        Term(what=f"the gap between {first} and {obj}", measure=before, low=0.0),
        Term(what=f"the gap between {obj} and {second}", measure=after, low=0.0),
        Term(
            what=f"the middle of {obj} off the line between them",
            measure=aside,
            high=record.get("tol", BETWEEN_TOLERANCE_M),
        ),
        _level(obj, first, problem),
        _level(obj, second, problem),
    )


def _align(record: Record, problem: Problem) -> Constraint:
    (a, a_name), (b, b_name) = (_direction(record[key], problem) for key in "ab")
    undirected = record.get("undirected", False)
    return _made(
        record,
        Term(
            what=f"the angle between {a_name} and {b_name}",
            measure=lambda state: arrays.angle(a(state), b(state), undirected=undirected),
            high=float(np.radians(record["max_deg"])),
            unit="rad",
        ),
    )


def _upright(record: Record, problem: Problem) -> Constraint:
    obj = record["obj"]
    is_cube = problem.model(obj).symmetry == "cube"

    def tilt(state: State) -> Array:
        R = _pose(state, obj)[:, :3, :3]
        if not is_cube:
            up = R[:, :, 2]
            return namespace(R).arctan2(norm(up[:, :2]), up[:, 2])
        up = abs(R[:, 2])  # of each axis, either way up
        xp = namespace(R)
        flat = norm(R[:, :2].swapaxes(1, 2))
        return xp.amin(xp.arctan2(flat, up), axis=-1)

    return _made(
        record,
        Term(
            what=f"the tilt of {obj}",
            measure=tilt,
            high=float(np.radians(record["max_deg"])),
            unit="rad",
        ),
    )


def _relpose(record: Record, problem: Problem) -> Constraint:
    obj, reference = record["obj"], record["reference"]
    q = np.array(record["q_wxyz"], dtype=np.float64)
    T_wanted = se3.transform_from(q, np.array(record["p"], dtype=np.float64))

    def reached(state: State) -> Array:
        T = like(T_wanted, state.T_base_tcp)[None]
        return T if reference == BASE else _pose(state, reference) @ T

    return _made(record, *_near_pose(f"{obj} from its place", obj, reached, record))


def _near_pose(what: str, obj: str, wanted: Point, record: Record) -> tuple[Term, Term]:
    def off(state: State) -> Array:
        return norm((_pose(state, obj) - wanted(state))[:, :3, 3])

    def turned(state: State) -> Array:
        R = wanted(state)[:, :3, :3].swapaxes(1, 2) @ _pose(state, obj)[:, :3, :3]
        return arrays.turn(R)

    most_rad = float(np.radians(record["tol_deg"]))
    return (
        Term(what=f"the distance of {what}", measure=off, high=record["tol"]),
        Term(what=f"the turn of {what}", measure=turned, high=most_rad, unit="rad"),
    )


def _clearance(record: Record, problem: Problem) -> Constraint:
    obj, against = record["obj"], record["against"]
    return _made(
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
            T = _pose(state, obj)
            z = arrays.carried(T, like(points, T))[..., 2]
            return namespace(T).amin(z, axis=-1) - height

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
            T = _pose(state, obj)
            found = arrays.grid_distance(grid, arrays.carried(T, like(points, T)))
            return namespace(T).amin(found, axis=-1)

        return over_scene
    others = surface_points(problem, against)

    def apart(state: State) -> Array:
        T, T_other = _pose(state, obj), _pose(state, against)
        xp = namespace(state.T_base_tcp)
        there = arrays.seen_from(T_other, arrays.carried(T, like(points, T)))
        back = arrays.seen_from(T, arrays.carried(T_other, like(others, T_other)))
        return xp.minimum(
            xp.amin(_panel_distance(problem.model(against), there), axis=-1),
            xp.amin(_panel_distance(problem.model(obj), back), axis=-1),
        )

    return apart


def _panel_distance(model: ObjectModel, points: Array) -> Array:
    """Signed distances of points in an object's frame to the boxes it is made of [m]."""
    xp = namespace(points)
    found = [
        arrays.box_distance(points - like(centre, points), like(np.array(size) / 2, points))
        for centre, size in model.panels()
    ]
    return xp.amin(xp.stack(found, axis=-1), axis=-1)


def _keepout(record: Record, problem: Problem) -> Constraint:
    distance, region = _region(record["region"], problem)
    if "obj" in record:
        obj = record["obj"]
        surface = surface_points(problem, obj)
        name = obj

        def points(state: State) -> Array:
            T = _pose(state, obj)
            return arrays.carried(T, like(surface, T))
    else:
        point, name = _point(record["a"], problem)

        def points(state: State) -> Array:
            return point(state)[:, None]

    def least(state: State) -> Array:
        found = distance(state, points(state))
        return namespace(found).amin(found, axis=-1)

    return _made(
        record,
        Term(
            what=f"the distance of {name} from {region}",
            measure=least,
            low=record.get("margin", 0.0),
        ),
    )


def _region(spec: Record, problem: Problem) -> tuple[Callable[[State, Array], Array], str]:
    """Signed distances of points to a region, negative inside, and its name in words."""
    if "box" in spec:
        low, high = (np.array(spec["box"][key], dtype=np.float64) for key in ("min", "max"))

        def of_box(state: State, points: Array) -> Array:
            centre, half = like((low + high) / 2, points), like((high - low) / 2, points)
            return arrays.box_distance(points - centre, half)

        return of_box, f"the box from {_millimetres(low)} to {_millimetres(high)}"
    if "sphere" in spec:
        centre = np.array(spec["sphere"]["centre"], dtype=np.float64)
        radius = spec["sphere"]["radius"]
        return (
            lambda state, points: norm(points - like(centre, points)) - radius,
            f"the sphere of {radius * 1e3:.0f} mm around {_millimetres(centre)}",
        )
    over = spec["over"]
    half = _half_m(problem.model(over))

    def of_column(state: State, points: Array) -> Array:
        """Of an upright column over the box around an object that stands upright."""
        q = arrays.seen_from(_box_pose(state, over, problem), points)[..., :2]
        return arrays.box_distance(q, like(half[:2], points))

    return of_column, f"what is over {over}"


def _height(record: Record, problem: Problem) -> Constraint:
    table = problem.scene.table_height_m
    if "obj" in record:
        obj, name = record["obj"], f"the lowest point of {record['obj']}"

        def measure(state: State) -> Array:
            return _heights(state, obj, problem)[0] - table
    else:
        point, name = _point(record["a"], problem)

        def measure(state: State) -> Array:
            return point(state)[:, 2] - table

    return _made(
        record,
        Term(
            what=f"the height of {name} over the table",
            measure=measure,
            low=record.get("min", -np.inf),
            high=record.get("max", np.inf),
        ),
    )


def _speed(record: Record, problem: Problem) -> Constraint:
    point, name = _point(record.get("a", {"ee": True}), problem)
    limit = record["max"]

    def along(states: State, times_s: Array | None) -> Array:
        num_states, num_steps = states.T_base_tcp.shape[:2]
        if times_s is None or num_steps < 2:
            return like(np.full(num_states, -limit), states.T_base_tcp)
        p = point(flattened(states)).reshape(num_states, num_steps, 3)
        seconds = times_s[1:] - times_s[:-1]
        speeds = norm(p[:, 1:] - p[:, :-1]) / seconds
        return namespace(p).amax(speeds, axis=-1) - limit

    term = Term(what=f"the speed of {name}", measure=_nothing, high=limit, unit="m/s")
    return replace(_made(record, term), along=along)


def _nothing(state: State) -> Array:
    """What a single state has of a number that only a path has."""
    return 0.0 * state.T_base_tcp[:, 0, 0]


def _hold(record: Record, problem: Problem) -> Constraint:
    obj = record["obj"]
    limits = {
        "tol": record.get("tol", HOLD_TOLERANCE_M),
        "tol_deg": record.get("tol_deg", HOLD_TOLERANCE_DEG),
    }

    def along(states: State, times_s: Array | None) -> Array:
        num_states, num_steps = states.T_base_tcp.shape[:2]
        steps = flattened(states)
        xp = namespace(steps.T_base_tcp)
        T_tcp, T_object = steps.T_base_tcp, _pose(steps, obj)
        R_in_hand = T_tcp[:, :3, :3].swapaxes(1, 2) @ T_object[:, :3, :3]
        p_in_hand = arrays.seen_from(T_tcp, T_object[:, None, :3, 3])[:, 0]
        R = R_in_hand.reshape(num_states, num_steps, 3, 3)
        p = p_in_hand.reshape(num_states, num_steps, 3)
        slid = norm(p - p[:, :1]) - limits["tol"]
        turned = arrays.turn(R[:, :1].swapaxes(2, 3) @ R) - np.radians(limits["tol_deg"])
        scale = SCALES["m"] / SCALES["rad"]
        return xp.amax(xp.maximum(slid, turned * scale), axis=-1)

    what = f"the way {obj} has slid in the hand"
    term = Term(what=what, measure=_nothing, high=limits["tol"])
    return replace(_made(record, term), along=along)


def _reach(record: Record, problem: Problem) -> Constraint:
    """A necessary condition: the links, laid out straight, are as long as the way to the tool.

    Inverse kinematics decides; this says by how much a tool is too far off, which that does not.
    """
    p_shoulder, length_m = _outer_reach(problem)
    return _made(
        record,
        Term(
            what="the distance of the tool from the arm's first joint",
            measure=lambda state: norm(
                state.T_base_tcp[:, :3, 3] - like(p_shoulder, state.T_base_tcp)
            ),
            high=length_m - record.get("margin", 0.0),
        ),
    )


def _outer_reach(problem: Problem) -> tuple[Float[np.ndarray, "3"], float]:
    """Where the arm's first joint is in the base frame, and the lengths of the links behind it [m].

    The placements of the joints and the tool in the robot description, one behind the other.
    """
    model, tool = problem.robot.model, problem.robot.tcp_id
    frame = model.frames[tool]
    length = float(np.linalg.norm(frame.placement.translation))
    joint = int(frame.parentJoint)
    while int(model.parents[joint]):
        length += float(np.linalg.norm(model.jointPlacements[joint].translation))
        joint = int(model.parents[joint])
    return np.array(model.jointPlacements[joint].translation), length


def _visible(record: Record, problem: Problem) -> Constraint:
    obj, name = record["obj"], record["camera"]
    if name not in problem.cameras:
        known = ", ".join(sorted(problem.cameras)) or "none"
        message = f"visible {obj}: there is no camera {name!r} here. Cameras: {known}."
        raise UsageError(message)
    view = problem.cameras[name]
    points = surface_points(problem, obj)
    share = record.get("frac", 0.5)
    camera = view.camera
    # Planes through the eye and the edges of the image, pointing outwards.
    left, right = camera.cx / camera.fx, (camera.width - camera.cx) / camera.fx
    top, bottom = camera.cy / camera.fy, (camera.height - camera.cy) / camera.fy
    planes = np.array([[-1, 0, -left], [1, 0, -right], [0, -1, -top], [0, 1, -bottom]])
    planes /= np.linalg.norm(planes, axis=1, keepdims=True)
    others = [key for key in problem.scene.task.objects if key != obj]

    def hidden(state: State) -> Array:
        """Of each point: how far out of the picture or behind something; negative in view."""
        T = _pose(state, obj)
        xp = namespace(T)
        p = arrays.carried(T, like(points, T))
        q = arrays.seen_from(like(view.T_base_camera, T)[None], p)
        found = [xp.amax(q @ like(planes.T, T), axis=-1)]
        for other in (key for key in others if key in state.Ts_base_object):
            T_other = _pose(state, other)
            for centre, size in problem.model(other).panels():
                shift = np.eye(4)
                shift[:3, 3] = centre
                half = like(np.array(size) / 2, T)
                T_panel = T_other @ like(shift, T)
                found.append(arrays.blocked_length(view.T_base_camera[:3, 3], p, T_panel, half))
        return _quantile(xp.amax(xp.stack(found, axis=-1), axis=-1), share)

    term = Term(
        what=f"{share:.0%} of the surface of {obj} out of the view of {name}",
        measure=hidden,
        high=0.0,
    )
    return _made(record, term)


def _stable(record: Record, problem: Problem) -> Constraint:
    """The middle stays over the face that the object stands on, and over its support."""
    obj, support = record["obj"], record.get("support", TABLE)
    half, margin = _half_m(problem.model(obj)), record.get("margin", 0.0)

    def beyond(state: State) -> Array:
        """How far the plumb line through the middle leaves the face that looks down."""
        down = -_pose(state, obj)[:, 2, :3]  # in the object frame
        xp = namespace(down)
        steep = abs(down)
        lower = steep == xp.amax(steep, axis=-1)[:, None]
        length = xp.where(lower, like(half, down) / xp.where(lower, steep, 1.0), 0.0).sum(-1)
        aside = abs(down) * length[:, None] - like(half, down)
        return xp.amax(xp.where(lower, -np.inf, aside), axis=-1)

    what = f"the plumb line of {obj} beyond its own lower face"
    terms = [Term(what=what, measure=beyond, high=-margin)]
    if support != TABLE:
        terms.append(_over_support(record, problem, support, margin))
    return _made(record, *terms)


def _moved(record: Record, problem: Problem) -> Constraint:
    obj = record["obj"]
    if obj not in problem.scene.Ts_base_object:
        message = f"moved {obj}: it was not localised, so nobody knows where it was before."
        raise UsageError(message)
    start = problem.scene.Ts_base_object[obj][:3, 3]
    terms = []

    def way(state: State) -> Array:
        return _pose(state, obj)[:, :3, 3] - like(start, state.T_base_tcp)

    if "at_least" in record or "at_most" in record:
        direction = np.array(record.get("direction", (0.0, 0.0, 0.0)), dtype=np.float64)
        unit = direction / np.linalg.norm(direction) if direction.any() else None
        terms.append(
            Term(
                what=f"the way {obj} was moved",
                measure=(lambda state: norm(way(state)))
                if unit is None
                else (lambda state: (way(state) * like(unit, state.T_base_tcp)).sum(-1)),
                low=record.get("at_least", -np.inf),
                high=record.get("at_most", np.inf),
            )
        )
    if "target" in record:
        target = np.array(record["target"], dtype=np.float64)
        terms.append(
            Term(
                what=f"the distance of {obj} from its target",
                measure=lambda state: norm(
                    _pose(state, obj)[:, : len(target), 3] - like(target, state.T_base_tcp)
                ),
                high=record["tol"],
            )
        )
    return _made(record, *terms)


_KINDS: dict[str, Callable[[Record, Problem], Constraint]] = {
    "distance": _distance,
    "above": _above,
    "on": _on,
    "inside": _inside,
    "outside": _outside,
    "beside": _beside,
    "between": _between,
    "align": _align,
    "upright": _upright,
    "relpose": _relpose,
    "clearance": _clearance,
    "keepout": _keepout,
    "height": _height,
    "speed": _speed,
    "hold": _hold,
    "reach": _reach,
    "visible": _visible,
    "stable": _stable,
    "moved": _moved,
}
KINDS = tuple(_KINDS)
"""What can be asked; the schema lists the same."""
