"""Coverage of Newcombe's interval for groups of different size, counted out when it is asked for.

The stored map holds groups of equal size. The smaller group's entry is no bound for others: with 10
and 16 trials it covers as little as 88.3 %, with 10 and 10 at least 90.9 %.
"""

from functools import lru_cache

import numpy as np
from jaxtyping import Float64
from scipy.special import gammaln, xlog1py, xlogy

from evaluator.statistics.coverage.exact import PAIR_RATES, ROOM, Coverage
from evaluator.statistics.proportion import wilson

MOST = 200
"""A larger group is taken as one of this size: its own rate is as good as known then."""


@lru_cache(maxsize=512)
def newcombe_coverage(n_first: int, n_second: int) -> Coverage:
    """Count out how often the interval of second - first holds it, over rates 0.05, 0.10 .. 0.95.

    Args:
        n_first: Trials of one group, at least 1.
        n_second: Trials of the other.
    """
    sizes = min(n_first, MOST), min(n_second, MOST)
    (p_first, low_first, high_first), (p_second, low_second, high_second) = map(_ends, sizes)
    difference = p_second - p_first[:, None]
    low = difference - np.hypot(p_second - low_second, (high_first - p_first)[:, None])
    high = difference + np.hypot(high_second - p_second, (p_first - low_first)[:, None])
    chances_first, chances_second = map(_chances, sizes)
    worst, worst_at, total = 2.0, "", 0.0
    for rate_first, chance_first in zip(PAIR_RATES, chances_first, strict=True):
        for rate_second, chance_second in zip(PAIR_RATES, chances_second, strict=True):
            truth = rate_second - rate_first
            covered = float(
                chance_first @ ((low <= truth + ROOM) & (high >= truth - ROOM)) @ chance_second
            )
            total += covered
            if covered < worst:
                worst, worst_at = covered, f"p = {rate_first:.2f} and {rate_second:.2f}"
    mean = total / len(PAIR_RATES) ** 2
    return Coverage(n=min(n_first, n_second), worst=worst, worst_at=worst_at, mean=mean)


def _ends(n: int) -> Float64[np.ndarray, "3 counts"]:
    """Rate and Wilson's ends of every count."""
    found = [
        (k / n, interval.low, interval.high) for k in range(n + 1) for interval in [wilson(k, n)]
    ]
    return np.array(found).T


def _chances(n: int) -> Float64[np.ndarray, "rates counts"]:
    k, rates = np.arange(n + 1), PAIR_RATES[:, None]
    ways = gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1)
    return np.asarray(np.exp(ways + xlogy(k, rates) + xlog1py(n - k, -rates)))
