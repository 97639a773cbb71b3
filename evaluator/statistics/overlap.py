"""Do the starts that were tried on the robot lie where the twin's other starts lie?

What the twin says of the other starts may stand for them only if the tried ones are like them. Two
looks at where objects lay: are both draws from one distribution, and is any other start further out
than the tried ones reach?
"""

import math
from collections.abc import Iterator
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float64

from evaluator.errors import UndefinedStatisticError

MIN_STARTS = 2
"""On each side; a single start has no neighbour of its own kind."""
MAX_STARTS = 500
"""Of each side that are looked at; more are drawn from."""
MOST_COUNTED = 5_000
"""So many ways to split the starts are counted out; of more, this many less one are drawn."""
SEED = 0
ROUNDING = 1e-9
"""Relative: the same split written in another order is no larger."""

Starts = Float64[np.ndarray, "num_starts num_coordinates"]


def starts_alike(tried: Starts, others: Float64[np.ndarray, "num_others num_coordinates"]) -> float:
    """Return the p-value that both sets of starts were drawn from one distribution.

    Permutation test on the energy distance 2 E|X - Y| - E|X - X'| - E|Y - Y'| (Szekely and Rizzo
    2004), exact where all splits can be counted out, else (1 + as large) / (1 + drawn) over seeded
    draws (Phipson and Smyth 2010). Small p: tried and other starts lie elsewhere.

    Args:
        tried: Coordinates of all objects [m], one row for each start with a robot trial.
        others: The same of the starts that only the twin has.

    Raises:
        UndefinedStatisticError: With fewer than two starts on a side.
    """
    _refuse_few(tried, others)
    rng = np.random.default_rng(SEED)
    tried, others = (_some(side, rng) for side in (tried, others))
    both = np.concatenate([tried, others])
    distances_m = _distances(both, both)
    n, total = len(tried), len(both)
    found = float(_energy((np.arange(total) < n)[None], distances_m)[0])
    largest = found - ROUNDING * max(abs(found), float(distances_m.mean()))
    as_large = num_splits = 0
    exact = math.comb(total, n) <= MOST_COUNTED
    for splits in _all_splits(total, n) if exact else _drawn_splits(total, n, rng):
        as_large += int((_energy(splits, distances_m) >= largest).sum())
        num_splits += len(splits)
    return as_large / num_splits if exact else (1 + as_large) / (1 + num_splits)


def starts_covered(
    tried: Starts, others: Float64[np.ndarray, "num_others num_coordinates"]
) -> tuple[int, int]:
    """Count the other starts that lie no further from a tried one than tried ones lie apart.

    Further means: beyond the largest distance of a tried start from its nearest tried neighbour.
    Were both drawn alike, about n / (n + 1) of the others would be covered by n tried ones.

    Returns:
        Covered starts, and all others that were looked at.

    Raises:
        UndefinedStatisticError: With fewer than two starts on a side.
    """
    _refuse_few(tried, others)
    apart_m = _distances(tried, tried)
    np.fill_diagonal(apart_m, np.inf)
    reach_m = float(apart_m.min(axis=1).max())
    nearest_m = np.array([_distances(row[None], tried).min() for row in others])
    return int((nearest_m <= reach_m * (1 + ROUNDING)).sum()), len(others)


def _refuse_few(tried: np.ndarray, others: np.ndarray) -> None:
    for side, words in ((tried, "with a robot trial"), (others, "only the twin has")):
        if len(side) < MIN_STARTS:
            raise UndefinedStatisticError(
                statistic="overlap of starts",
                reason=f"{len(side)} localised starts {words}; it needs {MIN_STARTS}",
            )


def _some(side: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    if len(side) <= MAX_STARTS:
        return side
    return np.asarray(side[np.sort(rng.choice(len(side), MAX_STARTS, replace=False))])


def _distances(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.norm(first[:, None] - second[None], axis=-1))


def _energy(splits: Bool[np.ndarray, "num_splits total"], distances_m: np.ndarray) -> np.ndarray:
    """Energy distance between the marked and the unmarked starts of each split."""
    marked = splits.astype(np.float64)
    n = marked.sum(axis=1)
    m = marked.shape[1] - n
    to_marked = marked @ distances_m
    within = (to_marked * marked).sum(axis=1)
    between = (to_marked * (1 - marked)).sum(axis=1)
    rest = distances_m.sum() - within - 2 * between
    return np.asarray(2 * between / (n * m) - within / n**2 - rest / m**2)


def _all_splits(total: int, n: int) -> Iterator[np.ndarray]:
    chosen = np.array(list(combinations(range(total), n)))
    splits = np.zeros((len(chosen), total), dtype=bool)
    np.put_along_axis(splits, chosen, values=True, axis=1)
    yield splits


def _drawn_splits(total: int, n: int, rng: np.random.Generator) -> Iterator[np.ndarray]:
    left = MOST_COUNTED - 1
    while left:
        count = min(left, 500)
        start = np.tile(np.arange(total) < n, (count, 1))
        yield rng.permuted(start, axis=1)
        left -= count
