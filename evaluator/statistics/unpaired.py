"""Two groups of trials that share no starts: Newcombe's interval, Boschloo's exact test."""

import math
from functools import lru_cache

import numpy as np
from jaxtyping import Float
from scipy.special import gammaln

from evaluator.errors import UndefinedStatisticError
from evaluator.result import Interval
from evaluator.statistics.proportion import LEVEL, check_count, clopper_pearson, wilson

MAX_TABLES = 4_000_000
"""Boschloo's test looks at every possible pair of counts; beyond this a normal test is as good."""
SEARCH_POINTS = 2001
TIE = 1e-10
"""Relative room in comparing Fisher's p of two tables, so that equal ones are equal."""
GOLDEN = (math.sqrt(5) - 1) / 2
ROOM = 1 << 15
"""Numbers held at once in searching a grid [256 kB]."""


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


def guaranteed_difference(
    k_first: int, n_first: int, k_second: int, n_second: int, *, level: float = LEVEL
) -> Interval:
    """Return an interval of second - first that covers at least ``level``, whatever is true.

    The difference of two Clopper-Pearson intervals, each at (1 + level) / 2: by Bonferroni both
    hold together with at least ``level``. Wide; for where Newcombe's is refused.
    """
    each = (1 + level) / 2
    first = clopper_pearson(k_first, n_first, level=each)
    second = clopper_pearson(k_second, n_second, level=each)
    return Interval(
        low=second.low - first.high,
        high=second.high - first.low,
        level=level,
        method="clopper-pearson-difference",
    )


def boschloo(k_first: int, n_first: int, k_second: int, n_second: int) -> float:
    """Return the two-sided p of Boschloo's exact unconditional test (1970) for equal rates.

    Fisher's one-sided p orders the tables; the p-value is the largest probability, over the
    unknown common rate, of a table at least as extreme. Two-sided is twice the smaller side, as
    SciPy has it. Given the total s of successes, the probability of the region is fixed, so the
    p-value is a polynomial in the rate with s = 0..N as terms; it is searched on a grid and
    polished.

    Raises:
        UndefinedStatisticError: Without trials, or for groups whose tables cannot be counted out.
        ImpossibleCountError: For counts that cannot be.
    """
    check_count(k_first, n_first)
    check_count(k_second, n_second)
    if (n_first + 1) * (n_second + 1) > MAX_TABLES:
        raise UndefinedStatisticError(
            statistic="Boschloo's test",
            reason=f"{n_first} and {n_second} trials have more than {MAX_TABLES} tables; "
            "read Newcombe's interval",
        )
    greater = _one_sided(k_first, n_first, k_second, n_second)
    less = _one_sided(n_first - k_first, n_first, n_second - k_second, n_second)
    return min(1.0, 2 * min(greater, less))


def _one_sided(k_first: int, n_first: int, k_second: int, n_second: int) -> float:
    """P of a table that speaks at least as strongly for a higher rate in the second group."""
    given_total, fisher = _tables(n_first, n_second)
    region = fisher <= fisher[k_first, k_second] * (1 + TIE)
    totals = np.add.outer(np.arange(n_first + 1), np.arange(n_second + 1))
    weights = np.bincount(totals[region], given_total[region], minlength=n_first + n_second + 1)
    return _largest(weights)


@lru_cache(maxsize=2)
def _tables(
    n_first: int, n_second: int
) -> tuple[Float[np.ndarray, "first second"], Float[np.ndarray, "first second"]]:
    """Probability of each pair of counts given their sum (hypergeometric), and Fisher's p of it.

    They follow from the sizes of the groups alone, and a run has few: both sides of a test and the
    cells of all tasks share them.
    """
    first, second = _log_choose(n_first), _log_choose(n_second)
    both = _log_choose(n_first + n_second)
    totals = np.add.outer(np.arange(n_first + 1), np.arange(n_second + 1))
    given_total = np.asarray(np.exp(np.add.outer(first, second) - both[totals]))
    fisher = given_total.copy()
    for k in range(1, n_first + 1):
        # Same total, one success less in the first group: the anti-diagonal neighbour.
        fisher[k, :-1] += fisher[k - 1, 1:]
    given_total.flags.writeable = fisher.flags.writeable = False
    return given_total, fisher


def _log_choose(n: int) -> Float[np.ndarray, " counts"]:
    k = np.arange(n + 1)
    return np.asarray(gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1))


def _largest(weights: Float[np.ndarray, " totals"]) -> float:
    """Largest value over rates p in 0..1 of sum_s weights[s] Binomial(s; N, p)."""
    chosen = np.flatnonzero(weights)
    log_choose = _log_choose(len(weights) - 1)[chosen] + np.log(weights[chosen])

    def at(rates: Float[np.ndarray, " rates"]) -> Float[np.ndarray, " rates"]:
        logs = np.log(rates)[:, None] * chosen
        logs += np.log1p(-rates)[:, None] * (len(weights) - 1 - chosen)
        return np.asarray(np.exp(logs + log_choose).sum(axis=1))

    grid = np.linspace(0, 1, SEARCH_POINTS + 2)[1:-1]
    # What fits the processor's cache takes a third of the time; each rate's sum stays the same.
    rows = max(1, ROOM // len(chosen))
    values = np.concatenate([at(grid[i : i + rows]) for i in range(0, len(grid), rows)])
    best = int(values.argmax())
    # At p = 0 and 1 only the tables without any, or with only successes, are possible.
    ends = max(float(weights[0]), float(weights[-1]))
    step = grid[1] - grid[0]
    low, high = max(grid[best] - step, step / 1e6), min(grid[best] + step, 1 - step / 1e6)
    for _ in range(40):
        a, b = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
        left, right = at(np.array([a, b]))
        low, high = (low, b) if left > right else (a, high)
    polished = float(at(np.array([(low + high) / 2]))[0])
    return min(1.0, max(ends, float(values[best]), polished))
