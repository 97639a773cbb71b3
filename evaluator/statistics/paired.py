"""Two answers on the same starts: only the pairs that differ carry information."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

from evaluator.errors import UndefinedStatisticError
from evaluator.result import Interval
from evaluator.statistics.proportion import LEVEL, ImpossibleCountError, normal_quantile

BISECTIONS = 60
"""Halvings of an interval of length 2; what is left is below the spacing of floats near 1."""


@dataclass(frozen=True, kw_only=True)
class McNemar:
    """A paired yes/no comparison."""

    improved: int
    """Failed before, succeeded after."""
    worsened: int
    """Succeeded before, failed after."""
    p_exact: float
    """Two-sided binomial test on the discordant pairs."""
    p_mid: float
    """The same with the mid-p correction (less conservative; Fagerland 2013)."""


def mcnemar(pairs: Iterable[tuple[bool, bool]]) -> McNemar:
    """Test pairs (before, after) of the same start for a change in success.

    Raises:
        UndefinedStatisticError: Without a single discordant pair.
    """
    seen = list(pairs)
    improved = sum(after and not before for before, after in seen)
    worsened = sum(before and not after for before, after in seen)
    if improved + worsened == 0:
        raise UndefinedStatisticError(
            statistic="McNemar's test",
            reason=f"none of the {len(seen)} pairs differ between the conditions"
            if seen
            else "there are no pairs",
        )
    p_exact, p_mid = sign_test(improved, worsened)
    return McNemar(improved=improved, worsened=worsened, p_exact=p_exact, p_mid=p_mid)


def sign_test(improved: int, worsened: int) -> tuple[float, float]:
    """Return the two-sided exact p and mid-p of Binomial(improved + worsened, 1/2)."""
    discordant, smaller = improved + worsened, min(improved, worsened)
    # Whole numbers as long as possible: exact for any count.
    below, here = 0, 1
    for i in range(smaller):  # each binomial coefficient from the one before
        below, here = below + here, here * (discordant - i) // (i + 1)
    total = 2**discordant
    p_exact, p_mid = 2 * (below + here) / total, (2 * below + here) / total
    return min(1.0, p_exact), min(1.0, p_mid)


def tango_difference(improved: int, worsened: int, n: int, *, level: float = LEVEL) -> Interval:
    """Return the score interval of P(after) - P(before) over pairs (Tango 1998).

    All differences d that the score test with the variance under d does not reject, found by
    bisection; the restricted estimate of the worsened probability is the larger root of
    Tango's quadratic (his equations 4 and 5).

    Args:
        improved: Pairs that failed before and succeeded after.
        worsened: Pairs that succeeded before and failed after.
        n: All pairs, those without a change included.
        level: Confidence level.

    Raises:
        UndefinedStatisticError: Without pairs.
        ImpossibleCountError: When more pairs changed than there are.
    """
    if n == 0:
        raise UndefinedStatisticError(statistic="Tango interval", reason="there are no pairs")
    if min(improved, worsened) < 0 or improved + worsened > n:
        raise ImpossibleCountError(k=improved + worsened, n=n)
    z = normal_quantile(0.5 + level / 2)
    estimate = (improved - worsened) / n
    low = -1.0 if worsened == n else -_upper_end(worsened, improved, n, z, -estimate)
    high = 1.0 if improved == n else _upper_end(improved, worsened, n, z, estimate)
    return Interval(low=low, high=high, level=level, method="tango")


def _upper_end(improved: int, worsened: int, n: int, z: float, estimate: float) -> float:
    """Find the difference above the estimate where the score reaches -z."""
    inside, outside = estimate, 1.0
    for _ in range(BISECTIONS):
        middle = (inside + outside) / 2
        if _score(improved, worsened, n, middle) > -z:
            inside = middle
        else:
            outside = middle
    return inside


def _score(improved: int, worsened: int, n: int, difference: float) -> float:
    """Tango's statistic: observed minus supposed difference in restricted standard errors."""
    d = difference
    b = (2 * n - improved + worsened) * d - improved - worsened
    c = -worsened * d * (1 - d)
    root = math.sqrt(max(0.0, b * b - 8 * n * c))
    # The larger root of 2n q^2 + b q + c, written so that nothing cancels.
    restricted = (root - b) / (4 * n) if b <= 0 else -2 * c / (b + root)
    variance = n * (2 * restricted + d * (1 - d))
    distance = improved - worsened - n * d
    if variance <= 0:
        return math.copysign(math.inf, distance) if distance else 0.0
    return distance / math.sqrt(variance)
