"""What is left of a trajectory error without a constant delay, or without a constant rigid motion.

A delay is the controller's, a rigid motion the calibration's; what remains of an error when either
is taken out belongs to neither.
"""

import numpy as np
from jaxtyping import Float, Int

from bridge.clock import NS_PER_S
from bridge.geometry.trajectory import PoseTrajectory
from evaluator.errors import UndefinedStatisticError

LAGS_S = np.arange(-20, 61) / 100
"""Delays that are tried: -0.2 s to 0.6 s in steps of 10 ms."""
MAX_INSTANTS = 200
"""Delays are compared at no more instants than this."""
EQUAL_M = 1e-5
"""Delays whose mean distances differ by less fit equally well."""
NOT_FINITE = "the recorded or replayed data hold values that are not finite"
FLAT = 1e-9
"""A second singular value below this share of the first: positions on a line."""


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

    Args:
        stamps_ns: Instants on the common clock.
        p_recorded_m: Where the recorded motion was.
        replayed: The same motion; held at its ends where it is shorter.

    Raises:
        UndefinedStatisticError: When it is undefined.
    """
    choice = np.linspace(0, len(stamps_ns) - 1, min(len(stamps_ns), MAX_INSTANTS)).round()
    ids = np.unique(choice.astype(np.int64))
    asked = stamps_ns[ids][None, :] - (LAGS_S[:, None] * NS_PER_S).round().astype(np.int64)
    other = np.stack(
        [np.interp(asked, replayed.stamps_ns, replayed.p_m[:, axis]) for axis in range(3)], axis=-1
    )
    costs = _left_over_m(other, p_recorded_m[ids])
    near = LAGS_S[costs <= costs.min() + EQUAL_M]
    return float(near[np.argmin(np.abs(near))])


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


def align_rigid(
    p_source_m: Float[np.ndarray, "num_poses 3"], p_target_m: Float[np.ndarray, "num_poses 3"]
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """Find the rigid motion that best lays one list of positions over another.

    Least squares without scale: Umeyama (1991), equations 40 and 41 with c = 1.

    Args:
        p_source_m: Positions in the source frame [m].
        p_target_m: The same instants in the target frame [m].

    Returns:
        Rotation ``R_target_source`` and translation ``p_target_source`` [m].

    Raises:
        UndefinedStatisticError: When the source positions lie on a line, or are not finite.
    """
    middle_source, middle_target = p_source_m.mean(axis=0), p_target_m.mean(axis=0)
    covariance = (p_target_m - middle_target).T @ (p_source_m - middle_source) / len(p_source_m)
    if not np.isfinite(covariance).all():
        raise UndefinedStatisticError(
            statistic="rigid alignment",
            reason=NOT_FINITE,
        )
    left, sizes, right = np.linalg.svd(covariance)
    if sizes[1] <= FLAT * max(sizes[0], FLAT):
        raise UndefinedStatisticError(
            statistic="rigid alignment",
            reason="the positions lie on a line, which any turn about it leaves as it is",
        )
    mirror = np.diag([1.0, 1.0, np.sign(np.linalg.det(left) * np.linalg.det(right))])
    R = left @ mirror @ right
    return R, middle_target - R @ middle_source


def without_rigid_motion(
    p_recorded_m: Float[np.ndarray, "num_poses 3"], p_replayed_m: Float[np.ndarray, "num_poses 3"]
) -> Float[np.ndarray, " num_poses"]:
    """Distance [m] of the same instants after the replay was laid over the recording.

    Raises:
        UndefinedStatisticError: When the replayed positions lie on a line, or are not finite.
    """
    R, shift = align_rigid(p_replayed_m, p_recorded_m)
    return np.asarray(np.linalg.norm(p_recorded_m - (p_replayed_m @ R.T + shift), axis=1))
