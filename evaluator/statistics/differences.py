"""Has a rate changed? Same starts: McNemar, sign test, Tango; other starts: Newcombe, Boschloo."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from jaxtyping import Float
from numpy.lib.stride_tricks import sliding_window_view
from scipy.special import gammaln

from evaluator.errors import UndefinedStatisticError
from evaluator.result import Interval
from evaluator.statistics.intervals import (
    LEVEL,
    ImpossibleCountError,
    check_count,
    clopper_pearson,
    normal_quantile,
    wilson,
)

BISECTIONS = 60
"""Halvings of an interval of length 2; what is left is below the spacing of floats near 1."""


@dataclass(frozen=True, kw_only=True)
class McNemar:
    """A paired yes/no comparison."""

    improved: int
    """Failed before, succeeded after."""
    worsened: int
    """Succeeded before, failed after."""
    p_exact: float
    """Two-sided binomial test on the discordant pairs."""
    p_mid: float
    """The same with the mid-p correction (less conservative; Fagerland 2013)."""


def mcnemar(pairs: Iterable[tuple[bool, bool]]) -> McNemar:
    """Test pairs (before, after) of the same start for a change in success."""
    seen = list(pairs)
    improved = sum(after and not before for before, after in seen)
    worsened = sum(before and not after for before, after in seen)
    if improved + worsened == 0:
        raise UndefinedStatisticError(
            statistic="McNemar's test",
            reason=f"none of the {len(seen)} pairs differ between the conditions"
            if seen
            else "there are no pairs",
        )
    p_exact, p_mid = sign_test(improved, worsened)
    return McNemar(improved=improved, worsened=worsened, p_exact=p_exact, p_mid=p_mid)


def sign_test(improved: int, worsened: int) -> tuple[float, float]:
    """Return the two-sided exact p and mid-p of Binomial(improved + worsened, 1/2)."""
    discordant, smaller = improved + worsened, min(improved, worsened)
    # Whole numbers as long as possible: exact for any count.
    below, here = 0, 1
    for i in range(smaller):  # each binomial coefficient from the one before
        below, here = below + here, here * (discordant - i) // (i + 1)
    total = 2**discordant
    p_exact, p_mid = 2 * (below + here) / total, (2 * below + here) / total
    return min(1.0, p_exact), min(1.0, p_mid)


def tango_difference(improved: int, worsened: int, n: int, *, level: float = LEVEL) -> Interval:
    """Return the score interval of P(after) - P(before) over pairs (Tango 1998).

    All differences d that the score test with the variance under d does not reject, found by
    bisection; the restricted estimate of the worsened probability is the larger root of
    Tango's quadratic (his equations 4 and 5).
    """
    if n == 0:
        raise UndefinedStatisticError(statistic="Tango interval", reason="there are no pairs")
    if min(improved, worsened) < 0 or improved + worsened > n:
        raise ImpossibleCountError(k=improved + worsened, n=n)
    z = normal_quantile(0.5 + level / 2)
    estimate = (improved - worsened) / n
    low = -1.0 if worsened == n else -_upper_end(worsened, improved, n, z, -estimate)
    high = 1.0 if improved == n else _upper_end(improved, worsened, n, z, estimate)
    return Interval(low=low, high=high, level=level, method="tango")


def tango_points(improved: int, worsened: int, n: int) -> tuple[float, Interval]:
    """Return the paired difference and its ``tango_difference``, both in percentage points."""
    fraction = tango_difference(improved, worsened, n)
    interval = replace(fraction, low=100 * fraction.low, high=100 * fraction.high)
    return 100 * (improved - worsened) / n, interval


def _upper_end(improved: int, worsened: int, n: int, z: float, estimate: float) -> float:
    """Find the difference above the estimate where the score reaches -z."""
    inside, outside = estimate, 1.0
    for _ in range(BISECTIONS):
        middle = (inside + outside) / 2
        if _score(improved, worsened, n, middle) > -z:
            inside = middle
        else:
            outside = middle
    return inside


def _score(improved: int, worsened: int, n: int, difference: float) -> float:
    """Tango's statistic: observed minus supposed difference in restricted standard errors."""
    d = difference
    b = (2 * n - improved + worsened) * d - improved - worsened
    c = -worsened * d * (1 - d)
    root = math.sqrt(max(0.0, b * b - 8 * n * c))
    # The larger root of 2n q^2 + b q + c, written so that nothing cancels.
    restricted = (root - b) / (4 * n) if b <= 0 else -2 * c / (b + root)
    variance = n * (2 * restricted + d * (1 - d))
    distance = improved - worsened - n * d
    if variance <= 0:
        return math.copysign(math.inf, distance) if distance else 0.0
    return distance / math.sqrt(variance)


MAX_TABLES = 4_000_000
"""Boschloo's test looks at every possible pair of counts; beyond this a normal test is as good."""
SEARCH_POINTS = 2001
TIE = 1e-10
"""Relative room in comparing Fisher's p of two tables, so that equal ones are equal."""
GOLDEN = (math.sqrt(5) - 1) / 2
LOG_TAIL = 80.0
"""Counts less probable than e^-80 = 2e-35 are left out of sums."""
ROOM = 1 << 17
"""Numbers held at once in searching a grid [1 MB]."""


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
    """
    check_count(k_first, n_first)
    check_count(k_second, n_second)
    if (n_first + 1) * (n_second + 1) > MAX_TABLES:
        raise UndefinedStatisticError(
            statistic="Boschloo's test",
            reason=f"{n_first} and {n_second} trials have more than {MAX_TABLES} tables; "
            "read Newcombe's interval",
        )
    fisher, total = _fisher(n_first, n_second), k_first + k_second
    # One side of the two is read in the mirrored table; only the smaller one counts.
    sides = [
        _weights(fisher, k_first, k_second),
        _weights(fisher, n_first - k_first, n_second - k_second),
    ]
    pooled = np.array([(total + 0.5) / (n_first + n_second + 1)])
    at_least = [float(_at(pooled, sides[0])[0]), float(_at(1 - pooled, sides[1])[0])]
    first = int(at_least[1] < at_least[0])
    smaller = _largest(sides[first])
    if at_least[1 - first] < smaller:  # else the other side is the larger one for certain
        smaller = min(smaller, _largest(sides[1 - first]))
    return min(1.0, 2 * smaller)


@lru_cache(maxsize=2)
def _fisher(n_first: int, n_second: int) -> Float[np.ndarray, "first second"]:
    """Fisher's one-sided p of each pair of counts: few successes in the first group.

    They follow from the sizes of the groups alone, and a run has few: both sides of a test and the
    groups of all tasks share them.
    """
    first, second = _log_choose(n_first), _log_choose(n_second)
    both = _log_choose(n_first + n_second)
    logs = np.add.outer(first, second)
    logs -= sliding_window_view(both, n_second + 1)  # row k: of the totals k, k + 1, ...
    fisher: np.ndarray = np.exp(logs, out=logs)
    for k in range(1, n_first + 1):
        # Same total, one success less in the first group: the anti-diagonal neighbour.
        fisher[k, :-1] += fisher[k - 1, 1:]
    fisher.flags.writeable = False
    return fisher


def _weights(
    fisher: Float[np.ndarray, "first second"], k_first: int, k_second: int
) -> Float[np.ndarray, " totals"]:
    """P, given each total of successes, of a table that Fisher's p ranks at least as extreme.

    Along one total Fisher's p adds up the tables from the most extreme one on, so the answer is the
    largest that is not above the table's own, found by halving.
    """
    n_first, n_second = fisher.shape[0] - 1, fisher.shape[1] - 1
    limit = fisher[k_first, k_second] * (1 + TIE)
    totals = np.arange(n_first + n_second + 1)
    least = np.maximum(0, totals - n_second)
    low, high = least - 1, np.minimum(n_first, totals)  # around the last count inside
    for _ in range((n_first + 1).bit_length()):
        middle = np.maximum((low + high + 1) // 2, least)
        is_inside = (fisher[middle, totals - middle] <= limit) | (low == high)
        low = np.where(is_inside, np.minimum(middle, high), low)
        high = np.where(is_inside, high, middle - 1)
    k = np.maximum(low, least)
    return np.asarray(np.where(low < least, 0.0, fisher[k, totals - k]))


def _log_choose(n: int) -> Float[np.ndarray, " counts"]:
    k = np.arange(n + 1)
    return np.asarray(gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1))


def _at(
    rates: Float[np.ndarray, " rates"], weights: Float[np.ndarray, " totals"]
) -> Float[np.ndarray, " rates"]:
    """Return the sum over s of weights[s] Binomial(s; N, p) at ascending rates p in 0 < p < 1.

    Totals that far from N p that Bernstein's inequality gives them less than e^-LOG_TAIL are left
    out: no weight exceeds Fisher's p of the table, so they add nothing to it that could be seen.
    """
    n = len(weights) - 1
    variance = n * float((rates * (1 - rates)).max())
    reach = LOG_TAIL / 3 + math.sqrt((LOG_TAIL / 3) ** 2 + 2 * LOG_TAIL * variance)
    low = max(0, math.floor(n * rates[0] - reach))
    high = min(n, math.ceil(n * rates[-1] + reach)) + 1
    chosen = low + np.flatnonzero(weights[low:high])
    logs = np.log(rates)[:, None] * chosen
    logs += np.log1p(-rates)[:, None] * (n - chosen)
    logs += _log_choose(n)[chosen]
    return np.asarray(np.exp(logs, out=logs) @ weights[chosen])


def _largest(weights: Float[np.ndarray, " totals"]) -> float:
    """Largest value over rates p in 0..1 of sum_s weights[s] Binomial(s; N, p)."""
    grid = np.linspace(0, 1, SEARCH_POINTS + 2)[1:-1]
    rows = max(1, ROOM // len(weights))  # what fits the processor's cache takes a third of the time
    values = np.concatenate([_at(grid[i : i + rows], weights) for i in range(0, len(grid), rows)])
    best = int(values.argmax())
    # At p = 0 and 1 only the tables without any, or with only successes, are possible.
    ends = max(float(weights[0]), float(weights[-1]))
    step = grid[1] - grid[0]
    low, high = max(grid[best] - step, step / 1e6), min(grid[best] + step, 1 - step / 1e6)
    for _ in range(40):
        a, b = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
        left, right = _at(np.array([a, b]), weights)
        low, high = (low, b) if left > right else (a, high)
    polished = float(_at(np.array([(low + high) / 2]), weights)[0])
    return min(1.0, max(ends, float(values[best]), polished))


def mean_of_intervals(values: Sequence[float], intervals: Sequence[Interval]) -> Interval:
    """Return the interval of a mean of independent estimates from the interval of each.

    Distances to the ends are added as variances are: the mean of one is its own interval, of
    differences with Wilson's ends Newcombe's method carried on (Zou and Donner 2008, equation 2).
    """
    if not values:
        raise UndefinedStatisticError(statistic="interval of a mean", reason="there are none")
    mean = sum(values) / len(values)
    pairs = list(zip(values, intervals, strict=True))
    below = math.sqrt(sum((value - each.low) ** 2 for value, each in pairs)) / len(values)
    above = math.sqrt(sum((each.high - value) ** 2 for value, each in pairs)) / len(values)
    method = " and ".join(dict.fromkeys(each.method for each in intervals))
    first = intervals[0]
    return Interval(low=mean - below, high=mean + above, level=first.level, method=f"mean-{method}")
