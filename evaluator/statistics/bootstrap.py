"""Uncertainty of agreement over groups: one group or one policy left out, or measured again.

Points: other tasks of the same kind. Clusters: other policies, whose groups come together. What the
same groups would give when measured again is another question: a ``Remeasured`` band of measurement
noise, not an interval of a true value, for the noise itself pulls a correlation towards 0 and
errors away from it.

Each statistic errs by as much upwards as downwards on its own scale (``SCALES``): Fisher's z for
correlations, the logarithm for errors; the others are taken as they are.
"""

import math
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float64
from scipy.special import stdtrit

from evaluator.errors import UndefinedStatisticError
from evaluator.result import Interval
from evaluator.statistics.agreement import Number, counted_groups, exact, floats
from evaluator.statistics.intervals import LEVEL
from evaluator.statistics.weighted import EPSILON, values_of

NEAR = 1e-9
"""A value this close to its limit is at it; Fisher's z is endless there."""
EDGE = 1e-6
"""A redrawn correlation is cut off here before Fisher's z."""


@dataclass(frozen=True, kw_only=True)
class Scale:
    """One scale."""

    there: Callable[[float], float]
    back: Callable[[float], float]
    slope: Callable[[float], float]
    """Derivative of ``there``."""
    low: float = -math.inf
    """The statistic is never below."""
    high: float = math.inf
    is_open: bool = False
    """At its limits the scale is endless, and no interval can be given there."""

    def around(self, statistic: str, value: float, error: float) -> tuple[float, float]:
        """Go ``error`` to both sides of a value, on this scale by the delta method.

        Args:
            value: Where the interval has its middle, in units of the statistic.
            error: How far to go to each side where the scale is straight, in units of the
                statistic.

        Raises:
            UndefinedStatisticError: At a limit of the scale, or when the error is 0.
        """
        if error < NEAR:
            raise UndefinedStatisticError(
                statistic=statistic, reason="nothing varies: the interval would have no width"
            )
        self.refuse_limit(statistic, value)
        middle, half = self.there(value), error * self.slope(value)
        return self.clip(self.back(middle - half)), self.clip(self.back(middle + half))

    def refuse_limit(self, statistic: str, value: float) -> None:
        """Refuse a value at which the scale has no end."""
        if self.is_open and min(value - self.low, self.high - value) < NEAR:
            raise UndefinedStatisticError(
                statistic=statistic, reason=f"it is {value:g} exactly, the end of its range"
            )

    def clip(self, value: float) -> float:
        """Keep an end where the statistic can be."""
        return min(self.high, max(self.low, value))


CORRELATION = Scale(
    there=lambda r: math.atanh(max(-1 + EDGE, min(1 - EDGE, r))),
    back=math.tanh,
    slope=lambda r: 1 / (1 - r * r),
    low=-1.0,
    high=1.0,
    is_open=True,
)
SHARE = Scale(
    there=lambda p: CORRELATION.there(2 * p - 1),
    back=lambda z: (math.tanh(z) + 1) / 2,
    slope=lambda p: 1 / (2 * p * (1 - p)),
    low=0.0,
    high=1.0,
    is_open=True,
)
ERROR = Scale(
    there=lambda e: math.log(max(NEAR, e)),
    back=math.exp,
    slope=lambda e: 1 / e,
    low=0.0,
    is_open=True,
)
PLAIN = Scale(there=lambda v: v, back=lambda v: v, slope=lambda _: 1.0)
RATE = Scale(there=PLAIN.there, back=PLAIN.back, slope=PLAIN.slope, low=0.0, high=1.0)

SCALES: dict[str, Scale] = {
    "pearson": CORRELATION,
    "spearman": CORRELATION,
    "bias": PLAIN,
    "mae": ERROR,
    "order": SHARE,
    "mmrv-recorded": RATE,
}
"""By the names of ``weighted.STATISTICS``."""


MIN_UNITS = 4
"""Below this, leaving one out says too little about the spread."""
MAX_UNDEFINED = 0.05
"""The part of the draws that may leave the statistic undefined."""


class GroupSample:
    """Groups, what they belong to, and the interval of each statistic over them."""

    def __init__(
        self,
        *,
        recorded: Sequence[Number],
        sim: Sequence[Number],
        clusters: Sequence[Hashable] | None = None,
    ) -> None:
        """Prepare.

        Args:
            clusters: What each group belongs to, for example its policy; groups alone without.
        """
        self._recorded, self._sim = (floats(side) for side in exact("interval", recorded, sim))
        names = list(range(len(self._recorded))) if clusters is None else list(clusters)
        units = {name: place for place, name in enumerate(dict.fromkeys(names))}
        self._members = np.array([units[name] for name in names])
        self.num_units = len(units)
        self.method = "jackknife-points" if clusters is None else "jackknife-clusters"

    def interval(self, statistic: str, *, level: float = LEVEL) -> Interval:
        """Return Student's t with the standard error of leaving one unit out (Tukey 1958).

        On Fisher's z or the logarithm where ``SCALES`` says so.

        Raises:
            UndefinedStatisticError: Below 4 units, when the statistic is undefined, at the end of
                its range, or when nothing varies.
        """
        units = self.num_units
        if units < MIN_UNITS:
            reason = f"{units} units; it needs at least {MIN_UNITS}"
            raise UndefinedStatisticError(statistic=self.method, reason=reason)
        left = (np.arange(units)[:, None] != self._members[None, :]).astype(np.float64)
        every = np.ones((1, len(self._members)))
        (value,), (known,) = values_of(statistic, every, self._recorded, self._sim)
        without, defined = values_of(statistic, left, self._recorded, self._sim)
        if not known or not defined.all():
            reason = "the statistic is undefined when one unit is left out"
            raise UndefinedStatisticError(statistic=self.method, reason=reason)
        error = math.sqrt((units - 1) / units * float(((without - without.mean()) ** 2).sum()))
        reach = float(stdtrit(units - 1, 0.5 + level / 2)) * error
        low, high = SCALES[statistic].around(self.method, float(value), reach)
        return refuse_no_width(Interval(low=low, high=high, level=level, method=self.method))


def student_interval(values: Sequence[Number], *, level: float = LEVEL) -> Interval:
    """Return Student's t interval of a mean over independent groups, or over cluster means.

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

    Args:
        values: The statistic in each resample; anything where it is undefined.

    Raises:
        UndefinedStatisticError: When more than 5 % are undefined.
    """
    undefined = float(weights[~defined].sum())
    if undefined > MAX_UNDEFINED:
        raise UndefinedStatisticError(
            statistic=statistic,
            reason=f"the statistic is undefined in {100 * undefined:.0f} % of the draws",
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
            reason="nothing varies: the interval would have no width",
        )
    return interval


NUM_DRAWS = 4_000
MIN_GROUPS = 3
WHAT = "remeasurement band"


@dataclass(frozen=True)
class Remeasured:
    """Measured rates of each group, and rates as they might have come out."""

    recorded: Float64[np.ndarray, " groups"]
    sim: Float64[np.ndarray, " groups"]
    recorded_again: Float64[np.ndarray, "draws groups"]
    sim_again: Float64[np.ndarray, "draws groups"]

    @cached_property
    def _every(self) -> Float64[np.ndarray, "draws groups"]:
        return np.ones_like(self.recorded_again)

    def band(self, statistic: str, *, level: float = LEVEL) -> Interval:
        """Return where a statistic would fall.

        Two measurements differ by sqrt(2) times the spread of one, around the value that was
        found; on Fisher's scale for correlations and shares, on the logarithm for errors.

        Raises:
            UndefinedStatisticError: Below 3 groups, when the statistic is undefined or at the end
                of its range, or when no redrawn rate changes it.
        """
        if len(self.recorded) < MIN_GROUPS:
            reason = f"{counted_groups(len(self.recorded))}; it needs at least {MIN_GROUPS}"
            raise UndefinedStatisticError(statistic=WHAT, reason=reason)
        scale = SCALES[statistic]
        (value,), (known,) = values_of(statistic, self._every[:1], self.recorded, self.sim)
        if not known:
            raise UndefinedStatisticError(statistic=WHAT, reason="the statistic is undefined")
        scale.refuse_limit(WHAT, float(value))
        values, defined = values_of(statistic, self._every, self.recorded_again, self.sim_again)
        weights = np.full(len(values), 1 / len(values))
        ends = weighted_ends(values, defined, weights, (1 - level) / 2, WHAT)
        low, high = (scale.there(end) for end in ends)
        centre, half = scale.there(float(value)), math.sqrt(2) * (high - low) / 2
        if half < NEAR:
            reason = "no other outcome of the trials changes it"
            raise UndefinedStatisticError(statistic=WHAT, reason=reason)
        return Interval(
            low=scale.clip(scale.back(centre - half)),
            high=scale.clip(scale.back(centre + half)),
            level=level,
            method="remeasurement",
        )


def remeasure_paired(
    tables: Sequence[tuple[int, int, int, int]],
    *,
    rng: np.random.Generator,
    num_draws: int = NUM_DRAWS,
) -> Remeasured:
    """Draw each group's table of trials anew: both succeed, only sim, only recorded, neither.

    From a multinomial with the observed shares, 1/4 added to each count.
    """
    if any(sum(table) == 0 for table in tables):
        raise UndefinedStatisticError(statistic=WHAT, reason="a group has no trial with both sides")
    counts = np.array(tables, dtype=np.float64).reshape(-1, 4)
    totals = counts.sum(axis=1)
    recorded, sim = [], []
    for table, total in zip(counts, totals.astype(int).tolist(), strict=True):
        again = rng.multinomial(total, (table + 0.25) / (total + 1), size=num_draws)
        recorded.append((again[:, 0] + again[:, 2]) / total)
        sim.append((again[:, 0] + again[:, 1]) / total)
    return Remeasured(
        (counts[:, 0] + counts[:, 2]) / totals,
        (counts[:, 0] + counts[:, 1]) / totals,
        np.array(recorded).reshape(len(tables), num_draws).T,
        np.array(sim).reshape(len(tables), num_draws).T,
    )


def remeasure_counts(
    recorded: Sequence[tuple[int, int]],
    sim: Sequence[tuple[int, int]],
    *,
    rng: np.random.Generator,
    num_draws: int = NUM_DRAWS,
) -> Remeasured:
    """Draw counts (k, n) anew, of sides whose trials are not paired; 1/2 added to each count.

    Args:
        recorded: Successes and trials of each group as recorded; 1 trial or more.
    """
    found, drawn = [], []
    for side in (recorded, sim):
        found.append(np.array([k / n for k, n in side]))
        again = [rng.binomial(n, (k + 0.5) / (n + 1), size=num_draws) / n for k, n in side]
        drawn.append(np.array(again).reshape(len(side), num_draws).T)
    return Remeasured(found[0], found[1], drawn[0], drawn[1])
