"""A scene of a cube, a brick, an open box and a fixed post, and states around good ones."""

import math
from functools import cache
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull
from upright import upright as pose

from bridge.geometry import se3
from bridge.geometry.mesh import box_corners
from bridge.robots.default import ROBOT
from bridge.task.task_file import Task, TaskFile
from twin.plan.problem import Problem, Shape, State
from twin.replay.scene import ReplayScene
from twin.robot.model import load_robot

TOML = b"""
schema_version = 1
name = "blocks"
instruction = "Put the cube onto the brick."
manipulated = ["cube", "brick"]
containers = ["box"]
[objects.cube]
shape = "box"
size_m = [0.04, 0.04, 0.04]
color_srgb = [200, 45, 40]
symmetry = "cube"
[objects.brick]
shape = "box"
size_m = [0.12, 0.06, 0.05]
color_srgb = [40, 45, 200]
[objects.box]
shape = "open_box"
inner_m = [0.15, 0.15, 0.05]
wall_m = 0.006
color_srgb = [60, 110, 180]
fixed = true
[objects.post]
shape = "box"
size_m = [0.05, 0.05, 0.2]
color_srgb = [60, 60, 60]
fixed = true
[start.cube]
x_m = [0.4, 0.5]
y_m = [-0.2, -0.1]
yaw_rad = [0.0, 0.5]
[start.brick]
x_m = [0.4, 0.5]
y_m = [0.0, 0.0]
yaw_rad = [0.0, 0.5]
[start.box]
x_m = [0.5, 0.5]
y_m = [0.2, 0.2]
yaw_rad = [0.0, 0.0]
[start.post]
x_m = [0.7, 0.7]
y_m = [0.0, 0.0]
yaw_rad = [0.0, 0.0]
[[stages]]
id = "grasp"
text = "Grasp the cube."
grasp = "cube"
allowed_contacts = [["cube", "table"], ["gripper", "cube"]]
[[stages]]
id = "place"
text = "Put it onto the brick."
release = "cube"
allowed_contacts = [["cube", "brick"], ["gripper", "cube"], ["brick", "table"]]
[[success]]
kind = "on"
object = "cube"
support = "brick"
"""


@cache
def blocks_task() -> Task:
    return TaskFile(TOML, "test").task()


PLACES = {
    "cube": pose(0.45, -0.15, 0.02, 0.3),
    "brick": pose(0.45, 0.0, 0.025, 0.2),
    "box": pose(0.5, 0.2, 0.0, 0.1),
    "post": pose(0.7, 0.0, 0.1, 0.4),
}
LOOKING_DOWN = np.diag([1.0, -1.0, -1.0, 1.0])


def box_shape(size_m: tuple[float, float, float]) -> Shape:
    corners = box_corners(np.array(size_m))
    triangles = ConvexHull(corners).simplices.astype(np.int64)
    return Shape(vertices_m=corners, triangles=triangles, source="test")


@cache
def blocks() -> Problem:
    task = blocks_task()
    scene = ReplayScene(task=task, Ts_base_object=dict(PLACES), urdf=ROBOT.urdf_text())
    return Problem(
        scene=scene,
        robot=load_robot(scene.urdf),
        shapes={key: box_shape(model.size_m) for key, model in task.objects.items()},
    )


def state(**Ts: np.ndarray) -> State:
    """One state: the scene's poses, with those that are given, and the tool 20 cm over the cube."""
    tcp = Ts.pop("tcp", None)
    objects = {key: T[None] for key, T in (PLACES | Ts).items()}
    if tcp is None:
        tcp = objects["cube"][0] @ LOOKING_DOWN
        tcp[2, 3] += 0.2
    return State(Ts_base_object=objects, T_base_tcp=tcp[None], width_m=np.full(1, 0.05))


def around(
    start: State,
    count: int,
    rng: np.random.Generator,
    *,
    far_m: float = 0.08,
    turn_rad: float = 0.5,
) -> State:
    """States near one: what can move and the tool are shifted and turned."""

    def shaken(T: np.ndarray) -> np.ndarray:
        size = rng.uniform(0.0, 1.0, size=(count, 1)) ** 2  # many near, some far
        moved = np.repeat(T, count, axis=0)
        moved[:, :3, 3] += size * rng.uniform(-far_m, far_m, size=(count, 3))
        turned = se3.rotation_from_vector(size * rng.uniform(-turn_rad, turn_rad, size=(count, 3)))
        moved[:, :3, :3] = turned @ moved[:, :3, :3]
        return moved

    objects = {
        key: shaken(T) if key in ("cube", "brick") else T for key, T in start.Ts_base_object.items()
    }
    return State(
        Ts_base_object=objects, T_base_tcp=shaken(start.T_base_tcp), width_m=np.full(count, 0.05)
    )


CUBE, OPENING = {"object": "cube", "anchor": "bottom"}, {"object": "box", "anchor": "opening"}
IN_BOX = state(cube=pose(0.5, 0.2, 0.03, 0.3))
ON_BRICK = state(cube=pose(0.46, 0.01, 0.07, 0.5))
OVER_BOX = state(cube=pose(0.51, 0.2, 0.096, 0.5))
BESIDE = state(cube=pose(0.45, 0.07, 0.02, 0.2))
OUT = state(cube=pose(0.5, 0.05, 0.02, 0.3))
START = state()
TILTED = state(
    brick=PLACES["brick"] @ se3.transform_from(np.array([0.9, 0.3, 0.2, 0.1]), np.zeros(3))
)

TOOL, MIDDLE = {"ee": True}, {"object": "cube"}
DOWN = {"a": {"ee": "approach"}, "b": {"world": "-z"}}
OVER = {"a": CUBE, "b": OPENING, "height": 0.02, "tolerance_m": 0.01, "aside_m": 0.03}
POINT = pose(0.5, 0.1, 0.1)
RIGHT = state(cube=pose(0.45, -0.07, 0.02, 0.2))
AWAY = state(tcp=pose(0.5, 0.1, 0.3) @ LOOKING_DOWN)
TEN = math.radians(10)
_EXAMPLES: dict[str, tuple[dict[str, Any], State, State]] = {
    "distance": ({"a": TOOL, "b": MIDDLE, "min": 0.19, "max": 0.21}, START, AWAY),
    "distance at least": (
        {"a": MIDDLE, "b": {"xyz": [0.5, 0.1, 0.1]}, "min": 0.1}, START, state(cube=POINT),
    ),
    "above": (OVER, OVER_BOX, START),
    "on": ({"object": "cube", "support": "brick"}, ON_BRICK, START),
    "on table": ({"object": "cube", "support": "table"}, START, ON_BRICK),
    "inside": ({"object": "cube", "container": "box"}, IN_BOX, START),
    "outside": ({"object": "cube", "container": "box"}, OUT, IN_BOX),
    "beside": ({"object": "cube", "reference": "brick"}, BESIDE, ON_BRICK),
    "beside left": ({"object": "cube", "reference": "brick", "direction": "left"}, BESIDE, RIGHT),
    "align": ({**DOWN, "tolerance_rad": TEN}, START, state(tcp=np.eye(4))),
    "align bodies": (
        {"a": MIDDLE | {"axis": "-y"}, "b": {"object": "post", "axis": "x"}, "tolerance_rad": 0.3},
        state(cube=pose(0.5, -0.2, 0.02, 2.1)), START,
    ),
    "upright": ({"object": "brick", "tolerance_rad": TEN}, START, TILTED),
    "upright cube": (
        {"object": "cube", "tolerance_rad": TEN},
        START, state(cube=TILTED.Ts_base_object["brick"][0]),
    ),
    "clearance": ({"object": "cube", "against": "box", "min": 0.02}, START, IN_BOX),
    "clearance table": ({"object": "cube", "against": "table", "min": 0.02}, ON_BRICK, START),
    "keepout over": ({"object": "cube", "over": "box", "margin_m": 0.01}, START, OVER_BOX),
    "height": ({"a": CUBE, "min": 0.04}, ON_BRICK, START),
    "height of a body": ({"object": "cube", "max": 0.03}, START, ON_BRICK),
    "moved": (
        {"object": "cube", "at_least_m": 0.05, "direction": [0.0, 1.0, 0.0]}, ON_BRICK, START,
    ),
    "moved to": ({"object": "cube", "target_m": [0.45, 0.0], "tolerance_m": 0.03}, ON_BRICK, START),
    "moved by": (
        {"object": "cube", "by_m": 0.16, "direction": "left", "tolerance_m": 0.03}, ON_BRICK, START,
    ),
}  # fmt: skip
EXAMPLES = {
    name: ({"kind": name.split()[0], **record}, good, bad)
    for name, (record, good, bad) in _EXAMPLES.items()
}
"""A record of each kind, a state in which it holds, and one in which it does not."""
