"""Numbers that only figures need: bands over many motions, distributions.

The report draws what it is given; what has to be computed for a figure is computed here.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np


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
    """Return the empirical distribution of finite values, thinned evenly; None without any."""
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
