"""Do the twin's success rates move with the recorded ones? Pearson, Spearman, Kendall."""

import math
from collections.abc import Sequence

from evaluator.errors import UndefinedStatisticError
from evaluator.result import Interval
from evaluator.statistics.columns import Number, ranks, varying
from evaluator.statistics.proportion import LEVEL, normal_quantile

MIN_CELLS_INTERVAL = 4
"""Fisher's standard error is 1/sqrt(n - 3)."""


def pearson(recorded: Sequence[Number], sim: Sequence[Number]) -> float:
    """Return Pearson's r over cells; exact on counts, so that rates on a line give 1 and not less.

    Range: -1 to 1. Undefined when: fewer than 3 cells, or one side is constant.

    Raises:
        UndefinedStatisticError: With the reason.
    """
    x, y = varying("Pearson r", recorded, sim)
    mean_x, mean_y = sum(x) / len(x), sum(y) / len(y)
    from_mean = [(a - mean_x, b - mean_y) for a, b in zip(x, y, strict=True)]
    shared = sum(a * b for a, b in from_mean)
    spreads = sum(a * a for a, _ in from_mean) * sum(b * b for _, b in from_mean)
    size = math.sqrt(shared * shared / spreads)
    return -size if shared < 0 else size


def spearman(recorded: Sequence[Number], sim: Sequence[Number]) -> float:
    """Return Spearman's rank correlation; ties share their average rank.

    Range: -1 to 1. Undefined when: fewer than 3 cells, or one side is constant.

    Raises:
        UndefinedStatisticError: With the reason.
    """
    x, y = varying("Spearman rho", recorded, sim)
    return pearson(ranks(x), ranks(y))


def kendall(recorded: Sequence[Number], sim: Sequence[Number]) -> float:
    """Return Kendall's tau-b: concordant minus discordant pairs, corrected for ties (1945).

    (C - D) / sqrt((pairs - pairs tied in recorded) (pairs - pairs tied in sim)).

    Range: -1 to 1. Undefined when: fewer than 3 cells, or one side is constant.

    Raises:
        UndefinedStatisticError: With the reason.
    """
    x, y = varying("Kendall tau-b", recorded, sim)
    pairs = [(i, j) for j in range(len(x)) for i in range(j)]
    signs = [(_sign(x[i] - x[j]), _sign(y[i] - y[j])) for i, j in pairs]
    concordance = sum(a * b for a, b in signs)
    untied_x, untied_y = sum(a != 0 for a, _ in signs), sum(b != 0 for _, b in signs)
    return concordance / math.sqrt(untied_x * untied_y)


def fisher_interval(r: float, num_cells: int, *, level: float = LEVEL) -> Interval:
    """Return Fisher's z interval of Pearson's r. The cells must be independent of each other.

    Raises:
        UndefinedStatisticError: Below 4 cells, or when r is exactly 1 or -1.
    """
    if num_cells < MIN_CELLS_INTERVAL:
        raise UndefinedStatisticError(
            statistic="Fisher interval of r",
            reason=f"{num_cells} cells; it needs at least {MIN_CELLS_INTERVAL}",
        )
    if abs(r) >= 1:
        raise UndefinedStatisticError(
            statistic="Fisher interval of r", reason=f"r is {r:+.0f} exactly"
        )
    z = math.atanh(r)
    half = normal_quantile(0.5 + level / 2) / math.sqrt(num_cells - 3)
    return Interval(
        low=math.tanh(z - half), high=math.tanh(z + half), level=level, method="fisher-z"
    )


def _sign(value: Number) -> int:
    return (value > 0) - (value < 0)
