"""Coverage of intervals of lengths: counted out for the median, drawn for the mean."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.stats import binom

from evaluator.result import Interval
from evaluator.statistics.coverage.exact import Coverage
from evaluator.statistics.lengths import median_rank

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
    """Coverage of an interval of the mean of n lengths, over the populations above."""
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
