"""How far two sets of runs of one motion lie apart over normalised time, and how each strays."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from bridge.geometry.trajectory import PoseTrajectory
from evaluator.errors import UndefinedStatisticError
from evaluator.metrics.trajectory import NORMALISED_SAMPLES, angles_rad

MOVING_THRESHOLD_M = 0.01
"""A run waits while it is closer than this to where it started, or will stay."""


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
    rotation_over_pairs_rad: float
    """Mean angle over all pairs and all normalised instants."""
    of_recorded_m: tuple[float, ...]
    """Mean distance of each recorded run to all replayed ones."""
    profile_m: Float[np.ndarray, " num_samples"]
    """Distance of the mean curves over normalised time."""


def band_distance(
    recorded: Sequence[PoseTrajectory],
    replayed: Sequence[PoseTrajectory],
    num_samples: int = NORMALISED_SAMPLES,
) -> BandDistance:
    """Compare two unpaired sets of runs of the same motion over normalised time.

    Range: 0 and up, 0 is perfect.

    Raises:
        UndefinedStatisticError: When one side has no run.
    """
    if not recorded or not replayed:
        side = "recorded" if not recorded else "replayed"
        raise UndefinedStatisticError(statistic="band distance", reason=f"no {side} run")
    a, q_a = _curves(recorded, num_samples)
    b, q_b = _curves(replayed, num_samples)
    pairs = np.linalg.norm(a[:, None] - b[None, :], axis=-1)
    shape = (len(a), len(b), num_samples, 4)
    angles = angles_rad(
        np.broadcast_to(q_a[:, None], shape).reshape(-1, 4),
        np.broadcast_to(q_b[None, :], shape).reshape(-1, 4),
    )
    profile = np.linalg.norm(a.mean(axis=0) - b.mean(axis=0), axis=-1)
    return BandDistance(
        mean_over_pairs_m=float(pairs.mean()),
        between_mean_curves_m=float(profile.mean()),
        max_between_mean_curves_m=float(profile.max()),
        end_point_over_pairs_m=float(pairs[:, :, -1].mean()),
        end_point_between_means_m=float(profile[-1]),
        rotation_over_pairs_rad=float(angles.mean()),
        of_recorded_m=tuple(pairs.mean(axis=(1, 2)).tolist()),
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
    curves, _ = _curves(runs, num_samples)
    squared = ((curves - curves.mean(axis=0)) ** 2).sum(axis=-1)
    profile = np.sqrt(squared.sum(axis=0) / (len(runs) - 1))
    return Repeatability(
        mean_m=float(profile.mean()),
        worst_m=float(profile.max()),
        end_point_m=float(profile[-1]),
        profile_m=profile,
    )


def mean_curve_m(
    runs: Sequence[PoseTrajectory], num_samples: int = NORMALISED_SAMPLES
) -> Float[np.ndarray, "num_samples 3"]:
    """Mean position of several runs at uniform instants of normalised time."""
    return np.asarray(_curves(runs, num_samples)[0].mean(axis=0))


def _curves(
    runs: Sequence[PoseTrajectory], num_samples: int
) -> tuple[
    Float[np.ndarray, "num_runs num_samples 3"], Float[np.ndarray, "num_runs num_samples 4"]
]:
    resampled = [run.normalised_time(num_samples) for run in runs]
    return np.stack([run.p_m for run in resampled]), np.stack([run.q_wxyz for run in resampled])
