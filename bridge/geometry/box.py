"""Boxes around the origin."""

from itertools import product

import numpy as np
from jaxtyping import Float


def box_corners(size_m: Float[np.ndarray, "3"]) -> Float[np.ndarray, "8 3"]:
    """Corners of a box of these extents around the origin [m]."""
    return np.asarray(np.array(list(product((-0.5, 0.5), repeat=3))) * size_m)
