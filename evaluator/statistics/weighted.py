"""Every statistic of agreement over many weighted sets of groups at once, as resampling asks for.

A resample counts each group several times: ``recorded`` and ``sim`` hold one value per group and
``counts`` tells the sets apart. A new measurement has other rates in each set: then both sides are
sets x groups and every count is one. The plain forms are in ``agreement``.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float64

EPSILON = 1e-12
"""A variance of rates below this is rounding, not variation."""
CHUNK = 4_000_000
"""Numbers of sets x groups x groups held at once [32 MB]."""

Counts = Float64[np.ndarray, "sets groups"]
Side = Float64[np.ndarray, "*groups"]
"""Rates by group, or by set and group."""
Values = tuple[Float64[np.ndarray, " sets"], Bool[np.ndarray, " sets"]]
"""A statistic of each set of groups, and where it is defined."""
Statistic = Callable[[Counts, Side, Side], Values]


def values_of(statistic: str, counts: Counts, recorded: Side, sim: Side) -> Values:
    """Compute one statistic of every set."""
    compute = STATISTICS[statistic]
    if recorded.ndim == 1:
        return compute(counts, recorded, sim)
    size = max(1, CHUNK // max(1, counts.shape[1] ** 2))
    parts = [
        compute(counts[at : at + size], recorded[at : at + size], sim[at : at + size])
        for at in range(0, len(counts), size)
    ]
    return np.concatenate([p for p, _ in parts]), np.concatenate([known for _, known in parts])


def ratio(
    shared: Float64[np.ndarray, " sets"],
    first: Float64[np.ndarray, " sets"],
    second: Float64[np.ndarray, " sets"],
) -> Values:
    """Return shared / sqrt(first second), undefined where a factor is 0."""
    defined = (first > EPSILON) & (second > EPSILON)
    scale = np.sqrt(np.where(defined, first * second, 1.0))
    return np.clip(shared / scale, -1.0, 1.0), defined


def _moments(counts: Counts, x: Side, y: Side) -> tuple[np.ndarray, ...]:
    """Means of both sides, their covariance and their variances."""
    total = counts.sum(axis=1)
    mean_x, mean_y = (counts * x).sum(axis=1) / total, (counts * y).sum(axis=1) / total
    dx, dy = x - mean_x[:, None], y - mean_y[:, None]
    second = ((counts * a * b).sum(axis=1) / total for a, b in ((dx, dy), (dx, dx), (dy, dy)))
    return (mean_x, mean_y, *second)


def _pearson(counts: Counts, recorded: Side, sim: Side) -> Values:
    _, _, shared, first, second = _moments(counts, recorded, sim)
    return ratio(shared, first, second)


def _ranks(counts: Counts, side: Side) -> Counts:
    """Average ranks in each set; a group that is there three times takes three ranks."""
    if side.ndim == 2:
        fewer = (side[:, None, :] < side[:, :, None]).sum(axis=2)
        alike = (side[:, None, :] == side[:, :, None]).sum(axis=2)
        return np.asarray(fewer + (alike + 1) / 2)
    below = (side[:, None] < side[None, :]).astype(np.float64)
    same = (side[:, None] == side[None, :]).astype(np.float64)
    return np.asarray(counts @ below + (counts @ same + 1) / 2)


def _signs(side: Side) -> np.ndarray:
    return np.asarray(np.sign(side[..., :, None] - side[..., None, :]))


def _over_pairs(counts: Counts, of_pair: np.ndarray) -> Float64[np.ndarray, " sets"]:
    """Sum over pairs of groups, each as often as it is in the set."""
    if of_pair.ndim == 3:
        return np.asarray(of_pair.sum(axis=(1, 2)) / 2)
    return np.asarray(((counts @ of_pair) * counts).sum(axis=1) / 2)


def _order(counts: Counts, recorded: Side, sim: Side) -> Values:
    first, second = _signs(recorded), _signs(sim)
    differ = np.abs(first)
    right = differ * ((first == second) + 0.5 * (second == 0))
    pairs = _over_pairs(counts, differ)
    defined = pairs > EPSILON
    return _over_pairs(counts, right) / np.where(defined, pairs, 1.0), defined


def _mmrv(counts: Counts, judge: Side, judged: Side) -> Values:
    """Mean over groups of the largest gap to a group in the set whose order is wrong."""
    above = judge[..., :, None] > judge[..., None, :]
    wrong = above != (judged[..., :, None] > judged[..., None, :])
    violations = wrong * np.abs(judge[..., :, None] - judge[..., None, :])
    if violations.ndim == 3:
        worst = violations.max(axis=2)
    else:
        worst = np.stack([_largest_there(counts, row) for row in violations], axis=1)
    return _weighted_mean(counts, worst)


def _largest_there(counts: Counts, row: Float64[np.ndarray, " groups"]) -> np.ndarray:
    """Largest violation of one group against the groups that are in each set."""
    order = np.argsort(-row, kind="stable")[: int((row > 0).sum())]
    if not len(order):
        return np.zeros(len(counts))
    there = counts[:, order] > 0
    first = there.argmax(axis=1)
    return np.asarray(np.where(there.any(axis=1), row[order][first], 0.0))


def _weighted_mean(counts: Counts, values: Side) -> Values:
    means = (counts * values).sum(axis=1) / counts.sum(axis=1)
    return means, np.ones(len(counts), dtype=bool)


STATISTICS: dict[str, Statistic] = {
    "pearson": _pearson,
    "spearman": lambda counts, recorded, sim: _pearson(
        counts, _ranks(counts, recorded), _ranks(counts, sim)
    ),
    "bias": lambda counts, recorded, sim: _weighted_mean(counts, sim - recorded),
    "mae": lambda counts, recorded, sim: _weighted_mean(counts, np.abs(sim - recorded)),
    "order": _order,
    "mmrv-recorded": _mmrv,
}
