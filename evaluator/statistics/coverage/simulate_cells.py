"""Coverage by drawing cells: every statistic of agreement, by every method, from the same draws."""

from collections.abc import Callable, Iterator, Sequence
from functools import cache

import numpy as np
from scipy.stats import rankdata

from evaluator.errors import UndefinedStatisticError
from evaluator.result import Interval
from evaluator.statistics.bootstrap import METHODS, CellSample, refuse_no_width
from evaluator.statistics.coverage.exact import Coverage
from evaluator.statistics.coverage.population import Population
from evaluator.statistics.remeasure import remeasure_counts
from evaluator.statistics.weighted import STATISTICS, Values, values_of

TRUTH_DRAWS = 200_000
PAIR_CELLS, PAIR_SETS = 400, 60
"""Cells of one set, and sets, for the truth of what is counted over pairs of cells."""
MAX_SETS, SET_NUMBERS = 2_000, 5_000_000
"""Sets whose mean MMRV is the truth, and sets x cells x cells at most."""
MAX_EXACT, NUM_RESAMPLES, NUM_DRAWS = 2_000, 499, 400
"""Fewer resamples than are made for a report: the drawing repeats them thousands of times."""
SEED = 20_261_121
ENOUGH = 0.2
"""A population with fewer intervals than this share of the most is too rarely defined to judge."""


@cache
def truth(statistic: str, population: Population, num_units: int) -> float:
    """Return the statistic of a very large sample of measured cells.

    The mean maximum rank violation grows with the number of cells, whatever the twin is like; its
    truth is the mean over many samples of as many cells.

    Args:
        statistic: A name in ``weighted.STATISTICS``.
        population: Of cells.
        num_units: Cells, or clusters of cells, in one sample; asked for by MMRV only.
    """
    rng = np.random.default_rng(SEED)
    if statistic == "bias":
        return 0.0  # both sides have the same distribution
    if statistic.startswith("mmrv"):
        cells = num_units * population.cells_per_cluster
        sets = min(MAX_SETS, SET_NUMBERS // cells**2)
        return _mean_over_sets(statistic, population, num_units, sets, rng)
    if statistic in ("kendall", "order"):
        units = PAIR_CELLS // population.cells_per_cluster
        return _mean_over_sets(statistic, population, units, PAIR_SETS, rng)
    x, y = population.draw(TRUTH_DRAWS // population.cells_per_cluster, rng)
    if statistic == "spearman":
        return float(np.corrcoef(rankdata(x), rankdata(y))[0, 1])
    (value,), _ = values_of(statistic, np.ones((1, len(x))), x, y)
    return float(value)


def _mean_over_sets(
    statistic: str, population: Population, units: int, sets: int, rng: np.random.Generator
) -> float:
    x, y = population.draw(units * sets, rng)
    recorded, sim = x.reshape(sets, -1), y.reshape(sets, -1)
    values, defined = values_of(statistic, np.ones_like(recorded), recorded, sim)
    return float(values[defined].mean())


def of_agreement(
    num_units: int, populations: Sequence[Population], *, draws: int, rng: np.random.Generator
) -> dict[str, Coverage]:
    """Coverage of every statistic by every method, as ``jackknife-points:mae``.

    Samples in which a method gives no interval do not count for it.

    Args:
        num_units: Cells, or clusters of cells.
        populations: What the cells are drawn from; all of them clustered, or none.
        draws: Samples of each population.
        rng: Source of the samples and resamples.
    """
    tally = _Tally(populations)
    for place, population in enumerate(populations):
        per_cluster = population.cells_per_cluster
        clusters = [i // per_cluster for i in range(num_units * per_cluster)]
        truths = {name: truth(name, population, num_units) for name in STATISTICS}
        for _ in range(draws):
            x, y = population.draw(num_units, rng)
            sample = CellSample(
                recorded=x.tolist(),
                sim=y.tolist(),
                rng=rng,
                clusters=None if per_cluster == 1 else clusters,
                max_exact=MAX_EXACT,
                num_resamples=NUM_RESAMPLES,
            )
            for statistic, value in truths.items():
                for method in METHODS:

                    def make(statistic: str = statistic, method: str = method) -> Interval:
                        return refuse_no_width(sample.interval(statistic, method))  # noqa: B023

                    tally.add(f"{method}-{sample.kind}:{statistic}", place, make, value)
    return tally.coverage(num_units)


def of_remeasurements(
    num_cells: int, populations: Sequence[Population], *, draws: int, rng: np.random.Generator
) -> dict[str, Coverage]:
    """How often a band holds the statistic of a second measurement, as ``remeasurement:mae``.

    Pearson's is called ``remeasurement``.

    Args:
        num_cells: Cells.
        populations: What the cells are drawn from.
        draws: Samples of each population.
        rng: Source of the samples.
    """
    tally = _Tally(populations)
    for place, population in enumerate(populations):
        for _ in range(draws):
            rates = population.true_rates(num_cells, rng)
            first, second = population.measure(rates, rng), population.measure(rates, rng)
            counts = [[(int(k), population.trials) for k in side] for side in first]
            band = remeasure_counts(counts[0], counts[1], rng=rng, num_draws=NUM_DRAWS)
            for statistic, value in _second(second / population.trials):
                key = f"remeasurement:{statistic}".removesuffix(":pearson")
                tally.add(key, place, lambda b=band, s=statistic: b.band(s), value)  # type: ignore[misc]
    return tally.coverage(num_cells)


def _second(rates: np.ndarray) -> Iterator[tuple[str, float]]:
    """Every statistic of a second measurement that is defined there."""
    for statistic in STATISTICS:
        found: Values = values_of(statistic, np.ones((1, rates.shape[1])), rates[0], rates[1])
        if found[1][0]:
            yield statistic, float(found[0][0])


class _Tally:
    """How often each interval was there, and how often it held the truth, by population."""

    def __init__(self, populations: Sequence[Population]) -> None:
        self._names = [population.name for population in populations]
        self._counts: dict[str, np.ndarray] = {}

    def add(self, key: str, place: int, make: Callable[[], Interval], value: float) -> None:
        counts = self._counts.setdefault(key, np.zeros((2, len(self._names))))
        try:
            interval = make()
        except UndefinedStatisticError:
            return
        counts[:, place] += 1, interval.low <= value <= interval.high

    def coverage(self, n: int) -> dict[str, Coverage]:
        found = {}
        for key, (made, held) in self._counts.items():
            there = made > ENOUGH * made.max()
            if not there.any():
                found[key] = Coverage(n=n, worst=0.0, worst_at="never defined", mean=0.0)
                continue
            shares = np.where(there, held / np.maximum(made, 1), np.inf)
            worst = int(shares.argmin())
            found[key] = Coverage(
                n=n,
                worst=float(shares[worst]),
                worst_at=self._names[worst],
                mean=float(shares[there].mean()),
            )
        return found
