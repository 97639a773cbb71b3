"""Forward and inverse kinematics of the arm's controller: Pinocchio, tool frame ``tcp``."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import pinocchio
from jaxtyping import Bool, Float

from bridge.clock import ns_from_s
from bridge.errors import BridgeError
from bridge.geometry import se3
from bridge.robots.default import ARM_JOINTS, BASE_FRAME, MAX_WIDTH_M, ROBOT, TCP_FRAME
from bridge.task.plan import Waypoint

Pose = Float[np.ndarray, "4 4"]
Joints = Float[np.ndarray, "6"]
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
        """Say the position asked for, how close the arm came, and joints past their limits."""
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
        self._model: Any = pinocchio.buildModelFromXML(ROBOT.urdf_text())
        self._data: Any = self._model.createData()
        self._frame = self._model.getFrameId(TCP_FRAME)
        joints = [self._model.joints[self._model.getJointId(name)] for name in ARM_JOINTS]
        self._q_ids = np.array([joint.idx_q for joint in joints])
        self._v_ids = np.array([joint.idx_v for joint in joints])

    def why_refused(self, joints_rad: Joints, last_rad: Joints, in_s: float) -> str:
        """Why the controller refuses a target; empty: it does not."""
        model, ids = self._model, self._q_ids
        lower, upper = model.lowerPositionLimit[ids], model.upperPositionLimit[ids]
        for index in np.flatnonzero((joints_rad < lower) | (joints_rad > upper))[:1]:
            limits = f"{lower[index]:.3f} to {upper[index]:.3f} rad"
            return f"limits: {ARM_JOINTS[index]} at {joints_rad[index]:.3f} rad, allowed {limits}"
        speeds, most = np.abs(joints_rad - last_rad) / in_s, model.velocityLimit[self._v_ids]
        for index in np.flatnonzero(speeds > most)[:1]:
            at = f"{speeds[index]:.2f} rad/s, it reaches {most[index]:.2f}"
            return f"limits: {ARM_JOINTS[index]} at {at}"
        return ""

    def T_base_tcp(self, joints_rad: Joints) -> Pose:
        """Return where the tool is at these joints."""
        return self.T_base_frame(joints_rad, TCP_FRAME)

    def T_base_frame(self, joints_rad: Joints, frame: str) -> Pose:
        """Return where a link is at these joints, gripper closed."""
        pinocchio.framesForwardKinematics(self._model, self._data, self._full(joints_rad))
        placement = self._data.oMf[self._model.getFrameId(frame)]
        return np.array(placement.homogeneous)

    def joints_for(self, T_base_tcp: Pose, joints_seed_rad: Joints) -> Joints:
        """Solve the inverse problem from a nearby start: Levenberg-Marquardt on SE(3)."""
        target = pinocchio.SE3(T_base_tcp)
        joints = joints_seed_rad.astype(np.float64).copy()
        damping = DAMPING_START
        error = self._error(joints, target)
        for _ in range(MAX_ITERATIONS):
            far_m, far_rad = np.linalg.norm(error[:3]), np.linalg.norm(error[3:])
            near = far_m < TOLERANCE_M and far_rad < TOLERANCE_RAD
            if near and not _past_limit(joints).any():
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

    def _full(self, joints_rad: Joints) -> Any:
        q = pinocchio.neutral(self._model)
        q[self._q_ids] = joints_rad
        return q

    def _error(self, joints_rad: Joints, target: Any) -> Joints:
        pinocchio.framesForwardKinematics(self._model, self._data, self._full(joints_rad))
        return np.array(pinocchio.log6(self._data.oMf[self._frame].actInv(target)).vector)

    def _jacobian(self, joints_rad: Joints) -> Float[np.ndarray, "6 6"]:
        full = pinocchio.computeFrameJacobian(
            self._model, self._data, self._full(joints_rad), self._frame, pinocchio.LOCAL
        )
        return np.array(full[:, self._v_ids])


@cache
def arm_kinematics() -> Kinematics:
    """Return the one model of this process; building it parses the URDF."""
    return Kinematics()


def tool_down(p_m: Float[np.ndarray, "3"], yaw_rad: float) -> Pose:
    """Pose ``T_base_tcp`` with the tool pointing down; yaw 0 closes the fingers along base y."""
    T = np.eye(4)
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    # Columns: tool x is -x of the base at yaw 0, tool y is y, tool z is down.
    T[:3, :3] = np.array([[-c, -s, 0.0], [-s, c, 0.0], [0.0, 0.0, -1.0]])
    T[:3, 3] = p_m
    return T


def _past_limit(joints_rad: Joints) -> Bool[np.ndarray, "6"]:
    return np.asarray(np.abs(joints_rad) > JOINT_LIMIT_RAD + 1e-9)


def wrap_rad(angle_rad: float) -> float:
    """Bring an angle to -pi..pi."""
    return float((angle_rad + np.pi) % (2 * np.pi) - np.pi)


def yaw_of(T: Pose) -> float:
    """Angle of the x axis in the horizontal plane [rad]."""
    return float(np.arctan2(T[1, 0], T[0, 0]))


def slerp_poses(
    T_start: Pose,
    T_end: Pose,
    fractions: Float[np.ndarray, " num_poses"],
) -> Float[np.ndarray, "num_poses 4 4"]:
    """Straight line in position, constant axis in rotation."""
    (q_start, p_start), (q_end, p_end) = se3.split(T_start), se3.split(T_end)
    q_starts, q_ends = (np.tile(q, (len(fractions), 1)) for q in (q_start, q_end))
    q = se3.interpolate_quaternion(q_starts, q_ends, fractions)
    return se3.transform_from(q, p_start + fractions[:, None] * (p_end - p_start))


WAYPOINT_S = 0.05

TimeLaw = Callable[[Float[np.ndarray, " num_times"]], Float[np.ndarray, " num_times"]]
"""Share of a leg's way done at each share of its time; both run from 0 to 1."""


def minimum_jerk(s: Float[np.ndarray, " num_times"]) -> Float[np.ndarray, " num_times"]:
    """At rest at both ends: Flash and Hogan (1985)."""
    return np.asarray(s**3 * (10 - 15 * s + 6 * s**2))


@dataclass(frozen=True, kw_only=True)
class Leg:
    """One movement of the tool, or a wait when it stays where it is."""

    name: str
    stage: str
    T_base_tcp: Pose
    duration_s: float
    g: int
    law: TimeLaw = minimum_jerk
    step_s: float = WAYPOINT_S
    """Between its waypoints."""


@dataclass(frozen=True, kw_only=True)
class Track:
    """What has been planned so far: waypoints, and when each stage begins and ends."""

    tau: tuple[Waypoint, ...]
    bounds: Mapping[str, tuple[int, int]]
    T_base_tcp: Pose
    """Where the tool is at the end."""

    @staticmethod
    def at_rest(T_base_tcp: Pose, joints_rad: Joints) -> "Track":
        """Start with an open gripper."""
        return Track(
            tau=(_waypoint(0, T_base_tcp, joints_rad, 0),),
            bounds={},
            T_base_tcp=T_base_tcp,
        )


def follow_legs(
    before: Track, legs: Sequence[Leg], kinematics: Kinematics, max_joint_speed_rad_s: float
) -> Track:
    """Go on along straight lines at 20 Hz with smooth speed, slower where a joint would race."""
    tau, bounds = list(before.tau), dict(before.bounds)
    T_from, t_ns = before.T_base_tcp, tau[-1].t_ns
    joints = np.array(tau[-1].joints_rad, dtype=np.float64)
    for leg in legs:
        count = max(round(leg.duration_s / leg.step_s), 1)
        while True:
            Ts = slerp_poses(T_from, leg.T_base_tcp, leg.law(np.arange(1, count + 1) / count))
            rows = [joints]
            for T in Ts:
                rows.append(kinematics.joints_for(T, rows[-1]))
            steps = np.abs(np.diff(rows, axis=0))
            speed = float(steps.max()) / leg.step_s
            if speed <= max_joint_speed_rad_s:
                break
            count = int(np.ceil(count * 1.02 * speed / max_joint_speed_rad_s))
        begin_ns = t_ns
        for T, row in zip(Ts, rows[1:], strict=True):
            t_ns += ns_from_s(leg.step_s)
            tau.append(_waypoint(t_ns, T, row, leg.g))
        bounds[leg.stage] = (bounds.get(leg.stage, (begin_ns, 0))[0], t_ns)
        T_from, joints = leg.T_base_tcp, rows[-1]
    return Track(tau=tuple(tau), bounds=bounds, T_base_tcp=T_from)


def _waypoint(t_ns: int, T: Pose, joints_rad: Joints, g: int) -> Waypoint:
    """The gripper wide open, or told to shut (g)."""
    q, p = se3.split(T)
    w, x, y, z = (float(value) for value in q)
    return Waypoint(
        t_ns=t_ns,
        p_m=(float(p[0]), float(p[1]), float(p[2])),
        q_wxyz=(w, x, y, z),
        g=g,
        width_m=0.0 if g else MAX_WIDTH_M,
        joints_rad=tuple(float(value) for value in joints_rad),
    )
