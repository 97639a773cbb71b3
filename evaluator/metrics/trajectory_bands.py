"""How far two sets of runs of one motion lie apart over normalised time, and how each strays."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from bridge.geometry.trajectory import PoseTrajectory
from evaluator.errors import UndefinedStatisticError
from evaluator.metrics.trajectory import NORMALISED_SAMPLES

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
    turned_over_pairs_rad: float
    """Mean angle over all pairs and instants between what both turned since they began."""
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
    turned = np.swapaxes(_turned(q_a), -1, -2)[:, None] @ _turned(q_b)[None, :]
    profile = np.linalg.norm(a.mean(axis=0) - b.mean(axis=0), axis=-1)
    return BandDistance(
        mean_over_pairs_m=float(pairs.mean()),
        between_mean_curves_m=float(profile.mean()),
        max_between_mean_curves_m=float(profile.max()),
        end_point_over_pairs_m=float(pairs[:, :, -1].mean()),
        end_point_between_means_m=float(profile[-1]),
        turned_over_pairs_rad=float(se3.rotation_angle_rad(turned).mean()),
        of_recorded_m=tuple(pairs.mean(axis=(1, 2)).tolist()),
        profile_m=profile,
    )


def _turned(
    q_wxyz: Float[np.ndarray, "num_runs num_samples 4"],
) -> Float[np.ndarray, "num_runs num_samples 3 3"]:
    """Rotation since the first instant, in the fixed frame: whatever axes a body was given."""
    R = se3.rotation_from_quaternion(q_wxyz)
    return np.asarray(R @ np.swapaxes(R[:, :1], -1, -2))


def path_distance_m(
    recorded: Sequence[PoseTrajectory],
    replayed: Sequence[PoseTrajectory],
    num_samples: int = NORMALISED_SAMPLES,
) -> float:
    """Mean distance over all pairs at equal shares of the way: where they go, whatever the speed.

    Range: 0 m and up, 0 is perfect. Undefined when: one side has no run, or a run does not move.

    Raises:
        UndefinedStatisticError: When it is undefined.
    """
    if not recorded or not replayed:
        side = "recorded" if not recorded else "replayed"
        raise UndefinedStatisticError(statistic="path distance", reason=f"no {side} run")
    a, b = (np.stack([_by_way(run, num_samples) for run in side]) for side in (recorded, replayed))
    return float(np.linalg.norm(a[:, None] - b[None, :], axis=-1).mean())


def _by_way(run: PoseTrajectory, num_samples: int) -> Float[np.ndarray, "num_samples 3"]:
    steps = np.linalg.norm(np.diff(run.p_m, axis=0), axis=1)
    way = np.concatenate([[0.0], np.cumsum(steps)])
    if not way[-1] > 0:
        raise UndefinedStatisticError(statistic="path distance", reason="a run does not move")
    asked = np.linspace(0.0, way[-1], num_samples)
    return np.stack([np.interp(asked, way, run.p_m[:, axis]) for axis in range(3)], axis=1)


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
