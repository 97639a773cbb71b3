"""How many starts and trials a study needs, from the rates that are expected.

For a power by the very test, and for a width by the very interval that the evaluator will use.
"""

import math
from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np
from scipy.special import bdtr

from evaluator.errors import UndefinedStatisticError
from evaluator.statistics.differences import tango_difference
from evaluator.statistics.intervals import RATE_INTERVALS
from evaluator.statistics.power import ALPHA, MAX_PAIRS, POWER, power_paired

PARTS = 7
"""Equally likely counts at which an interval's width is averaged."""
STAYS = 5
"""More trials can mean less power by a step of the test: so many further ones have to reach it."""
MOST = MAX_PAIRS


def paired_chances(p_first: float, p_second: float, correlation: float) -> tuple[float, float]:
    """Return the chances of a pair to improve and to worsen, from both rates.

    Args:
        correlation: Phi of both outcomes of a start; 0 where nobody knows, which asks for more
            starts than what is usual, above 0. Cut to what the rates allow.
    """
    spread = math.sqrt(p_first * (1 - p_first) * p_second * (1 - p_second))
    both = p_first * p_second + correlation * spread
    both = min(max(both, 0.0, p_first + p_second - 1), p_first, p_second)
    return p_second - both, p_first - both


def pairs_for_power(
    p_improved: float, p_worsened: float, *, power: float = POWER, alpha: float = ALPHA
) -> int:
    """Return the pairs with which McNemar's mid-p test shows a difference.

    Raises:
        UndefinedStatisticError: Without a difference, or when 4,000 pairs are not enough.
    """
    if p_improved == p_worsened:
        reason = "the rates are equal; no number of pairs shows a difference"
        raise UndefinedStatisticError(statistic="pairs", reason=reason)
    return _smallest(
        lambda n: power_paired(p_improved, p_worsened, n, alpha=alpha, mid=True) >= power, "pairs"
    )


def paired_width(p_improved: float, p_worsened: float, num_pairs: int) -> float:
    """Return the expected width of Tango's interval of the difference, a fraction."""
    differ = p_improved + p_worsened
    widths = []
    for discordant in _quantiles(num_pairs, min(differ, 1.0)):
        share = p_improved / differ if differ else 0.5
        for improved in _quantiles(discordant, share):
            widths.append(_tango_width(improved, discordant - improved, num_pairs))
    return float(np.mean(widths))


@lru_cache(maxsize=65_536)
def _tango_width(improved: int, worsened: int, num_pairs: int) -> float:
    found = tango_difference(improved, worsened, num_pairs)
    return found.high - found.low


def pairs_for_width(p_improved: float, p_worsened: float, width: float) -> int:
    """Return the pairs with which Tango's interval is expected to be no wider than ``width``.

    Raises:
        UndefinedStatisticError: When 4,000 pairs are not enough.
    """
    return _halved(lambda n: paired_width(p_improved, p_worsened, n) <= width, "pairs")


def rate_width(rate: float, num_trials: int, *, method: str = "wilson") -> float:
    """Return the expected width of the interval of a rate."""
    ends = [RATE_INTERVALS[method](k, num_trials) for k in range(num_trials + 1)]
    mass = np.diff(bdtr(np.arange(num_trials + 1), num_trials, rate), prepend=0.0)
    return float(mass @ np.array([each.high - each.low for each in ends]))


def power_above(
    rate: float, limit: float, num_trials: int, *, alpha: float = ALPHA, method: str = "wilson"
) -> float:
    """Return the chance that the interval of a rate lies above a limit."""
    make = RATE_INTERVALS[method]
    low, high = -1, num_trials  # the lower end rises with k: the last that is not above
    while low < high:
        k = (low + high + 1) // 2
        low, high = (k, high) if make(k, num_trials, level=1 - alpha).low <= limit else (low, k - 1)
    return 1.0 - float(bdtr(low, num_trials, rate)) if low >= 0 else 1.0


def trials_above(
    rate: float,
    limit: float,
    *,
    power: float = POWER,
    alpha: float = ALPHA,
    method: str = "wilson",
) -> int:
    """Return the trials with which the interval of a rate lies above a limit.

    Raises:
        UndefinedStatisticError: When the rate is not above the limit, or 4,000 are not enough.
    """
    if rate <= limit:
        reason = f"a rate of {100 * rate:g} % is not above {100 * limit:g} %"
        raise UndefinedStatisticError(statistic="trials", reason=reason)
    return _smallest(
        lambda n: power_above(rate, limit, n, alpha=alpha, method=method) >= power, "trials"
    )


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values adjusted for all of them being asked (Holm 1979), in the given order."""
    adjusted, largest = [0.0] * len(p_values), 0.0
    order = sorted(range(len(p_values)), key=lambda place: p_values[place])
    for rank, place in enumerate(order):
        largest = max(largest, min(1.0, (len(p_values) - rank) * p_values[place]))
        adjusted[place] = largest
    return adjusted


def _quantiles(n: int, rate: float) -> list[int]:
    """Return equally likely values of a binomial count."""
    below = bdtr(np.arange(n + 1), n, rate)
    shares = (np.arange(PARTS) + 0.5) / PARTS
    return [int(place) for place in np.minimum(np.searchsorted(below, shares), n)]


def _halved(enough: Callable[[int], bool], counted: str) -> int:
    """Return the smallest number that is enough, where all larger ones are, too."""
    high = 8
    while not enough(high):
        high *= 2
        if high > MOST:
            _refuse(counted)
    low = 0 if high == 8 else high // 2
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if enough(middle) else (middle, high)
    return high


def _smallest(enough: Callable[[int], bool], counted: str) -> int:
    """Return the smallest number from which on some further ones are enough, too."""
    near = _halved(enough, counted)
    start = max(1, near - near // 4 - STAYS)
    run = 0
    for n in range(start, MOST):
        run = run + 1 if enough(n) else 0
        if run > STAYS:
            return n - STAYS
    return _refuse(counted)


def _refuse(counted: str) -> int:
    raise UndefinedStatisticError(statistic=counted, reason=f"more than {MOST} {counted}")
