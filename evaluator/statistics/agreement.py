"""Does the twin say what then happens? Counted per trial, not as rates.

Equal rates can hide that the twin was wrong about every single trial.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

from evaluator.errors import UndefinedStatisticError


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
        seen = list(pairs)
        return Confusion(
            true_positive=sum(said and happened for said, happened in seen),
            false_positive=sum(said and not happened for said, happened in seen),
            false_negative=sum(not said and happened for said, happened in seen),
            true_negative=sum(not said and not happened for said, happened in seen),
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
    def said_success(self) -> int:
        """Denominator of the positive predictive value."""
        return self.true_positive + self.false_positive

    @property
    def said_failure(self) -> int:
        """Denominator of the negative predictive value."""
        return self.true_negative + self.false_negative


def phi(confusion: Confusion) -> float:
    """Return the correlation of two yes/no columns (Matthews' coefficient).

    Range: -1 to 1, 1 is full agreement, 0 is none beyond the margins.
    Undefined when: one column is constant, for then there is nothing to correlate.

    Raises:
        UndefinedStatisticError: Naming the constant column.
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


@dataclass(frozen=True, kw_only=True)
class McNemar:
    """A paired yes/no comparison; only the discordant pairs carry information."""

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
    discordant = improved + worsened
    if discordant == 0:
        raise UndefinedStatisticError(
            statistic="McNemar's test",
            reason=f"none of the {len(seen)} pairs differ between the conditions"
            if seen
            else "there are no pairs",
        )
    smaller = min(improved, worsened)
    masses = [math.comb(discordant, i) / 2**discordant for i in range(smaller + 1)]
    doubled = 2 * sum(masses)
    p_exact, p_mid = min(1.0, doubled), min(1.0, doubled - masses[-1])
    return McNemar(improved=improved, worsened=worsened, p_exact=p_exact, p_mid=p_mid)
