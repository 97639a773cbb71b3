"""Boxes and triangles: corners, and points spread over a surface."""

from itertools import product

import numpy as np
from jaxtyping import Float, Int


def box_corners(size_m: Float[np.ndarray, "3"]) -> Float[np.ndarray, "8 3"]:
    """Corners of a box of these extents around the origin [m]."""
    return np.asarray(np.array(list(product((-0.5, 0.5), repeat=3))) * size_m)


def sample_triangles(
    areas: Float[np.ndarray, " num_triangles"],
    count: int,
    rng: np.random.Generator,
    *,
    in_order: bool = False,
) -> tuple[
    Int[np.ndarray, " num_samples"],
    Float[np.ndarray, "num_samples 1"],
    Float[np.ndarray, "num_samples 1"],
]:
    """Spread points over triangles, evenly over their area.

    Returns:
        The triangle of each point, and its share of the way from the first corner to the second
        and to the third: ``a + u (b - a) + v (c - a)``.
    """
    if in_order:
        edges = np.cumsum(areas) / areas.sum()
        chosen = np.searchsorted(edges, (np.arange(count) + 0.5) / count)
    else:
        chosen = rng.choice(len(areas), size=count, p=areas / areas.sum())
    u, v = rng.uniform(size=(2, count, 1))
    over = u + v > 1
    return chosen, np.where(over, 1 - u, u), np.where(over, 1 - v, v)
