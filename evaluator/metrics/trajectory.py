"""How far two motions lie apart: over a common clock, over normalised time, and at their ends."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from bridge.geometry.trajectory import PoseTrajectory
from evaluator.errors import UndefinedStatisticError

NORMALISED_SAMPLES = 101
"""Samples from start to end for runs without a common clock."""
MOVING_THRESHOLD_M = 0.01
"""A run waits while it is closer than this to where it started, or will stay."""


@dataclass(frozen=True, kw_only=True)
class PoseErrors:
    """Distance between two poses at the same instants."""

    stamps_ns: Int[np.ndarray, " num_samples"]
    position_m: Float[np.ndarray, " num_samples"]
    rotation_rad: Float[np.ndarray, " num_samples"]


def pose_errors(recorded: PoseTrajectory, replayed: PoseTrajectory) -> PoseErrors:
    """Compare at the recorded stamps inside the time both cover; the replay is interpolated.

    Range: 0 m and up, 0 is perfect. Undefined when: the two share no instant.

    Raises:
        UndefinedStatisticError: When the stamps do not overlap.
    """
    first = max(int(recorded.stamps_ns[0]), int(replayed.stamps_ns[0]))
    last = min(int(recorded.stamps_ns[-1]), int(replayed.stamps_ns[-1]))
    common = (recorded.stamps_ns >= first) & (recorded.stamps_ns <= last)
    if not common.any():
        raise UndefinedStatisticError(
            statistic="trajectory error", reason="recorded and replayed stamps do not overlap"
        )
    stamps = recorded.stamps_ns[common]
    other = replayed.at(stamps)
    return PoseErrors(
        stamps_ns=stamps,
        position_m=np.linalg.norm(recorded.p_m[common] - other.p_m, axis=1),
        rotation_rad=_angles_rad(recorded.q_wxyz[common], other.q_wxyz),
    )


def _angles_rad(
    q_first: Float[np.ndarray, "num_samples 4"], q_second: Float[np.ndarray, "num_samples 4"]
) -> Float[np.ndarray, " num_samples"]:
    # atan2 of the chords: exact at zero and for opposite signs, where acos of a product is noisy.
    near = np.linalg.norm(q_first - q_second, axis=1)
    far = np.linalg.norm(q_first + q_second, axis=1)
    return np.asarray(4.0 * np.arctan2(np.minimum(near, far), np.maximum(near, far)))


def moving_part(run: PoseTrajectory, *, threshold_m: float = MOVING_THRESHOLD_M) -> PoseTrajectory:
    """Cut the waiting at both ends: from leaving the start to staying at the end.

    A run that never leaves its start is returned whole.
    """
    away_from_start = np.linalg.norm(run.p_m - run.p_m[0], axis=1) > threshold_m
    away_from_end = np.linalg.norm(run.p_m - run.p_m[-1], axis=1) > threshold_m
    if not away_from_start.any() or not away_from_end.any():
        return run
    first = max(0, int(np.argmax(away_from_start)) - 1)
    last = min(len(run) - 1, int(np.flatnonzero(away_from_end)[-1]) + 1)
    if last <= first:
        return run
    keep = slice(first, last + 1)
    return PoseTrajectory(run.stamps_ns[keep], run.p_m[keep], run.q_wxyz[keep])


@dataclass(frozen=True, kw_only=True)
class BandDistance:
    """How far a band of replayed runs lies from a band of recorded ones, not run by run."""

    mean_over_pairs_m: float
    """Mean distance over all (recorded, replayed) pairs and all normalised instants."""
    between_mean_curves_m: float
    """Mean distance of the two mean curves: what is left when each band's spread averages out."""
    max_between_mean_curves_m: float
    end_point_over_pairs_m: float
    """Mean distance of the end points over all pairs."""
    end_point_between_means_m: float
    profile_m: Float[np.ndarray, " num_samples"]
    """Distance of the mean curves over normalised time."""


def band_distance(
    recorded: Sequence[PoseTrajectory],
    replayed: Sequence[PoseTrajectory],
    num_samples: int = NORMALISED_SAMPLES,
) -> BandDistance:
    """Compare two unpaired sets of runs of the same motion over normalised time.

    Raises:
        UndefinedStatisticError: When one side has no run.
    """
    if not recorded or not replayed:
        side = "recorded" if not recorded else "replayed"
        raise UndefinedStatisticError(statistic="band distance", reason=f"no {side} run")
    a, b = _curves(recorded, num_samples), _curves(replayed, num_samples)
    pairs = np.linalg.norm(a[:, None] - b[None, :], axis=-1)
    profile = np.linalg.norm(a.mean(axis=0) - b.mean(axis=0), axis=-1)
    return BandDistance(
        mean_over_pairs_m=float(pairs.mean()),
        between_mean_curves_m=float(profile.mean()),
        max_between_mean_curves_m=float(profile.max()),
        end_point_over_pairs_m=float(pairs[:, :, -1].mean()),
        end_point_between_means_m=float(profile[-1]),
        profile_m=profile,
    )


@dataclass(frozen=True, kw_only=True)
class Repeatability:
    """How far runs of the same motion spread around their own mean."""

    mean_m: float
    """Root mean square distance from the mean curve, averaged over normalised time."""
    worst_m: float
    """The same at its worst instant."""
    end_point_m: float
    """The same at the end point."""
    profile_m: Float[np.ndarray, " num_samples"]


def repeatability(
    runs: Sequence[PoseTrajectory], num_samples: int = NORMALISED_SAMPLES
) -> Repeatability:
    """Measure the spread of one side; the scale against which a band distance is read.

    The sum of squares is divided by (runs - 1), since the mean is estimated from the same runs.

    Raises:
        UndefinedStatisticError: Below 2 runs.
    """
    if len(runs) < 2:
        raise UndefinedStatisticError(
            statistic="repeatability", reason=f"{len(runs)} run; it needs at least 2"
        )
    curves = _curves(runs, num_samples)
    squared = ((curves - curves.mean(axis=0)) ** 2).sum(axis=-1)
    profile = np.sqrt(squared.sum(axis=0) / (len(runs) - 1))
    return Repeatability(
        mean_m=float(profile.mean()),
        worst_m=float(profile.max()),
        end_point_m=float(profile[-1]),
        profile_m=profile,
    )


def _curves(
    runs: Sequence[PoseTrajectory], num_samples: int
) -> Float[np.ndarray, "num_runs num_samples 3"]:
    return np.stack([run.normalised_time(num_samples).p_m for run in runs])
