"""Poses on the way and steps in SE(3), for NumPy arrays and for torch tensors alike.

A step has seven numbers: three of the position in the base frame [m], three of a rotation vector
in the tool's own frame [rad], one of the width [m]. Torch is loaded only where tensors come in.
"""

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from twin.plan.constrain.arrays import Array, like, namespace, turn


def rotation_vector(R: Array) -> Array:
    """Rotation vectors of ``(num, 3, 3)`` rotations [rad]; smooth below half a turn."""
    if isinstance(R, np.ndarray):
        return se3.vector_from_rotation(R)
    xp = namespace(R)
    skew = xp.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], 1)
    square = (skew * skew).sum(1)
    tiny = square < 1e-18
    sine = xp.sqrt(xp.where(tiny, xp.ones_like(square), square))
    return skew * xp.where(tiny, 0.5 * xp.ones_like(sine), turn(R) / sine)[:, None]


def rotation_of(vector_rad: Array) -> Array:
    """Rotations ``(num, 3, 3)`` of rotation vectors, differentiable at zero too."""
    if isinstance(vector_rad, np.ndarray):
        return se3.rotation_from_vector(vector_rad)
    torch = namespace(vector_rad)
    square = (vector_rad * vector_rad).sum(dim=1)
    tiny = square < 1e-12
    angle = torch.where(tiny, torch.ones_like(square), square).sqrt()
    a = torch.where(tiny, 1.0 - square / 6, torch.sin(angle) / angle)[:, None, None]
    b = torch.where(tiny, 0.5 - square / 24, (1.0 - torch.cos(angle)) / angle**2)[:, None, None]
    x, y, z = vector_rad.unbind(dim=1)
    zero = torch.zeros_like(x)
    K = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=1).reshape(-1, 3, 3)
    return torch.eye(3, dtype=K.dtype, device=K.device) + a * K + b * (K @ K)


def interpolated(
    T_start: Float[np.ndarray, "4 4"], T_end: Array, fractions: Float[np.ndarray, " num_steps"]
) -> Array:
    """Poses on the straight ways from one start to many ends, at constant speed.

    Args:
        T_start: Where all begin.
        T_end: ``(num, 4, 4)``, NumPy or torch.
        fractions: Shares of the way.

    Returns:
        ``(num, num_steps, 4, 4)``.
    """
    num, steps = len(T_end), len(fractions)
    R_start, p_start = like(T_start[:3, :3], T_end), like(T_start[:3, 3], T_end)
    share = like(fractions, T_end)
    whole = rotation_vector(R_start.T @ T_end[:, :3, :3])
    turns = (whole[:, None, :] * share[None, :, None]).reshape(num * steps, 3)
    p = p_start + share[None, :, None] * (T_end[:, None, :3, 3] - p_start)
    T = pose_of(R_start @ rotation_of(turns), p.reshape(num * steps, 3))
    return T.reshape(num, steps, 4, 4)


def pose_of(R: Array, p: Array) -> Array:
    """Poses ``(num, 4, 4)`` of rotations and positions."""
    xp = namespace(R)
    last = xp.broadcast_to(like([[0.0, 0.0, 0.0, 1.0]], R), (len(R), 1, 4))
    return xp.concatenate([xp.concatenate([R, p[:, :, None]], 2), last], 1)


def moved(T: Array, step: Array) -> Array:
    """Poses after steps of the position in the base frame and the rotation in the tool's.

    Args:
        T: ``(num, 4, 4)``.
        step: ``(num, 6)`` [m, rad].
    """
    return pose_of(T[:, :3, :3] @ rotation_of(step[:, 3:6]), T[:, :3, 3] + step[:, :3])
