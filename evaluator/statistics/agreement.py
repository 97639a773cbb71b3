"""How far the twin's success rates lie from the recorded ones, and whether it ranks as they do.

A correlation sees neither a constant offset nor a wrong slope: +12 points everywhere give r = 1.
Both sides are rates from 0 to 1 of the same groups in the same order, given by keyword: bias
changes its sign and MMRV its meaning when they are swapped.
"""

import math
from collections.abc import Sequence
from fractions import Fraction
from typing import Literal

from evaluator.errors import UndefinedStatisticError

MIN_GROUPS = 3
"""Two points always lie on a line."""

Number = Fraction | float | int
"""Rates as exact fractions where counts are known, so that ties are ties."""
Gap = Literal["recorded", "sim"]
"""Which side's gap MMRV weighs an order by that the other one gets wrong."""


def counted_groups(count: int) -> str:
    """Write how many groups there are: "1 group", "2 groups"."""
    return "1 group" if count == 1 else f"{count} groups"


def exact(
    statistic: str, recorded: Sequence[Number], sim: Sequence[Number], *, at_least: int = 1
) -> tuple[list[Fraction], list[Fraction]]:
    """Return both sides as exact fractions.

    Raises:
        UndefinedStatisticError: Below ``at_least`` groups.
    """
    if len(recorded) != len(sim):
        raise ValueError(f"{len(recorded)} recorded rates but {len(sim)} of the twin")
    if len(recorded) < at_least:
        reason = f"{counted_groups(len(recorded))}; it needs at least {at_least}"
        if not recorded and at_least < MIN_GROUPS:
            reason = "there are no groups"
        raise UndefinedStatisticError(statistic=statistic, reason=reason)
    return [Fraction(v) for v in recorded], [Fraction(v) for v in sim]


def varying(
    statistic: str, recorded: Sequence[Number], sim: Sequence[Number]
) -> tuple[list[Fraction], list[Fraction]]:
    """Return both sides, at least 3 groups of which not all are the same on either side."""
    x, y = exact(statistic, recorded, sim, at_least=MIN_GROUPS)
    for name, side in (("recorded", x), ("twin", y)):
        if len(set(side)) == 1:
            reason = f"the {name} rate is {float(side[0]):g} in all {len(side)} groups"
            raise UndefinedStatisticError(statistic=statistic, reason=reason)
    return x, y


def ranks(values: Sequence[Number]) -> list[Fraction]:
    """Return ranks from 1; equal values share their average rank."""
    ordered = sorted(values)
    first = {value: place for place, value in reversed([*enumerate(ordered, start=1)])}
    last = {value: place for place, value in enumerate(ordered, start=1)}
    return [Fraction(first[value] + last[value], 2) for value in values]


def bias(*, recorded: Sequence[Number], sim: Sequence[Number]) -> float:
    """Return mean(sim - recorded): above 0 the twin is optimistic. r does not see this."""
    gaps = _gaps("bias", recorded, sim)
    return float(sum(gaps) / len(gaps))


def mean_absolute_error(*, recorded: Sequence[Number], sim: Sequence[Number]) -> float:
    """Return mean |sim - recorded|; 0 is perfect."""
    gaps = _gaps("mean absolute error", recorded, sim)
    return float(sum(map(abs, gaps)) / len(gaps))


def mmrv(*, recorded: Sequence[Number], sim: Sequence[Number], gap: Gap = "recorded") -> float:
    """Return the mean maximum rank violation (SIMPLER, Li et al. 2024, equation 1).

    For each group the largest gap to a group whose order the twin got wrong, averaged over groups.
    ``gap`` names the convention: ``recorded`` measures the gap in recorded rates, as the
    equation does; ``sim`` measures it in the twin's rates, as some published code does by
    swapping the arguments. A tie on one side only is a violation. Exact on counts.

    Range: 0 to 1, 0 is perfect.

    Raises:
        UndefinedStatisticError: Below 2 groups.
    """
    x, y = exact("MMRV", recorded, sim, at_least=2)
    judge, judged = (x, y) if gap == "recorded" else (y, x)
    both = [*zip(judge, judged, strict=True)]
    worst = [
        max(
            abs(a - other)
            for other, of_other in both
            if a == other or (b > of_other) != (a > other)
        )
        for a, b in both
    ]
    return float(sum(worst) / len(worst))


def _gaps(statistic: str, recorded: Sequence[Number], sim: Sequence[Number]) -> list[Fraction]:
    x, y = exact(statistic, recorded, sim)
    return [s - r for r, s in zip(x, y, strict=True)]


def mean_rate(rates: Sequence[Number]) -> float:
    """Return the macro average: every group counts the same, however many trials it has."""
    if not rates:
        raise UndefinedStatisticError(statistic="mean rate", reason="there are no groups")
    return float(sum(map(float, rates)) / len(rates))


def pearson(recorded: Sequence[Number], sim: Sequence[Number]) -> float:
    """Return Pearson's r over groups; exact on counts, so that rates on a line give 1 and not less.

    Range: -1 to 1. Undefined when: fewer than 3 groups, or one side is constant.
    """
    x, y = varying("Pearson r", recorded, sim)
    mean_x, mean_y = sum(x) / len(x), sum(y) / len(y)
    from_mean = [(a - mean_x, b - mean_y) for a, b in zip(x, y, strict=True)]
    shared = sum(a * b for a, b in from_mean)
    spreads = sum(a * a for a, _ in from_mean) * sum(b * b for _, b in from_mean)
    size = math.sqrt(shared * shared / spreads)
    return -size if shared < 0 else size


def within_and_between(tasks: Sequence[Sequence[tuple[Number, Number]]]) -> tuple[float, float]:
    """Return r of the distances to the means of tasks, and r of those means."""
    inside: list[tuple[Fraction, Fraction]] = []
    means: list[tuple[Fraction, Fraction]] = []
    for groups in tasks:
        x, y = ([Fraction(value) for value in side] for side in zip(*groups, strict=True))
        mean_x, mean_y = sum(x, Fraction(0)) / len(x), sum(y, Fraction(0)) / len(y)
        means.append((mean_x, mean_y))
        inside += [(a - mean_x, b - mean_y) for a, b in zip(x, y, strict=True)]
    within = pearson([a for a, _ in inside], [b for _, b in inside])
    return within, pearson([a for a, _ in means], [b for _, b in means])


def spearman(recorded: Sequence[Number], sim: Sequence[Number]) -> float:
    """Return Spearman's rank correlation; ties share their average rank.

    Range: -1 to 1. Undefined when: fewer than 3 groups, or one side is constant.
    """
    x, y = varying("Spearman rho", recorded, sim)
    return pearson(ranks(x), ranks(y))
