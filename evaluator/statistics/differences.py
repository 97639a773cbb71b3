"""The difference of two success rates in percentage points, of the same trials or of others."""

from collections.abc import Sequence
from dataclasses import replace

from evaluator.result import Interval
from evaluator.statistics.intervals import LEVEL
from evaluator.statistics.sequential import Evidence, Stratum


def paired_points(
    improved: int, worsened: int, n: int, *, level: float = LEVEL
) -> tuple[float, Interval]:
    """Return P(second) - P(first) over pairs, with Tango's score interval (1998)."""
    return points_of([Stratum(improved=improved, worsened=worsened, pairs=n)], level=level)


def points_of(strata: Sequence[Stratum], *, level: float = LEVEL) -> tuple[float, Interval]:
    """Return the difference over tasks or groups, each weighted by its pairs.

    Raises:
        UndefinedStatisticError: Where no task has trials of both.
    """
    evidence = Evidence(strata=tuple(strata))
    value = 100 * evidence.difference
    found = evidence.interval(level=level)
    return value, replace(found, low=100 * found.low, high=100 * found.high)
