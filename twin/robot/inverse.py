"""Inverse kinematics: joints that put the tool centre point where a plan wants it.

Levenberg-Marquardt on the SE(3) error with a warm start, because the next waypoint of a
trajectory is near; random restarts, from a fixed seed, only where there is no warm start.
"""

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from twin.robot.config import IkConfig
from twin.robot.model import RobotModel

_HOME_RAD = np.array([0.0, -1.57, 1.57, -1.57, -1.57, 0.0])
_CONVERGED = 1e-8
"""Norm of the error twist at which iterating stops: far below the tolerance, so that a round
trip is exact and the tolerance decides feasibility only."""


@dataclass(frozen=True, kw_only=True)
class IkSolution:
    """Joints, and how far they miss the wanted pose."""

    joints_rad: Float[np.ndarray, " num_joints"]
    position_error_m: float
    rotation_error_rad: float
    reached: bool
    """Whether both errors are within the tolerance."""


def pose_error(
    robot: RobotModel,
    joints_rad: Float[np.ndarray, " num_joints"],
    T_base_tcp: Float[np.ndarray, "4 4"],
) -> tuple[float, float]:
    """Distance [m] and angle [rad] between where joints put the tool and a wanted pose."""
    error = pin.SE3(robot.T_base_tcp(joints_rad)).actInv(pin.SE3(T_base_tcp))
    return float(np.linalg.norm(error.translation)), float(np.linalg.norm(pin.log3(error.rotation)))


def solve_ik(
    robot: RobotModel,
    T_base_tcp: Float[np.ndarray, "4 4"],
    config: IkConfig,
    *,
    warm_start_rad: Float[np.ndarray, " num_joints"] | None = None,
) -> IkSolution:
    """Find joints within their limits that reach a pose, near the warm start where there is one.

    Returns:
        The best solution found; ``reached`` says whether it is one.
    """
    start = _HOME_RAD if warm_start_rad is None else warm_start_rad
    best = _descend(robot, T_base_tcp, start, config)
    rng = np.random.default_rng(config.seed)
    span = np.minimum(np.pi, (robot.upper_rad - robot.lower_rad) / 2)
    for _ in range(config.restarts):
        if best.reached:
            break
        start = np.clip(rng.uniform(-span, span), robot.lower_rad, robot.upper_rad)
        other = _descend(robot, T_base_tcp, start, config)
        if other.reached or other.position_error_m < best.position_error_m:
            best = other
    return best


def _descend(
    robot: RobotModel,
    T_base_tcp: Float[np.ndarray, "4 4"],
    start_rad: Float[np.ndarray, " num_joints"],
    config: IkConfig,
) -> IkSolution:
    target = pin.SE3(T_base_tcp)
    model, data = robot.model, robot.data
    joints = np.clip(start_rad, robot.lower_rad, robot.upper_rad)
    q = robot.configuration(joints)
    damping, last = 1e-6, np.inf
    accepted = joints
    jacobian = np.zeros((6, len(joints)))
    error = np.zeros(6)
    for _ in range(config.max_iterations):
        q[robot.arm_ids] = joints
        pin.framesForwardKinematics(model, data, q)
        trial = pin.log6(data.oMf[robot.tcp_id].actInv(target)).vector
        norm = float(np.linalg.norm(trial))
        if norm < last:
            accepted, last, error = joints, norm, trial
            if norm < _CONVERGED:
                break
            damping = max(damping * 0.2, 1e-9)
            full = pin.computeFrameJacobian(model, data, q, robot.tcp_id)
            jacobian = full[:, robot.arm_ids]
        else:
            damping *= 10.0
            if damping > 1e3:
                break
        step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + damping * np.eye(6), error)
        joints = np.clip(accepted + step, robot.lower_rad, robot.upper_rad)
    position, rotation = pose_error(robot, accepted, T_base_tcp)
    return IkSolution(
        joints_rad=accepted,
        position_error_m=position,
        rotation_error_rad=rotation,
        reached=position <= config.position_tolerance_m
        and rotation <= config.rotation_tolerance_rad,
    )
