"""Looking after every trial without paying for it: stop, or continue?

A test for a fixed n that is looked at again and again will be significant sooner or later. A
confidence sequence holds at every n at once: here of a success rate.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from scipy.special import betaln, xlog1py, xlogy

from evaluator.errors import UndefinedStatisticError
from evaluator.result import Interval
from evaluator.statistics.intervals import LEVEL, check_count

PRIOR = 0.5
"""Krichevsky and Trofimov's bettor: a mixture of bets with Beta(1/2, 1/2) weights."""
MAX_TRIALS = 100_000
BISECTIONS = 60

Ends = Float64[np.ndarray, " looks"]
Poor = Bool[np.ndarray, " looks"]


def capital_log(k: int, n: int, rate: float) -> float:
    """Return the log of what a bettor against ``rate`` owns after k successes in n trials.

    The bettor starts with 1 and mixes all constant bets with Beta(1/2, 1/2): capital
    B(k + 1/2, n - k + 1/2) / B(1/2, 1/2) / (rate^k (1 - rate)^(n - k)). If the rate is true this
    is a martingale, so it ever exceeds 1/alpha with probability at most alpha (Ville 1939;
    Robbins 1970; Waudby-Smith and Ramdas 2024, section 4).

    Args:
        n: Trials; without any the bettor still owns 1, so the log is 0.
        rate: The rate that is bet against, 0 to 1; one that excludes what has happened gives
            infinity.
    """
    if n == 0:
        return 0.0
    check_count(k, n)
    mixture = float(betaln(k + PRIOR, n - k + PRIOR) - betaln(PRIOR, PRIOR))
    if (k and rate <= 0) or (n - k and rate >= 1):
        return math.inf
    return (
        mixture
        - (k * math.log(rate) if k else 0.0)
        - ((n - k) * math.log1p(-rate) if n - k else 0.0)
    )


def betting_interval(k: int, n: int, *, level: float = LEVEL) -> Interval:
    """Return the rates a bettor has not yet refuted; valid however often one looked before."""
    check_count(k, n)
    ruin = -math.log1p(-level)
    low = 0.0 if k == 0 else _end(k, n, ruin, 0.0)
    high = 1.0 if k == n else _end(k, n, ruin, 1.0)
    return Interval(low=low, high=high, level=level, method="betting")


def _end(k: int, n: int, ruin: float, outside: float) -> float:
    """Where the capital reaches 1/alpha between the observed rate and 0 or 1."""
    inside = k / n
    for _ in range(BISECTIONS):
        middle = (inside + outside) / 2
        if capital_log(k, n, middle) < ruin:
            inside = middle
        else:
            outside = middle
    return inside


@dataclass(kw_only=True)
class ConfidenceSequence:
    """Trials coming in one by one, and what they have settled so far."""

    level: float = LEVEL
    k: int = 0
    n: int = 0
    low: float = 0.0
    high: float = 1.0
    """Ends only move inwards: what was refuted once stays refuted."""

    @property
    def interval(self) -> Interval:
        """What is left."""
        return Interval(low=self.low, high=self.high, level=self.level, method="betting")


def sequence_of(outcomes: Sequence[bool], *, level: float = LEVEL) -> ConfidenceSequence:
    """Return the sequence after all these trials, looked at after each.

    Raises:
        UndefinedStatisticError: When after some trial no constant rate was left.
    """
    sequence = ConfidenceSequence(level=level)
    if not outcomes:
        return sequence
    k, n = np.cumsum(np.array(outcomes, dtype=bool)), np.arange(1, len(outcomes) + 1)
    ruin = -np.log1p(-level)
    mixture = betaln(k + PRIOR, n - k + PRIOR) - betaln(PRIOR, PRIOR)

    def is_poor(rate: Ends) -> Poor:
        return np.asarray(mixture - xlogy(k, rate) - xlog1py(n - k, -rate) < ruin)

    lows = np.where(k == 0, 0.0, _ends(k / n, 0.0, is_poor))
    highs = np.where(k == n, 1.0, _ends(k / n, 1.0, is_poor))
    low, high = np.maximum.accumulate(lows), np.minimum.accumulate(highs)
    crossed = np.flatnonzero(low > high)
    if len(crossed):
        raise _changed(int(crossed[0]) + 1)
    sequence.k, sequence.n = int(k[-1]), len(outcomes)
    sequence.low, sequence.high = float(low[-1]), float(high[-1])
    return sequence


def _ends(seen: Ends, outside: float, is_poor: Callable[[Ends], Poor]) -> Ends:
    """Bisect all looks together: where, from what was seen, the capital reaches 1/alpha."""
    far = np.full(len(seen), outside)
    for _ in range(BISECTIONS):
        middle = (seen + far) / 2
        poor = is_poor(middle)
        seen, far = np.where(poor, middle, seen), np.where(poor, far, middle)
    return seen


def _changed(after: int) -> UndefinedStatisticError:
    return UndefinedStatisticError(
        statistic="confidence sequence",
        reason=f"after {after} trials no constant rate fits: the rate has changed",
    )


@dataclass(frozen=True, kw_only=True)
class Advice:
    """Whether more trials are needed to answer a question about a rate."""

    stop: bool
    answer: str
    """above, below or open."""
    more_trials: int | None
    """How many more the answer would take if the observed rate went on; None when it is there,
    or would take more than 100,000."""


def stop_or_continue(sequence: ConfidenceSequence, goal: float) -> Advice:
    """Say whether the rate is above or below a goal, or how many more trials it may take."""
    if sequence.n == 0:
        raise UndefinedStatisticError(statistic="stop or continue", reason="there are no trials")
    if sequence.low > goal:
        return Advice(stop=True, answer="above", more_trials=None)
    if sequence.high < goal:
        return Advice(stop=True, answer="below", more_trials=None)
    needed = _trials_to_decide(sequence.k / sequence.n, goal, sequence.n, sequence.level)
    more = None if needed is None else needed - sequence.n
    return Advice(stop=False, answer="open", more_trials=more)


def _trials_to_decide(rate: float, goal: float, at_least: int, level: float) -> int | None:
    def decided(n: int) -> bool:
        interval = betting_interval(round(rate * n), n, level=level)
        return interval.low > goal or interval.high < goal

    high = max(1, at_least)
    while not decided(high):
        high *= 2
        if high > MAX_TRIALS:
            return None
    low = high // 2
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if decided(middle) else (middle, high)
    return max(high, at_least)
