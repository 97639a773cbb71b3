"""How far two poses of one body lie apart over a common clock."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from bridge.geometry.trajectory import PoseTrajectory
from evaluator.errors import UndefinedStatisticError

NORMALISED_SAMPLES = 101
"""Samples from start to end for runs without a common clock."""


@dataclass(frozen=True, kw_only=True)
class PoseErrors:
    """Distance between two poses at the same instants."""

    stamps_ns: Int[np.ndarray, " num_samples"]
    position_m: Float[np.ndarray, " num_samples"]
    rotation_rad: Float[np.ndarray, " num_samples"]


def pose_errors(recorded: PoseTrajectory, replayed: PoseTrajectory) -> PoseErrors:
    """Compare at the recorded stamps inside the time both cover; the replay is interpolated.

    Absolute pose error without alignment, its length and its angle: Sturm et al. (2012).
    Range: 0 m and up, 0 is perfect. Undefined when: the two share no instant.

    Raises:
        UndefinedStatisticError: When the stamps do not overlap.
    """
    common = _common(recorded.stamps_ns, replayed)
    stamps = recorded.stamps_ns[common]
    other = replayed.at(stamps)
    return PoseErrors(
        stamps_ns=stamps,
        position_m=np.linalg.norm(recorded.p_m[common] - other.p_m, axis=1),
        rotation_rad=angles_rad(recorded.q_wxyz[common], other.q_wxyz),
    )


def position_errors(
    stamps_ns: Int[np.ndarray, " num_samples"],
    p_recorded_m: Float[np.ndarray, "num_samples 3"],
    replayed: PoseTrajectory,
) -> Float[np.ndarray, " num_common"]:
    """Return the distances [m] of ``pose_errors``, to the bit, where no angle is asked for.

    Raises:
        UndefinedStatisticError: When the stamps do not overlap.
    """
    common = _common(stamps_ns, replayed)
    other_m = replayed.positions_at(stamps_ns[common])
    return np.asarray(np.linalg.norm(p_recorded_m[common] - other_m, axis=1))


def _common(
    stamps_ns: Int[np.ndarray, " num_samples"], replayed: PoseTrajectory
) -> Bool[np.ndarray, " num_samples"]:
    first = max(int(stamps_ns[0]), int(replayed.stamps_ns[0]))
    last = min(int(stamps_ns[-1]), int(replayed.stamps_ns[-1]))
    common = (stamps_ns >= first) & (stamps_ns <= last)
    if not common.any():
        raise UndefinedStatisticError(
            statistic="trajectory error", reason="recorded and replayed stamps do not overlap"
        )
    return common


def angles_rad(
    q_first_wxyz: Float[np.ndarray, "num_samples 4"],
    q_second_wxyz: Float[np.ndarray, "num_samples 4"],
) -> Float[np.ndarray, " num_samples"]:
    """Return the angle between rotations, given as unit quaternions of either sign.

    Range: 0 rad to pi. The arc tangent of the chords is exact at zero and for opposite signs, where
    the arc cosine of a product is noisy.
    """
    near = np.linalg.norm(q_first_wxyz - q_second_wxyz, axis=1)
    far = np.linalg.norm(q_first_wxyz + q_second_wxyz, axis=1)
    return np.asarray(4.0 * np.arctan2(np.minimum(near, far), np.maximum(near, far)))
