"""Intervals of lengths that are mostly small and now and then large, as the miss of a dropped cube.

Student's interval of their mean needs many of them; the median has an interval that holds for any
distribution, from six values on.
"""

import math
from collections.abc import Hashable, Sequence

import numpy as np
from scipy.special import bdtr

from evaluator.errors import UndefinedStatisticError
from evaluator.result import Interval
from evaluator.statistics.proportion import LEVEL

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
        raise UndefinedStatisticError(
            statistic="median interval",
            reason=f"{len(values)} values; at {100 * level:g} % it needs at least "
            f"{math.ceil(1 - math.log2(1 - level))}",
        )
    ordered = np.sort(np.asarray(values, dtype=np.float64))
    return Interval(
        low=float(ordered[place - 1]),
        high=float(ordered[-place]),
        level=level,
        method=ORDER_STATISTICS,
    )


def median_rank(n: int, level: float = LEVEL) -> int:
    """Return l, counted from 1; 0 where no two values keep the level."""
    if not n:
        return 0
    below = bdtr(np.arange(n // 2 + 1), n, 0.5)  # P(B <= l - 1) for l = 1, 2 ..
    return int((1 - 2 * below >= level).sum())


def cluster_means(values: Sequence[float], clusters: Sequence[Hashable]) -> list[float]:
    """Return the mean of each cluster, in the order in which clusters first appear."""
    of_cluster: dict[Hashable, list[float]] = {}
    for value, cluster in zip(values, clusters, strict=True):
        of_cluster.setdefault(cluster, []).append(value)
    return [float(np.mean(members)) for members in of_cluster.values()]
