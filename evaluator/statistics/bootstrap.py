"""Uncertainty of agreement over cells: resampled cells, resampled policies, one left out.

Points: other tasks of the same kind. Clusters: other policies, whose cells come together. What the
same cells would give when measured again is another question: ``remeasure``.
"""

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, combinations

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.special import gammaln, ndtr, stdtrit

from evaluator.errors import UndefinedStatisticError
from evaluator.result import Interval
from evaluator.statistics.columns import Number, exact, floats
from evaluator.statistics.proportion import LEVEL
from evaluator.statistics.scales import NEAR, SCALES
from evaluator.statistics.weighted import EPSILON, STATISTICS, Values, values_of

MAX_EXACT = 30_000
"""Up to so many different resamples are all visited: 9 units."""
NUM_RESAMPLES = 9_999
MIN_UNITS = 4
"""Of three units, one resample in nine holds only one of them."""
MAX_UNDEFINED = 0.05
"""The part of the resamples that may leave the statistic undefined, as all the same cell does."""
METHODS = ("bootstrap", "bootstrap-expanded", "jackknife")
"""What ``CellSample.interval`` knows, from the narrowest to the widest."""


@dataclass(frozen=True, kw_only=True)
class Resamples:
    """How often each unit is in each resample, and how likely that resample is."""

    counts: Int64[np.ndarray, "resamples units"]
    weights: Float64[np.ndarray, " resamples"]
    is_exact: bool


def resamples(
    num_units: int,
    rng: np.random.Generator,
    *,
    max_exact: int = MAX_EXACT,
    num_resamples: int = NUM_RESAMPLES,
) -> Resamples:
    """Return every resample with its probability when there are few, else random ones.

    The K^K ordered draws of K units are C(2K - 1, K) different resamples, each as likely as its
    multinomial coefficient says (Hall 1992, appendix I).
    """
    if math.comb(2 * num_units - 1, num_units) <= max_exact:
        counts = _all_counts(num_units)
        logs = gammaln(num_units + 1) - gammaln(counts + 1).sum(axis=1)
        weights = np.exp(logs - num_units * math.log(num_units))
        return Resamples(counts=counts, weights=weights, is_exact=True)
    counts = rng.multinomial(num_units, np.full(num_units, 1 / num_units), size=num_resamples)
    weights = np.full(num_resamples, 1 / num_resamples)
    return Resamples(counts=counts.astype(np.int64), weights=weights, is_exact=False)


def _all_counts(num_units: int) -> Int64[np.ndarray, "resamples units"]:
    """Every way to share K draws among K units: bars between stars."""
    if num_units == 1:
        return np.ones((1, 1), dtype=np.int64)
    slots = 2 * num_units - 1
    flat = chain.from_iterable(combinations(range(slots), num_units - 1))
    bars = np.fromiter(flat, dtype=np.int64).reshape(-1, num_units - 1)
    ends = np.full((len(bars), 1), slots, dtype=np.int64)
    edges = np.concatenate([np.full_like(ends, -1), bars, ends], axis=1)
    return np.asarray(np.diff(edges, axis=1) - 1)


class CellSample:
    """Cells, what they belong to, and the interval of each statistic over them.

    Resamples are drawn once, when the first method asks for them, and shared by all statistics.
    """

    def __init__(
        self,
        *,
        recorded: Sequence[Number],
        sim: Sequence[Number],
        rng: np.random.Generator,
        clusters: Sequence[Hashable] | None = None,
        max_exact: int = MAX_EXACT,
        num_resamples: int = NUM_RESAMPLES,
    ) -> None:
        """Prepare.

        Args:
            recorded: Recorded rate of each cell.
            sim: The twin's.
            rng: Draws the resamples where they are too many to visit.
            clusters: What each cell belongs to, for example its policy; cells alone without.
            max_exact: All resamples are visited up to this many.
            num_resamples: Random resamples beyond that.
        """
        self._recorded, self._sim = (floats(side) for side in exact("interval", recorded, sim))
        names = list(range(len(self._recorded))) if clusters is None else list(clusters)
        units = {name: place for place, name in enumerate(dict.fromkeys(names))}
        self._members = np.array([units[name] for name in names])
        self._rng, self._limits = rng, (max_exact, num_resamples)
        self._values: dict[str, Values] = {}
        self.num_units = len(units)
        self.kind = "points" if clusters is None else "clusters"

    @cached_property
    def _drawn(self) -> Resamples:
        max_exact, num = self._limits
        return resamples(self.num_units, self._rng, max_exact=max_exact, num_resamples=num)

    @cached_property
    def _counts(self) -> Float64[np.ndarray, "resamples cells"]:
        return self._drawn.counts[:, self._members].astype(np.float64)

    def _resampled(self, statistic: str) -> Values:
        if statistic not in self._values:
            found = values_of(statistic, self._counts, self._recorded, self._sim)
            self._values[statistic] = found
        return self._values[statistic]

    def interval(self, statistic: str, method: str, *, level: float = LEVEL) -> Interval:
        """Return the interval of a statistic by one of ``METHODS``.

        bootstrap: percentiles of the resampled values. bootstrap-expanded: percentiles further
        out, as Student's t is further out than the normal (Hesterberg 2015).
        jackknife: Student's t with the standard error of leaving one unit out (Tukey 1958), on
        Fisher's z or the logarithm where ``scales`` says so.

        Raises:
            UndefinedStatisticError: Below 4 units, when the statistic is undefined in more than
                5 % of the resamples, at the end of its range, or when nothing varies.
        """
        what = f"{method} of {self.kind}"
        if self.num_units < MIN_UNITS:
            reason = f"{self.num_units} units; it needs at least {MIN_UNITS}"
            raise UndefinedStatisticError(statistic=what, reason=reason)
        if method == "jackknife":
            low, high = self._jackknife(statistic, what, level)
        else:
            tail = (1 - level) / 2
            if method == "bootstrap-expanded":
                tail = expanded_tail(tail, self.num_units)
            values, defined = self._resampled(statistic)
            low, high = weighted_ends(values, defined, self._drawn.weights, tail, what)
        return Interval(low=low, high=high, level=level, method=f"{method}-{self.kind}")

    def _jackknife(self, statistic: str, what: str, level: float) -> tuple[float, float]:
        units = self.num_units
        left = (np.arange(units)[:, None] != self._members[None, :]).astype(np.float64)
        every = np.ones((1, len(self._members)))
        (value,), (known,) = values_of(statistic, every, self._recorded, self._sim)
        without, defined = values_of(statistic, left, self._recorded, self._sim)
        if not known or not defined.all():
            reason = "the statistic is undefined when one unit is left out"
            raise UndefinedStatisticError(statistic=what, reason=reason)
        error = math.sqrt((units - 1) / units * float(((without - without.mean()) ** 2).sum()))
        reach = float(stdtrit(units - 1, 0.5 + level / 2)) * error
        return SCALES[statistic].around(what, float(value), reach)


def expanded_tail(tail: float, num_units: int) -> float:
    """Return the tail at which a percentile is as far out as Student's t would have it."""
    quantile = float(stdtrit(num_units - 1, tail))
    return float(ndtr(quantile * math.sqrt(num_units / (num_units - 1))))


def bootstrap_interval(
    statistic: str,
    *,
    recorded: Sequence[Number],
    sim: Sequence[Number],
    rng: np.random.Generator,
    clusters: Sequence[Hashable] | None = None,
    level: float = LEVEL,
    max_exact: int = MAX_EXACT,
    num_resamples: int = NUM_RESAMPLES,
) -> Interval:
    """Return the percentile interval of a statistic over resampled cells or clusters of cells.

    Args:
        statistic: A name in ``weighted.STATISTICS``: pearson, mae, mmrv-recorded ...
        recorded: Recorded rate of each cell.
        sim: The twin's.
        rng: Draws the resamples where they are too many to visit.
        clusters: What each cell belongs to, for example its policy; cells on their own without.
        level: Confidence level.
        max_exact: All resamples are visited up to this many.
        num_resamples: Random resamples beyond that.

    Raises:
        UndefinedStatisticError: Below 4 units, or when the statistic is undefined in more than
            5 % of the resamples.
        ValueError: For an unknown statistic.
    """
    if statistic not in STATISTICS:
        message = f"{statistic!r} has no bootstrap; there are: {', '.join(STATISTICS)}"
        raise ValueError(message)
    sample = CellSample(
        recorded=recorded,
        sim=sim,
        rng=rng,
        clusters=clusters,
        max_exact=max_exact,
        num_resamples=num_resamples,
    )
    return sample.interval(statistic, "bootstrap", level=level)


def student_interval(values: Sequence[Number], *, level: float = LEVEL) -> Interval:
    """Return Student's t interval of a mean over independent cells, or over cluster means.

    Raises:
        UndefinedStatisticError: Below 3 values, or when they are all the same: no interval of
            zero width is given.
    """
    x = floats(values)
    if len(x) < 3:
        raise UndefinedStatisticError(
            statistic="Student's interval", reason=f"{len(x)} values; it needs at least 3"
        )
    spread = float(x.std(ddof=1))
    if spread * spread < EPSILON:
        raise UndefinedStatisticError(
            statistic="Student's interval", reason=f"all {len(x)} values are the same"
        )
    half = float(stdtrit(len(x) - 1, 0.5 + level / 2)) * spread / math.sqrt(len(x))
    mean = float(x.mean())
    return Interval(low=mean - half, high=mean + half, level=level, method="student-t")


def weighted_ends(
    values: Float64[np.ndarray, " sets"],
    defined: Bool[np.ndarray, " sets"],
    weights: Float64[np.ndarray, " sets"],
    tail: float,
    statistic: str,
) -> tuple[float, float]:
    """Return the weighted quantiles of the defined values that leave ``tail`` on each side.

    Raises:
        UndefinedStatisticError: When more than 5 % are undefined.
    """
    undefined = float(weights[~defined].sum())
    if undefined > MAX_UNDEFINED:
        raise UndefinedStatisticError(
            statistic=statistic,
            reason=f"the statistic is undefined in {100 * undefined:.0f} % of the resamples",
        )
    order = np.argsort(values[defined], kind="stable")
    ordered, mass = values[defined][order], np.cumsum(weights[defined][order])
    tails = np.array([tail, 1 - tail]) * mass[-1]
    places = np.minimum(np.searchsorted(mass, tails - EPSILON), len(ordered) - 1)
    return float(ordered[places[0]]), float(ordered[places[1]])


def refuse_no_width(interval: Interval) -> Interval:
    """Return the interval if it has any width.

    Raises:
        UndefinedStatisticError: When it has none: it would claim to be certain.
    """
    if interval.high - interval.low < NEAR:
        raise UndefinedStatisticError(
            statistic=interval.method,
            reason="nothing varies between resamples: the interval would have no width",
        )
    return interval
