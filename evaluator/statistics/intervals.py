"""Intervals for success rates and for medians of lengths.

Rates never have Wald's: it collapses at 0/n and n/n. Lengths that are mostly small and now and then
large, as the miss of a dropped cube, would need many values for Student's interval of their mean;
the median has one that holds for any distribution, from six values on.
"""

import math
from collections.abc import Hashable, Sequence
from fractions import Fraction
from statistics import NormalDist

import numpy as np

from evaluator.errors import EvaluatorError, UndefinedStatisticError
from evaluator.result import Interval

LEVEL = 0.95


class ImpossibleCountError(EvaluatorError):
    """A count that no experiment can give."""

    def __init__(self, *, k: int, n: int) -> None:
        """Remember the count."""
        self.k, self.n = k, n
        super().__init__(f"{k} successes of {n} is not a possible count. Check k and n.")


def wilson(k: int, n: int, *, level: float = LEVEL) -> Interval:
    """Return the score interval of a proportion k/n (Wilson 1927), the default for rates."""
    check_count(k, n)
    z = normal_quantile(0.5 + level / 2)
    rate = k / n
    centre = (rate + z * z / (2 * n)) / (1 + z * z / n)
    half = z * math.sqrt(rate * (1 - rate) / n + z * z / (4 * n * n)) / (1 + z * z / n)
    low = 0.0 if k == 0 else max(0.0, centre - half)
    high = 1.0 if k == n else min(1.0, centre + half)
    return Interval(low=low, high=high, level=level, method="wilson")


def relative_gain(before: float, after: float) -> float:
    """Return (after - before) / before; 1.0 means doubled. Not a gain in percentage points."""
    if before == 0:
        reason = "the rate before is 0, nothing to be relative to"
        raise UndefinedStatisticError(statistic="relative gain", reason=reason)
    return (after - before) / before


def check_count(k: int, n: int) -> None:
    """Refuse what cannot be counted."""
    if n == 0:
        raise UndefinedStatisticError(statistic="rate", reason="there are no trials")
    if not 0 <= k <= n:
        raise ImpossibleCountError(k=k, n=n)


def normal_quantile(probability: float) -> float:
    """Return the standard normal's quantile, 1.96 at 0.975."""
    return NormalDist().inv_cdf(probability)


ORDER_STATISTICS = "order-statistics"


def median_interval(values: Sequence[float], *, level: float = LEVEL) -> Interval:
    """Return two of the values between which the median lies, whatever the distribution is.

    The l-th smallest and the l-th largest hold it with probability 1 - 2 P(B < l), where B is
    binomial(n, 1/2); the largest l that keeps the level (Thompson 1936).

    Raises:
        UndefinedStatisticError: Below 6 values at 95 %: even the smallest and the largest may miss.
    """
    place = median_rank(len(values), level)
    if place == 0:
        least = math.ceil(1 - math.log2(1 - level))
        reason = f"{len(values)} values; at {100 * level:g} % it needs at least {least}"
        raise UndefinedStatisticError(statistic="median interval", reason=reason)
    ordered = sorted(map(float, values))
    low, high = ordered[place - 1], ordered[-place]
    return Interval(low=low, high=high, level=level, method=ORDER_STATISTICS)


def median_rank(n: int, level: float = LEVEL) -> int:
    """Return l, counted from 1; 0 where no two values keep the level."""
    rank, below, ways = 0, 0, 1  # ways of fewer than l successes in n, and of l, of 2 ** n
    most = int(Fraction(1 - level) * 2**n)
    while 2 * (below + ways) <= most and rank <= n // 2:
        rank, below, ways = rank + 1, below + ways, ways * (n - rank) // (rank + 1)
    return rank


def cluster_means(values: Sequence[float], clusters: Sequence[Hashable]) -> list[float]:
    """Return the mean of each cluster, in the order in which clusters first appear."""
    of_cluster: dict[Hashable, list[float]] = {}
    for value, cluster in zip(values, clusters, strict=True):
        of_cluster.setdefault(cluster, []).append(value)
    return [float(np.mean(members)) for members in of_cluster.values()]
