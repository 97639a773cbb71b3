"""Joint limits, jumps and excess speed of a path, each named with its joint and instant."""

import numpy as np
from jaxtyping import Bool, Float, Int

from bridge.task.robot import ARM_JOINTS
from twin.replay.config import ReplayConfig
from twin.replay.failure import Failure
from twin.robot.model import RobotModel

_LIMIT_SLACK_RAD = 1e-3
_SPEED_SLACK = 1.02
"""Recorded and rounded joints may exceed a limit by as little as this."""


def outside_limits(
    robot: RobotModel, joints_rad: Float[np.ndarray, "num_steps num_joints"]
) -> Bool[np.ndarray, "num_steps num_joints"]:
    """Say which joints are beyond their limits by more than rounding."""
    return (joints_rad < robot.lower_rad - _LIMIT_SLACK_RAD) | (
        joints_rad > robot.upper_rad + _LIMIT_SLACK_RAD
    )


def limit_failure(
    robot: RobotModel, t_ns: int, joints_rad: Float[np.ndarray, " num_joints"], joint: int
) -> Failure:
    """Name a joint that is beyond its limits."""
    return Failure(
        t_ns=t_ns,
        cause="joint_limit",
        bodies=(ARM_JOINTS[joint],),
        detail=f"{ARM_JOINTS[joint]} is at {joints_rad[joint]:.3f} rad, its limits are "
        f"{robot.lower_rad[joint]:.3f} to {robot.upper_rad[joint]:.3f} rad",
    )


def jumps(
    times_ns: Int[np.ndarray, " num_times"],
    joints_rad: Float[np.ndarray, "num_times num_joints"],
    robot: RobotModel,
    config: ReplayConfig,
) -> list[Failure]:
    """Find the first jump and the first excess of speed between neighbouring postures."""
    if len(times_ns) < 2:
        return []
    steps = np.abs(np.diff(joints_rad, axis=0))
    speeds = steps / (np.diff(times_ns)[:, None] * 1e-9)
    failures = []
    for cause, values, limit, unit in (
        ("joint_jump", steps, np.full(len(ARM_JOINTS), config.max_joint_step_rad), "rad"),
        ("joint_speed", speeds, robot.velocity_limit_rad_s * _SPEED_SLACK, "rad/s"),
    ):
        over = values > limit
        if np.any(over):
            index, joint = (int(i) for i in np.argwhere(over)[0])
            failures.append(
                Failure(
                    t_ns=int(times_ns[index]),
                    cause=cause,
                    bodies=(ARM_JOINTS[joint],),
                    detail=f"{ARM_JOINTS[joint]} changes by {values[index, joint]:.2f} {unit}, "
                    f"the limit is {limit[joint]:.2f} {unit}",
                )
            )
    return failures
