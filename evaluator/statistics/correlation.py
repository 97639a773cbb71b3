"""Do the twin's success rates move with the recorded ones? Pearson, Spearman, bias, MMRV."""

import math
from collections.abc import Sequence
from fractions import Fraction

import numpy as np
from scipy.special import ndtri

from evaluator.errors import UndefinedStatisticError
from evaluator.result import Interval

MIN_CELLS = 3
"""Two points always lie on a line."""
MIN_CELLS_INTERVAL = 4
"""Fisher's standard error is 1/sqrt(n - 3)."""

Number = Fraction | float | int
"""Rates as exact fractions where counts are known, so that ties are ties."""


def pearson(recorded: Sequence[Number], sim: Sequence[Number]) -> float:
    """Return Pearson's r over cells.

    Range: -1 to 1. Undefined when: fewer than 3 cells, or one side is constant.

    Raises:
        UndefinedStatisticError: With the reason.
    """
    x, y = _columns("Pearson r", recorded, sim)
    x, y = x - x.mean(), y - y.mean()
    r = float(x @ y) / math.sqrt(float(x @ x) * float(y @ y))
    return max(-1.0, min(1.0, r))


def spearman(recorded: Sequence[Number], sim: Sequence[Number]) -> float:
    """Return Spearman's rank correlation; ties share their average rank."""
    _columns("Spearman rho", recorded, sim)
    return pearson(_ranks(recorded), _ranks(sim))


def fisher_interval(r: float, num_cells: int, *, level: float = 0.95) -> Interval:
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
    half = float(ndtri(0.5 + level / 2)) / math.sqrt(num_cells - 3)
    return Interval(
        low=math.tanh(z - half), high=math.tanh(z + half), level=level, method="fisher-z"
    )


def bias(*, recorded: Sequence[Number], sim: Sequence[Number]) -> float:
    """Return mean(sim - recorded): above 0 the twin is optimistic. r does not see this."""
    return float(np.mean(_gaps("bias", recorded, sim)))


def mean_absolute_error(*, recorded: Sequence[Number], sim: Sequence[Number]) -> float:
    """Return mean |sim - recorded|; 0 is perfect."""
    return float(np.mean(np.abs(_gaps("mean absolute error", recorded, sim))))


def mmrv(*, recorded: Sequence[Number], sim: Sequence[Number], gap: str = "recorded") -> float:
    """Return the mean maximum rank violation (SIMPLER, equation 1).

    For each cell the largest gap to a cell whose order the twin got wrong, averaged over cells.
    ``gap`` names the convention: ``recorded`` measures the gap in recorded rates, as the
    equation does; ``sim`` measures it in the twin's rates, as some published code does by
    swapping the arguments. A tie on one side only is a violation.

    Range: 0 to 1, 0 is perfect.

    Raises:
        UndefinedStatisticError: Below 2 cells.
    """
    _gaps("MMRV", recorded, sim)
    if len(recorded) < 2:
        raise UndefinedStatisticError(statistic="MMRV", reason="1 cell; it needs at least 2")
    if gap not in ("recorded", "sim"):
        message = f"gap {gap!r} is no MMRV convention; there are: recorded, sim"
        raise ValueError(message)
    sides = [Fraction(v) for v in recorded], [Fraction(v) for v in sim]
    judge, judged = sides if gap == "recorded" else sides[::-1]
    worst = []
    cells = range(len(judge))
    for i in cells:
        violations = [
            abs(judge[i] - judge[j])
            for j in cells
            if (judged[i] > judged[j]) != (judge[i] > judge[j])
        ]
        worst.append(max(violations, default=Fraction(0)))
    return float(sum(worst) / len(worst))


def _gaps(statistic: str, recorded: Sequence[Number], sim: Sequence[Number]) -> np.ndarray:
    if len(recorded) != len(sim):
        message = f"{len(recorded)} recorded rates but {len(sim)} of the twin"
        raise ValueError(message)
    if not recorded:
        raise UndefinedStatisticError(statistic=statistic, reason="there are no cells")
    return np.array([float(s - r) for r, s in zip(recorded, sim, strict=True)])


def _columns(
    statistic: str, recorded: Sequence[Number], sim: Sequence[Number]
) -> tuple[np.ndarray, np.ndarray]:
    if len(recorded) != len(sim):
        message = f"{len(recorded)} recorded rates but {len(sim)} of the twin"
        raise ValueError(message)
    if len(recorded) < MIN_CELLS:
        count = len(recorded)
        raise UndefinedStatisticError(
            statistic=statistic,
            reason=f"{count} cell{'' if count == 1 else 's'}; it needs at least {MIN_CELLS}",
        )
    for name, side in (("recorded", recorded), ("twin", sim)):
        if len(set(side)) == 1:
            raise UndefinedStatisticError(
                statistic=statistic,
                reason=f"the {name} side is constant ({float(side[0]):g} in all {len(side)} cells)",
            )
    return np.array([float(v) for v in recorded]), np.array([float(v) for v in sim])


def _ranks(values: Sequence[Number]) -> list[float]:
    return [
        sum(other < value for other in values) + (sum(other == value for other in values) + 1) / 2
        for value in values
    ]
