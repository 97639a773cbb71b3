"""Counts in strata: one effect over tasks, and a drift over the order of trials.

Each stratum is compared within itself, so that tasks of different difficulty do not look like an
effect or like a drift.
"""

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from evaluator.errors import UndefinedStatisticError


@dataclass(frozen=True, kw_only=True)
class MantelHaenszel:
    """The common effect of two arms over strata."""

    difference: float
    """Rate of the second arm - rate of the first, a fraction, weighted over strata."""
    p: float
    """Two-sided, no continuity correction."""


def mantel_haenszel(tables: Sequence[tuple[int, int, int, int]]) -> MantelHaenszel:
    """Test two unpaired arms over strata (Cochran 1954; Mantel and Haenszel 1959).

    The difference has Mantel-Haenszel weights n_1 n_2 / n (Greenland and Robins 1985).

    Args:
        tables: Of each stratum k and n of the first arm, k and n of the second.

    Raises:
        UndefinedStatisticError: When no stratum has trials in both arms, or none varies.
    """
    counts = np.array([t for t in tables if t[1] and t[3]], dtype=np.float64).reshape(-1, 4)
    if not len(counts):
        reason = "no stratum has trials in both arms"
        raise UndefinedStatisticError(statistic="Mantel-Haenszel test", reason=reason)
    k_first, n_first, k_second, n_second = counts.T
    n, k = n_first + n_second, k_first + k_second
    variance = n_first * n_second * k * (n - k) / (n**2 * np.maximum(n - 1, 1))
    if variance.sum() == 0:
        reason = "all trials of every stratum ended the same"
        raise UndefinedStatisticError(statistic="Mantel-Haenszel test", reason=reason)
    z = (k_second - n_second * k / n).sum() / math.sqrt(variance.sum())
    weights = n_first * n_second / n
    difference = weights @ (k_second / n_second - k_first / n_first) / weights.sum()
    return MantelHaenszel(difference=float(difference), p=2 * float(ndtr(-abs(z))))


@dataclass(frozen=True, kw_only=True)
class Drift:
    """Whether success changes with the order of trials."""

    change: float
    """Slope over the whole session: rate at the end - rate at the beginning, a fraction."""
    p: float
    """Two-sided."""


def drift(succeeded: Sequence[bool], strata: Sequence[Hashable]) -> Drift:
    """Test for a trend of success over the order of trials, within strata.

    Mantel's extension test (1963) with the place in the session as score: the sum over strata of
    score x outcome against its mean and variance over permutations within strata, normal.

    Args:
        succeeded: Outcomes in the order of the trials.
        strata: Of each trial what it is compared within: task, policy and condition.

    Raises:
        UndefinedStatisticError: When no stratum has both outcomes at two places.
    """
    place = np.linspace(0.0, 1.0, len(succeeded)) if succeeded else np.zeros(0)
    y = np.array(succeeded, dtype=np.float64)
    names = list(dict.fromkeys(strata))
    numbers = np.array([names.index(stratum) for stratum in strata], dtype=np.int64)
    covariance = variance = spread = 0.0
    for number in range(len(names)):
        t, mine = place[numbers == number], y[numbers == number]
        if len(mine) < 2:
            continue
        around = t - t.mean()
        covariance += float(around @ mine)
        spread += float(around @ around)
        variance += float(around @ around) * float(mine.var(ddof=1))
    if variance == 0:
        reason = "no task, policy and condition has trials that ended differently"
        raise UndefinedStatisticError(statistic="drift", reason=reason)
    p = 2 * float(ndtr(-abs(covariance) / math.sqrt(variance)))
    return Drift(change=covariance / spread, p=p)
