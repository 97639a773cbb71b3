"""Real spherical harmonics of degree 1: how colour changes with the direction of view.

In the order and with the signs of 3D Gaussian splatting files: from order -1 to 1, with the
Condon-Shortley sign (Sloan 2008). The constant one is the colour itself and is not among them.
"""

from typing import Any

import numpy as np
from jaxtyping import Float, Float32

SH_FIRST = 0.4886025119029199
"""Factor of the three of them, sqrt(3 / (4 pi))."""
NUM_FIRST = 3


def harmonic_terms(x: Any, y: Any, z: Any) -> list[Any]:
    """Values of the harmonics along unit directions, arrays of NumPy or of torch."""
    return [-SH_FIRST * y, SH_FIRST * z, -SH_FIRST * x]


def turned_harmonics(
    harmonics: Float32[np.ndarray, "num_splats num_harmonics 3"],
    R_new_old: Float[np.ndarray, "*splats 3 3"],
) -> Float32[np.ndarray, "num_splats num_harmonics 3"]:
    """The harmonics of Gaussians that were turned with all that shines on them.

    One rotation for all of them, or one for each. They are a vector for each colour,
    sqrt(3 / (4 pi)) v . d with v = (-h_2, -h_0, h_1), and turn like one.
    """
    if harmonics.shape[1] == 0:
        return harmonics
    v = np.stack([-harmonics[:, 2], -harmonics[:, 0], harmonics[:, 1]], axis=1)
    x, y, z = np.moveaxis(R_new_old @ v, 1, 0)
    return np.ascontiguousarray(np.stack([-y, z, -x], axis=1), dtype=np.float32)
