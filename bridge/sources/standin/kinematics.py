"""Forward and inverse kinematics of the arm's controller: Pinocchio, tool frame ``tcp``."""

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import pinocchio
from jaxtyping import Bool, Float

from bridge.errors import BridgeError
from bridge.geometry import se3
from bridge.task.robot import ARM_JOINTS, BASE_FRAME, TCP_FRAME, ur5_with_gripper_urdf

TOLERANCE_M = 1e-5
TOLERANCE_RAD = 1e-5
DAMPING_START = 1e-4
MAX_DAMPING = 1e4
MAX_ITERATIONS = 80
JOINT_LIMIT_RAD = np.pi
"""Narrower than the URDF's two turns, so that a path never winds a cable up."""


class UnreachablePoseError(BridgeError):
    """The arm cannot bring the tool to a pose."""

    def __init__(
        self, *, p_m: tuple[float, float, float], residual_m: float, beyond: Sequence[str] = ()
    ) -> None:
        """Remember the position asked for, how close the arm came, and joints past their limits."""
        self.p_m = p_m
        self.residual_m = residual_m
        self.beyond = tuple(beyond)
        x, y, z = p_m
        off = f"the best joints are {residual_m * 1e3:.1f} mm off"
        if beyond:
            off += f" with {' and '.join(beyond)} past {np.degrees(JOINT_LIMIT_RAD):.0f} deg"
        super().__init__(
            f"the tool cannot reach ({x:.3f}, {y:.3f}, {z:.3f}) m in {BASE_FRAME}: {off}. "
            "Move the target nearer or change its orientation."
        )


class Kinematics:
    """The arm's nominal model; the controller of the cell believes in it."""

    def __init__(self) -> None:
        """Build the Pinocchio model from the URDF."""
        self._model: Any = pinocchio.buildModelFromXML(ur5_with_gripper_urdf())
        self._data: Any = self._model.createData()
        self._frame = self._model.getFrameId(TCP_FRAME)
        joints = [self._model.joints[self._model.getJointId(name)] for name in ARM_JOINTS]
        self._q_ids = np.array([joint.idx_q for joint in joints])
        self._v_ids = np.array([joint.idx_v for joint in joints])

    def T_base_tcp(self, joints_rad: Float[np.ndarray, "6"]) -> Float[np.ndarray, "4 4"]:
        """Return where the tool is at these joints."""
        return self.T_base_frame(joints_rad, TCP_FRAME)

    def T_base_frame(
        self, joints_rad: Float[np.ndarray, "6"], frame: str
    ) -> Float[np.ndarray, "4 4"]:
        """Return where a link is at these joints, gripper closed."""
        pinocchio.framesForwardKinematics(self._model, self._data, self._full(joints_rad))
        placement = self._data.oMf[self._model.getFrameId(frame)]
        return np.array(placement.homogeneous)

    def joints_for(
        self,
        T_base_tcp: Float[np.ndarray, "4 4"],
        joints_seed_rad: Float[np.ndarray, "6"],
    ) -> Float[np.ndarray, "6"]:
        """Solve the inverse problem from a nearby start: Levenberg-Marquardt on SE(3).

        Raises:
            UnreachablePoseError: No convergence to 0.01 mm and 0.01 mrad within the limits.
        """
        target = pinocchio.SE3(T_base_tcp)
        joints = joints_seed_rad.astype(np.float64).copy()
        damping = DAMPING_START
        error = self._error(joints, target)
        for _ in range(MAX_ITERATIONS):
            if _converged(error) and not _past_limit(joints).any():
                return joints
            jacobian = self._jacobian(joints)
            normal = jacobian.T @ jacobian + damping * np.eye(6)
            step = np.linalg.solve(normal, jacobian.T @ error)
            trial = joints + np.clip(step, -0.4, 0.4)
            trial_error = self._error(trial, target)
            if np.linalg.norm(trial_error) < np.linalg.norm(error):
                joints, error, damping = trial, trial_error, max(damping * 0.2, 1e-12)
            elif damping > MAX_DAMPING:
                break  # a local minimum outside reach: no step improves
            else:
                damping *= 8.0
        residual = self.T_base_tcp(joints)[:3, 3] - T_base_tcp[:3, 3]
        x, y, z = (float(value) for value in T_base_tcp[:3, 3])
        raise UnreachablePoseError(
            p_m=(x, y, z),
            residual_m=float(np.linalg.norm(residual)),
            beyond=[ARM_JOINTS[index] for index in np.flatnonzero(_past_limit(joints))],
        )

    def _full(self, joints_rad: Float[np.ndarray, "6"]) -> Any:
        q = pinocchio.neutral(self._model)
        q[self._q_ids] = joints_rad
        return q

    def _error(self, joints_rad: Float[np.ndarray, "6"], target: Any) -> Float[np.ndarray, "6"]:
        pinocchio.framesForwardKinematics(self._model, self._data, self._full(joints_rad))
        return np.array(pinocchio.log6(self._data.oMf[self._frame].actInv(target)).vector)

    def _jacobian(self, joints_rad: Float[np.ndarray, "6"]) -> Float[np.ndarray, "6 6"]:
        full = pinocchio.computeFrameJacobian(
            self._model, self._data, self._full(joints_rad), self._frame, pinocchio.LOCAL
        )
        return np.array(full[:, self._v_ids])


@cache
def arm_kinematics() -> Kinematics:
    """Return the one model of this process; building it parses the URDF."""
    return Kinematics()


def tool_down(p_m: Float[np.ndarray, "3"], yaw_rad: float) -> Float[np.ndarray, "4 4"]:
    """Pose ``T_base_tcp`` with the tool pointing down; yaw 0 closes the fingers along base y."""
    T = np.eye(4)
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    # Columns: tool x is -x of the base at yaw 0, tool y is y, tool z is down.
    T[:3, :3] = np.array([[-c, -s, 0.0], [-s, c, 0.0], [0.0, 0.0, -1.0]])
    T[:3, 3] = p_m
    return T


def _past_limit(joints_rad: Float[np.ndarray, "6"]) -> Bool[np.ndarray, "6"]:
    return np.asarray(np.abs(joints_rad) > JOINT_LIMIT_RAD + 1e-9)


def _converged(error: Float[np.ndarray, "6"]) -> bool:
    return bool(
        np.linalg.norm(error[:3]) < TOLERANCE_M and np.linalg.norm(error[3:]) < TOLERANCE_RAD
    )


def wrap_rad(angle_rad: float) -> float:
    """Bring an angle to -pi..pi."""
    return float((angle_rad + np.pi) % (2 * np.pi) - np.pi)


def yaw_of(T: Float[np.ndarray, "4 4"]) -> float:
    """Angle of the x axis in the horizontal plane [rad]."""
    return float(np.arctan2(T[1, 0], T[0, 0]))


def slerp_poses(
    T_start: Float[np.ndarray, "4 4"],
    T_end: Float[np.ndarray, "4 4"],
    fractions: Float[np.ndarray, " num_poses"],
) -> Float[np.ndarray, "num_poses 4 4"]:
    """Straight line in position, constant axis in rotation."""
    q_start, p_start = se3.split(T_start)
    q_end, p_end = se3.split(T_end)
    count = len(fractions)
    q = se3.interpolate_quaternion(
        np.tile(q_start, (count, 1)), np.tile(q_end, (count, 1)), fractions
    )
    return se3.transform_from(q, p_start + fractions[:, None] * (p_end - p_start))
