"""Coverage by drawing: agreement over cells, and the real rate with the twin's help."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Float64, Int64
from scipy.special import ndtr

from evaluator.errors import UndefinedStatisticError
from evaluator.result import Interval
from evaluator.statistics.coverage.exact import Coverage
from evaluator.statistics.gate import Confusion

TWINS = ((0.9, 0.9), (0.7, 0.7), (0.95, 0.6), (0.5, 0.5))
"""P(sim success | real success) and P(sim failure | real failure): good, fair, optimistic, none."""
REAL_RATES = (0.05, 0.1, 0.3, 0.5, 0.7, 0.9, 0.95)
ALONE_PER_PAIR = 10
"""Starts in the twin without a robot trial, for each with one."""
TRUTH_DRAWS = 400_000
LOOKED_AT_AGAIN = 3
"""Truths with the lowest coverage that are drawn a second time."""
LONGER = 5


@dataclass(frozen=True, kw_only=True)
class Population:
    """Cells whose recorded and simulated success rates go together more or less.

    Both rates of a cell are 0.05 + 0.9 x the normal distribution function of two normal variables
    with correlation ``correlation``; a share of each belongs to the cluster. Counts are binomial.
    """

    correlation: float
    cluster_share: float = 0.0
    cells_per_cluster: int = 1
    trials: int = 10

    def draw(
        self, num_clusters: int, rng: np.random.Generator
    ) -> tuple[Float64[np.ndarray, " cells"], Float64[np.ndarray, " cells"]]:
        """Draw measured rates, recorded and simulated, cluster by cluster."""
        recorded, sim = self.measure(self.true_rates(num_clusters, rng), rng)
        return recorded / self.trials, sim / self.trials

    def measure(
        self, true_rates: Float64[np.ndarray, "sides cells"], rng: np.random.Generator
    ) -> Int64[np.ndarray, "sides cells"]:
        """Count successes of cells with these true rates."""
        return np.asarray(rng.binomial(self.trials, true_rates), dtype=np.int64)

    def true_rates(
        self, num_clusters: int, rng: np.random.Generator
    ) -> Float64[np.ndarray, "sides cells"]:
        """Draw true rates, recorded and simulated, cluster by cluster."""
        own, shared = (1 - self.cluster_share) ** 0.5, self.cluster_share**0.5
        size = (num_clusters, self.cells_per_cluster)
        alone = self._pairs(size, rng)
        together = self._pairs((num_clusters, 1), rng)
        rates = 0.05 + 0.9 * ndtr(own * alone + shared * together)
        return np.asarray(rates.reshape(2, -1))

    def _pairs(self, size: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
        first, second = rng.standard_normal((2, *size))
        rest = (1 - self.correlation**2) ** 0.5
        return np.array([first, self.correlation * first + rest * second])


POPULATIONS = tuple(
    Population(correlation=r, trials=trials) for r in (0.0, 0.5, 0.9) for trials in (10, 50)
)
CLUSTERED = tuple(
    Population(correlation=r, trials=trials, cluster_share=0.5, cells_per_cluster=3)
    for r in (0.0, 0.5, 0.9)
    for trials in (10, 50)
)

Cells = tuple[Sequence[float], Sequence[float]]


@cache
def truth(statistic: str, population: Population) -> float:
    """Return the statistic of a very large sample of measured cells."""
    rng = np.random.default_rng(20_261_121)
    x, y = population.draw(TRUTH_DRAWS // population.cells_per_cluster, rng)
    if statistic == "bias":
        return 0.0  # both sides have the same distribution
    if statistic == "mae":
        return float(np.abs(y - x).mean())
    return float(np.corrcoef(x, y)[0, 1])


def of_cells(
    interval: Callable[[Cells, int, np.random.Generator], Interval],
    statistic: str,
    num_units: int,
    populations: Sequence[Population],
    *,
    draws: int,
    rng: np.random.Generator,
) -> Coverage:
    """Coverage over populations of cells; samples without an interval do not count.

    Args:
        interval: Makes one from measured rates and the number of cells in a cluster.
        statistic: pearson, bias or mae: what the truth is.
        num_units: Cells, or clusters of cells.
        populations: What the cells are drawn from.
        draws: Samples of each population.
        rng: Source of the samples.
    """

    def sample(place: int) -> bool | None:
        population = populations[place]
        x, y = population.draw(num_units, rng)
        try:
            found = interval((x.tolist(), y.tolist()), population.cells_per_cluster, rng)
        except UndefinedStatisticError:
            return None
        return found.low <= truth(statistic, population) <= found.high

    return _judge(num_units, [_name(p) for p in populations], sample, draws)


def of_remeasurement(
    band: Callable[[Cells, int, np.random.Generator], Interval],
    num_cells: int,
    populations: Sequence[Population],
    *,
    draws: int,
    rng: np.random.Generator,
) -> Coverage:
    """How often a band holds the r of a second measurement of the same cells.

    Args:
        band: Makes one from the successes of each cell and the trials in each.
        num_cells: Cells.
        populations: What the cells are drawn from.
        draws: Samples of each population.
        rng: Source of the samples.
    """

    def sample(place: int) -> bool | None:
        population = populations[place]
        rates = population.true_rates(num_cells, rng)
        first, second = population.measure(rates, rng), population.measure(rates, rng)
        if (second.min(axis=1) == second.max(axis=1)).any():
            return None
        again = float(np.corrcoef(second)[0, 1])
        try:
            found = band((first[0].tolist(), first[1].tolist()), population.trials, rng)
        except UndefinedStatisticError:
            return None
        return found.low <= again <= found.high

    return _judge(num_cells, [_name(p) for p in populations], sample, draws)


def of_proxy(
    interval: Callable[[Confusion, int, int], Interval],
    num_pairs: int,
    *,
    draws: int,
    rng: np.random.Generator,
) -> Coverage:
    """Coverage of the real rate from robot trials and ten times as many starts in the twin."""
    truths = [(rate, twin) for rate in REAL_RATES for twin in TWINS]
    alone = ALONE_PER_PAIR * num_pairs

    def sample(place: int) -> bool | None:
        rate, (sensitivity, specificity) = truths[place]
        tp, fp = rate * sensitivity, (1 - rate) * (1 - specificity)
        shares = [tp, fp, rate - tp, 1 - rate - fp]
        table = rng.multinomial(num_pairs, shares).tolist()
        sim_k = int(rng.binomial(alone, tp + fp))
        pairs = Confusion(
            true_positive=table[0],
            false_positive=table[1],
            false_negative=table[2],
            true_negative=table[3],
        )
        try:
            found = interval(pairs, sim_k, alone)
        except UndefinedStatisticError:
            return None
        return found.low <= rate <= found.high

    names = [f"p = {rate:g}, twin right {twin[0]:g} and {twin[1]:g}" for rate, twin in truths]
    return _judge(num_pairs, names, sample, draws)


def _judge(
    n: int, names: Sequence[str], sample: Callable[[int], bool | None], draws: int
) -> Coverage:
    """Draw every truth; draw the lowest ones anew and longer, for a minimum of noise is too low."""

    def share(place: int, count: int) -> float | None:
        answers = [answer for answer in (sample(place) for _ in range(count)) if answer is not None]
        return sum(answers) / len(answers) if answers else None

    found = {place: share(place, draws) for place in range(len(names))}
    covered = {place: value for place, value in found.items() if value is not None}
    if not covered:
        return Coverage(n=n, worst=0.0, worst_at="never defined", mean=0.0)
    mean = float(np.mean(list(covered.values())))
    lowest = sorted(covered, key=lambda place: covered[place])[:LOOKED_AT_AGAIN]
    again = {place: share(place, LONGER * draws) or 0.0 for place in lowest}
    worst = min(again, key=lambda place: again[place])
    return Coverage(n=n, worst=again[worst], worst_at=names[worst], mean=mean)


def _name(population: Population) -> str:
    return f"r = {population.correlation:g}, {population.trials} trials per cell"
