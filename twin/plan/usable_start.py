"""What of a start makes planning pointless, said before anything is searched."""

from typing import Any

import numpy as np

from bridge.episode import streams
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import BridgeError
from bridge.robots.robot import Robot
from bridge.task.check import TABLE
from twin.plan.constrain.kinds import outer_reach
from twin.plan.grasp.search import GraspConfig
from twin.plan.loop.propose import NoPlanError
from twin.plan.problem import Problem
from twin.scene.store.folder import read_record

_AGAIN = "Record the start again: robot-gst record RUN."
_RIGID = 1e-3
"""By how much a rotation may differ from one."""
_LIMIT_RAD = 0.01
"""Beyond a joint's limit by so much an encoder may read."""


def refuse_unusable(problem: Problem) -> None:
    """Refuse poses and postures that nothing can be planned from.

    Args:
        problem: Objects, covariances and arm as they were found.

    Raises:
        NoPlanError: What was found, where, and what to do.
    """
    _refuse_posture(problem)
    scene = problem.scene
    for name, T in scene.Ts_base_object.items():
        if not np.isfinite(T).all():
            _refuse(f"the pose of {name} is not made of numbers", "Localise it again.")
        if np.abs(T[:3, :3].T @ T[:3, :3] - np.eye(3)).max() > _RIGID:
            _refuse(f"the pose of {name} has a rotation that is none", "Localise it again.")
    most_m = GraspConfig().most_uncertain_m
    for name, covariance in scene.covariances.items():
        if not np.isfinite(covariance).all():
            _refuse(f"the covariance of {name} is not made of numbers", "Localise it again.")
        sigma_m = float(np.sqrt(max(np.linalg.eigvalsh(covariance[:3, :3]).max(), 0.0)))
        if sigma_m > most_m:
            _refuse(
                f"the position of {name} is known to {sigma_m * 1e3:.0f} mm, and at most "
                f"{most_m * 1e3:.0f} mm are good enough",
                "Localise it again, nearer or with more frames.",
            )
    for name in _handled(problem):
        _refuse_far(problem, name)


def refuse_other_robot(run: RunFolder, robot: Robot) -> None:
    """Refuse a rebuilt scene that another robot recorded: it stands where that one was calibrated.

    Args:
        run: Its ``scene.json`` names the episodes that it was made of.
        robot: Who recorded the start.

    Raises:
        NoPlanError: They differ.
    """
    sources: list[dict[str, Any]] = (read_record(run) or {}).get("sources") or []
    names = {str(source.get("id", "")) for source in sources}
    for path in run.episodes():
        if path.stem not in names:
            continue
        try:
            other = streams.recorded_robot(Episode.open(path)).name
        except BridgeError:
            continue
        if other != robot.name:
            _refuse(
                f"the scene in {run.scene_dir} was recorded with robot {other} ({path.stem}), and "
                f"the start with {robot.name}",
                "Scan the cell with the robot that is to act and rebuild it: robot-gst rebuild "
                "RUN, or name the robot: --robot.",
            )


def _refuse(found: str, hint: str) -> None:
    message = f"{found}. {hint}"
    raise NoPlanError(message)


def _refuse_posture(problem: Problem) -> None:
    robot, start = problem.robot, problem.scene.start_rad
    if start is None:
        return
    if start.shape != robot.home_rad.shape:
        _refuse(
            f"the start gives {start.size} joints, and {robot.record.name} has "
            f"{robot.home_rad.size}",
            "Name the robot that was recorded: --robot.",
        )
    if not np.isfinite(start).all():
        _refuse("the arm's joints at the start are not made of numbers", _AGAIN)
    over = np.maximum(start - robot.upper_rad, robot.lower_rad - start)
    if over.max() > _LIMIT_RAD:
        joint = int(over.argmax())
        _refuse(
            f"{robot.joints[joint]} of {robot.record.name} starts at {start[joint]:.2f} rad, "
            f"beyond its limits of {robot.lower_rad[joint]:.2f} to {robot.upper_rad[joint]:.2f}",
            f"Move it back. {_AGAIN}",
        )


def _handled(problem: Problem) -> list[str]:
    """What is moved, and what it is put into or onto."""
    task = problem.scene.task
    goals = (task.goal_of(key) for key in task.manipulated)
    targets = [goal[1] for goal in goals if goal is not None and goal[1] != TABLE]
    return list(dict.fromkeys([*task.manipulated, *targets]))


def _refuse_far(problem: Problem, name: str) -> None:
    """Beyond what the links laid out straight reach, with the object's own size to spare."""
    T = problem.scene.Ts_base_object.get(name)
    if T is None:
        return
    p_shoulder, length_m = outer_reach(problem)
    away_m = float(np.linalg.norm(T[:3, 3] - p_shoulder))
    if away_m - float(np.linalg.norm(problem.model(name).size_m)) > length_m:
        x, y, z = T[:3, 3] * 1e3
        _refuse(
            f"{name} at ({x:.0f}, {y:.0f}, {z:.0f}) mm is out of reach: {away_m:.2f} m from the "
            f"first joint of {problem.robot.record.name}, which reaches {length_m:.2f} m",
            f"Move it nearer. {_AGAIN}",
        )
