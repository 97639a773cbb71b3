"""What a yes/no answer before motion is worth. Counted per trial, not as rates.

Equal rates can hide that the twin was wrong about every single trial.
"""

import math
from collections import Counter
from collections.abc import Iterable
from fractions import Fraction
from typing import NamedTuple

from evaluator.errors import UndefinedStatisticError


class Confusion(NamedTuple):
    """Said against happened, counted over trials."""

    true_positive: int
    """Said success, and it was one."""
    false_positive: int
    """Said success, but it failed: the costly one."""
    false_negative: int
    """Said failure, but it would have succeeded."""
    true_negative: int

    @staticmethod
    def of(pairs: Iterable[tuple[bool, bool]]) -> "Confusion":
        """Count pairs (said, happened)."""
        sums = Counter((bool(predicted), bool(happened)) for predicted, happened in pairs)
        both = (True, True), (True, False), (False, True), (False, False)
        return Confusion(*(sums[pair] for pair in both))

    @property
    def n(self) -> int:
        """All pairs."""
        return sum(self)

    @property
    def agreed(self) -> int:
        """Pairs where both said the same."""
        return self.true_positive + self.true_negative

    @property
    def predicted_success(self) -> int:
        """Denominator of the positive predictive value."""
        return self.true_positive + self.false_positive


def phi(confusion: Confusion) -> float:
    """Return the correlation of two yes/no columns (Matthews' coefficient).

    Range: -1 to 1, 1 is full agreement, 0 is none beyond the margins.
    Undefined when: one column is constant, for then there is nothing to correlate.
    """
    tp, fp, fn, tn = confusion
    if confusion.n == 0:
        raise UndefinedStatisticError(statistic="phi", reason="there are no pairs")
    positives = {"twin": tp + fp, "recorded": tp + fn}
    constant = [name for name, count in positives.items() if count in (0, confusion.n)]
    if constant:
        reason = f"the {' and '.join(constant)} side is the same in all {confusion.n} pairs"
        raise UndefinedStatisticError(statistic="phi", reason=reason)
    return (tp * tn - fp * fn) / math.sqrt((tp + fp) * (tp + fn) * (tn + fp) * (tn + fn))


def kappa(confusion: Confusion) -> float:
    """Return Cohen's kappa (1960): agreement beyond what the margins give by chance.

    Range: -1 to 1. Undefined when: both columns are constant and alike.
    """
    n = confusion.n
    if n == 0:
        raise UndefinedStatisticError(statistic="kappa", reason="there are no pairs")
    predicted = confusion.predicted_success
    happened = confusion.true_positive + confusion.false_negative
    by_chance = Fraction(predicted * happened + (n - predicted) * (n - happened), n * n)
    if by_chance == 1:
        reason = f"both sides are the same in all {n} pairs"
        raise UndefinedStatisticError(statistic="kappa", reason=reason)
    return float((Fraction(confusion.agreed, n) - by_chance) / (1 - by_chance))
