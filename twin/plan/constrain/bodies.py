"""Bodies, points and directions of many states: what constraints measure between."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.geometry.mesh import sample_triangles
from bridge.task.relations import AXES, Box
from bridge.task.task_file import ObjectModel
from twin.plan.constrain.schema import BASE
from twin.plan.problem import Array, Numbers, Points, Problem, State, Vector

NUM_POINTS = 200
"""Of an object's surface; its corners first."""

Record = Mapping[str, Any]
Point = Callable[[State], Array]
"""A point of each state in the base frame, ``(num_states, 3)``."""


def carried(T: Array, points_m: Array) -> Array:
    """Points of a body in the frame of its pose, ``(num_states, num_points, 3)``."""
    return points_m @ T[:, :3, :3].swapaxes(-1, -2) + T[:, None, :3, 3]


def pose_of(state: State, object_id: str) -> Array:
    """Poses of an object, ``(num_states, 4, 4)``, or one for all states."""
    return state.Ts_base_object[object_id]


def box_of(state: State, object_id: str, problem: Problem) -> Box:
    """The box around an object in each state."""
    T, before = pose_of(state, object_id), problem.scene.Ts_base_object.get(object_id)
    before_m = None if before is None else before[:3, 3]
    return Box.around(problem.model(object_id), T, before_m=before_m)


def _anchor_m(model: ObjectModel, anchor: str) -> Vector:
    """A named point of an object, in its frame."""
    up = np.array([0.0, 0.0, model.size_m[2] / 2])
    middle = 0 * up if model.origin_at_centre else up
    places: dict[str, Float[np.ndarray, 3]] = {
        "centroid": middle,
        "origin": np.zeros(3),
        "top": middle + up,
        "bottom": middle - up,
        "opening": middle + up,
        "handle": np.array(model.grasp_m),
    }
    return places[anchor]


def point_of(spec: Record, problem: Problem) -> tuple[Point, str]:
    """A point of each state, and its name in words."""
    offset = np.array(spec.get("offset", (0.0, 0.0, 0.0)), dtype=np.float64)
    aside = f" offset by {millimetres(offset)}" if offset.any() else ""
    if "ee" in spec:
        return lambda state: _at(state.T_base_tcp, offset), f"the tool{aside}"
    if "object" in spec:
        name, anchor = spec["object"], spec.get("anchor", "centroid")
        p_object = _anchor_m(problem.model(name), anchor) + offset
        return lambda state: _at(pose_of(state, name), p_object), f"{name}'s {anchor}{aside}"
    p, frame = np.array(spec["xyz"], dtype=np.float64) + offset, spec.get("frame", BASE)
    if frame == BASE:
        return lambda state: p[None], f"the point {millimetres(p)}"
    return lambda state: _at(pose_of(state, frame), p), f"the point {millimetres(p)} of {frame}"


def _at(T: Array, p_m: Vector) -> Array:
    return carried(T, p_m[None])[:, 0]


def millimetres(p_m: Numbers) -> str:
    """A point in words."""
    return "(" + ", ".join(f"{value * 1e3:.0f}" for value in p_m) + ") mm"


def direction_of(spec: Record) -> tuple[Point, str]:
    """A direction of each state in the base frame, and its name in words."""
    if "ee" in spec:
        column = {"approach": 2, "closing": 1}[spec["ee"]]
        return lambda state: state.T_base_tcp[:, :3, column], f"the tool's {spec['ee']} direction"
    name = spec["axis"] if "object" in spec else spec["world"]
    axis = (-1.0 if name[0] == "-" else 1.0) * np.eye(3)[AXES.index(name[-1])]
    if "object" in spec:
        return (
            lambda state: pose_of(state, spec["object"])[:, :3, :3] @ axis,
            f"{spec['object']}'s {name} axis",
        )
    return lambda state: axis[None], f"the base frame's {name} axis"


def surface_points(problem: Problem, object_id: str, count: int = NUM_POINTS) -> Points:
    """Points of an object's surface in its frame: corners, and more spread evenly over it [m]."""
    shape = problem.shapes[object_id]
    corners = shape.vertices_m[np.unique(shape.triangles)]
    corners = corners[:: max(1, -(-2 * len(corners) // count))]
    a, b, c = (shape.vertices_m[shape.triangles[:, k]] for k in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    rng = np.random.default_rng(0)
    chosen, u, v = sample_triangles(areas, count - len(corners), rng, in_order=True)
    spread = a[chosen] + u * (b - a)[chosen] + v * (c - a)[chosen]
    return np.concatenate([corners, spread])
