"""Recorded and simulated success rates side by side, checked before anything is computed."""

from collections.abc import Sequence
from fractions import Fraction

import numpy as np
from jaxtyping import Float64

from evaluator.errors import UndefinedStatisticError

MIN_CELLS = 3
"""Two points always lie on a line."""

Number = Fraction | float | int
"""Rates as exact fractions where counts are known, so that ties are ties."""


def counted_cells(count: int) -> str:
    """Write how many cells there are: "1 cell", "2 cells"."""
    return "1 cell" if count == 1 else f"{count} cells"


def exact(
    statistic: str, recorded: Sequence[Number], sim: Sequence[Number], *, at_least: int = 1
) -> tuple[list[Fraction], list[Fraction]]:
    """Return both sides as exact fractions.

    Raises:
        UndefinedStatisticError: Below ``at_least`` cells.
        ValueError: When the sides differ in length.
    """
    if len(recorded) != len(sim):
        message = f"{len(recorded)} recorded rates but {len(sim)} of the twin"
        raise ValueError(message)
    count = len(recorded)
    if count == 0:
        raise UndefinedStatisticError(statistic=statistic, reason="there are no cells")
    if count < at_least:
        reason = f"{counted_cells(count)}; it needs at least {at_least}"
        raise UndefinedStatisticError(statistic=statistic, reason=reason)
    return [Fraction(v) for v in recorded], [Fraction(v) for v in sim]


def varying(
    statistic: str, recorded: Sequence[Number], sim: Sequence[Number]
) -> tuple[list[Fraction], list[Fraction]]:
    """Return both sides, at least 3 cells of which not all are the same on either side.

    Raises:
        UndefinedStatisticError: With the reason.
    """
    # No cells are too few cells here; exact() would word it as an absence.
    if len(recorded) == len(sim) == 0:
        raise UndefinedStatisticError(
            statistic=statistic, reason=f"0 cells; it needs at least {MIN_CELLS}"
        )
    x, y = exact(statistic, recorded, sim, at_least=MIN_CELLS)
    for name, side in (("recorded", x), ("twin", y)):
        if len(set(side)) == 1:
            raise UndefinedStatisticError(
                statistic=statistic,
                reason=f"the {name} side is constant ({float(side[0]):g} in all {len(side)} cells)",
            )
    return x, y


def floats(values: Sequence[Number]) -> Float64[np.ndarray, " cells"]:
    """Return rates as an array."""
    return np.array([float(v) for v in values], dtype=np.float64)


def ranks(values: Sequence[Number]) -> list[Fraction]:
    """Return ranks from 1; equal values share their average rank."""
    return [
        Fraction(2 * sum(other < v for other in values) + sum(other == v for other in values) + 1)
        / 2
        for v in values
    ]
