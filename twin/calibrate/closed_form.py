"""Closed-form solutions of AX = XB and AX = ZB; where ``robot_world`` starts refining from.

Both describe one set of pose pairs. With a camera in the hand, A is ``T_base_hand``, B is
``T_target_camera``, X is ``T_hand_camera`` and Z is ``T_base_target``. With a fixed camera and the
target in the hand, B is ``T_camera_target``, X is ``T_hand_target`` and Z is ``T_base_camera``.
"""

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3

MAX_MOTIONS = 2000
"""Motions between pairs of poses that are used; more change nothing but the time."""
HALF_TURN_RAD = 3.0
"""Above this angle noise may flip the axis of a motion."""


def motions(
    Ts_a: Float[np.ndarray, "num_pairs 4 4"], Ts_b: Float[np.ndarray, "num_pairs 4 4"]
) -> tuple[Float[np.ndarray, "num_motions 4 4"], Float[np.ndarray, "num_motions 4 4"]]:
    """Motions P and Q between pairs of poses, for which P X = X Q.

    From A_i X = Z B_i for two poses: P = A_j^-1 A_i and Q = B_j^-1 B_i.
    """
    first, second = np.triu_indices(len(Ts_a), 1)
    if len(first) > MAX_MOTIONS:
        kept = np.unique(np.linspace(0, len(first) - 1, MAX_MOTIONS).astype(int))
        first, second = first[kept], second[kept]
    P = se3.invert(Ts_a)[second] @ Ts_a[first]
    Q = se3.invert(Ts_b)[second] @ Ts_b[first]
    return P, Q


def solve_hand_eye(
    Ts_a: Float[np.ndarray, "num_pairs 4 4"], Ts_b: Float[np.ndarray, "num_pairs 4 4"]
) -> Float[np.ndarray, "4 4"]:
    """Solve AX = XB for X from the motions between all poses.

    Park and Martin, "Robot sensor calibration: solving AX = XB on the Euclidean group" (1994):
    the rotation that lays the rotation vectors of Q over those of P, then linear least squares
    for the translation. The rotation is found by singular values, which unlike their square root
    of a matrix also refuses mirror images.
    """
    P, Q = motions(Ts_a, Ts_b)
    alpha, beta = se3.vector_from_rotation(P[:, :3, :3]), se3.vector_from_rotation(Q[:, :3, :3])
    clear = np.linalg.norm(alpha, axis=1) < HALF_TURN_RAD
    clear &= np.linalg.norm(beta, axis=1) < HALF_TURN_RAD
    if clear.sum() < 2:
        clear[:] = True
    R = nearest_rotation(alpha[clear].T @ beta[clear])
    left = P[:, :3, :3] - np.eye(3)
    right = Q[:, :3, 3] @ R.T - P[:, :3, 3]
    t, *_ = np.linalg.lstsq(left.reshape(-1, 3), right.reshape(-1), rcond=None)
    return _transform(R, t)


def solve_robot_world(
    Ts_a: Float[np.ndarray, "num_pairs 4 4"], Ts_b: Float[np.ndarray, "num_pairs 4 4"]
) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "4 4"]]:
    """Solve AX = ZB for X and Z at once.

    Shah, "Solving the robot-world/hand-eye calibration problem using the Kronecker product"
    (2013): with vec(A X B^T) = (B kron A) vec(X), the first singular vectors of the sum of
    R_B kron R_A are the stacked columns of R_X and R_Z; translations follow by least squares.
    """
    R_a, R_b = Ts_a[:, :3, :3], Ts_b[:, :3, :3]
    total = np.einsum("nij,nkl->ikjl", R_b, R_a).reshape(9, 9)
    U, _, Vt = np.linalg.svd(total)
    R_x = _rotation_from_columns(Vt[0])
    R_z = _rotation_from_columns(U[:, 0])
    minus = np.tile(-np.eye(3), (len(Ts_a), 1, 1))
    left = np.concatenate([R_a, minus], axis=2).reshape(-1, 6)
    right = Ts_b[:, :3, 3] @ R_z.T - Ts_a[:, :3, 3]
    t, *_ = np.linalg.lstsq(left, right.reshape(-1), rcond=None)
    return _transform(R_x, t[:3]), _transform(R_z, t[3:])


def nearest_rotation(M: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation R that maximises trace(R^T M)."""
    U, _, Vt = np.linalg.svd(M)
    sign = np.array([1.0, 1.0, np.linalg.det(U @ Vt)])
    return np.asarray((U * sign) @ Vt)


def _rotation_from_columns(values: Float[np.ndarray, "9"]) -> Float[np.ndarray, "3 3"]:
    M = values.reshape(3, 3).T
    return nearest_rotation(M * np.sign(np.linalg.det(M)))


def _transform(R: Float[np.ndarray, "3 3"], t_m: Float[np.ndarray, "3"]) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t_m
    return T
