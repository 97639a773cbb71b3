"""Coverage by counting every outcome out: no random numbers, so no noise in the worst case."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from scipy.special import gammaln, xlogy

from evaluator.result import Interval

RATES = np.round(np.arange(0.05, 0.9501, 0.01), 2)
"""True rates of one group: 0.05, 0.06 .. 0.95."""
PAIR_RATES = np.round(np.arange(0.05, 0.9501, 0.05), 2)
"""True rates of two groups, and of the two ways in which a pair can differ."""
ROOM = 1e-12
"""An end that is the truth but for rounding covers it."""


@dataclass(frozen=True, kw_only=True)
class Coverage:
    """How often an interval held the truth, over the true rates looked at."""

    n: int
    worst: float
    worst_at: str
    mean: float


def of_rate(interval: Callable[[int, int], Interval], n: int) -> Coverage:
    """Coverage of a binomial interval at n trials, over rates 0.05 .. 0.95."""
    from scipy.stats import binom  # noqa: PLC0415  # half a second, and only the map is made of it

    ends = np.array([(i.low, i.high) for i in (interval(k, n) for k in range(n + 1))])
    held = (ends[:, :1] <= RATES + ROOM) & (ends[:, 1:] >= RATES - ROOM)
    chances = binom.pmf(np.arange(n + 1)[:, None], n, RATES)
    covered = (chances * held).sum(axis=0)
    return _summary(n, covered, [f"p = {rate:.2f}" for rate in RATES])


def of_difference(interval: Callable[[int, int, int, int], Interval], n: int) -> Coverage:
    """Coverage of an interval of second - first with n trials in each of two groups."""
    from scipy.stats import binom  # noqa: PLC0415  # as above

    counts = range(n + 1)
    made = [[interval(first, n, second, n) for second in counts] for first in counts]
    low = np.array([[item.low for item in row] for row in made])
    high = np.array([[item.high for item in row] for row in made])
    chances = binom.pmf(np.arange(n + 1)[:, None], n, PAIR_RATES)
    covered, names = [], []
    for i, p_first in enumerate(PAIR_RATES):
        for j, p_second in enumerate(PAIR_RATES):
            held = _holds(low, high, p_second - p_first)
            covered.append(float(chances[:, i] @ held @ chances[:, j]))
            names.append(f"p = {p_first:.2f} and {p_second:.2f}")
    return _summary(n, np.array(covered), names)


def of_paired_difference(interval: Callable[[int, int, int], Interval], n: int) -> Coverage:
    """Coverage of an interval of P(improved) - P(worsened) over n pairs."""
    outcomes = [(b, c) for b in range(n + 1) for c in range(n + 1 - b)]
    made = [interval(b, c, n) for b, c in outcomes]
    low, high = np.array([i.low for i in made]), np.array([i.high for i in made])
    b, c = np.array(outcomes).T
    ways = gammaln(n + 1) - gammaln(b + 1) - gammaln(c + 1) - gammaln(n - b - c + 1)
    covered, names = [], []
    for p_improved in PAIR_RATES:
        for p_worsened in PAIR_RATES:
            same = 1 - p_improved - p_worsened
            if same < -ROOM:
                continue
            logs = xlogy(b, p_improved) + xlogy(c, p_worsened) + xlogy(n - b - c, max(0.0, same))
            held = _holds(low, high, p_improved - p_worsened)
            covered.append(float(np.exp(ways + logs)[held].sum()))
            names.append(f"p = {p_improved:.2f} better, {p_worsened:.2f} worse")
    return _summary(n, np.array(covered), names)


def _holds(low: np.ndarray, high: np.ndarray, truth: float) -> Bool[np.ndarray, "*outcomes"]:
    return np.asarray((low <= truth + ROOM) & (high >= truth - ROOM))


def _summary(n: int, covered: Float64[np.ndarray, " rates"], names: Sequence[str]) -> Coverage:
    worst = int(covered.argmin())
    return Coverage(
        n=n, worst=float(covered[worst]), worst_at=names[worst], mean=float(covered.mean())
    )
