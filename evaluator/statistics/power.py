"""How many trials a question needs, before or after somebody ran too few."""

import math
from functools import lru_cache

import numpy as np
from jaxtyping import Int64

from evaluator.errors import UndefinedStatisticError
from evaluator.statistics.intervals import normal_quantile

ALPHA = 0.05
"""Two-sided."""
POWER = 0.8
MAX_PAIRS = 4_000
"""The exact paired power counts every outcome out; beyond this a normal formula is as good."""


def trials_needed(
    p_first: float,
    p_second: float,
    *,
    power: float = POWER,
    alpha: float = ALPHA,
    sides: int = 2,
) -> int:
    """Return the trials per arm with which a difference of two rates is found.

    The smallest n with the wanted power by the formula of ``power_unpaired`` (one tail counted,
    as its closed form has it): 82 per arm for 60 % against 80 %.

    Args:
        sides: 2 for a difference in either direction, 1 where only one direction counts.

    Raises:
        UndefinedStatisticError: For equal rates: no number of trials is enough.
    """
    _check_rates(p_first, p_second)
    pooled, separate = _spreads(p_first, p_second)
    z = normal_quantile(1 - alpha / sides)
    root = (z * pooled + normal_quantile(power) * separate) / abs(p_second - p_first)
    return max(1, math.ceil(root * root))


def detectable_rate(
    p_first: float, n_per_arm: int, *, power: float = POWER, alpha: float = ALPHA
) -> float:
    """Return the smallest better rate that n trials per arm would show with this power.

    Raises:
        UndefinedStatisticError: When even a rate of 1 would not show.
    """
    if n_per_arm < 1:
        raise UndefinedStatisticError(statistic="detectable rate", reason="there are no trials")
    if p_first >= 1 or trials_needed(p_first, 1.0, power=power, alpha=alpha) > n_per_arm:
        raise UndefinedStatisticError(
            statistic="detectable rate",
            reason=f"with {n_per_arm} trials per arm not even a rate of 100 % would be told from "
            f"{100 * p_first:.0f} %",
        )
    low, high = p_first, 1.0
    for _ in range(50):
        middle = (low + high) / 2
        # Nothing is ever enough to tell equal rates apart.
        close = middle - p_first < 1e-9
        enough = not close and trials_needed(p_first, middle, power=power, alpha=alpha)
        low, high = (low, middle) if enough and enough <= n_per_arm else (middle, high)
    return high


def power_paired(
    p_improved: float,
    p_worsened: float,
    num_pairs: int,
    *,
    alpha: float = ALPHA,
    mid: bool = False,
) -> float:
    """Return the chance that McNemar's exact test on n pairs is significant.

    By counting out: sum over the number of pairs that differ, and over how many of them improved.

    Args:
        num_pairs: Pairs, those without a change included; 1 to 4,000.

    Raises:
        UndefinedStatisticError: Beyond 4,000 pairs, or without pairs that can differ.
    """
    differ = p_improved + p_worsened
    if not 0 < differ <= 1 + 1e-12 or min(p_improved, p_worsened) < 0:
        raise UndefinedStatisticError(
            statistic="paired power",
            reason=f"the chances to improve ({p_improved:g}) and to worsen ({p_worsened:g}) are "
            "no probabilities of pairs that differ",
        )
    if not 1 <= num_pairs <= MAX_PAIRS:
        raise UndefinedStatisticError(
            statistic="paired power",
            reason=f"{num_pairs} pairs; it is counted out for 1 to {MAX_PAIRS}",
        )
    from scipy.stats import binom  # noqa: PLC0415  # half a second; beyond these pairs not needed

    discordant = np.arange(1, num_pairs + 1)
    least = _largest_shown(num_pairs, alpha, mid)[1:]
    share = p_improved / differ
    shown = binom.cdf(least, discordant, share) + binom.cdf(least, discordant, 1 - share)
    return min(1.0, float(binom.pmf(discordant, num_pairs, min(differ, 1.0)) @ shown))


@lru_cache(maxsize=256)
def _largest_shown(num_pairs: int, alpha: float, mid: bool) -> Int64[np.ndarray, " discordant"]:
    """The largest smaller count of 0, 1, 2 .. differing pairs that is significant; -1 for none."""
    from scipy.stats import binom  # noqa: PLC0415

    discordant = np.arange(num_pairs + 1)
    first = binom.ppf(alpha / 2, discordant, 0.5)  # the first whose tail reaches alpha / 2
    tail = binom.cdf(first, discordant, 0.5)
    if mid:
        tail = tail - binom.pmf(first, discordant, 0.5) / 2
    found = np.where(tail <= alpha / 2, first, first - 1).astype(np.int64)
    found[0] = -1
    return np.asarray(found)


def _spreads(p_first: float, p_second: float) -> tuple[float, float]:
    """Standard deviation of the difference for one trial per arm: pooled, and separate."""
    mean = (p_first + p_second) / 2
    separate = p_first * (1 - p_first) + p_second * (1 - p_second)
    return math.sqrt(2 * mean * (1 - mean)), math.sqrt(separate)


def _check_rates(p_first: float, p_second: float) -> None:
    if not (0 <= p_first <= 1 and 0 <= p_second <= 1):
        message = f"rates lie in 0..1, not {p_first} and {p_second}"
        raise ValueError(message)
    if p_first == p_second:
        raise UndefinedStatisticError(
            statistic="power", reason="the rates are equal; no number of trials shows a difference"
        )
