"""Which method gives the interval of a statistic over so many cells: the map decides."""

from dataclasses import dataclass

from evaluator.statistics.bootstrap import METHODS
from evaluator.statistics.coverage.stored import FLOOR, coverage_of, load_map

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
        num_units: Cells, or clusters of cells.
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
    """Name the smallest number of cells from which on one of the methods holds."""
    found = [
        (enough, key.partition(":")[0])
        for _, key in options
        if (enough := holds_from(key)) is not None and enough > num_units
    ]
    unit = "cells" if kind == "points" else "policies"
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
