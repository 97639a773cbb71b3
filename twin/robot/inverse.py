"""Inverse kinematics: joints that put the tool centre point where a plan wants it.

Levenberg-Marquardt on the SE(3) error with a warm start, because the next waypoint of a
trajectory is near; random restarts, from a fixed seed, only where there is no warm start. Works
for any arm; ``twin.robot.ur_inverse`` knows all answers at once for arms of one kind.
"""

import math
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from jaxtyping import Float
from scipy.linalg.lapack import dposv

from twin.robot.config import IkConfig
from twin.robot.model import RobotModel

HOME_RAD = np.array([0.0, -1.57, 1.57, -1.57, -1.57, 0.0])
"""Where a search begins that knows no better; treat as constant."""
_CONVERGED = 1e-8
"""Norm of the error twist at which iterating stops: far below the tolerance, so that a round
trip is exact and the tolerance decides feasibility only."""
_MAX_DAMPING = 1e3


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
    start = HOME_RAD if warm_start_rad is None else warm_start_rad
    best = _descend(robot, T_base_tcp, start, config)
    if best.reached:
        return best
    rng = np.random.default_rng(config.seed)
    span = np.minimum(np.pi, (robot.upper_rad - robot.lower_rad) / 2)
    for _ in range(config.restarts):
        start = np.clip(rng.uniform(-span, span), robot.lower_rad, robot.upper_rad)
        other = _descend(robot, T_base_tcp, start, config)
        if other.reached or other.position_error_m < best.position_error_m:
            best = other
        if best.reached:
            break
    return best


def _descend(
    robot: RobotModel,
    T_base_tcp: Float[np.ndarray, "4 4"],
    start_rad: Float[np.ndarray, " num_joints"],
    config: IkConfig,
) -> IkSolution:
    """One descent. Calls into pinocchio take a microsecond each, so each is made once a step."""
    model, data, tcp_id = robot.model, robot.data, robot.tcp_id
    lower, upper, arm = robot.lower_rad, robot.upper_rad, robot.arm_ids
    target = pin.SE3(T_base_tcp)
    joints = np.minimum(np.maximum(start_rad, lower), upper)
    q = robot.configuration(joints)
    damping, last = 1e-6, math.inf
    accepted, misses = joints, target.translation
    jacobian, error = np.zeros((6, len(joints))), np.zeros(6)
    for _ in range(config.max_iterations):
        q[arm] = joints
        pin.computeJointJacobians(model, data, q)
        difference = pin.updateFramePlacement(model, data, tcp_id).actInv(target)
        trial = pin.log6(difference).vector
        norm = math.sqrt(trial @ trial)
        if norm < last:
            accepted, last, error, misses = joints, norm, trial, difference.translation
            if norm < _CONVERGED:
                break
            damping = max(damping * 0.2, 1e-9)
            full = pin.getFrameJacobian(model, data, tcp_id, pin.LOCAL)
            jacobian = full[:, robot.arm_velocity_ids]
        else:
            damping *= 10.0
            if not damping < _MAX_DAMPING:
                break
        square = jacobian @ jacobian.T
        square.flat[::7] += damping
        weights = dposv(square, error)[1]
        joints = np.minimum(np.maximum(accepted + jacobian.T @ weights, lower), upper)
    # The angular part of the twist is the rotation vector of what is left.
    position, rotation = math.hypot(*misses), math.hypot(*error[3:])
    return IkSolution(
        joints_rad=accepted,
        position_error_m=position,
        rotation_error_rad=rotation,
        reached=last < math.inf  # nothing was tried of a pose that is no number
        and position <= config.position_tolerance_m
        and rotation <= config.rotation_tolerance_rad,
    )
