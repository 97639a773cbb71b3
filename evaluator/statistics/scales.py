"""On which scale a statistic of agreement errs by as much upwards as downwards, and where it ends.

Fisher's z for correlations, the logarithm for errors; the others are taken as they are.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

from evaluator.errors import UndefinedStatisticError

NEAR = 1e-9
"""A value this close to its limit is at it; Fisher's z is endless there."""
EDGE = 1e-6
"""A redrawn correlation is cut off here before Fisher's z."""


@dataclass(frozen=True, kw_only=True)
class Scale:
    """One scale."""

    there: Callable[[float], float]
    back: Callable[[float], float]
    slope: Callable[[float], float]
    """Derivative of ``there``."""
    low: float = -math.inf
    """The statistic is never below."""
    high: float = math.inf
    is_open: bool = False
    """At its limits the scale is endless, and no interval can be given there."""

    def around(self, statistic: str, value: float, error: float) -> tuple[float, float]:
        """Go ``error`` to both sides of a value, on this scale by the delta method.

        Raises:
            UndefinedStatisticError: At a limit of the scale, or when the error is 0.
        """
        if error < NEAR:
            raise UndefinedStatisticError(
                statistic=statistic, reason="nothing varies: the interval would have no width"
            )
        self.refuse_limit(statistic, value)
        middle, half = self.there(value), error * self.slope(value)
        return self.clip(self.back(middle - half)), self.clip(self.back(middle + half))

    def refuse_limit(self, statistic: str, value: float) -> None:
        """Refuse a value at which the scale has no end.

        Raises:
            UndefinedStatisticError: Naming it.
        """
        if self.is_open and min(value - self.low, self.high - value) < NEAR:
            raise UndefinedStatisticError(
                statistic=statistic, reason=f"it is {value:g} exactly, the end of its range"
            )

    def clip(self, value: float) -> float:
        """Keep an end where the statistic can be."""
        return min(self.high, max(self.low, value))


CORRELATION = Scale(
    there=lambda r: math.atanh(max(-1 + EDGE, min(1 - EDGE, r))),
    back=math.tanh,
    slope=lambda r: 1 / (1 - r * r),
    low=-1.0,
    high=1.0,
    is_open=True,
)
SHARE = Scale(
    there=lambda p: CORRELATION.there(2 * p - 1),
    back=lambda z: (math.tanh(z) + 1) / 2,
    slope=lambda p: 1 / (2 * p * (1 - p)),
    low=0.0,
    high=1.0,
    is_open=True,
)
ERROR = Scale(
    there=lambda e: math.log(max(NEAR, e)),
    back=math.exp,
    slope=lambda e: 1 / e,
    low=0.0,
    is_open=True,
)
PLAIN = Scale(there=lambda v: v, back=lambda v: v, slope=lambda _: 1.0)
RATE = Scale(there=PLAIN.there, back=PLAIN.back, slope=PLAIN.slope, low=0.0, high=1.0)

SCALES: dict[str, Scale] = {
    "pearson": CORRELATION,
    "spearman": CORRELATION,
    "kendall": CORRELATION,
    "bias": PLAIN,
    "mae": ERROR,
    "rmse": ERROR,
    "slope": PLAIN,
    "intercept": PLAIN,
    "order": SHARE,
    "mmrv-recorded": RATE,
    "mmrv-sim": RATE,
}
"""By the names of ``weighted.STATISTICS``."""
