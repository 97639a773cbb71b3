"""Rigid transforms as 4x4 matrices ``T_a_b`` (points of frame b expressed in frame a).

Quaternions are ``wxyz``, scalar first, with w >= 0. Storage is quaternion plus translation;
matrices exist only in memory.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.errors import InvalidRecordError


def transform_from(
    q_wxyz: Float[np.ndarray, "*batch 4"], p_m: Float[np.ndarray, "*batch 3"]
) -> Float[np.ndarray, "*batch 4 4"]:
    """Build ``T_a_b`` from the rotation ``q_a_b_wxyz`` and the origin ``p_a_b`` [m]."""
    T = np.zeros((*q_wxyz.shape[:-1], 4, 4))
    T[..., :3, :3] = rotation_from_quaternion(q_wxyz)
    T[..., :3, 3] = p_m
    T[..., 3, 3] = 1.0
    return T


def rotation_from_quaternion(
    q_wxyz: Float[np.ndarray, "*batch 4"],
) -> Float[np.ndarray, "*batch 3 3"]:
    """Turn (not necessarily unit) quaternions into rotation matrices."""
    w, x, y, z = np.moveaxis(q_wxyz / np.linalg.norm(q_wxyz, axis=-1, keepdims=True), -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    R = np.empty((*q_wxyz.shape[:-1], 3, 3), dtype=w.dtype)
    for i, row in enumerate(rows):
        for j, value in enumerate(row):
            R[..., i, j] = value
    return R


def quaternion_from_rotation(
    R: Float[np.ndarray, "*batch 3 3"],
) -> Float[np.ndarray, "*batch 4"]:
    """Turn rotation matrices into unit quaternions with w >= 0 (Shepperd's method)."""
    r, trace = np.moveaxis(R, (-2, -1), (0, 1)), np.trace(R, axis1=-2, axis2=-1)
    x, y, z = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    xy, xz, yz = r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1]
    # Four quaternions of any length, each exact where its pivot is largest.
    candidates = (
        (1 + trace, x, y, z),
        (x, 1 + r[0, 0] - r[1, 1] - r[2, 2], xy, xz),
        (y, xy, 1 - r[0, 0] + r[1, 1] - r[2, 2], yz),
        (z, xz, yz, 1 - r[0, 0] - r[1, 1] + r[2, 2]),
    )
    pivots = np.stack([trace, r[0, 0], r[1, 1], r[2, 2]], axis=-1)
    best = np.argmax(pivots, axis=-1)[..., None, None]
    each = np.stack([np.stack(parts, axis=-1) for parts in candidates], axis=-2)
    q = np.take_along_axis(each, best, axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.asarray(np.where(q[..., :1] < 0, -q, q))


def split(
    T: Float[np.ndarray, "*batch 4 4"],
) -> tuple[Float[np.ndarray, "*batch 4"], Float[np.ndarray, "*batch 3"]]:
    """Split ``T_a_b`` into ``q_a_b_wxyz`` and ``p_a_b`` [m], the form that is stored."""
    return quaternion_from_rotation(T[..., :3, :3]), T[..., :3, 3].copy()


def invert(T: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 4 4"]:
    """Return ``T_b_a`` for ``T_a_b``."""
    R_inverse = np.swapaxes(T[..., :3, :3], -1, -2)
    inverse = np.zeros_like(T)
    inverse[..., :3, :3] = R_inverse
    inverse[..., :3, 3] = -np.einsum("...ij,...j->...i", R_inverse, T[..., :3, 3])
    inverse[..., 3, 3] = 1.0
    return inverse


def apply(
    T_a_b: Float[np.ndarray, "4 4"], p_b: Float[np.ndarray, "*batch 3"]
) -> Float[np.ndarray, "*batch 3"]:
    """Carry points from frame b to frame a [m]."""
    return np.asarray(p_b @ T_a_b[:3, :3].T + T_a_b[:3, 3])


def rotation_angle_rad(R: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch"]:
    """Return the angle of a rotation, stable near 0 and pi [rad]."""
    skew = np.stack(
        [
            R[..., 2, 1] - R[..., 1, 2],
            R[..., 0, 2] - R[..., 2, 0],
            R[..., 1, 0] - R[..., 0, 1],
        ],
        axis=-1,
    )
    trace = np.trace(R, axis1=-2, axis2=-1)
    return np.asarray(np.arctan2(np.linalg.norm(skew, axis=-1), trace - 1.0))


def interpolate_quaternion(
    q_start_wxyz: Float[np.ndarray, "*batch 4"],
    q_end_wxyz: Float[np.ndarray, "*batch 4"],
    fraction: Float[np.ndarray, "*batch"],
) -> Float[np.ndarray, "*batch 4"]:
    """Interpolate along the shorter arc at constant angular speed (Shoemake 1985)."""
    dot = np.sum(q_start_wxyz * q_end_wxyz, axis=-1)
    q_end = np.where(dot[..., None] < 0, -q_end_wxyz, q_end_wxyz)
    angle = np.arccos(np.clip(np.abs(dot), 0.0, 1.0))
    sine = np.sin(angle)
    nearly_equal = sine < 1e-9
    safe_sine = np.where(nearly_equal, 1.0, sine)
    weight_start = np.where(nearly_equal, 1 - fraction, np.sin((1 - fraction) * angle) / safe_sine)
    weight_end = np.where(nearly_equal, fraction, np.sin(fraction * angle) / safe_sine)
    q = weight_start[..., None] * q_start_wxyz + weight_end[..., None] * q_end
    return np.asarray(q / np.linalg.norm(q, axis=-1, keepdims=True))


def look_at(
    p_world_eye: Float[np.ndarray, "3"],
    p_world_target: Float[np.ndarray, "3"],
    up_world: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "4 4"]:
    """Pose ``T_world_camera`` of an OpenCV camera (+Z forward, +Y down) facing a target.

    Args:
        p_world_eye: Where the camera is [m].
        p_world_target: What lies on its optical axis [m]; not where the camera is.
        up_world: Points up in the image; not along the optical axis. Its length does not matter.
    """
    forward = p_world_target - p_world_eye
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, up_world)
    right = right / np.linalg.norm(right)
    return from_rotation(np.stack([right, np.cross(forward, right), forward], axis=1), p_world_eye)


def from_rotation(
    R: Float[np.ndarray, "3 3"], p_m: Float[np.ndarray, "3"] | Sequence[float]
) -> Float[np.ndarray, "4 4"]:
    """Build ``T_a_b`` from ``R_a_b`` and the origin ``p_a_b`` [m]."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, p_m
    return T


def small_motion(numbers: Float[np.ndarray, "6"]) -> Float[np.ndarray, "4 4"]:
    """A turn (rotation vector [rad]), then a shift [m]."""
    return from_rotation(rotation_from_vector(numbers[:3]), numbers[3:])


def rotation_from_vector(
    turn_rad: Float[np.ndarray, "*batch 3"],
) -> Float[np.ndarray, "*batch 3 3"]:
    """Turn rotation vectors, axis times angle [rad], into rotation matrices."""
    half = np.linalg.norm(turn_rad, axis=-1, keepdims=True) / 2
    # sin(half) / (2 half), smooth at 0
    factor = 0.5 * np.sinc(half / np.pi)
    return rotation_from_quaternion(np.concatenate([np.cos(half), factor * turn_rad], axis=-1))


def vector_from_rotation(
    R: Float[np.ndarray, "*batch 3 3"],
) -> Float[np.ndarray, "*batch 3"]:
    """Turn rotation matrices into rotation vectors of length 0..pi [rad]."""
    q = quaternion_from_rotation(R)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, q[..., :1])
    tiny = sine < 1e-12
    return np.asarray(q[..., 1:] * np.where(tiny, 2.0, angle / np.where(tiny, 1.0, sine)))


def nearest_rotation(M: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Return the rotation R that maximises trace(R^T M): Kabsch (1976)."""
    left, _, right = np.linalg.svd(M)
    left[..., 2] *= np.where(np.linalg.det(left @ right) < 0, -1.0, 1.0)[..., None]
    return np.asarray(left @ right)


def align_rigid(
    p_source_m: Float[np.ndarray, "num_points 3"],
    p_target_m: Float[np.ndarray, "num_points 3"],
    weights: Float[np.ndarray, " num_points"] | None = None,
) -> Float[np.ndarray, "4 4"]:
    """Find ``T_target_source``, the rigid motion that best lays one point list over another.

    Least squares without scale. Source points on a line leave the turn about it open.

    Args:
        p_source_m: Points in the source frame.
        p_target_m: The same points in the target frame.
        weights: Of the squared distances; None: all alike.
    """
    each = np.ones(len(p_source_m)) if weights is None else weights
    share = each / each.sum()
    source, target = share @ p_source_m, share @ p_target_m
    cross = ((p_target_m - target) * share[:, None]).T @ (p_source_m - source)
    R = nearest_rotation(cross)
    return from_rotation(R, target - R @ source)


def pose_record(T: Float[np.ndarray, "4 4"]) -> dict[str, list[float]]:
    """Position [m] and quaternion of a pose, as JSON records hold them."""
    q, p = split(T)
    return {"p_m": p.tolist(), "q_wxyz": q.tolist()}


def pose_from_record(record: Any) -> Float[np.ndarray, "4 4"]:
    """Read what ``pose_record`` made."""
    try:
        q = np.array(record["q_wxyz"], dtype=np.float64)
        p = np.array(record["p_m"], dtype=np.float64)
    except (ValueError, KeyError, TypeError) as error:
        raise InvalidRecordError(name="pose", where="", found=repr(error)) from error
    if q.shape != (4,) or p.shape != (3,) or not np.isfinite([*q, *p]).all() or not q.any():
        raise InvalidRecordError(name="pose", where="", found=str(record))
    return transform_from(q, p)
