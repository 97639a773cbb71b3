"""The real success rate from few robot trials and many in the twin.

Needs robot trials whose starts are a random part of the twin's: an easier part would mislead. Two
looks at where objects lay tell: are both draws from one distribution, and is any other start
further out than the tried ones reach?
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float64
from scipy.special import betaincinv

from evaluator.errors import UndefinedStatisticError
from evaluator.result import Interval
from evaluator.statistics.differences import boschloo
from evaluator.statistics.gate import Confusion
from evaluator.statistics.intervals import LEVEL, check_count

MIN_STARTS = 2
"""On each side; a single start has no neighbour of its own kind."""
MAX_STARTS = 500
"""Of each side that are looked at; more are drawn from."""
MOST_COUNTED = 5_000
"""So many ways to split the starts are counted out; of more, this many less one are drawn."""
SEED = 0
ROUNDING = 1e-9
"""Relative: the same split written in another order is no larger."""

Starts = Float64[np.ndarray, "num_starts num_coordinates"]


def starts_alike(tried: Starts, others: Float64[np.ndarray, "num_others num_coordinates"]) -> float:
    """Return the p-value that both sets of starts were drawn from one distribution.

    Permutation test on the energy distance 2 E|X - Y| - E|X - X'| - E|Y - Y'| (Szekely and Rizzo
    2004), exact where all splits can be counted out, else (1 + as large) / (1 + drawn) over seeded
    draws (Phipson and Smyth 2010). Small p: tried and other starts lie elsewhere.

    Args:
        tried: Coordinates of all objects [m], one row for each start with a robot trial.
        others: The same of the starts that only the twin has.

    Raises:
        UndefinedStatisticError: With fewer than two starts on a side.
    """
    _refuse_few(tried, others)
    rng = np.random.default_rng(SEED)
    tried, others = (_some(side, rng) for side in (tried, others))
    both = np.concatenate([tried, others])
    distances_m = _distances(both, both)
    n, total = len(tried), len(both)
    found = float(_energy((np.arange(total) < n)[None], distances_m)[0])
    largest = found - ROUNDING * max(abs(found), float(distances_m.mean()))
    as_large = num_splits = 0
    exact = math.comb(total, n) <= MOST_COUNTED
    for splits in _all_splits(total, n) if exact else _drawn_splits(total, n, rng):
        as_large += int((_energy(splits, distances_m) >= largest).sum())
        num_splits += len(splits)
    return as_large / num_splits if exact else (1 + as_large) / (1 + num_splits)


def _refuse_few(tried: np.ndarray, others: np.ndarray) -> None:
    for side, words in ((tried, "with a robot trial"), (others, "only the twin has")):
        if len(side) < MIN_STARTS:
            raise UndefinedStatisticError(
                statistic="overlap of starts",
                reason=f"{len(side)} localised starts {words}; it needs {MIN_STARTS}",
            )


def _some(side: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    if len(side) <= MAX_STARTS:
        return side
    return np.asarray(side[np.sort(rng.choice(len(side), MAX_STARTS, replace=False))])


def _distances(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.norm(first[:, None] - second[None], axis=-1))


def _energy(splits: Bool[np.ndarray, "num_splits total"], distances_m: np.ndarray) -> np.ndarray:
    """Energy distance between the marked and the unmarked starts of each split."""
    marked = splits.astype(np.float64)
    n = marked.sum(axis=1)
    m = marked.shape[1] - n
    to_marked = marked @ distances_m
    within = (to_marked * marked).sum(axis=1)
    between = (to_marked * (1 - marked)).sum(axis=1)
    rest = distances_m.sum() - within - 2 * between
    return np.asarray(2 * between / (n * m) - within / n**2 - rest / m**2)


def _all_splits(total: int, n: int) -> Iterator[np.ndarray]:
    chosen = np.array(list(combinations(range(total), n)))
    splits = np.zeros((len(chosen), total), dtype=bool)
    np.put_along_axis(splits, chosen, values=True, axis=1)
    yield splits


def _drawn_splits(total: int, n: int, rng: np.random.Generator) -> Iterator[np.ndarray]:
    left = MOST_COUNTED - 1
    while left:
        count = min(left, 500)
        start = np.tile(np.arange(total) < n, (count, 1))
        yield rng.permuted(start, axis=1)
        left -= count


GRID = 40
"""Equally likely values of each of three rates; the interval's ends are then right to 0.002."""
PRIOR = 0.5
"""Jeffreys' prior, chosen by coverage."""
MAX_SAVED = 10_000
SHOWN_FROM = 0.025
"""One-sided p from which on a twin's answers are worth something."""


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """A real success rate with the twin's help."""

    value: float
    interval: Interval


def post_stratified(pairs: Confusion, sim_k: int, sim_n: int, *, level: float = LEVEL) -> Estimate:
    """Estimate the real rate by strata of the twin's answer, each with a Beta(1/2, 1/2) prior.

    p = pi theta_1 + (1 - pi) theta_0 with theta_1 = P(real success | sim success),
    theta_0 = P(real success | sim failure), pi = P(sim success) over all starts, paired ones
    included; three independent Beta posteriors. Mean and equal-tailed interval of p on the grid
    of their equally likely values: no random numbers. With Beta(1, 1), as the design has it, ten
    robot trials and a useless twin cover a rate of 5 % in only 61 % of the cases.

    Args:
        pairs: Twin's answer against the real outcome, over the robot trials.

    Raises:
        UndefinedStatisticError: Without robot trials.
        ImpossibleCountError: When sim_k is not in 0..sim_n.
    """
    if pairs.n == 0:
        raise UndefinedStatisticError(
            statistic="rate from the twin", reason="no robot trial has the twin's answer"
        )
    if sim_n:
        check_count(sim_k, sim_n)
    predicted = pairs.predicted_success + sim_k
    pi = _values(predicted, pairs.n + sim_n)
    given_success = _values(pairs.true_positive, pairs.predicted_success)
    given_failure = _values(pairs.false_negative, pairs.predicted_failure)
    rates = (
        pi[:, None, None] * given_success[None, :, None]
        + (1 - pi)[:, None, None] * given_failure[None, None, :]
    ).ravel()
    low, high = np.quantile(rates, [(1 - level) / 2, (1 + level) / 2])
    share = (predicted + PRIOR) / (pairs.n + sim_n + 2 * PRIOR)
    value = share * (pairs.true_positive + PRIOR) / (pairs.predicted_success + 2 * PRIOR)
    value += (1 - share) * (pairs.false_negative + PRIOR) / (pairs.predicted_failure + 2 * PRIOR)
    interval = Interval(
        low=float(low), high=float(high), level=level, method="post-stratified-beta"
    )
    return Estimate(value=value, interval=interval)


@lru_cache(maxsize=4096)
def _values(k: int, n: int) -> Float64[np.ndarray, " values"]:
    """Equally likely values of a rate with posterior Beta(k + 1/2, n - k + 1/2)."""
    return np.asarray(betaincinv(k + PRIOR, n - k + PRIOR, (np.arange(GRID) + 0.5) / GRID))


def applicability(paired_k: int, paired_n: int, alone_k: int, alone_n: int) -> float:
    """Return Boschloo's p that the robot trials are a random part of the twin's starts.

    Compares the twin's success rate on the starts that were tried on the robot with its rate on
    the others. A small p forbids the estimates above; a large one does not prove them.

    Raises:
        UndefinedStatisticError: Without trials in one part.
    """
    if not paired_n or not alone_n:
        missing = "robot trials" if not paired_n else "further starts in the twin"
        raise UndefinedStatisticError(
            statistic="applicability of the twin", reason=f"there are no {missing}"
        )
    return boschloo(paired_k, paired_n, alone_k, alone_n)


def trials_saved(pairs: Confusion, sim_k: int, sim_n: int, *, level: float = LEVEL) -> int:
    """Return how many further robot trials would make the estimate as narrow without the twin.

    The same posterior twice: ``post_stratified`` with the twin, Beta(k + 1/2, n - k + 1/2) without
    it. A twin saves nothing that is not shown to be right more often after a yes than after a no
    (Boschloo's test, one-sided at 2.5 %): a useless one would look narrower by chance.

    Args:
        pairs: Twin's answer against the real outcome, over the robot trials.

    Raises:
        UndefinedStatisticError: Without robot trials, or when it would be more than 10,000.
    """
    if pairs.n and not _is_right_more_often(pairs):
        return 0
    estimate = post_stratified(pairs, sim_k, sim_n, level=level)
    width = estimate.interval.high - estimate.interval.low

    def is_enough(n: int) -> bool:
        k = estimate.value * n
        low, high = betaincinv(k + PRIOR, n - k + PRIOR, [(1 - level) / 2, (1 + level) / 2])
        return bool(high - low <= width)

    low, high = pairs.n, MAX_SAVED
    if is_enough(low):
        return 0
    if not is_enough(high):
        raise UndefinedStatisticError(
            statistic="trials saved", reason=f"more than {MAX_SAVED} robot trials"
        )
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if is_enough(middle) else (middle, high)
    return high - pairs.n


def _is_right_more_often(pairs: Confusion) -> bool:
    """Whether success is shown to be more frequent after a yes than after a no."""
    yes, no = pairs.predicted_success, pairs.predicted_failure
    if not yes or not no or pairs.true_positive * no <= pairs.false_negative * yes:
        return False
    return boschloo(pairs.false_negative, no, pairs.true_positive, yes) <= 2 * SHOWN_FROM
