"""Coverage by drawing: closed forms over groups, and the real rate with the twin's help."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Float64, Int64
from scipy.special import ndtr
from scipy.stats import rankdata

from evaluator.errors import UndefinedStatisticError
from evaluator.result import Interval
from evaluator.statistics.bootstrap import METHODS, GroupSample, refuse_no_width, remeasure_counts
from evaluator.statistics.coverage import Coverage
from evaluator.statistics.gate import Confusion
from evaluator.statistics.weighted import STATISTICS, Values, values_of

# Coverage by drawing groups: every statistic of agreement, by every method, from the same
# draws.


@dataclass(frozen=True, kw_only=True)
class Population:
    """Groups whose recorded and simulated success rates go together more or less.

    Both rates of a group are 0.05 + 0.9 x the normal distribution function of two normal variables
    with correlation ``correlation``; a share of each belongs to the cluster. Counts are binomial.
    """

    correlation: float
    cluster_share: float = 0.0
    groups_per_cluster: int = 1
    trials: int = 10

    @property
    def name(self) -> str:
        """What the map says of the truth that is covered least."""
        return f"r = {self.correlation:g}, {self.trials} trials per group"

    def draw(
        self, num_clusters: int, rng: np.random.Generator
    ) -> tuple[Float64[np.ndarray, " groups"], Float64[np.ndarray, " groups"]]:
        """Draw measured rates, recorded and simulated, cluster by cluster.

        Args:
            num_clusters: Clusters to draw, each of ``groups_per_cluster`` groups.
            rng: Draws true rates and outcomes.
        """
        recorded, sim = self.measure(self.true_rates(num_clusters, rng), rng)
        return recorded / self.trials, sim / self.trials

    def measure(
        self, true_rates: Float64[np.ndarray, "sides groups"], rng: np.random.Generator
    ) -> Int64[np.ndarray, "sides groups"]:
        """Count successes of groups with these true rates.

        Args:
            true_rates: Chance of success of each group, 0 to 1: recorded in the first row, then the
                twin's.
            rng: Draws the outcomes.
        """
        return np.asarray(rng.binomial(self.trials, true_rates), dtype=np.int64)

    def true_rates(
        self, num_clusters: int, rng: np.random.Generator
    ) -> Float64[np.ndarray, "sides groups"]:
        """Draw true rates, recorded and simulated, cluster by cluster.

        Args:
            num_clusters: Clusters to draw, each of ``groups_per_cluster`` groups.
            rng: Draws the rates.
        """
        own, shared = (1 - self.cluster_share) ** 0.5, self.cluster_share**0.5
        size = (num_clusters, self.groups_per_cluster)
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
    Population(correlation=r, trials=trials, cluster_share=0.5, groups_per_cluster=3)
    for r in (0.0, 0.5, 0.9)
    for trials in (10, 50)
)


TRUTH_DRAWS = 200_000
PAIR_GROUPS, PAIR_SETS = 400, 60
"""Groups of one set, and sets, for the truth of what is counted over pairs of groups."""
MAX_SETS, SET_NUMBERS = 2_000, 5_000_000
"""Sets whose mean MMRV is the truth, and sets x groups x groups at most."""
MAX_EXACT, NUM_RESAMPLES, NUM_DRAWS = 2_000, 499, 400
"""Fewer resamples than are made for a report: the drawing repeats them thousands of times."""
SEED = 20_261_121
ENOUGH = 0.2
"""A population with fewer intervals than this share of the most is too rarely defined to judge."""


@cache
def truth(statistic: str, population: Population, num_units: int) -> float:
    """Return the statistic of a very large sample of measured groups.

    The mean maximum rank violation grows with the number of groups, whatever the twin is like; its
    truth is the mean over many samples of as many groups.

    Args:
        statistic: A name in ``weighted.STATISTICS``.
        population: Of groups.
        num_units: Groups, or clusters of groups, in one sample; asked for by MMRV only.
    """
    rng = np.random.default_rng(SEED)
    if statistic == "bias":
        return 0.0  # both sides have the same distribution
    if statistic.startswith("mmrv"):
        groups = num_units * population.groups_per_cluster
        sets = min(MAX_SETS, SET_NUMBERS // groups**2)
        return _mean_over_sets(statistic, population, num_units, sets, rng)
    if statistic in ("kendall", "order"):
        units = PAIR_GROUPS // population.groups_per_cluster
        return _mean_over_sets(statistic, population, units, PAIR_SETS, rng)
    x, y = population.draw(TRUTH_DRAWS // population.groups_per_cluster, rng)
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
        num_units: Groups, or clusters of groups.
        populations: What the groups are drawn from; all of them clustered, or none.
        draws: Samples of each population.
        rng: Source of the samples and resamples.
    """
    tally = _Tally(populations)
    for place, population in enumerate(populations):
        per_cluster = population.groups_per_cluster
        clusters = [i // per_cluster for i in range(num_units * per_cluster)]
        truths = {name: truth(name, population, num_units) for name in STATISTICS}
        for _ in range(draws):
            x, y = population.draw(num_units, rng)
            sample = GroupSample(
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
    num_groups: int, populations: Sequence[Population], *, draws: int, rng: np.random.Generator
) -> dict[str, Coverage]:
    """How often a band holds the statistic of a second measurement, as ``remeasurement:mae``.

    Pearson's is called ``remeasurement``.

    Args:
        num_groups: Groups.
        populations: What the groups are drawn from.
        draws: Samples of each population.
        rng: Source of the samples.
    """
    tally = _Tally(populations)
    for place, population in enumerate(populations):
        for _ in range(draws):
            rates = population.true_rates(num_groups, rng)
            first, second = population.measure(rates, rng), population.measure(rates, rng)
            counts = [[(int(k), population.trials) for k in side] for side in first]
            band = remeasure_counts(counts[0], counts[1], rng=rng, num_draws=NUM_DRAWS)
            for statistic, value in _second(second / population.trials):
                key = f"remeasurement:{statistic}".removesuffix(":pearson")
                tally.add(key, place, lambda b=band, s=statistic: b.band(s), value)  # type: ignore[misc]
    return tally.coverage(num_groups)


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


TWINS = ((0.9, 0.9), (0.7, 0.7), (0.95, 0.6), (0.5, 0.5))
"""P(sim success | real success) and P(sim failure | real failure): good, fair, optimistic, none."""
REAL_RATES = (0.05, 0.1, 0.3, 0.5, 0.7, 0.9, 0.95)
ALONE_PER_PAIR = 10
"""Starts in the twin without a robot trial, for each with one."""
LOOKED_AT_AGAIN = 3
"""Truths with the lowest coverage that are drawn a second time."""
LONGER = 5

Groups = tuple[Sequence[float], Sequence[float]]


def of_groups(
    interval: Callable[[Groups, int, np.random.Generator], Interval],
    statistic: str,
    num_units: int,
    populations: Sequence[Population],
    *,
    draws: int,
    rng: np.random.Generator,
) -> Coverage:
    """Coverage over populations of groups; samples without an interval do not count.

    Args:
        interval: Makes one from measured rates and the number of groups in a cluster.
        statistic: A name in ``weighted.STATISTICS``: what the truth is.
        num_units: Groups, or clusters of groups.
        populations: What the groups are drawn from.
        draws: Samples of each population.
        rng: Source of the samples.
    """

    def sample(place: int) -> bool | None:
        population = populations[place]
        x, y = population.draw(num_units, rng)
        try:
            found = interval((x.tolist(), y.tolist()), population.groups_per_cluster, rng)
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
    """Coverage of the real rate from robot trials and ten times as many starts in the twin.

    Args:
        interval: Gives the interval of the real rate from the paired trials, and from successes and
            trials of the twin on further starts.
        num_pairs: Trials that both the robot and the twin made.
        draws: Samples for each true rate and twin.
        rng: Draws the samples.
    """
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
