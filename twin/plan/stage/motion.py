"""Poses on the way and steps in SE(3), for NumPy arrays and for torch tensors alike.

A step has seven numbers: three of the position in the base frame [m], three of a rotation vector
in the tool's own frame [rad], one of the width [m]. Torch is loaded only where tensors come in.
"""

import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3


def arrays_like(reference: Any, *arrays: Any) -> tuple[Any, ...]:
    """NumPy arrays as whatever the reference is: unchanged, or tensors on its device."""
    if isinstance(reference, np.ndarray):
        return arrays
    torch = _of(reference)
    made = (torch.as_tensor(np.array(a), dtype=reference.dtype) for a in arrays)
    return tuple(a.to(reference.device) for a in made)


def concatenated(parts: Sequence[Any]) -> Any:
    """Put ``(num, n)`` matrices side by side."""
    return _of(parts[0]).concatenate(list(parts), 1)


def positive_part(x: Any) -> Any:
    """[x]_+."""
    return np.maximum(x, 0.0) if isinstance(x, np.ndarray) else x.clamp(min=0.0)


def worst(values: Any, num_states: int) -> Any:
    """Largest of each state's steps, which lie one after the other, column by column."""
    steps = values.reshape(num_states, -1, *values.shape[1:])
    return _of(values).amax(steps, 1)


def _of(array: Any) -> Any:
    """The library an array belongs to."""
    return np if isinstance(array, np.ndarray) else sys.modules["torch"]


def rotation_vector(R: Any) -> Any:
    """Rotation vectors of ``(num, 3, 3)`` rotations [rad]; smooth below half a turn."""
    if isinstance(R, np.ndarray):
        return se3.vector_from_rotation(R)
    torch = _of(R)
    skew = torch.stack(
        [R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], dim=1
    )
    square = (skew * skew).sum(dim=1)
    tiny = square < 1e-18
    sine = torch.where(tiny, torch.ones_like(square), square).sqrt()
    cosine = R[:, 0, 0] + R[:, 1, 1] + R[:, 2, 2] - 1.0
    ratio = torch.where(tiny, torch.full_like(sine, 0.5), torch.atan2(sine, cosine) / sine)
    return skew * ratio[:, None]


def rotation_of(vector_rad: Any) -> Any:
    """Rotations ``(num, 3, 3)`` of rotation vectors, differentiable at zero too."""
    if isinstance(vector_rad, np.ndarray):
        return se3.rotation_from_vector(vector_rad)
    torch = _of(vector_rad)
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
    T_start: Float[np.ndarray, "4 4"], T_end: Any, fractions: Float[np.ndarray, " num_steps"]
) -> Any:
    """Poses on the straight ways from one start to many ends, at constant speed.

    Args:
        T_start: Where all begin.
        T_end: ``(num, 4, 4)``, NumPy or torch.
        fractions: Shares of the way.

    Returns:
        ``(num * num_steps, 4, 4)``, the steps of one way one after the other.
    """
    num, steps = len(T_end), len(fractions)
    R_start, p_start, share = arrays_like(T_end, T_start[:3, :3], T_start[:3, 3], fractions)
    turn = rotation_vector(R_start.T @ T_end[:, :3, :3])
    turns = (turn[:, None, :] * share[None, :, None]).reshape(num * steps, 3)
    p = p_start + share[None, :, None] * (T_end[:, None, :3, 3] - p_start)
    return pose_of(R_start @ rotation_of(turns), p.reshape(num * steps, 3))


def pose_of(R: Any, p: Any) -> Any:
    """Poses ``(num, 4, 4)`` of rotations and positions."""
    (last,) = arrays_like(R, np.broadcast_to([[0.0, 0.0, 0.0, 1.0]], (len(R), 1, 4)))
    library = _of(R)
    return library.concatenate([library.concatenate([R, p[:, :, None]], 2), last], 1)


def moved(T: Any, step: Any) -> Any:
    """Poses after steps of the position in the base frame and the rotation in the tool's.

    Args:
        T: ``(num, 4, 4)``.
        step: ``(num, 6)`` [m, rad].
    """
    return pose_of(T[:, :3, :3] @ rotation_of(step[:, 3:6]), T[:, :3, 3] + step[:, :3])
