"""What a yes/no answer before motion is worth. Counted per trial, not as rates.

Equal rates can hide that the twin was wrong about every single trial.
"""

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from evaluator.errors import UndefinedStatisticError


def brier(predicted: Sequence[float], happened: Sequence[bool]) -> float:
    """Return the mean of (p - outcome)^2 (Brier 1950).

    Range: 0 to 1, 0 is perfect; always saying 1/2 gives 1/4.
    """
    p = _checked("Brier score", predicted, happened)
    return float(np.mean((p - np.array(happened, dtype=np.float64)) ** 2))


def brier_of_base_rate(happened: Sequence[bool]) -> float:
    """Return the Brier score of always saying the observed rate: what knowing nothing reaches."""
    if not happened:
        raise UndefinedStatisticError(statistic="Brier score", reason="there are no trials")
    rate = sum(happened) / len(happened)
    return rate * (1 - rate)


def _checked(statistic: str, predicted: Sequence[float], happened: Sequence[bool]) -> np.ndarray:
    if len(predicted) != len(happened):
        message = f"{len(predicted)} probabilities but {len(happened)} outcomes"
        raise ValueError(message)
    if not len(predicted):
        raise UndefinedStatisticError(statistic=statistic, reason="there are no trials")
    p = np.array(predicted, dtype=np.float64)
    if not ((p >= 0) & (p <= 1)).all():
        message = "a success probability lies in 0..1"
        raise ValueError(message)
    return p


@dataclass(frozen=True, kw_only=True)
class Confusion:
    """Said against happened, counted over trials."""

    true_positive: int
    """Said success, and it was one."""
    false_positive: int
    """Said success, but it failed: the costly one."""
    false_negative: int
    """Said failure, but it would have succeeded."""
    true_negative: int

    @staticmethod
    def count(pairs: Iterable[tuple[bool, bool]]) -> "Confusion":
        """Count pairs (said, happened)."""
        sums = Counter((bool(predicted), bool(happened)) for predicted, happened in pairs)
        return Confusion(
            true_positive=sums[True, True],
            false_positive=sums[True, False],
            false_negative=sums[False, True],
            true_negative=sums[False, False],
        )

    @property
    def n(self) -> int:
        """All pairs."""
        return self.true_positive + self.false_positive + self.false_negative + self.true_negative

    @property
    def agreed(self) -> int:
        """Pairs where both said the same."""
        return self.true_positive + self.true_negative

    @property
    def predicted_success(self) -> int:
        """Denominator of the positive predictive value."""
        return self.true_positive + self.false_positive

    @property
    def predicted_failure(self) -> int:
        """Denominator of the negative predictive value."""
        return self.true_negative + self.false_negative

    @property
    def succeeded(self) -> int:
        """Pairs that happened to succeed."""
        return self.true_positive + self.false_negative


def phi(confusion: Confusion) -> float:
    """Return the correlation of two yes/no columns (Matthews' coefficient).

    Range: -1 to 1, 1 is full agreement, 0 is none beyond the margins.
    Undefined when: one column is constant, for then there is nothing to correlate.
    """
    tp, fp = confusion.true_positive, confusion.false_positive
    fn, tn = confusion.false_negative, confusion.true_negative
    if confusion.n == 0:
        raise UndefinedStatisticError(statistic="phi", reason="there are no pairs")
    constant = [
        name
        for name, positives in (("twin", tp + fp), ("recorded", tp + fn))
        if positives in (0, confusion.n)
    ]
    if constant:
        sides = " and ".join(constant)
        raise UndefinedStatisticError(
            statistic="phi", reason=f"the {sides} side is the same in all {confusion.n} pairs"
        )
    margins = math.sqrt((tp + fp) * (tp + fn) * (tn + fp) * (tn + fn))
    return (tp * tn - fp * fn) / margins


def kappa(confusion: Confusion) -> float:
    """Return Cohen's kappa (1960): agreement beyond what the margins give by chance.

    Range: -1 to 1. Undefined when: both columns are constant and alike.
    """
    n = confusion.n
    if n == 0:
        raise UndefinedStatisticError(statistic="kappa", reason="there are no pairs")
    predicted, happened = confusion.predicted_success, confusion.succeeded
    by_chance = Fraction(predicted * happened + (n - predicted) * (n - happened), n * n)
    if by_chance == 1:
        raise UndefinedStatisticError(
            statistic="kappa", reason=f"both sides are the same in all {n} pairs"
        )
    return float((Fraction(confusion.agreed, n) - by_chance) / (1 - by_chance))
