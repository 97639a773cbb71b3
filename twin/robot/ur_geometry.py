"""Whether an arm has the geometry of a UR, and its lengths, read off its joint axes.

Nothing depends on how a description places its link frames: the axes at zero joints decide. A
Denavit-Hartenberg chain is laid through them and must then reproduce pinocchio's kinematics.
"""

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from twin.robot.model import RobotModel

_SAME_DIRECTION = 1e-4
_SHORTEST_M = 1e-4
_WORST = 1e-5
"""Deviation from pinocchio [m and rad] up to which an arm counts as one; rpy="1.5708" is 4e-6."""
_NUM_CHECKS = 12

_ALPHA = (np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0)


@dataclass(frozen=True, kw_only=True)
class UrGeometry:
    """Lengths and fixed frames; d1 is part of ``T_base_0`` and d6 of ``T_6_tcp``."""

    a2_m: float
    """Upper arm."""
    a3_m: float
    """Forearm."""
    d4_m: float
    """How far the wrist stands beside the plane that holds the first axis."""
    d5_m: float
    """From the fourth axis to the sixth."""
    signs: Float[np.ndarray, "6"]
    offsets_rad: Float[np.ndarray, "6"]
    """theta = signs * joints + offsets."""
    T_base_0: Float[np.ndarray, "4 4"]
    """First axis along z; the origin is where the first two axes meet."""
    T_6_tcp: Float[np.ndarray, "4 4"]
    """Sixth axis along z; the origin is where the last two axes meet."""
    deviation: float = 0.0
    """Largest entry of the difference to pinocchio's poses over random postures."""

    def forward(self, joints_rad: Float[np.ndarray, "6"]) -> Float[np.ndarray, "4 4"]:
        """Pose ``T_base_tcp`` of one posture."""
        theta = self.signs * joints_rad + self.offsets_rad
        a = (0.0, self.a2_m, self.a3_m, 0.0, 0.0, 0.0)
        d = (0.0, 0.0, 0.0, self.d4_m, self.d5_m, 0.0)
        T = self.T_base_0
        for row in zip(theta, a, d, _ALPHA, strict=True):
            T = T @ _link(*row)
        return np.asarray(T @ self.T_6_tcp)


def ur_geometry(robot: RobotModel) -> UrGeometry | None:
    """Read the geometry off the joint axes; None when the arm has another one."""
    axes = _axes(robot)
    if axes is None:
        return None
    geometry = _through(*axes, robot.T_base_tcp(np.zeros(6)))
    return None if geometry is None else _checked(geometry, robot)


def _axes(
    robot: RobotModel,
) -> tuple[Float[np.ndarray, "6 3"], Float[np.ndarray, "6 3"]] | None:
    """Direction of each joint axis at zero and the point on it nearest the base's origin."""
    if len(robot.arm_ids) != 6:
        return None
    q = robot.configuration(np.zeros(6))
    twists = np.array(pin.computeJointJacobians(robot.model, robot.model.createData(), q))
    twists = twists[:, robot.arm_velocity_ids].T
    directions = twists[:, 3:]
    if not np.allclose(np.linalg.norm(directions, axis=1), 1.0):
        return None
    return directions, np.cross(directions, twists[:, :3])


def _through(
    w: Float[np.ndarray, "6 3"], p: Float[np.ndarray, "6 3"], T_base_tcp: Float[np.ndarray, "4 4"]
) -> UrGeometry | None:
    """Lay the chain through the axes; None when they do not stand to each other as a UR's do."""
    across = [w[0] @ w[1], w[3] @ w[4], w[4] @ w[5]]
    along = [np.linalg.norm(np.cross(w[1], w[2])), np.linalg.norm(np.cross(w[1], w[3]))]
    if np.abs([*across, *along]).max() > _SAME_DIRECTION:
        return None
    origin = _meeting(p[0], w[0], p[1], w[1])
    x1, y1, z1 = np.cross(w[0], w[1]), w[0], w[1]
    elbow, wrist = ((point - origin) @ np.stack([x1, y1], axis=1) for point in (p[2], p[3]))
    fore = wrist - elbow
    a2, a3 = float(np.hypot(*elbow)), float(np.hypot(*fore))
    if min(a2, a3) < _SHORTEST_M:
        return None
    wrist_45, wrist_56 = _meeting(p[3], w[3], p[4], w[4]), _meeting(p[4], w[4], p[5], w[5])
    upper_rad, fore_rad = (float(np.arctan2(v[1], v[0])) for v in (elbow, fore))
    turned_rad = float(np.arctan2(w[4] @ x1, -w[4] @ y1))
    x4 = np.cos(turned_rad) * x1 + np.sin(turned_rad) * y1
    bent_rad = float(np.arctan2(-w[5] @ x4, w[5] @ z1))
    T_base_0 = np.eye(4)
    T_base_0[:3, :3] = np.stack([x1, -z1, w[0]], axis=1)
    T_base_0[:3, 3] = origin
    chain = UrGeometry(
        a2_m=a2,
        a3_m=a3,
        d4_m=float((wrist_45 - origin) @ z1),
        d5_m=float((wrist_56 - wrist_45) @ w[4]),
        signs=np.array([1.0, 1.0, np.sign(w[2] @ z1), np.sign(w[3] @ z1), 1.0, 1.0]),
        offsets_rad=np.array(
            [0.0, upper_rad, fore_rad - upper_rad, turned_rad - fore_rad, bent_rad, 0.0]
        ),
        T_base_0=T_base_0,
        T_6_tcp=np.eye(4),
    )
    T_6_tcp = np.linalg.solve(chain.forward(np.zeros(6)), T_base_tcp)
    return UrGeometry(**{**vars(chain), "T_6_tcp": T_6_tcp})


def _checked(geometry: UrGeometry, robot: RobotModel) -> UrGeometry | None:
    rng = np.random.default_rng(0)
    postures = rng.uniform(-np.pi, np.pi, (_NUM_CHECKS, 6))
    worst = max(
        float(np.abs(geometry.forward(row) - robot.T_base_tcp(row)).max()) for row in postures
    )
    if not worst < _WORST:
        return None
    return UrGeometry(**{**vars(geometry), "deviation": worst})


def _meeting(
    p: Float[np.ndarray, "3"],
    v: Float[np.ndarray, "3"],
    q: Float[np.ndarray, "3"],
    w: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "3"]:
    """Where two lines that are square to each other meet: the point of the first one."""
    along = np.linalg.solve(np.stack([v, -w, np.cross(v, w)], axis=1), q - p)[0]
    return np.asarray(p + along * v)


def _link(theta: float, a_m: float, d_m: float, alpha: float) -> Float[np.ndarray, "4 4"]:
    """Rotate about z, move along z, move along the new x, rotate about it."""
    c, s, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
    return np.array(
        [
            [c, -s * ca, s * sa, a_m * c],
            [s, c * ca, -c * sa, a_m * s],
            [0.0, sa, ca, d_m],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
