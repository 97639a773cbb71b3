"""The limits of a robot that refuse a policy's target: the same in the twin and in the cell."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from twin.policies.errors import RefusedError
from twin.replay.motion import motion_failures
from twin.replay.path import JointPath, outside_limits
from twin.robot.model import RobotModel

Knot = tuple[int, Float[np.ndarray, " num_joints"]]
"""When a target was to be reached, and the target."""


def refuse_target(
    robot: RobotModel,
    knots: Sequence[Knot],
    joints_rad: Float[np.ndarray, " num_joints"],
    width_m: float,
    duration_s: float,
) -> None:
    """Refuse a target that the arm cannot or must not reach in a stretch of time.

    Args:
        knots: The targets before it, at least one.

    Raises:
        RefusedError: Which limit refuses it, and by how much.
    """
    now_ns, last_rad = knots[-1]
    if joints_rad.shape != last_rad.shape or not (
        np.isfinite(joints_rad).all() and np.isfinite(width_m)
    ):
        raise RefusedError(
            name="target",
            detail=f"{len(robot.joints)} joints and a width were expected, all of them finite; "
            f"got {np.array2string(joints_rad, precision=3)} and {width_m}",
        )
    length_ns = round(duration_s * 1e9)
    stood = [(now_ns - length_ns, last_rad)] if len(knots) == 1 else []
    times, joints = zip(*stood, *knots[-2:], (now_ns + length_ns, joints_rad), strict=True)
    path = JointPath(
        times_ns=np.array(times, dtype=np.int64) - times[0],
        joints_rad=np.stack(joints),
        width_times_ns=np.zeros(1, dtype=np.int64),
        width_m=np.array([width_m]),
        first_close_ns=None,
        moving=True,
    )
    failures = outside_limits(robot, path.times_ns[-1:], joints_rad[None])
    hint = _degrees(robot, joints_rad) if failures else ""
    for failure in failures or motion_failures(path, robot):
        raise RefusedError(name="limits", detail=f"{failure.detail}{hint}")


def _degrees(robot: RobotModel, joints_rad: Float[np.ndarray, " num_joints"]) -> str:
    """What to do where numbers are joints in degrees; empty where they are not."""
    as_read = np.radians(joints_rad)
    inside = (robot.lower_rad <= as_read) & (as_read <= robot.upper_rad)
    if not inside.all() or np.abs(joints_rad).max() <= 2 * np.pi:
        return ""
    return "; in degrees it would be within them: degrees = true under [actions] of the mapping"
