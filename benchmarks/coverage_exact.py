"""Coverage by counting every outcome out: no random numbers, so no noise in the least coverage."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from scipy.special import gammaln, xlogy
from scipy.stats import binom

from evaluator.result import Interval
from evaluator.statistics.coverage import PAIR_RATES, ROOM, Coverage
from evaluator.statistics.intervals import median_rank

RATES = np.round(np.arange(0.05, 0.9501, 0.01), 2)
"""True rates of one group: 0.05, 0.06 .. 0.95."""


def of_rate(interval: Callable[[int, int], Interval], n: int) -> Coverage:
    """Coverage of a binomial interval at n trials, over rates 0.05 .. 0.95.

    Args:
        interval: Gives the interval of k successes in n trials.
        n: Trials.
    """
    ends = np.array([(i.low, i.high) for i in (interval(k, n) for k in range(n + 1))])
    held = (ends[:, :1] <= RATES + ROOM) & (ends[:, 1:] >= RATES - ROOM)
    chances = binom.pmf(np.arange(n + 1)[:, None], n, RATES)
    covered = (chances * held).sum(axis=0)
    return _summary(n, covered, [f"p = {rate:.2f}" for rate in RATES])


def of_difference(interval: Callable[[int, int, int, int], Interval], n: int) -> Coverage:
    """Coverage of an interval of second - first with n trials in each of two groups.

    Args:
        interval: Gives the interval from successes and trials of the first group, then of the
            second.
        n: Trials in each group.
    """
    counts = range(n + 1)
    made = [[interval(first, n, second, n) for second in counts] for first in counts]
    low = np.array([[item.low for item in row] for row in made])
    high = np.array([[item.high for item in row] for row in made])
    chances = binom.pmf(np.arange(n + 1)[:, None], n, PAIR_RATES)
    covered, names = [], []
    for i, p_first in enumerate(PAIR_RATES):
        for j, p_second in enumerate(PAIR_RATES):
            held = _holds(low, high, p_second - p_first)
            covered.append(float(chances[:, i] @ held @ chances[:, j]))
            names.append(f"p = {p_first:.2f} and {p_second:.2f}")
    return _summary(n, np.array(covered), names)


def of_paired_difference(interval: Callable[[int, int, int], Interval], n: int) -> Coverage:
    """Coverage of an interval of P(improved) - P(worsened) over n pairs.

    Args:
        interval: Gives the interval from pairs improved, pairs worsened, and all pairs.
        n: Pairs, those without a change included.
    """
    outcomes = [(b, c) for b in range(n + 1) for c in range(n + 1 - b)]
    made = [interval(b, c, n) for b, c in outcomes]
    low, high = np.array([i.low for i in made]), np.array([i.high for i in made])
    b, c = np.array(outcomes).T
    ways = gammaln(n + 1) - gammaln(b + 1) - gammaln(c + 1) - gammaln(n - b - c + 1)
    covered, names = [], []
    for p_improved in PAIR_RATES:
        for p_worsened in PAIR_RATES:
            same = 1 - p_improved - p_worsened
            if same < -ROOM:
                continue
            logs = xlogy(b, p_improved) + xlogy(c, p_worsened) + xlogy(n - b - c, max(0.0, same))
            held = _holds(low, high, p_improved - p_worsened)
            covered.append(float(np.exp(ways + logs)[held].sum()))
            names.append(f"p = {p_improved:.2f} better, {p_worsened:.2f} worse")
    return _summary(n, np.array(covered), names)


def _holds(low: np.ndarray, high: np.ndarray, truth: float) -> Bool[np.ndarray, "*outcomes"]:
    return np.asarray((low <= truth + ROOM) & (high >= truth - ROOM))


def _summary(n: int, covered: Float64[np.ndarray, " rates"], names: Sequence[str]) -> Coverage:
    worst = int(covered.argmin())
    return Coverage(
        n=n, worst=float(covered[worst]), worst_at=names[worst], mean=float(covered.mean())
    )


Sample = Float64[np.ndarray, "draws lengths"]


@dataclass(frozen=True, kw_only=True)
class Lengths:
    """A distribution of lengths around 1, with its mean."""

    name: str
    mean: float
    draw: Callable[[np.random.Generator, tuple[int, int]], Sample]


def _distances(rng: np.random.Generator, size: tuple[int, int]) -> Sample:
    """Distance of two points in space, normal in each direction."""
    return np.asarray(np.linalg.norm(rng.standard_normal((*size, 3)), axis=-1))


def _skewed(spread: float) -> Callable[[np.random.Generator, tuple[int, int]], Sample]:
    def draw(rng: np.random.Generator, size: tuple[int, int]) -> Sample:
        return np.asarray(rng.lognormal(0.0, spread, size))

    return draw


def _with_misses(share: float, factor: float) -> Callable[..., Sample]:
    def draw(rng: np.random.Generator, size: tuple[int, int]) -> Sample:
        far = rng.random(size) < share
        return np.asarray(_distances(rng, size) * np.where(far, factor, 1.0))

    return draw


NORMAL_MEAN = float(np.sqrt(8 / np.pi))
"""Mean length of a vector whose three components are standard normal."""
POPULATIONS = (
    Lengths(name="normal in space", mean=NORMAL_MEAN, draw=_distances),
    Lengths(name="lognormal, sigma 0.5", mean=float(np.exp(0.125)), draw=_skewed(0.5)),
    Lengths(name="lognormal, sigma 1", mean=float(np.exp(0.5)), draw=_skewed(1.0)),
    Lengths(
        name="one in ten a miss, 20 times as far",
        mean=2.9 * NORMAL_MEAN,
        draw=_with_misses(0.1, 20.0),
    ),
)
"""Misses are what makes a mean hard: a sample without one knows nothing of them."""


def of_median(n: int) -> Coverage:
    """Coverage of the median's interval of n values; the same for every continuous distribution."""
    place = median_rank(n)
    covered = float(1 - 2 * binom.cdf(place - 1, n, 0.5)) if place else 0.0
    return Coverage(n=n, worst=covered, worst_at="any continuous distribution", mean=covered)


def of_mean(
    interval: Callable[[list[float]], Interval], n: int, *, draws: int, rng: np.random.Generator
) -> Coverage:
    """Coverage of an interval of the mean of n lengths, over the populations above.

    Args:
        interval: Gives the interval of the mean of some lengths.
        n: Lengths in each sample.
        draws: Samples from each population.
        rng: Draws the samples.
    """
    covered = []
    for population in POPULATIONS:
        made = [interval(row.tolist()) for row in population.draw(rng, (draws, n))]
        covered.append(sum(i.low <= population.mean <= i.high for i in made) / draws)
    worst = int(np.argmin(covered))
    return Coverage(
        n=n,
        worst=covered[worst],
        worst_at=POPULATIONS[worst].name,
        mean=float(np.mean(covered)),
    )
