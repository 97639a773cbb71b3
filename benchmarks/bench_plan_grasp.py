"""Grasps of reconstructed objects: how many, how fast, and whether they lift in the stand-in cell.

Each object is scanned once in the stand-in cell (seed of the development range, Gaussians not
fitted) and reconstructed as ``rebuild`` does it. Then starts are drawn in as many laboratories,
localised in the cells' own images, and the first grasp is driven: straight down, closed, lifted by
10 cm; it counts when the object's middle truly rose by 4 cm (a soft toy held by its head sags).
Reference in the same run: the task's own point (``grasp_m``, closing along the object's y axis,
from above), driven alike.

Rank: the object is believed to be where it is not, by 9 mm and 8 degrees, the covariance says so,
and grasps from all over the ranking are driven. Kendall's tau-b between margin and lifting, and the
chance that of one that lifts and one that does not the first has the greater margin.

What a lift would publish is not encoded, which takes longer than the physics of a cube, and starts
are shared out among processes; neither changes a number. CPU time is that of one process.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"

import argparse
import multiprocessing
import time
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from localise_cell import _Laboratory
from measure import Target, report_targets
from scan_objects import take_scan

from bridge.geometry import se3
from bridge.robots.default import ROBOT
from bridge.sources.standin.cell import StandinCell
from bridge.sources.standin.kinematics import tool_down
from bridge.sources.standin.scan import joint_move
from bridge.sources.standin.streams import Streams
from bridge.task.task_file import Task, load_task
from twin.plan.grasp.search import GraspConfig, GraspSearcher
from twin.plan.problem import Grasp, NoPlanError, Problem, Shape
from twin.plan.shapes import shapes_of
from twin.replay.scene import ReplayScene
from twin.robot.inverse import solve_ik
from twin.robot.model import load_robot
from twin.scene.localise.objects import localise_objects

SCAN_SEED = 1_000_700
FIRST_SEED = 1_000_710
"""Laboratories and starts; the development range."""
OBJECTS = {
    "cube": ("cube_into_box", "cube"),
    "duck": ("five_ducks_into_basket", "duck_1"),
    "sloth": ("sloth_into_basket", "sloth"),
}
APPROACH_M, LIFT_M, LIFTED_M = 0.08, 0.10, 0.04
STEPS = 8
ROUGH = np.diag(np.square([0.009, 0.009, 0.001, 0.01, 0.01, 0.14]))
EVERYTHING = GraspConfig(least_margin=-50.0, most=300)
"""Bad grasps too: a ranking of good ones alone says nothing."""
NUM_RANKS = 6
MOST_CPU_S, LEAST_GRASPS, LEAST_LIFTED, LEAST_IN_ORDER = 0.5, 50, 90.0, 60.0
NOTE = "reconstructed from one scan each; localised in the cell's images; CPU time, one thread"


@dataclass(frozen=True, kw_only=True)
class Start:
    """A laboratory with a start, and where the twin believes its objects are."""

    cell: StandinCell
    Ts_true: dict[str, np.ndarray]
    Ts_seen: dict[str, np.ndarray]
    covariances: dict[str, np.ndarray]


def scanned(task_name: str, key: str) -> Shape | None:
    """The surface that a scan gives."""
    found = take_scan(task_name, SCAN_SEED).shapes.get(key, "not found")
    if isinstance(found, str):
        print(f"  {key} was not reconstructed: {found}")
        return None
    vertices = found.vertices_m
    model = load_task(task_name).objects[key]
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    shift = -(low + high) / 2
    shift[2] = -model.size_m[2] / 2 - low[2]
    return Shape(
        vertices_m=vertices + shift,
        triangles=found.faces,
        source="scan",
        trusted_from_m=float(low[2] + shift[2]) + found.truncation_m,
        error_m=float(found.sdf.voxel_m),
    )


class Silent(Streams):
    """Publishes nothing."""

    def __init__(self) -> None:
        """Need no session."""

    def _forget(self, *_: object, **__: object) -> None:
        pass

    joints = tcp = camera_poses = gripper = truth_object = truth_nodes = _forget


def start_of(task: Task, seed: int, *, look: bool) -> Start:
    """Draw a laboratory and a start; with ``look`` localise it."""
    laboratory = _Laboratory(task.name, seed, None, honest=False)
    cell = laboratory.cell
    true = cell.world.Ts_base_object()
    if not look:
        cell.streams = Silent()
        return Start(cell=cell, Ts_true=true, Ts_seen=true, covariances={})
    for _ in range(3):
        cell.capture()
        cell.wait(0.2)
    cell.streams = Silent()
    found = localise_objects(laboratory.tap.frames, task)
    poses = {k: item.T_base_object for k, item in found.items() if item.T_base_object is not None}
    sure = {k: item.covariance for k, item in found.items() if item.covariance is not None}
    return Start(cell=cell, Ts_true=true, Ts_seen=poses, covariances=sure)


def problem_at(task: Task, start: Start, shapes: Mapping[str, Shape]) -> Problem:
    """What the planner knows of a start."""
    urdf = ROBOT.urdf_text()
    scene = ReplayScene(
        task=task, urdf=urdf, Ts_base_object=start.Ts_seen, covariances=start.covariances,
        start_rad=start.cell.home_rad,
    )  # fmt: skip
    return Problem(scene=scene, robot=load_robot(urdf), shapes=shapes)


def nominal_grasp(problem: Problem, key: str) -> Grasp:
    """The task's own point, from above, closing along the object's y axis."""
    T, model = problem.scene.Ts_base_object[key], problem.model(key)
    yaw = float(np.arctan2(T[1, 0], T[0, 0]))
    turns = np.arange(4) * np.pi if model.grasp_turn_rad > 3 else np.arange(4) * np.pi / 2
    yaw = min(((yaw + t + np.pi) % (2 * np.pi) - np.pi for t in turns), key=abs)
    T_base_tcp = tool_down(se3.apply(T, np.array(model.grasp_m)), yaw)
    home = problem.scene.start_rad
    joints = solve_ik(problem.robot, T_base_tcp, warm_start_rad=home).joints_rad
    return Grasp(
        object_id=key, T_object_tcp=se3.invert(T) @ T_base_tcp, width_m=0.0,
        open_m=ROBOT.gripper.max_width_m, margin=0.0, joints_rad=joints, pregrasp_m=APPROACH_M,
    )  # fmt: skip


def line(T: np.ndarray, shift_m: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Joints along a straight line to a pose moved by a vector, from the pose on."""
    rows, robot = [joints], load_robot(ROBOT.urdf_text())
    for share in np.arange(1, STEPS + 1) / STEPS:
        there = T.copy()
        there[:3, 3] += share * shift_m
        found = solve_ik(robot, there, warm_start_rad=rows[-1])
        rows.append(found.joints_rad)
    return np.array(rows)


def follow(cell: StandinCell, rows: np.ndarray, seconds: float) -> None:
    """Drive joints evenly."""
    times = (np.arange(len(rows)) / (len(rows) - 1) * seconds * 1e9).astype(np.int64)
    cell.follow(times, rows)


def lifts(start: Start, seen: np.ndarray, grasp: Grasp) -> bool:
    """Drive one grasp in the cell: whether the object truly rose."""
    cell = start.cell
    cell.reset(start.Ts_true)
    before = cell.world.Ts_base_object()[grasp.object_id][2, 3]
    T = seen @ grasp.T_object_tcp
    back = line(T, -APPROACH_M * T[:3, 2], grasp.joints_rad)
    up = line(T, np.array([0.0, 0.0, LIFT_M]), grasp.joints_rad)
    cell.follow(*joint_move(cell.home_rad, back[-1], cell.file.max_joint_speed_rad_s))
    follow(cell, back[::-1], 1.2)
    cell.wait(0.2)
    cell.grip(0.0)
    cell.wait(1.2)
    follow(cell, up, 1.2)
    cell.wait(0.6)
    after = cell.world.Ts_base_object()[grasp.object_id][2, 3]
    return bool(after - before > LIFTED_M)


def search_timed(
    problem: Problem, key: str, config: GraspConfig | None = None
) -> tuple[tuple[Grasp, ...], float, str]:
    """Grasps, CPU seconds, and what kept others from being one."""
    before = time.process_time()
    try:
        found = GraspSearcher(problem, config).search(key)
    except NoPlanError as error:
        return (), time.process_time() - before, str(error)
    return found.grasps, time.process_time() - before, str(found.rejected)


@dataclass(frozen=True, kw_only=True)
class First:
    """The first grasp of one start, driven."""

    lifted: bool
    reference: bool
    """Whether the task's own point lifts."""
    widths_m: tuple[float, ...] = ()
    """Of all grasps that were found."""
    cpu_s: float | None = None
    """Of the search; None: nothing to search."""
    note: str = ""


def first_grasp(name: str, shape: Shape, seed: int) -> First:
    """Localise one start and drive its first grasp."""
    task_name, key = OBJECTS[name]
    task = load_task(task_name)
    shapes = shapes_of(None, task)
    shapes = {k: shape if k == key or k.startswith(name) else v for k, v in shapes.items()}
    start = start_of(task, seed, look=True)
    if key not in start.Ts_seen:
        return First(lifted=False, reference=False, note=f"{name} {seed}: not localised")
    problem = problem_at(task, start, shapes)
    grasps, seconds, why = search_timed(problem, key)
    lifted = bool(grasps) and lifts(start, start.Ts_seen[key], grasps[0])
    return First(
        lifted=lifted,
        reference=lifts(start, start.Ts_seen[key], nominal_grasp(problem, key)),
        widths_m=tuple(grasp.width_m for grasp in grasps),
        cpu_s=seconds,
        note="" if lifted else f"{name} {seed}: not lifted; {len(grasps)} grasps; {why}",
    )


def first_grasps(name: str, rows: Iterable[First]) -> list[Target]:
    """What the first grasps of all starts say."""
    rows = list(rows)
    for row in rows:
        if row.note:
            print(f"  {row.note}")
    lifted, reference = [row.lifted for row in rows], [row.reference for row in rows]
    searched = [row for row in rows if row.cpu_s is not None]
    cpu = [row.cpu_s for row in searched]
    widths = [width for row in searched for width in row.widths_m]
    limit = ROBOT.gripper.max_width_m - 0.006
    return [
        Target(what=f"{name}: fewest grasps of a start", limit=LEAST_GRASPS, at_most=False,
               measured=min(len(row.widths_m) for row in searched)),
        Target(what=f"{name}: CPU of a search, median", measured=float(np.median(cpu)),
               limit=MOST_CPU_S, unit="s", reference=f"largest {max(cpu):.2f}"),
        Target(what=f"{name}: widest grasp", measured=max(widths) * 1e3, limit=limit * 1e3,
               unit="mm", reference=f"narrowest {min(widths) * 1e3:.0f}"),
        Target(what=f"{name}: first grasp lifts", measured=100 * float(np.mean(lifted)),
               limit=LEAST_LIFTED, unit="%", at_most=False,
               reference=f"of {len(lifted)}; grasp_m {100 * np.mean(reference):.0f} %"),
    ]  # fmt: skip


Ranked = list[tuple[float, bool]]
"""Margins of grasps, and whether they lifted."""


def ranked_grasps(name: str, shape: Shape, seed: int) -> Ranked:
    """Drive grasps from all over the ranking where the object is not where it is believed to be."""
    task_name, key = OBJECTS[name]
    task = load_task(task_name)
    shapes = shapes_of(None, task) | {key: shape}
    start = start_of(task, seed, look=False)
    error = np.random.default_rng([77, seed]).multivariate_normal(np.zeros(6), ROUGH)
    T = start.Ts_true[key].copy()
    T[:3, :3] = se3.rotation_from_vector(error[3:]) @ T[:3, :3]
    T[:3, 3] += error[:3]
    start = replace(start, Ts_seen=start.Ts_true | {key: T}, covariances={key: ROUGH})
    grasps, _, why = search_timed(problem_at(task, start, shapes), key, EVERYTHING)
    if not grasps:
        print(f"  {name} {seed}: {why}")
        return []
    chosen = np.linspace(0, len(grasps) - 1, NUM_RANKS).round().astype(int)
    return [(grasps[index].margin, lifts(start, T, grasps[index])) for index in chosen]


def ranking(name: str, parts: Iterable[Ranked]) -> Ranked:
    """All that were driven, and how many lift in each quarter of the ranking."""
    rows = [row for part in parts for row in part]
    margin, good = (np.array(column) for column in zip(*rows, strict=True))
    print(
        f"  {name}: {100 * good.mean():.0f} % of {len(rows)} lift; by quarter of the margin:",
        [f"{100 * good[part].mean():.0f}" for part in np.array_split(np.argsort(-margin), 4)],
    )
    return rows


def agreement(rows: list[tuple[float, bool]]) -> tuple[float, float]:
    """Kendall's tau-b of margin and lifting, and the chance that a pair is in the right order."""
    from scipy.stats import kendalltau

    margin, good = (np.array(column) for column in zip(*rows, strict=True))
    good = good.astype(bool)
    tau = float(kendalltau(margin, good).statistic)
    one, other = margin[good], margin[~good]
    if not len(one) or not len(other):
        return tau, float("nan")
    order = np.sign(one[:, None] - other[None])
    return tau, float((order.mean() + 1) / 2)


def measured(
    chosen: argparse.Namespace, each: Callable[[Callable[[int], Any], range], Iterable[Any]]
) -> list[Target]:
    """Every row of the table."""
    targets: list[Target] = []
    for name in chosen.objects:
        shape = scanned(*OBJECTS[name])
        if shape is None:
            continue
        seeds = range(FIRST_SEED, FIRST_SEED + chosen.starts)
        targets += first_grasps(name, each(partial(first_grasp, name, shape), seeds))
        if not chosen.ranked:
            continue
        seeds = range(FIRST_SEED + 100, FIRST_SEED + 100 + chosen.ranked)
        rows = ranking(name, each(partial(ranked_grasps, name, shape), seeds))
        tau, order = agreement(rows)
        targets.append(
            Target(what=f"{name}: margin and lifting in order", measured=100 * order,
                   limit=LEAST_IN_ORDER, unit="%", at_most=False,
                   reference=f"tau-b {tau:.2f}; {len(rows)} driven")
        )  # fmt: skip
    return targets


def main() -> None:
    """Measure what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--starts", type=int, default=40)
    parser.add_argument("--ranked", type=int, default=12)
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--objects", nargs="*", default=list(OBJECTS))
    chosen = parser.parse_args()
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(chosen.workers, mp_context=spawn) as pool:
        targets = measured(chosen, pool.map)
    report_targets("plan_grasp", targets, note=NOTE)


if __name__ == "__main__":
    main()
