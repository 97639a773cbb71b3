"""Intervals for success rates and their differences. Never Wald: it collapses at 0/n and n/n."""

import math

from scipy.special import betaincinv, ndtri

from evaluator.errors import EvaluatorError, UndefinedStatisticError
from evaluator.result import Interval

LEVEL = 0.95


class ImpossibleCountError(EvaluatorError):
    """A count that no experiment can give."""

    def __init__(self, *, k: int, n: int) -> None:
        """Remember the count."""
        self.k = k
        self.n = n
        super().__init__(f"{k} successes of {n} is not a possible count. Check k and n.")


def wilson(k: int, n: int, *, level: float = LEVEL) -> Interval:
    """Return the score interval of a proportion k/n (Wilson 1927), the default for rates.

    Raises:
        UndefinedStatisticError: Without trials.
        ImpossibleCountError: When k is not in 0..n.
    """
    _check(k, n)
    z = _z(level)
    rate = k / n
    centre = (rate + z * z / (2 * n)) / (1 + z * z / n)
    half = z * math.sqrt(rate * (1 - rate) / n + z * z / (4 * n * n)) / (1 + z * z / n)
    low = 0.0 if k == 0 else max(0.0, centre - half)
    high = 1.0 if k == n else min(1.0, centre + half)
    return Interval(low=low, high=high, level=level, method="wilson")


def clopper_pearson(k: int, n: int, *, level: float = LEVEL) -> Interval:
    """Return the interval that covers at least ``level`` for every true rate (1934)."""
    _check(k, n)
    tail = (1 - level) / 2
    low = 0.0 if k == 0 else float(betaincinv(k, n - k + 1, tail))
    high = 1.0 if k == n else float(betaincinv(k + 1, n - k, 1 - tail))
    return Interval(low=low, high=high, level=level, method="clopper-pearson")


def newcombe_difference(
    k_first: int, n_first: int, k_second: int, n_second: int, *, level: float = LEVEL
) -> Interval:
    """Return the interval of second - first for independent groups (Newcombe 1998, method 10).

    The result is a fraction: 0.2 is a gain of 20 percentage points.
    """
    first = wilson(k_first, n_first, level=level)
    second = wilson(k_second, n_second, level=level)
    p_first, p_second = k_first / n_first, k_second / n_second
    difference = p_second - p_first
    below = math.hypot(p_second - second.low, first.high - p_first)
    above = math.hypot(second.high - p_second, p_first - first.low)
    return Interval(
        low=difference - below, high=difference + above, level=level, method="newcombe-10"
    )


def relative_gain(before: float, after: float) -> float:
    """Return (after - before) / before; 1.0 means doubled. Not a gain in percentage points.

    Raises:
        UndefinedStatisticError: When there is nothing to be relative to.
    """
    if before == 0:
        raise UndefinedStatisticError(
            statistic="relative gain", reason="the rate before is 0, nothing to be relative to"
        )
    return (after - before) / before


def _check(k: int, n: int) -> None:
    if n == 0:
        raise UndefinedStatisticError(statistic="rate", reason="there are no trials")
    if not 0 <= k <= n:
        raise ImpossibleCountError(k=k, n=n)


def _z(level: float) -> float:
    return float(ndtri(0.5 + level / 2))
