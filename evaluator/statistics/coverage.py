"""Do the intervals hold what they promise? Asked before one is printed; some are refused.

The stored map, made by ``benchmarks/bench_evaluate_coverage.py``, holds groups of equal size. The
smaller group's entry is no bound for others (with 10 and 16 trials Newcombe's interval covers as
little as 88.3 %, with 10 and 10 at least 90.9 %), so groups of different size are counted out when
they are asked for.
"""

import json
from bisect import bisect_left
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from importlib import resources

import numpy as np
from jaxtyping import Float64
from scipy.special import gammaln, xlog1py, xlogy

from evaluator.result import Interval
from evaluator.statistics.bootstrap import METHODS
from evaluator.statistics.intervals import wilson

FLOOR = 0.90
"""An interval that claims 95 % and covers less than this somewhere is not printed."""
JUDGED_BY_MEAN = ("wilson", "clopper-pearson")
"""Printed everywhere: Clopper-Pearson holds by construction; Wilson's dips are narrow and its mean
over rates is right, which is what it is for."""
INSTEAD = {
    "jeffreys": "wilson or clopper-pearson",
    "newcombe-10": "clopper-pearson-difference",
    "tango": "McNemar's exact test, which needs no interval",
    "fisher-z": "the coefficient with its n, or more groups",
    "bootstrap-points": "fisher-z for r, student-t for means, or more groups",
    "bootstrap-clusters": "more policies: no interval holds with so few",
    "bootstrap-expanded-points": "the value with its n, or more groups",
    "bootstrap-expanded-clusters": "the value with its n, or more policies",
    "jackknife-points": "the value with its n, or more groups",
    "jackknife-clusters": "the value with its n, or more policies",
    "student-t": "the value with its n, or more groups",
    "post-stratified-beta": "wilson on the robot trials alone",
    "ppi++": "post-stratified-beta",
    "remeasurement": "the coefficient with its n",
}
MAP = "coverage_map.json"
NEWCOMBE = "newcombe-10"
Size = int | tuple[int, int]


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


@dataclass(frozen=True, kw_only=True)
class MethodCoverage:
    """The stored coverage of one method over n."""

    how: str
    """exact, or simulated with how many draws."""
    over: str
    """Which truths were looked at."""
    axis: str
    """What n counts."""
    points: tuple[Coverage, ...]
    """By rising n."""


@cache
def load_map() -> dict[str, MethodCoverage]:
    """Read the map that ships with the package, by name of method."""
    record = json.loads(resources.files("evaluator.statistics").joinpath(MAP).read_text())
    return {
        name: MethodCoverage(
            how=item["how"],
            over=item["over"],
            axis=item["axis"],
            points=tuple(Coverage(**point) for point in item["points"]),
        )
        for name, item in record["methods"].items()
    }


def coverage_of(method: str, n: int) -> Coverage | None:
    """Return the stored coverage of a method at n, the worse of the two stored neighbours.

    Above the largest stored n that one counts; below the smallest nothing is known.

    Args:
        method: Name in the coverage map; None is returned for one that it does not hold.
        n: What the method's coverage depends on: trials, pairs, groups or policies.
    """
    found = load_map().get(method)
    if found is None or n < found.points[0].n:
        return None
    sizes = [point.n for point in found.points]
    place = bisect_left(sizes, n)
    if place == len(sizes):
        return found.points[-1]
    if sizes[place] == n:
        return found.points[place]
    return min(found.points[place - 1 : place + 1], key=lambda point: point.worst)


def vouch(
    interval: Interval, n: Size | None, *, key: str = "", instead: str = ""
) -> tuple[Interval | None, str]:
    """Return the interval with its worst coverage, or None and why it is not printed.

    Only 95 % intervals were looked at; those of other levels, and methods that are not in the map,
    pass unmarked. A ``key`` that is not in the map is refused.

    Args:
        interval: What a method gave.
        n: What the method's coverage depends on: trials, pairs, groups, policies; of a difference
            the trials of both groups.
        key: Name in the map, where one method serves several statistics; its own without.
        instead: What to use where it is refused; what the method's own entry says without.
    """
    method = interval.method.split(",")[0]
    instead = instead or INSTEAD.get(method, "more data")
    if n is None or interval.level != 0.95 or (not key and method not in load_map()):
        return interval, ""
    key = key or method
    if key not in load_map():
        return None, f"the coverage of {method} for this statistic is not known; use {instead}"
    sizes = n if isinstance(n, tuple) else (n,)
    if key == NEWCOMBE and len(set(sizes)) == 2:
        known: Coverage | None = newcombe_coverage(*sizes)
    else:
        known = coverage_of(key, min(sizes))
    at = f"{' and '.join(map(str, dict.fromkeys(sizes)))} {load_map()[key].axis}"
    if known is None:
        return None, f"the coverage of {method} at {at} is not known; use {instead}"
    if method not in JUDGED_BY_MEAN and known.worst < FLOOR:
        return None, (
            f"{method} at {at} covers as little as {100 * known.worst:.1f} % where 95 % are "
            f"claimed ({known.worst_at}); use {instead}"
        )
    return replace(interval, worst_coverage=round(known.worst, 4)), ""


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


LEVEL = 0.95
CLOSED_FORMS: dict[tuple[str, str], tuple[str, str]] = {
    ("pearson", "points"): ("fisher-z", "fisher-z"),
    ("bias", "points"): ("student-t", "student-t:bias"),
    ("bias", "clusters"): ("student-t", "student-t:cluster-bias"),
}
"""Statistics with a formula of their own: its name, and its name in the map."""


@dataclass(frozen=True, kw_only=True)
class Choice:
    """The method to use, where its coverage is stored, and what else would hold."""

    method: str
    """fisher-z, student-t, or one of ``bootstrap.METHODS``."""
    key: str
    instead: str
    """For a reader whose interval is refused."""


def choose_method(statistic: str, kind: str, num_units: int) -> Choice:
    """Return the method whose least coverage at this n is best.

    Best: closest to 95 % from below; of methods that reach it, the narrowest.

    Args:
        statistic: A name in ``weighted.STATISTICS``.
        kind: points or clusters.
        num_units: Groups, or clusters of groups.
    """
    options = _options(statistic, kind)

    def kept(option: tuple[str, str]) -> float:
        known = coverage_of(option[1], num_units)
        return -1.0 if known is None else min(known.worst, LEVEL)

    method, key = max(options, key=kept)
    return Choice(method=method, key=key, instead=_instead(options, kind, num_units))


def _options(statistic: str, kind: str) -> list[tuple[str, str]]:
    resampled = [(method, f"{method}-{kind}:{statistic}") for method in METHODS]
    closed = CLOSED_FORMS.get((statistic, kind))
    return resampled if closed is None else [closed, *resampled]


def _instead(options: list[tuple[str, str]], kind: str, num_units: int) -> str:
    """Name the smallest number of groups from which on one of the methods holds."""
    found = [
        (enough, key.partition(":")[0])
        for _, key in options
        if (enough := holds_from(key)) is not None and enough > num_units
    ]
    unit = "groups" if kind == "points" else "policies"
    if not found:
        return "the value with its n"
    enough, name = min(found)
    return f"the value with its n, or {enough} {unit}, from where {name} holds"


def holds_from(key: str) -> int | None:
    """Return the smallest stored n from which on a method covers enough; None where it never does.

    A method that is not in the map holds nowhere.
    """
    method = load_map().get(key)
    enough = None
    for point in reversed(method.points if method else ()):
        if point.worst < FLOOR:
            break
        enough = point.n
    return enough
