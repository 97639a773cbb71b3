"""A cell with a box, a post and a wall, and pairs of postures between which one must go around.

For tests and the benchmark of the planner's paths.
"""

from dataclasses import dataclass

import numpy as np
from upright import upright as at

from bridge.robots.default import ROBOT
from bridge.task.task_file import ObjectModel, Task, load_task
from twin.plan.path.world import World, build_world
from twin.plan.problem import Problem
from twin.replay.scene import ReplayScene
from twin.robot.collision import hulls_of
from twin.robot.follow import follow_poses
from twin.robot.model import load_robot

EPS_M = 0.002
WIDTH_M = 0.085
KINDS = ("box", "post", "wall", "self")


def standing(name: str, size_m: tuple[float, float, float]) -> ObjectModel:
    return ObjectModel(
        id=name, shape="box", size_m=size_m, color_srgb=(90, 90, 90), fixed=True, mass_kg=1.0
    )


def task_with_post_and_wall() -> Task:
    task = load_task("cube_into_box")
    objects = dict(task.objects)
    objects["post"] = standing("post", (0.05, 0.05, 0.5))
    objects["wall"] = standing("wall", (0.3, 0.02, 0.25))
    return Task(**{**vars(task), "objects": objects})


def problem_of_test(urdf: str | None = None) -> Problem:
    urdf = urdf or ROBOT.urdf_text()
    scene = ReplayScene(
        task=task_with_post_and_wall(),
        Ts_base_object={
            "cube": at(0.45, -0.35, 0.02, 0.4),
            "box": at(0.5, 0.25, 0.0, 0.1),
            "post": at(0.6, -0.02, 0.25),
            "wall": at(0.42, 0.05, 0.125),
        },
        urdf=urdf,
    )
    return Problem(scene=scene, robot=load_robot(urdf), shapes={})


def tool_down(x: float, y: float, z: float, yaw: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = np.array(
        [[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1.0]]
    ) @ np.diag([1.0, -1.0, -1.0])
    T[:3, 3] = (x, y, z)
    return T


@dataclass(frozen=True)
class Pairs:
    """Postures to go from and to, and what is in the way."""

    problem: Problem
    world: World
    kinds: list[str]
    starts: np.ndarray
    goals: np.ndarray


def joints_at(problem: Problem, T: np.ndarray, near: np.ndarray | None) -> np.ndarray | None:
    found = follow_poses(problem.robot, T[None], start_rad=near)
    return found.joints_rad[0] if found.reached[0] else None


def drawn_pair(
    problem: Problem, kind: str, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray] | None:
    if kind == "self":
        home = problem.robot.home_rad
        return home + rng.uniform(-2.4, 2.4, 6), home + rng.uniform(-2.4, 2.4, 6)
    x, y, yaw = rng.uniform(0.4, 0.6), rng.uniform(-0.4, -0.12), rng.uniform(-1, 1)
    start = joints_at(problem, tool_down(x, y, rng.uniform(0.06, 0.2), yaw), None)
    if kind == "box":  # tips below the rim
        place = at(0.5, 0.25, 0.0, 0.1) @ np.array(
            [*rng.uniform(-0.02, 0.02, 2), rng.uniform(0.03, 0.045), 1.0]
        )
        x, y, z, yaw = *place[:3], 0.1 + rng.choice([0.0, np.pi / 2])
    else:
        x, y, z = rng.uniform(0.4, 0.6), rng.uniform(0.15, 0.4), rng.uniform(0.08, 0.2)
        yaw = rng.uniform(-1, 1)
    if start is None:
        return None
    goal = joints_at(problem, tool_down(x, y, z, yaw), start)
    return None if goal is None else (start, goal)


def pairs_of_test(each: int = 10, seed: int = 22) -> Pairs:
    """So many pairs for each thing in the way, free at both ends and not in between."""
    problem = problem_of_test()
    world = build_world(problem, width_m=WIDTH_M, eps_col_m=EPS_M)
    own = {hull.link for hull in hulls_of(problem.robot).hulls}
    rng = np.random.default_rng(seed)
    kinds, starts, goals = [], [], []
    for kind in KINDS:
        found = 0
        while found < each:
            drawn = drawn_pair(problem, kind, rng)
            if drawn is None or not usable(world, np.stack(drawn)):
                continue
            way = np.stack(drawn)
            blocking = blocking_names(world, way)
            if not blocking or (
                kind != "box" and not (blocking & ({kind} if kind != "self" else own))
            ):
                continue
            if kind == "self" and blocking - own:
                continue
            kinds.append(kind)
            starts.append(drawn[0])
            goals.append(drawn[1])
            found += 1
    return Pairs(problem, world, kinds, np.array(starts), np.array(goals))


def usable(world: World, postures: np.ndarray) -> bool:
    low, high = world.robot.lower_rad, world.robot.upper_rad
    inside = bool(((low < postures) & (postures < high)).all())
    return inside and all(world.motion.touching(q) < 0 for q in postures)


def blocking_names(world: World, way: np.ndarray) -> set[str]:
    """What touches on the straight way, looked at in a hundred places."""
    names = set()
    for share in np.linspace(0, 1, 101):
        pair = world.motion.touching(way[0] + share * (way[1] - way[0]))
        if pair >= 0:
            names.add(world.names[pair][1])
    return names
