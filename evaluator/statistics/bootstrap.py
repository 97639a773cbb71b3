"""Uncertainty of agreement over cells: resampled cells, resampled policies, measured again.

Three different questions. Points: other tasks of the same kind. Clusters: other policies, whose
cells come together. Remeasurement: the same cells with as many new trials.
"""

import math
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from itertools import chain, combinations

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.special import gammaln
from scipy.stats import t

from evaluator.errors import UndefinedStatisticError
from evaluator.result import Interval
from evaluator.statistics.columns import Number, exact, floats
from evaluator.statistics.proportion import LEVEL

MAX_EXACT = 30_000
"""Up to so many different resamples are all visited: 9 units."""
NUM_RESAMPLES = 9_999
MIN_UNITS = 4
"""Of three units, one resample in nine holds only one of them."""
MAX_UNDEFINED = 0.05
"""The part of the resamples that may leave the statistic undefined, as all the same cell does."""
EPSILON = 1e-12
"""A variance of rates below this is rounding, not variation."""

Rates = Float64[np.ndarray, "sets cells"]
Values = tuple[Float64[np.ndarray, " sets"], Bool[np.ndarray, " sets"]]
"""A statistic of each set of cells, and where it is defined."""


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
        statistic: pearson, bias or mae.
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
    if statistic not in WEIGHTED:
        message = f"{statistic!r} has no bootstrap; there are: {', '.join(WEIGHTED)}"
        raise ValueError(message)
    x, y = (floats(side) for side in exact(statistic, recorded, sim))
    names = list(range(len(x))) if clusters is None else list(clusters)
    units = list(dict.fromkeys(names))
    kind = "points" if clusters is None else "clusters"
    _enough(len(units), f"bootstrap of {kind}")
    drawn = resamples(len(units), rng, max_exact=max_exact, num_resamples=num_resamples)
    members = np.array([units.index(name) for name in names])
    values, defined = WEIGHTED[statistic](drawn.counts[:, members].astype(np.float64), x, y)
    low, high = _ends(values, defined, drawn.weights, level, f"bootstrap of {kind}")
    return Interval(low=low, high=high, level=level, method=f"bootstrap-{kind}")


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
    half = float(t.ppf(0.5 + level / 2, len(x) - 1)) * spread / math.sqrt(len(x))
    mean = float(x.mean())
    return Interval(low=mean - half, high=mean + half, level=level, method="student-t")


def remeasurement_band(
    tables: Sequence[tuple[int, int, int, int]],
    *,
    rng: np.random.Generator,
    level: float = LEVEL,
    num_draws: int = 4_000,
) -> Interval:
    """Return where Pearson's r would fall if the same cells were measured again.

    Each cell's table of trials (both succeed, only sim, only recorded, neither) is drawn anew from
    a multinomial with the observed shares, 1/4 added to each count. Two measurements differ by
    sqrt(2) times the spread of one, around the r that was found; on Fisher's scale.
    A band of measurement noise, not an interval of a true r: the noise itself pulls r towards 0.

    Raises:
        UndefinedStatisticError: Below 3 cells, without trials, or when r is undefined or 1.
    """
    if any(sum(table) == 0 for table in tables):
        raise UndefinedStatisticError(
            statistic="remeasurement band", reason="a cell has no trial with both sides"
        )
    counts = np.array(tables, dtype=np.float64).reshape(-1, 4)
    totals = counts.sum(axis=1)
    found = (counts[:, 0] + counts[:, 2]) / totals, (counts[:, 0] + counts[:, 1]) / totals
    recorded, sim = [], []
    for table, total in zip(counts, totals.astype(int).tolist(), strict=True):
        again = rng.multinomial(total, (table + 0.25) / (total + 1), size=num_draws)
        recorded.append((again[:, 0] + again[:, 2]) / total)
        sim.append((again[:, 0] + again[:, 1]) / total)
    return _band(found, np.array(recorded).T, np.array(sim).T, level)


def remeasurement_band_of_counts(
    recorded: Sequence[tuple[int, int]],
    sim: Sequence[tuple[int, int]],
    *,
    rng: np.random.Generator,
    level: float = LEVEL,
    num_draws: int = 4_000,
) -> Interval:
    """Return the same band from counts (k, n) of sides whose trials are not paired.

    Raises:
        UndefinedStatisticError: Below 3 cells, or when r is undefined or 1.
    """
    found, drawn = [], []
    for side in (recorded, sim):
        found.append(np.array([k / n for k, n in side]))
        again = [rng.binomial(n, (k + 0.5) / (n + 1), size=num_draws) / n for k, n in side]
        drawn.append(np.array(again).T)
    return _band((found[0], found[1]), drawn[0], drawn[1], level)


def _band(
    found: tuple[Float64[np.ndarray, " cells"], Float64[np.ndarray, " cells"]],
    recorded: Rates,
    sim: Rates,
    level: float,
) -> Interval:
    if len(found[0]) < 3:
        raise UndefinedStatisticError(
            statistic="remeasurement band", reason=f"{len(found[0])} cells; it needs at least 3"
        )
    (r,), (defined,) = _pearson_of_each(found[0][None], found[1][None])
    if not defined or abs(r) > 1 - EPSILON:
        raise UndefinedStatisticError(
            statistic="remeasurement band",
            reason="r is undefined" if not defined else f"r is {r:+.0f} exactly",
        )
    values, known = _pearson_of_each(recorded, sim)
    scaled = np.arctanh(np.clip(values, -1 + 1e-6, 1 - 1e-6))
    weights = np.full(len(values), 1 / len(values))
    low, high = _ends(scaled, known, weights, level, "remeasurement band")
    centre, half = math.atanh(float(r)), math.sqrt(2) * (high - low) / 2
    return Interval(
        low=math.tanh(centre - half),
        high=math.tanh(centre + half),
        level=level,
        method="remeasurement",
    )


def _pearson_of_each(x: Rates, y: Rates) -> Values:
    dx, dy = x - x.mean(axis=1, keepdims=True), y - y.mean(axis=1, keepdims=True)
    return _ratio((dx * dy).mean(axis=1), (dx * dx).mean(axis=1), (dy * dy).mean(axis=1))


def _weighted_pearson(
    counts: Rates, x: Float64[np.ndarray, "*cells"], y: Float64[np.ndarray, "*cells"]
) -> Values:
    """Pearson's r with cells counted several times; x and y may differ between resamples."""
    total = counts.sum(axis=1)
    mean_x, mean_y = (counts * x).sum(axis=1) / total, (counts * y).sum(axis=1) / total
    dx, dy = x - mean_x[:, None], y - mean_y[:, None]
    moments = [(counts * a * b).sum(axis=1) / total for a, b in ((dx, dy), (dx, dx), (dy, dy))]
    return _ratio(*moments)


def _weighted_mean(counts: Rates, gaps: Float64[np.ndarray, " cells"]) -> Values:
    return (counts @ gaps) / counts.sum(axis=1), np.ones(len(counts), dtype=bool)


WEIGHTED: dict[str, Callable[..., Values]] = {
    "pearson": _weighted_pearson,
    "bias": lambda counts, x, y: _weighted_mean(counts, y - x),
    "mae": lambda counts, x, y: _weighted_mean(counts, np.abs(y - x)),
}


def _ratio(
    shared: Float64[np.ndarray, " sets"],
    first: Float64[np.ndarray, " sets"],
    second: Float64[np.ndarray, " sets"],
) -> Values:
    defined = (first > EPSILON) & (second > EPSILON)
    scale = np.sqrt(np.where(defined, first * second, 1.0))
    return np.clip(shared / scale, -1.0, 1.0), defined


def _ends(
    values: Float64[np.ndarray, " sets"],
    defined: Bool[np.ndarray, " sets"],
    weights: Float64[np.ndarray, " sets"],
    level: float,
    statistic: str,
) -> tuple[float, float]:
    """Weighted quantiles of the defined values."""
    undefined = float(weights[~defined].sum())
    if undefined > MAX_UNDEFINED:
        raise UndefinedStatisticError(
            statistic=statistic,
            reason=f"the statistic is undefined in {100 * undefined:.0f} % of the resamples",
        )
    order = np.argsort(values[defined], kind="stable")
    ordered, mass = values[defined][order], np.cumsum(weights[defined][order])
    tails = np.array([(1 - level) / 2, (1 + level) / 2]) * mass[-1]
    places = np.minimum(np.searchsorted(mass, tails - EPSILON), len(ordered) - 1)
    return float(ordered[places[0]]), float(ordered[places[1]])


def _enough(num_units: int, statistic: str) -> None:
    if num_units < MIN_UNITS:
        raise UndefinedStatisticError(
            statistic=statistic, reason=f"{num_units} units; it needs at least {MIN_UNITS}"
        )
