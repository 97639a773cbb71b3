"""How far the twin's success rates lie from the recorded ones, and whether it ranks as they do.

A correlation sees neither a constant offset nor a wrong slope: +12 points everywhere give r = 1.
Arguments are keyword-only throughout: bias changes its sign and MMRV its meaning when swapped.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

from evaluator.errors import UndefinedStatisticError
from evaluator.statistics.columns import MIN_CELLS, Number, exact, floats

CONVENTIONS = ("recorded", "sim")


def bias(*, recorded: Sequence[Number], sim: Sequence[Number]) -> float:
    """Return mean(sim - recorded): above 0 the twin is optimistic. r does not see this.

    Raises:
        UndefinedStatisticError: Without cells.
    """
    gaps = _gaps("bias", recorded, sim)
    return float(sum(gaps) / len(gaps))


def mean_absolute_error(*, recorded: Sequence[Number], sim: Sequence[Number]) -> float:
    """Return mean |sim - recorded|; 0 is perfect.

    Raises:
        UndefinedStatisticError: Without cells.
    """
    gaps = _gaps("mean absolute error", recorded, sim)
    return float(sum(map(abs, gaps)) / len(gaps))


def root_mean_square_error(*, recorded: Sequence[Number], sim: Sequence[Number]) -> float:
    """Return sqrt(mean (sim - recorded)^2); 0 is perfect, and never below the mean |gap|.

    Raises:
        UndefinedStatisticError: Without cells.
    """
    gaps = _gaps("RMSE", recorded, sim)
    return math.sqrt(sum(gap * gap for gap in gaps) / len(gaps))


def largest_gap(*, recorded: Sequence[Number], sim: Sequence[Number]) -> float:
    """Return max |sim - recorded| over cells.

    Raises:
        UndefinedStatisticError: Without cells.
    """
    return float(max(map(abs, _gaps("largest gap", recorded, sim))))


@dataclass(frozen=True, kw_only=True)
class CalibrationLine:
    """recorded = intercept + slope x sim; slope 1 and intercept 0 is a calibrated twin."""

    slope: float
    intercept: float


def calibration_line(*, recorded: Sequence[Number], sim: Sequence[Number]) -> CalibrationLine:
    """Fit recorded on sim by least squares: what a sim rate is worth on the robot.

    Both sides are counts with noise, so the slope is pulled towards 0 (attenuation); it predicts,
    it does not say what the physics would do.

    Raises:
        UndefinedStatisticError: Below 3 cells, or when the sim side is constant.
    """
    x, y = exact("calibration line", sim, recorded, at_least=MIN_CELLS)
    mean_x, mean_y = sum(x) / len(x), sum(y) / len(y)
    spread = sum((v - mean_x) ** 2 for v in x)
    if spread == 0:
        raise UndefinedStatisticError(
            statistic="calibration line",
            reason=f"the twin side is constant ({float(x[0]):g} in all {len(x)} cells)",
        )
    slope = sum((a - mean_x) * (b - mean_y) for a, b in zip(x, y, strict=True)) / spread
    return CalibrationLine(slope=float(slope), intercept=float(mean_y - slope * mean_x))


def mmrv(*, recorded: Sequence[Number], sim: Sequence[Number], gap: str = "recorded") -> float:
    """Return the mean maximum rank violation (SIMPLER, Li et al. 2024, equation 1).

    For each cell the largest gap to a cell whose order the twin got wrong, averaged over cells.
    ``gap`` names the convention: ``recorded`` measures the gap in recorded rates, as the
    equation does; ``sim`` measures it in the twin's rates, as some published code does by
    swapping the arguments. A tie on one side only is a violation. Exact on counts.

    Range: 0 to 1, 0 is perfect.

    Raises:
        UndefinedStatisticError: Below 2 cells.
        ValueError: For a convention that does not exist.
    """
    x, y = exact("MMRV", recorded, sim, at_least=2)
    if gap not in CONVENTIONS:
        message = f"gap {gap!r} is no MMRV convention; there are: {', '.join(CONVENTIONS)}"
        raise ValueError(message)
    judge, judged = (x, y) if gap == "recorded" else (y, x)
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


@dataclass(frozen=True, kw_only=True)
class OrderAccuracy:
    """Of the pairs of cells that differ on the recorded side, how many the twin orders so."""

    right: Fraction
    """Pairs ordered as recorded; a tie in the twin counts one half."""
    pairs: int

    @property
    def value(self) -> float:
        """From 0 (all reversed) to 1; 1/2 is chance."""
        return float(self.right / self.pairs)


def order_accuracy(*, recorded: Sequence[Number], sim: Sequence[Number]) -> OrderAccuracy:
    """Count the pairs of cells that the twin orders as the recorded rates do.

    Raises:
        UndefinedStatisticError: Below 2 cells, or when no two recorded rates differ.
    """
    x, y = exact("pairwise order accuracy", recorded, sim, at_least=2)
    right, pairs = Fraction(0), 0
    for j in range(len(x)):
        for i in range(j):
            if x[i] == x[j]:
                continue
            pairs += 1
            if y[i] == y[j]:
                right += Fraction(1, 2)
            elif (x[i] > x[j]) == (y[i] > y[j]):
                right += 1
    if pairs == 0:
        raise UndefinedStatisticError(
            statistic="pairwise order accuracy",
            reason=f"the recorded side is constant ({float(x[0]):g} in all {len(x)} cells)",
        )
    return OrderAccuracy(right=right, pairs=pairs)


def _gaps(statistic: str, recorded: Sequence[Number], sim: Sequence[Number]) -> list[Fraction]:
    x, y = exact(statistic, recorded, sim)
    return [s - r for r, s in zip(x, y, strict=True)]


def mean_rate(rates: Sequence[Number]) -> float:
    """Return the macro average: every cell counts the same, however many trials it has.

    Raises:
        UndefinedStatisticError: Without cells.
    """
    if not rates:
        raise UndefinedStatisticError(statistic="mean rate", reason="there are no cells")
    return float(floats(rates).mean())
