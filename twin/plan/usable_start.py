"""What of a start makes planning pointless, said before anything is searched."""

import numpy as np

from bridge.episode.run_folder import RunFolder
from bridge.robots.robot import Robot
from twin.plan.problem import NoPlanError, Problem
from twin.replay.rebuilt_scene import scene_of_other_robot

_AGAIN = "Record the start again: robot-gst record RUN; a live cell asks again."
_RIGID = 1e-3
MOST_UNCERTAIN_M = 0.010
"""Standard deviation of a position beyond which nothing is planned."""
_LIMIT_RAD = 0.01
"""Beyond a joint's limit by so much an encoder may read."""


def refuse_unusable(problem: Problem) -> None:
    """Refuse poses and postures that nothing can be planned from."""
    _refuse_posture(problem)
    scene = problem.scene
    for name, T in scene.Ts_base_object.items():
        if not np.isfinite(T).all():
            _refuse(f"the pose of {name} is not made of numbers", "Localise it again.")
        if np.abs(T[:3, :3].T @ T[:3, :3] - np.eye(3)).max() > _RIGID:
            _refuse(f"the pose of {name} has a rotation that is none", "Localise it again.")
    for name, covariance in scene.covariances.items():
        if not np.isfinite(covariance).all():
            _refuse(f"the covariance of {name} is not made of numbers", "Localise it again.")
        sigma_m = float(np.sqrt(max(np.linalg.eigvalsh(covariance[:3, :3]).max(), 0.0)))
        if sigma_m > MOST_UNCERTAIN_M:
            _refuse(
                f"the position of {name} is known to {sigma_m * 1e3:.0f} mm, and at most "
                f"{MOST_UNCERTAIN_M * 1e3:.0f} mm are good enough",
                "Localise it again, nearer or with more frames.",
            )


def refuse_other_robot(run: RunFolder, robot: Robot) -> None:
    """Refuse a rebuilt scene that another robot recorded: it stands where that one stood."""
    if other := scene_of_other_robot(run, robot.name):
        _refuse(
            f"{other}, and the start with {robot.name}",
            "Scan the cell with the robot that is to act and rebuild it: robot-gst rebuild RUN, or "
            "name the robot: --robot.",
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
