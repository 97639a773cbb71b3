"""Numbers that only figures need: bands over many motions, intervals of bins, rates in the twin.

The report draws what it is given; what has to be computed for a figure is computed here.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from evaluator.compare.measure import vouched_rate
from evaluator.compare.rows import TrialRow
from evaluator.statistics.gate import reliability_bins


@dataclass(frozen=True, kw_only=True)
class ReliabilityPoint:
    """One bin of stated probabilities against what happened."""

    low: float
    high: float
    mean_probability: float
    succeeded: int
    n: int
    rate: float
    rate_low: float | None
    """None where no honest interval exists for so few trials."""
    rate_high: float | None


def reliability_points(rows: Sequence[TrialRow]) -> list[ReliabilityPoint]:
    """Return the bins of the reliability diagram with Wilson's interval of each."""
    seen = [
        (row.p_success, row.recorded)
        for row in rows
        if row.p_success is not None and row.recorded is not None
    ]
    if not seen:
        return []
    found = []
    for b in reliability_bins([p for p, _ in seen], [outcome for _, outcome in seen]):
        interval, _ = vouched_rate(b.succeeded, b.n, "wilson")
        found.append(
            ReliabilityPoint(
                low=b.low,
                high=b.high,
                mean_probability=b.mean_probability,
                succeeded=b.succeeded,
                n=b.n,
                rate=b.succeeded / b.n,
                rate_low=None if interval is None else interval.low,
                rate_high=None if interval is None else interval.high,
            )
        )
    return found


@dataclass(frozen=True, kw_only=True)
class CurveBand:
    """Curves over the same normalised time, summed up at each of its samples."""

    name: str
    num_curves: int
    median: tuple[float, ...]
    low: tuple[float, ...]
    """10th percentile over the curves."""
    high: tuple[float, ...]
    """90th percentile."""


def curve_bands(curves: Mapping[str, Sequence[Sequence[float]]]) -> list[CurveBand]:
    """Sum up groups of curves by their median and 10th to 90th percentile at each sample.

    A curve of another length than the first of its group, or one that is not finite, is left out.
    """
    bands = []
    for name, members in curves.items():
        length = len(members[0]) if members else 0
        alike = np.array([curve for curve in members if len(curve) == length], dtype=np.float64)
        alike = alike[np.isfinite(alike).all(axis=1)] if alike.size else alike
        if not alike.size:
            continue
        low, median, high = np.percentile(alike, (10, 50, 90), axis=0)
        bands.append(
            CurveBand(
                name=name,
                num_curves=len(alike),
                median=tuple(median.tolist()),
                low=tuple(low.tolist()),
                high=tuple(high.tolist()),
            )
        )
    return bands


@dataclass(frozen=True, kw_only=True)
class Shares:
    """Sorted values with the share of all that is at most as large."""

    name: str
    n: int
    values: tuple[float, ...]
    shares: tuple[float, ...]


MAX_STEPS = 200
"""Steps of a drawn distribution; more cannot be seen."""


def shares_of(name: str, values: Sequence[float]) -> Shares | None:
    """Return the empirical distribution of finite values, thinned evenly; None without any.

    Args:
        values: Any numbers; those that are not finite are left out.
    """
    found = np.sort(np.array([v for v in values if np.isfinite(v)], dtype=np.float64))
    if not found.size:
        return None
    ranks = np.arange(1, found.size + 1)
    if found.size > MAX_STEPS:
        keep = np.unique(np.linspace(0, found.size - 1, MAX_STEPS).round().astype(int))
        ranks, thinned = ranks[keep], found[keep]
    else:
        thinned = found
    return Shares(
        name=name,
        n=int(found.size),
        values=tuple(thinned.tolist()),
        shares=tuple((ranks / found.size).tolist()),
    )
