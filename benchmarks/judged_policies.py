"""Ten scripted policies of graded skill for ``bench_policy_agreement.py``.

Each looks once through the wrist camera, finds what its task moves and where it goes by colour,
misses by a normal error of its own size, and follows the motion planned for what it saw.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from bridge.robots.default import MAX_WIDTH_M
from bridge.sources.standin.cell_file import load_cell
from bridge.sources.standin.kinematics import arm_kinematics
from bridge.sources.standin.planner import NO_ERROR, plan_pick_and_place
from bridge.task.task_file import Task, load_task

TASKS = ("cube_into_box", "cube_on_block", "slippery_block_into_box")
ERRORS_MM = (0.0, 2.0, 4.0, 6.0, 8.0, 11.0, 14.0, 18.0, 24.0, 32.0)
"""Standard deviation of each of x and y with which a policy misses what it grasps."""
PERIOD_S, SPEED_RAD_S = 0.1, 1.2
ALIKE = 0.06
"""Largest distance of a pixel's share of red, green and blue from the object's."""
FEWEST = 30
"""Pixels of an object that is seen."""


class Looks:
    """One policy; deterministic for a seed."""

    def __init__(self, error_mm: float) -> None:
        """Nothing is planned before it has looked."""
        self._error_m = error_mm * 1e-3
        self._tasks = {task.instruction: task for task in map(load_task, TASKS)}
        self.metadata = {"checkpoint": f"looks-{error_mm:g}mm"}
        self.reset(0)

    def reset(self, seed: int) -> None:
        """A new trial begins."""
        self._rng = np.random.default_rng([len(ERRORS_MM), seed])
        self._rows: Float[np.ndarray, "num_rows 7"] | None = None

    def infer(self, observation: Mapping[str, Any]) -> dict[str, Any]:
        """The next second of the motion; at its end it stays."""
        state = np.asarray(observation["agent_pos"], dtype=np.float64)
        if self._rows is None:
            self._rows = self._planned(observation, state)
        rows, self._rows = self._rows[:10], self._rows[10:]
        return {"actions": rows if len(rows) else state[None]}

    def _planned(
        self, observation: Mapping[str, Any], state: Float[np.ndarray, "7"]
    ) -> Float[np.ndarray, "num_rows 7"]:
        task = self._tasks[observation["task"]]
        cell = load_cell(task.cell or "standin")
        seen = seen_from(observation["pixels"]["wrist"], task, cell.cameras["wrist"], state[:6])
        for name in task.manipulated:
            seen[name][:2, 3] += self._rng.normal(0.0, self._error_m, 2)
        plan = plan_pick_and_place(
            task, seen, NO_ERROR, kinematics=arm_kinematics(), joints_start_rad=state[:6],
            max_joint_speed_rad_s=SPEED_RAD_S, plan_id="looks", condition="", start_id="",
        )  # fmt: skip
        known = plan.times_ns() * 1e-9
        times = np.arange(PERIOD_S, known[-1] + PERIOD_S, PERIOD_S)
        joints = np.array([waypoint.joints_rad for waypoint in plan.tau])
        arm = [np.interp(times, known, column) for column in joints.T]
        later = np.minimum(np.searchsorted(known, times), len(known) - 1)
        widths = [_width_m(plan.tau[index]) for index in later]
        return np.column_stack([*arm, widths])


def _width_m(waypoint: Any) -> float:
    closed = 0.0 if waypoint.g else MAX_WIDTH_M
    return closed if waypoint.width_m is None else float(waypoint.width_m)


def seen_from(
    picture: np.ndarray, task: Task, mount: Any, joints_rad: Float[np.ndarray, "6"]
) -> dict[str, Float[np.ndarray, "4 4"]]:
    """Where each object of a task stands, from its upper face in the wrist camera's picture."""
    height, width = picture.shape[:2]
    camera = mount.camera.scaled(width / mount.camera.width)
    T = arm_kinematics().T_base_frame(joints_rad, mount.parent) @ mount.T_parent_camera
    shares = picture / np.maximum(picture.sum(axis=2, keepdims=True), 1)
    v, u = np.mgrid[:height, :width]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], 2)
    rays = rays @ T[:3, :3].T
    found = {}
    for name, thing in task.objects.items():
        color = np.array(thing.color_srgb) / sum(thing.color_srgb)
        mask = (np.abs(shares - color).max(axis=2) < ALIKE) & (picture.max(axis=2) > FEWEST)
        if mask.sum() < FEWEST:
            raise ValueError(f"no {name} in sight")
        top_m = thing.size_m[2] - thing.rest_height_m
        p = T[:3, 3] + rays[mask] * ((top_m - T[2, 3]) / rays[mask][:, 2:])
        yaw, centre = rectangle(p[:, :2])
        found[name] = se3.transform_from(
            np.array([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]),
            np.array([*centre, thing.rest_height_m]),
        )
    return found


def rectangle(p_m: Float[np.ndarray, "num_points 2"]) -> tuple[float, Float[np.ndarray, "2"]]:
    """Turn and middle of the smallest rectangle around points; a few outliers are left out."""
    best = (np.inf, 0.0, p_m[0])
    for yaw in np.linspace(-np.pi / 4, np.pi / 4, 91):
        c, s = np.cos(yaw), np.sin(yaw)
        turned = p_m @ np.array([[c, -s], [s, c]])
        low, high = np.quantile(turned, [0.01, 0.99], axis=0)
        area = float(np.prod(high - low))
        if area < best[0]:
            best = (area, float(yaw), np.array([[c, -s], [s, c]]) @ ((low + high) / 2))
    return best[1], best[2]


def __getattr__(name: str) -> Callable[[], Looks]:
    """``looks_0`` to ``looks_9``: the policy with the error of that number."""
    number = name.removeprefix("looks_")
    if not name.startswith("looks_") or not number.isdigit() or int(number) >= len(ERRORS_MM):
        raise AttributeError(name)
    return partial(Looks, ERRORS_MM[int(number)])
