"""Real spherical harmonics of degree 1 to 3: how colour changes with the direction of view.

In the order and with the signs of 3D Gaussian splatting files: degree by degree, in each from
order -l to l, with the Condon-Shortley sign (Sloan 2008). The constant one is the colour itself
and is not among them.
"""

from functools import cache
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

SH_FIRST = 0.4886025119029199
"""Factor of the three real spherical harmonics of degree 1, sqrt(3 / (4 pi))."""
SH_SECOND = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
"""Of degree 2 and order 1, 0, 2: sqrt(15 / (4 pi)), sqrt(5 / (16 pi)), sqrt(15 / (16 pi)). That of
xy is the first, too."""
SH_THIRD = (
    *(0.37317633259011546, 0.4570457994644658),
    *(1.445305721320277, 2.890611442640554, 0.5900435899266435),
)
"""Of degree 3 and order 0, 1, 2, that of xyz, and order 3: sqrt(7 / (16 pi)), sqrt(21 / (32 pi)),
sqrt(105 / (16 pi)), sqrt(105 / (4 pi)), sqrt(35 / (32 pi))."""

NUM_HARMONICS = (0, 3, 8, 15)
"""How many there are up to each degree."""
NUM_FIRST = NUM_HARMONICS[1]
HIGHEST = len(NUM_HARMONICS) - 1


def degree_of(num_harmonics: int) -> int:
    """The degree up to which so many harmonics go; one of ``NUM_HARMONICS``."""
    return NUM_HARMONICS.index(num_harmonics)


def harmonic_terms(x: Any, y: Any, z: Any, num_harmonics: int) -> list[Any]:
    """Values of the harmonics along unit directions, arrays of NumPy or of torch."""
    terms = [-SH_FIRST * y, SH_FIRST * z, -SH_FIRST * x]
    if num_harmonics <= NUM_FIRST:
        return terms[:num_harmonics]
    xx, yy, zz = x * x, y * y, z * z
    one, zero, two = SH_SECOND
    terms += [one * x * y, -one * y * z, zero * (2.0 * zz - xx - yy), -one * x * z]
    terms += [two * (xx - yy)]
    if num_harmonics <= NUM_HARMONICS[2]:
        return terms
    zero, one, two, xyz, three = SH_THIRD
    terms += [-three * y * (3.0 * xx - yy), xyz * x * y * z, -one * y * (4.0 * zz - xx - yy)]
    terms += [zero * z * (2.0 * zz - 3.0 * xx - 3.0 * yy)]
    terms += [-one * x * (4.0 * zz - xx - yy), two * z * (xx - yy), -three * x * (xx - 3.0 * yy)]
    return terms


def harmonic_basis(
    directions: Float[np.ndarray, "*shape 3"], num_harmonics: int = NUM_FIRST
) -> Float[np.ndarray, "*shape num_harmonics"]:
    """Values of the harmonics along unit directions."""
    x, y, z = np.moveaxis(directions, -1, 0)
    return np.asarray(np.stack(harmonic_terms(x, y, z, num_harmonics), axis=-1))


def turned_harmonics(
    harmonics: Float32[np.ndarray, "num_splats num_harmonics 3"],
    R_new_old: Float[np.ndarray, "*splats 3 3"],
) -> Float32[np.ndarray, "num_splats num_harmonics 3"]:
    """The harmonics of Gaussians that were turned with all that shines on them.

    One rotation for all of them, or one for each. Degree 1 is a vector for each colour,
    sqrt(3 / (4 pi)) v . d with v = (-h_2, -h_0, h_1), and turns like one. A rotation mixes the
    harmonics of a degree among themselves; how, follows from their values along enough directions:
    what is seen along d now was seen along R^T d before.
    """
    if harmonics.shape[1] == 0:
        return harmonics
    v = np.stack([-harmonics[:, 2], -harmonics[:, 0], harmonics[:, 1]], axis=1)
    x, y, z = np.moveaxis(R_new_old @ v, 1, 0)
    turned = [np.stack([-y, z, -x], axis=1)]
    for degree in range(2, degree_of(harmonics.shape[1]) + 1):
        band = slice(*NUM_HARMONICS[degree - 1 : degree + 1])
        directions, inverse = _directions(degree)
        before = harmonic_basis(directions @ R_new_old, NUM_HARMONICS[degree])[..., band]
        turned.append(inverse @ before @ harmonics[:, band])
    return np.ascontiguousarray(np.concatenate(turned, axis=1), dtype=np.float32)


@cache
def _directions(degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions all over the sphere, and the inverse of a degree's harmonics along them."""
    band = slice(*NUM_HARMONICS[degree - 1 : degree + 1])
    count = 4 * degree + 2
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    azimuth = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)  # a spiral by the golden angle
    across = np.sqrt(1.0 - z * z)
    directions = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), z], axis=1)
    values = harmonic_basis(directions, NUM_HARMONICS[degree])[:, band]
    return directions, np.linalg.pinv(values)
