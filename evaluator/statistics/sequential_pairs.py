"""Looking after every pair: has the rate changed between two conditions on the same starts?

Like ``sequential``, for three outcomes of a pair: improved, worsened, the same.
"""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64, Int64
from scipy.special import gammaln, xlogy

from evaluator.errors import UndefinedStatisticError
from evaluator.result import Interval
from evaluator.statistics.proportion import LEVEL, ImpossibleCountError
from evaluator.statistics.sequential import PRIOR, Advice, fewest

BISECTIONS = 50
SURE = "sequence of pairs"

Counts = Int64[np.ndarray, " looks"]
Ends = Float64[np.ndarray, " looks"]


def pairs_capital_log(improved: int, worsened: int, n: int, difference: float) -> float:
    """Return the log of what a bettor against this difference owns after n pairs.

    The bettor mixes all bets on (improved, worsened, same) with Dirichlet(1/2, 1/2, 1/2) weights;
    the capital against a difference d = P(improved) - P(worsened) is the least of those against
    any pair of chances with that difference, so it ever exceeds 1/alpha with probability at most
    alpha (Ville 1939). The chances that fit best under d solve a quadratic.

    Raises:
        ImpossibleCountError: When more pairs changed than there are.
    """
    counts = _checked(improved, worsened, n)
    return float(_capital_log(*counts, np.array([difference]))[0])


def _checked(improved: int, worsened: int, n: int) -> tuple[Counts, Counts, Counts]:
    if min(improved, worsened) < 0 or improved + worsened > n:
        raise ImpossibleCountError(k=improved + worsened, n=n)
    better, worse, same = (np.array([k]) for k in (improved, worsened, n - improved - worsened))
    return better, worse, same


def _capital_log(better: Counts, worse: Counts, same: Counts, d: Ends) -> Ends:
    n = better + worse + same
    counts = (better, worse, same)
    mixture = sum(gammaln(k + PRIOR) - gammaln(PRIOR) for k in counts)
    mixture = mixture - (gammaln(n + 3 * PRIOR) - gammaln(3 * PRIOR))
    chances = _best_chances(better, worse, same, d)
    return np.asarray(mixture - sum(xlogy(k, p) for k, p in zip(counts, chances, strict=True)))


def _best_chances(better: Counts, worse: Counts, same: Counts, d: Ends) -> tuple[Ends, ...]:
    """Chances with P(improved) - P(worsened) = d under which the counts are likeliest."""
    n = np.maximum(1, better + worse + same)
    b = (better + worse) * (1 + d) + 2 * d * (better + same)
    root = np.sqrt(np.maximum(0.0, b * b - 8 * n * better * d * (1 + d)))
    p = np.clip((b + root) / (4 * n), np.maximum(0.0, d), (1 + d) / 2)
    return p, np.maximum(0.0, p - d), np.maximum(0.0, 1 - 2 * p + d)


def _ends(better: Counts, worse: Counts, same: Counts, ruin: float, outside: float) -> Ends:
    """Bisect all looks together: where the capital reaches 1/alpha, or ``outside``."""
    close = (better - worse) / (better + worse + same)
    far = np.full(len(close), outside)
    reached = _capital_log(better, worse, same, far) < ruin
    for _ in range(BISECTIONS):
        middle = (close + far) / 2
        poor = _capital_log(better, worse, same, middle) < ruin
        close, far = np.where(poor, middle, close), np.where(poor, far, middle)
    return np.where(reached, outside, close)


def pairs_betting_interval(
    improved: int, worsened: int, n: int, *, level: float = LEVEL
) -> Interval:
    """Return the differences P(improved) - P(worsened) that a bettor has not yet refuted.

    Raises:
        UndefinedStatisticError: Without pairs.
        ImpossibleCountError: When more pairs changed than there are.
    """
    if n == 0:
        raise UndefinedStatisticError(statistic=SURE, reason="there are no pairs")
    counts = _checked(improved, worsened, n)
    ruin = -math.log1p(-level)
    low, high = (float(_ends(*counts, ruin, outside)[0]) for outside in (-1.0, 1.0))
    return Interval(low=low, high=high, level=level, method="betting-pairs")


def pairs_sequence(changes: Sequence[int], *, level: float = LEVEL) -> Interval:
    """Return what is left after every pair in order: +1 improved, -1 worsened, 0 the same.

    Ends only move inwards: what was refuted once stays refuted.

    Raises:
        UndefinedStatisticError: Without pairs, or when after some pair no difference was left.
    """
    if not changes:
        raise UndefinedStatisticError(statistic=SURE, reason="there are no pairs")
    seen, ruin = np.array(changes, dtype=np.int64), -math.log1p(-level)
    better, worse = np.cumsum(seen > 0), np.cumsum(seen < 0)
    same = np.arange(1, len(seen) + 1) - better - worse
    low = np.maximum.accumulate(_ends(better, worse, same, ruin, -1.0))
    high = np.minimum.accumulate(_ends(better, worse, same, ruin, 1.0))
    crossed = np.flatnonzero(low > high)
    if len(crossed):
        raise UndefinedStatisticError(
            statistic=SURE,
            reason=f"after {int(crossed[0]) + 1} pairs no constant difference fits: it has changed",
        )
    return Interval(low=float(low[-1]), high=float(high[-1]), level=level, method="betting-pairs")


def pairs_advice(changes: Sequence[int], interval: Interval) -> Advice:
    """Say whether the difference is above or below 0, or how many more pairs that may take."""
    if interval.low > 0:
        return Advice(stop=True, answer="above", more_trials=None)
    if interval.high < 0:
        return Advice(stop=True, answer="below", more_trials=None)
    n = len(changes)
    improved, worsened = sum(c > 0 for c in changes), sum(c < 0 for c in changes)
    needed = _pairs_to_decide(improved / n, worsened / n, n, interval.level)
    return Advice(stop=False, answer="open", more_trials=None if needed is None else needed - n)


def _pairs_to_decide(better: float, worse: float, at_least: int, level: float) -> int | None:
    ruin = -math.log1p(-level)

    def decided(n: int) -> bool:
        improved, worsened = round(better * n), round(worse * n)
        return improved != worsened and pairs_capital_log(improved, worsened, n, 0.0) >= ruin

    if better == worse:
        return None
    return fewest(decided, at_least)
