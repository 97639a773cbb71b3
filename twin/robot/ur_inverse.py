"""Closed-form inverse kinematics of UR-type arms: all eight branches of many poses at once.

The second, third and fourth axes are parallel, so the direction n they share and the wrist point
(where the last two axes meet) give the joints one after another (Hawkins 2013, "Analytic inverse
kinematics for the Universal Robots UR-5/UR-10 arms"):

    n . wrist = d4                      two shoulders
    n seen from the tool                two wrists, and with them the fifth axis
    what is left is a planar arm        two elbows

Angles come from two-argument arctangents of quantities that stay exact near the singularities.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float

from bridge.geometry import se3
from twin.robot.model import RobotModel
from twin.robot.ur_geometry import UrGeometry, ur_geometry

NUM_BRANCHES = 8
"""Branch number: 4 * shoulder + 2 * wrist + elbow, each 0 or 1."""
_BEYOND = 1e-9
"""A cosine may leave [-1, 1] by this: a stretched arm, reached to a fraction of a nanometre."""
_SINGULAR = 1e-9
"""Sine of the fifth joint below which the sixth may be anything."""
_LIMIT_SLACK_RAD = 1e-9

_TURN = 2 * np.pi


@dataclass(frozen=True, kw_only=True)
class UrInverse:
    """All joints of a UR-type arm that reach a pose."""

    geometry: UrGeometry
    lower_rad: Float[np.ndarray, "6"]
    upper_rad: Float[np.ndarray, "6"]

    @staticmethod
    def for_robot(robot: RobotModel) -> "UrInverse | None":
        """Return the inverse of a robot's arm, None when its geometry is not that of a UR."""
        return _for_robot(robot)

    def all_branches(
        self, Ts_base_tcp: Float[np.ndarray, "num_poses 4 4"]
    ) -> tuple[Float[np.ndarray, "num_poses 8 6"], Bool[np.ndarray, "num_poses 8"]]:
        """Solve many poses.

        Args:
            Ts_base_tcp: Rigid poses of the tool centre point.

        Returns:
            Joints [rad], one turn of each joint, within the limits; and which of them are
            solutions. Out of reach, outside the limits, not a number, or with a joint that may be
            anything (the wrist point on the first axis, the fifth joint straight): not valid, and
            all joints are 0.
        """
        joints, valid, _ = self.solve(Ts_base_tcp)
        return joints, valid

    def solve(
        self, Ts_base_tcp: Float[np.ndarray, "num_poses 4 4"]
    ) -> tuple[
        Float[np.ndarray, "num_poses 8 6"],
        Bool[np.ndarray, "num_poses 8"],
        Bool[np.ndarray, " num_poses"],
    ]:
        """``all_branches``, and at which poses some branch has a straight wrist.

        There the pose is within reach on that branch too, by joints that nobody can number.
        """
        finite = np.isfinite(Ts_base_tcp).all(axis=(1, 2))
        theta, valid, singular = _angles(
            self.geometry, np.where(finite[:, None, None], Ts_base_tcp, 0.0)
        )
        joints = (theta - self.geometry.offsets_rad) * self.geometry.signs
        joints -= _TURN * np.rint(joints / _TURN)
        joints += _TURN * (joints < self.lower_rad - _LIMIT_SLACK_RAD)
        joints -= _TURN * (joints > self.upper_rad + _LIMIT_SLACK_RAD)
        inside = (joints >= self.lower_rad - _LIMIT_SLACK_RAD) & (
            joints <= self.upper_rad + _LIMIT_SLACK_RAD
        )
        valid &= inside.all(axis=2) & finite[:, None]
        return np.where(valid[..., None], joints, 0.0), valid, singular & finite


@lru_cache(maxsize=4)
def _for_robot(robot: RobotModel) -> UrInverse | None:
    geometry = ur_geometry(robot)
    if geometry is None:
        return None
    return UrInverse(geometry=geometry, lower_rad=robot.lower_rad, upper_rad=robot.upper_rad)


def _angles(
    geometry: UrGeometry, Ts_base_tcp: Float[np.ndarray, "num_poses 4 4"]
) -> tuple[
    Float[np.ndarray, "num_poses 8 6"],
    Bool[np.ndarray, "num_poses 8"],
    Bool[np.ndarray, " num_poses"],
]:
    """Angles of the Denavit-Hartenberg chain; axes of the arrays: pose, shoulder, wrist, elbow."""
    g = geometry
    T = se3.invert(g.T_base_0) @ Ts_base_tcp @ se3.invert(g.T_6_tcp)
    R = T[:, :3, :3]
    x, y, z = (T[:, i, 3, None] for i in range(3))
    theta = np.empty((len(T), 2, 2, 2, 6))

    radius = np.hypot(x, y)
    sine = np.divide(g.d4_m, radius, out=np.full_like(radius, 2.0), where=radius > _SINGULAR)
    valid = (np.abs(sine) <= 1 + _BEYOND)[..., None, None]
    lean = np.arcsin(np.clip(sine, -1.0, 1.0))
    first = np.arctan2(y, x) + np.concatenate([lean, np.pi - lean], axis=1)
    c1, s1 = np.cos(first), np.sin(first)
    theta[..., 0] = first[..., None, None]

    # n, the direction of the parallel axes, in the frame of the tool: (s5 c6, -s5 s6, c5).
    nx, ny, nz = (R[:, 0, k, None] * s1 - R[:, 1, k, None] * c1 for k in range(3))
    s5 = np.hypot(nx, ny)
    safe = np.maximum(s5, _SINGULAR)
    wrist = np.array([1.0, -1.0])
    theta[..., 4] = np.arctan2(s5[..., None] * wrist, nz[..., None])[..., None]
    sixth = np.arctan2(-ny, nx)
    theta[..., 5] = (sixth[..., None] + np.array([0.0, np.pi]))[..., None]
    singular = (s5 <= _SINGULAR) & valid[..., 0, 0]
    valid = valid & (s5 > _SINGULAR)[..., None, None]

    # The fifth axis, in the plane of the arm.
    c6, s6 = nx / safe, -ny / safe
    across = -s6 * (R[:, 0, 0, None] * c1 + R[:, 1, 0, None] * s1) - c6 * (
        R[:, 0, 1, None] * c1 + R[:, 1, 1, None] * s1
    )
    up = -s6 * R[:, 2, 0, None] - c6 * R[:, 2, 1, None]
    across, up = across[..., None] * wrist, up[..., None] * wrist

    px = (x * c1 + y * s1)[..., None] - g.d5_m * across
    py = z[..., None] - g.d5_m * up
    c3 = (px**2 + py**2 - g.a2_m**2 - g.a3_m**2) / (2 * g.a2_m * g.a3_m)
    valid = valid & ((np.abs(c3) <= 1 + _BEYOND) & (np.hypot(px, py) > _SINGULAR))[..., None]
    c3 = np.clip(c3, -1.0, 1.0)
    s3 = np.sqrt((1.0 - c3) * (1.0 + c3))
    elbow = np.array([1.0, -1.0])
    third = np.arctan2(s3, c3)[..., None] * elbow
    inner = np.arctan2(g.a3_m * s3, g.a2_m + g.a3_m * c3)[..., None] * elbow
    theta[..., 2] = third
    theta[..., 1] = np.arctan2(py, px)[..., None] - inner
    theta[..., 3] = np.arctan2(across, -up)[..., None] - theta[..., 1] - third
    shape = (len(T), NUM_BRANCHES)
    everywhere = np.broadcast_to(valid, theta.shape[:-1]).reshape(shape)
    return theta.reshape(*shape, 6), everywhere.copy(), singular.any(axis=1)
