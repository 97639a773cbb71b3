"""Coverage by drawing: closed forms over cells, and the real rate with the twin's help."""

from collections.abc import Callable, Sequence

import numpy as np

from evaluator.errors import UndefinedStatisticError
from evaluator.result import Interval
from evaluator.statistics.coverage.exact import Coverage
from evaluator.statistics.coverage.population import Population
from evaluator.statistics.coverage.simulate_cells import truth
from evaluator.statistics.gate import Confusion

TWINS = ((0.9, 0.9), (0.7, 0.7), (0.95, 0.6), (0.5, 0.5))
"""P(sim success | real success) and P(sim failure | real failure): good, fair, optimistic, none."""
REAL_RATES = (0.05, 0.1, 0.3, 0.5, 0.7, 0.9, 0.95)
ALONE_PER_PAIR = 10
"""Starts in the twin without a robot trial, for each with one."""
LOOKED_AT_AGAIN = 3
"""Truths with the lowest coverage that are drawn a second time."""
LONGER = 5

Cells = tuple[Sequence[float], Sequence[float]]


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
        statistic: A name in ``weighted.STATISTICS``: what the truth is.
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
        return found.low <= truth(statistic, population, num_units) <= found.high

    return _judge(num_units, [population.name for population in populations], sample, draws)


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
