"""Do the intervals hold what they promise? Asked before one is printed; some are refused.

Intervals of one rate and of the difference of two are counted out for these numbers of trials.
The others were simulated once: ``HOLDS_FROM`` is the number from which on each covers 90 %.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from jaxtyping import Float64
from scipy.special import gammaln, xlog1py, xlogy

from evaluator.result import Interval
from evaluator.statistics.intervals import RATE_INTERVALS, wilson

FLOOR = 0.90
"""An interval that claims 95 % and covers less than this somewhere is not printed."""
JUDGED_BY_MEAN = ("wilson", "clopper-pearson")
"""Printed everywhere: Clopper-Pearson holds by construction; Wilson's dips are narrow and its mean
over rates is right, which is what it is for."""
NEWCOMBE = "newcombe-10"
INSTEAD = {
    "jeffreys": "wilson or clopper-pearson",
    NEWCOMBE: "clopper-pearson-difference",
    "tango": "McNemar's exact test, which needs no interval",
}
HOLDS_FROM = {
    "tango": (5, "pairs"),
    "student-t:length": (50, "episodes"),
    "jackknife-points:mmrv-recorded": (15, "groups"),
    "remeasurement:spearman": (6, "groups"),
    "remeasurement:order": (6, "groups"),
    "remeasurement:mmrv-recorded": (4, "groups"),
}
"""Smallest number that an interval is printed for, and what it counts; any where none is named."""
Size = int | tuple[int, int]
RATES = np.round(np.arange(0.05, 0.9501, 0.01), 2)
"""True rates of one group."""
PAIR_RATES = np.round(np.arange(0.05, 0.9501, 0.05), 2)
"""True rates of each of two groups."""
ROOM = 1e-12
"""An end that is the truth but for rounding covers it."""
MOST = 200
"""A larger group is taken as one of this size: its own rate is as good as known then."""


@dataclass(frozen=True, kw_only=True)
class Coverage:
    """How often an interval held the truth, over the true rates looked at."""

    worst: float
    worst_at: str
    mean: float


def vouch(
    interval: Interval, n: Size | None, *, key: str = "", instead: str = ""
) -> tuple[Interval | None, str]:
    """Return the interval, a rate's with its worst coverage, or None and why it is not printed.

    Only 95 % intervals were looked at; those of other levels pass unmarked.

    Args:
        n: What the method's coverage depends on: trials, pairs, groups, policies; of a difference
            the trials of both groups.
        instead: What to use where it is refused; what the method's own entry says without.
    """
    method = interval.method.split(",")[0]
    if n is None or interval.level != 0.95:
        return interval, ""
    sizes = n if isinstance(n, tuple) else (n,)
    instead = instead or INSTEAD.get(method, "")
    enough, unit = HOLDS_FROM.get(key or method, (0, ""))
    if min(sizes) < enough:
        return None, (
            f"{method} at {min(sizes)} {unit} covers less than {100 * FLOOR:.0f} % where 95 % are "
            f"claimed; use {instead or f'the value with its n, or {enough} {unit}'}"
        )
    known = _counted_out(method, sizes)
    if known is None:
        return interval, ""
    if method not in JUDGED_BY_MEAN and known.worst < FLOOR:
        at = " and ".join(map(str, dict.fromkeys(sizes)))
        return None, (
            f"{method} at {at} trials covers as little as {100 * known.worst:.1f} % where 95 % "
            f"are claimed ({known.worst_at}); use {instead}"
        )
    return replace(interval, worst_coverage=round(known.worst, 4)), ""


def _counted_out(method: str, sizes: tuple[int, ...]) -> Coverage | None:
    if method in RATE_INTERVALS:
        return rate_coverage(method, min(*sizes, MOST))
    if method == NEWCOMBE:
        return newcombe_coverage(sizes[0], sizes[-1])
    return None


@lru_cache(maxsize=512)
def rate_coverage(method: str, n: int) -> Coverage:
    """Count out how often the interval of a rate holds it, over rates 0.05, 0.06 .. 0.95."""
    _, low, high = _ends(RATE_INTERVALS[method], n)
    held = (low <= RATES[:, None] + ROOM) & (high >= RATES[:, None] - ROOM)
    covered = (_chances(n, RATES) * held).sum(axis=1)
    worst = int(covered.argmin())
    return Coverage(
        worst=float(covered[worst]), worst_at=f"p = {RATES[worst]:.2f}", mean=float(covered.mean())
    )


@lru_cache(maxsize=512)
def newcombe_coverage(n_first: int, n_second: int) -> Coverage:
    """Count out how often the interval of a difference holds it, over rates 0.05, 0.10 .. 0.95."""
    sizes = min(n_first, MOST), min(n_second, MOST)
    (p_first, low_first, high_first), (p_second, low_second, high_second) = (
        _ends(wilson, size) for size in sizes
    )
    difference = p_second - p_first[:, None]
    low = difference - np.hypot(p_second - low_second, (high_first - p_first)[:, None])
    high = difference + np.hypot(high_second - p_second, (p_first - low_first)[:, None])
    chances_first, chances_second = (_chances(size, PAIR_RATES) for size in sizes)
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
    return Coverage(worst=worst, worst_at=worst_at, mean=total / len(PAIR_RATES) ** 2)


def _ends(interval: Callable[[int, int], Interval], n: int) -> Float64[np.ndarray, "3 counts"]:
    """Rate and interval's ends of every count."""
    found = [(k / n, made.low, made.high) for k in range(n + 1) for made in [interval(k, n)]]
    return np.array(found).T


def _chances(n: int, rates: Float64[np.ndarray, " rates"]) -> Float64[np.ndarray, "rates counts"]:
    k, p = np.arange(n + 1), rates[:, None]
    ways = gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1)
    return np.asarray(np.exp(ways + xlogy(k, p) + xlog1py(n - k, -p)))
