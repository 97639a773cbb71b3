"""GMSD: how unevenly the edges of two images differ; needs no learned weights."""

import numpy as np
from jaxtyping import Bool, Float

from evaluator.errors import UndefinedStatisticError
from evaluator.metrics.image import check_same_shape

LUMA = (0.299, 0.587, 0.114)
"""Shares of red, green and blue in luma (ITU-R BT.601)."""
CONSTANT = 170.0
"""Keeps flat regions from counting, for images in 0..255."""
GMSD_MIN_PX = 6
"""Shortest side [px]: three pixels at half size, so that one gradient sees no border."""


def gmsd(
    recorded: Float[np.ndarray, "height width 3"],
    replayed: Float[np.ndarray, "replayed_height replayed_width 3"],
    *,
    mask: Bool[np.ndarray, "height width"] | None = None,
) -> float:
    """Return the gradient magnitude similarity deviation (Xue, Zhang, Mou, Bovik 2014).

    Luma in 0..255, halved by the mean of 2 x 2 pixels (an odd last row or column is dropped),
    Prewitt gradients divided by 3 with zeros beyond the border, similarity
    (2 g h + 170) / (g^2 + h^2 + 170), and its sample standard deviation over pixels. With a mask,
    over the pixels whose four originals all lie inside.

    Range: 0 and up, 0 is identical edges, lower is better.

    Raises:
        ImageShapeError: When the sizes differ.
        UndefinedStatisticError: When too little is left to have a deviation.
    """
    check_same_shape(recorded, replayed)
    if min(recorded.shape[:2]) < GMSD_MIN_PX:
        reason = f"a side is shorter than {GMSD_MIN_PX} pixels"
        raise UndefinedStatisticError(statistic="GMSD", reason=reason)
    first, second = _steepness(recorded), _steepness(replayed)
    similar = (2.0 * first * second + CONSTANT) / (first * first + second * second + CONSTANT)
    if mask is not None:
        similar = similar[_quads(mask).all(axis=(1, 3))]
    if similar.size < 2:
        raise UndefinedStatisticError(statistic="GMSD", reason="the mask holds too few pixels")
    return float(similar.std(ddof=1))


def _steepness(image: np.ndarray) -> np.ndarray:
    luma = 255.0 * (np.asarray(image, dtype=np.float64) @ np.array(LUMA))
    half = np.pad(_quads(luma).mean(axis=(1, 3)), 1)
    across = half[:, 2:] - half[:, :-2]
    down = half[2:] - half[:-2]
    x = across[:-2] + across[1:-1] + across[2:]
    y = down[:, :-2] + down[:, 1:-1] + down[:, 2:]
    return np.asarray(np.hypot(x, y) / 3.0)


def _quads(plane: np.ndarray) -> np.ndarray:
    rows, columns = plane.shape[0] // 2, plane.shape[1] // 2
    return plane[: 2 * rows, : 2 * columns].reshape(rows, 2, columns, 2)
