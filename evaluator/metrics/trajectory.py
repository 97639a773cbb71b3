"""How far two poses of one body lie apart over a common clock.

Also without a constant delay, which is the controller's: what remains is another path.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from bridge.clock import NS_PER_S
from bridge.episode.streams import JointTrack
from bridge.geometry.signals import LAGS_S, lag_of_least_cost
from bridge.geometry.trajectory import PoseTrajectory
from evaluator.errors import UndefinedStatisticError

MAX_INSTANTS = 200
"""Delays are compared at no more instants than this."""
NOT_FINITE = "the recorded or replayed data hold values that are not finite"


def find_lag_s(
    stamps_ns: Int[np.ndarray, " num_samples"],
    p_recorded_m: Float[np.ndarray, "num_samples 3"],
    replayed: PoseTrajectory,
) -> float:
    """Find by how much the recorded motion comes later, whatever rigid motion lies between the two.

    The delay of least root mean square distance after the best rigid motion: an offset is the
    calibration's, and would else be bought off by a delay. Of delays that fit equally well the
    smallest is taken, so a motion that hardly moves has none.
    Range: -0.2 s to 0.6 s, known to 10 ms. Undefined when: positions are not finite.
    """
    choice = np.linspace(0, len(stamps_ns) - 1, min(len(stamps_ns), MAX_INSTANTS)).round()
    ids = np.unique(choice.astype(np.int64))
    asked = stamps_ns[ids][None, :] - (LAGS_S[:, None] * NS_PER_S).round().astype(np.int64)
    other = np.stack(
        [np.interp(asked, replayed.stamps_ns, replayed.p_m[:, axis]) for axis in range(3)], axis=-1
    )
    return lag_of_least_cost(_left_over_m(other, p_recorded_m[ids]))


def _left_over_m(
    p_sources_m: Float[np.ndarray, "num_lags num_poses 3"],
    p_target_m: Float[np.ndarray, "num_poses 3"],
) -> Float[np.ndarray, " num_lags"]:
    """Root mean square distance after the best rigid motion: Umeyama (1991), equation 43, c = 1."""
    sources = p_sources_m - p_sources_m.mean(axis=1, keepdims=True)
    target = p_target_m - p_target_m.mean(axis=0)
    covariance = np.swapaxes(sources, 1, 2) @ target / len(target)
    if not np.isfinite(covariance).all():
        raise UndefinedStatisticError(statistic="delay", reason=NOT_FINITE)
    sizes = np.linalg.svd(covariance, compute_uv=False)
    sizes[:, 2] *= np.where(np.linalg.det(covariance) < 0, -1.0, 1.0)
    spread = (sources**2).sum(axis=2).mean(axis=1) + (target**2).sum(axis=1).mean()
    return np.asarray(np.sqrt(np.maximum(spread - 2 * sizes.sum(axis=1), 0.0)))


@dataclass(frozen=True, kw_only=True)
class JointErrors:
    """Joint angles of two motions at the same instants."""

    names: tuple[str, ...]
    """Joints that both know, in the recorded order."""
    stamps_ns: Int[np.ndarray, " num_samples"]
    error_rad: Float[np.ndarray, "num_samples num_joints"]
    """Recorded minus replayed, modulo a whole turn: -pi to pi."""


def joint_errors(recorded: JointTrack, replayed: JointTrack) -> JointErrors:
    """Compare at the recorded stamps inside the time both cover; the replay is interpolated.

    Angles that differ by a whole turn put the arm into the same place and count as equal.
    Range: 0 rad to pi, 0 is perfect. Undefined when: no joint or no instant is shared.
    """
    names = tuple(name for name in recorded.names if name in replayed.names)
    if not names:
        reason = "recorded and replayed joints have no name in common"
        raise UndefinedStatisticError(statistic="joint error", reason=reason)
    common = _common(recorded.stamps_ns, replayed.stamps_ns, "joint error")
    stamps = recorded.stamps_ns[common]
    mine, theirs = ([side.names.index(name) for name in names] for side in (recorded, replayed))
    difference = recorded.position[common][:, mine] - replayed.at(stamps)[:, theirs]
    wrapped = difference - 2 * np.pi * np.round(difference / (2 * np.pi))
    return JointErrors(names=names, stamps_ns=stamps, error_rad=wrapped)


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
    """
    common = _common(recorded.stamps_ns, replayed.stamps_ns)
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
    """Return the distances [m] of ``pose_errors``, to the bit, where no angle is asked for."""
    common = _common(stamps_ns, replayed.stamps_ns)
    other_m = replayed.at(stamps_ns[common]).p_m
    return np.asarray(np.linalg.norm(p_recorded_m[common] - other_m, axis=1))


def _common(
    stamps_ns: Int[np.ndarray, " num_samples"],
    other_ns: Int[np.ndarray, " num_others"],
    statistic: str = "trajectory error",
) -> Bool[np.ndarray, " num_samples"]:
    """Which stamps lie in the time that others cover."""
    common = (stamps_ns >= other_ns[0]) & (stamps_ns <= other_ns[-1])
    if not common.any():
        reason = "recorded and replayed stamps do not overlap"
        raise UndefinedStatisticError(statistic=statistic, reason=reason)
    return np.asarray(common)


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
