"""Sobol points: numbers in a cube that fill it evenly, scrambled by a seed.

The generators are those of Joe and Kuo (2008, ``new-joe-kuo-6``); the points are those of
``scipy.stats.qmc``, whose import takes longer than integrating a small model over them. Scrambled
by a random lower triangular matrix on the digits and a digital shift (Matousek 1998), every point
is uniform, and means over many points are exact to a higher order than those of random numbers.
"""

import numpy as np
from jaxtyping import Float64, Int64

BITS = 30
"""Binary digits of a coordinate."""
_GENERATORS = (
    (1, 0, (1,)),
    (2, 1, (1, 3)),
    (3, 1, (1, 3, 1)),
    (3, 2, (1, 1, 1)),
    (4, 1, (1, 1, 3, 3)),
    (4, 4, (1, 3, 5, 13)),
    (5, 2, (1, 1, 5, 5, 17)),
    (5, 4, (1, 1, 5, 5, 5)),
    (5, 7, (1, 1, 7, 11, 19)),
)
"""Of the dimensions from the second on: degree and inner coefficients of the primitive polynomial,
and the first odd numbers."""
MOST_DIMENSIONS = len(_GENERATORS) + 1


def sobol(
    count: int, dimensions: int, rng: np.random.Generator | None = None
) -> Float64[np.ndarray, "count dimensions"]:
    """Return points of the unit cube, below 1."""
    if not 1 <= dimensions <= MOST_DIMENSIONS or not 0 < count <= 2**BITS:
        message = f"Sobol points: {count} in {dimensions} dimensions of {MOST_DIMENSIONS}"
        raise ValueError(message)
    digits = _directions(dimensions)
    if rng is not None:
        mix = np.tril(rng.integers(0, 2, (dimensions, BITS, BITS)), -1) + np.eye(BITS, dtype=int)
        digits = digits @ mix.transpose(0, 2, 1) % 2
    numbers = digits @ (1 << np.arange(BITS)[::-1])
    places = np.arange(count)
    gray = places ^ (places >> 1)
    points = np.zeros((count, dimensions), dtype=np.int64)
    for bit in range(count.bit_length()):
        points[(gray >> bit) & 1 == 1] ^= numbers[:, bit]
    if rng is not None:
        points ^= rng.integers(0, 2**BITS, dimensions)
    return np.asarray(points / 2**BITS)


def _directions(dimensions: int) -> Int64[np.ndarray, "dimensions numbers digits"]:
    """Return the direction numbers of each dimension, digit by digit from the first on."""
    found = [[1] * BITS]
    for degree, inner, first in _GENERATORS[: dimensions - 1]:
        numbers = list(first)
        for place in range(degree, BITS):
            number = numbers[place - degree] ^ (numbers[place - degree] << degree)
            for back in range(1, degree):
                if inner >> (degree - 1 - back) & 1:
                    number ^= numbers[place - back] << back
            numbers.append(number)
        found.append(numbers)
    shifted = np.array(found, dtype=np.int64) << np.arange(BITS)[::-1]
    return np.asarray(shifted[:, :, None] >> np.arange(BITS)[::-1] & 1)
