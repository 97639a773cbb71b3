"""SSIM with its three customs at the border of an image, and MS-SSIM, in float64.

The window runs row by row over bands that stay in the cache, as sums of shifted rows: on one core
this takes about as long as a float32 convolution, and a broken pixel spoils only its own windows.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from evaluator.errors import UndefinedStatisticError
from evaluator.metrics.image import check_same_shape

WINDOW = 11
SIGMA = 1.5
C1 = 0.01**2
C2 = 0.03**2
BORDER = WINDOW // 2
_BELL = np.exp(-0.5 * ((np.arange(WINDOW) - BORDER) / SIGMA) ** 2)
_WINDOW = tuple(float(weight) for weight in _BELL / _BELL.sum())
_BAND_VALUES = 1 << 15
"""Values of one plane that are worked on at a time: 256 kB, so that a band stays in the cache."""

Padding = Literal["valid", "zero", "reflect"]
"""What a window sees beyond the border: it never reaches there, zeros, or the mirrored image."""
PADDINGS: dict[Padding, str] = {
    "valid": "windows inside the image only",
    "zero": "zeros beyond the border",
    "reflect": "mirrored beyond the border",
}
"""In words, for stamps."""

SCALE_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
"""Exponents of MS-SSIM from full size to a sixteenth."""
MS_SSIM_MIN_PX = WINDOW << (len(SCALE_WEIGHTS) - 1)
"""Shortest side [px] whose smallest scale still holds one window."""


@dataclass(frozen=True, kw_only=True)
class SsimMaps:
    """SSIM of every window centre, under every padding, and the part of it without brightness."""

    zero: Float[np.ndarray, "height width channels"]
    reflect: Float[np.ndarray, "height width channels"]
    structure: Float[np.ndarray, "inner_height inner_width channels"]
    """Contrast times structure, of windows inside the image."""

    @property
    def valid(self) -> Float[np.ndarray, "inner_height inner_width channels"]:
        """Windows inside the image."""
        return self.zero[BORDER:-BORDER, BORDER:-BORDER]

    def mean(
        self, padding: Padding, *, mask: Bool[np.ndarray, "height width"] | None = None
    ) -> float:
        """Average over pixels and channels; with a mask, over window centres inside it.

        Raises:
            UndefinedStatisticError: When the mask holds no window centre.
        """
        values = {"valid": self.valid, "zero": self.zero, "reflect": self.reflect}[padding]
        if mask is not None:
            inside = mask[BORDER:-BORDER, BORDER:-BORDER] if padding == "valid" else mask
            values = values[inside]
        if values.size == 0:
            raise UndefinedStatisticError(
                statistic="SSIM", reason="the mask holds no window centre away from the border"
            )
        return float(values.mean())


def ssim_maps(
    recorded: Float[np.ndarray, "height width channels"],
    replayed: Float[np.ndarray, "replayed_height replayed_width channels"],
) -> SsimMaps:
    """Compute SSIM (Wang et al. 2004) around every pixel, for all paddings at once.

    Gaussian window of 11 x 11 pixels with sigma 1.5, C1 1e-4, C2 9e-4 for images in 0..1,
    population covariance, each channel alone. Mirrored borders differ from zeros only within half
    a window of the border, so only these strips are computed twice.

    Raises:
        ImageShapeError: When the sizes differ.
        UndefinedStatisticError: When the image is smaller than the window.
    """
    check_same_shape(recorded, replayed)
    if min(recorded.shape[:2]) < WINDOW:
        raise UndefinedStatisticError(
            statistic="SSIM",
            reason=f"the image is smaller than the {WINDOW} x {WINDOW} window",
        )
    zero, structure = _terms(_padded(recorded, "constant"), _padded(replayed, "constant"))
    a, b = _padded(recorded, "reflect"), _padded(replayed, "reflect")
    reflect = zero.copy()
    near, far, whole = slice(None, BORDER), slice(-BORDER, None), slice(None)
    for rows, columns in ((near, whole), (far, whole), (whole, near), (whole, far)):
        seen = _seen(rows), _seen(columns)
        reflect[rows, columns] = _terms(a[seen], b[seen])[0]
    inner = structure[BORDER:-BORDER, BORDER:-BORDER]
    return SsimMaps(zero=zero, reflect=reflect, structure=inner)


def ssim(
    recorded: Float[np.ndarray, "height width channels"],
    replayed: Float[np.ndarray, "replayed_height replayed_width channels"],
    *,
    mask: Bool[np.ndarray, "height width"] | None = None,
    padding: Padding = "valid",
) -> float:
    """Return the mean structural similarity of two images in 0..1 (see ``ssim_maps``).

    With a mask, the mean runs over window centres inside it; windows may reach over its edge.

    Range: -1 to 1, 1 is identical. Undefined when: the image is smaller than the window.

    Raises:
        ImageShapeError: When the sizes differ.
        UndefinedStatisticError: With the reason.
    """
    return ssim_maps(recorded, replayed).mean(padding, mask=mask)


def ms_ssim(
    recorded: Float[np.ndarray, "height width channels"],
    replayed: Float[np.ndarray, "replayed_height replayed_width channels"],
    *,
    padding: Literal["valid", "reflect"] = "valid",
    first: SsimMaps | None = None,
    weights: Sequence[float] = SCALE_WEIGHTS,
) -> float:
    """Return the multi-scale structural similarity (Wang, Simoncelli, Bovik 2003).

    Five scales, each half the last by the mean of 2 x 2 pixels (an odd last row or column is
    dropped); contrast times structure of each scale, SSIM of the last, averaged over pixels and
    channels, negative means as 0, raised to ``SCALE_WEIGHTS`` and multiplied.

    Args:
        recorded: In 0..1.
        replayed: In 0..1.
        padding: Of the last scale's SSIM: ``valid`` as the paper has it, ``reflect`` as
            torchmetrics computes it.
        first: The maps of the full size, where they are known.
        weights: Exponents of the scales, full size first.

    Range: 0 to 1, 1 is identical. Undefined when: a side is shorter than ``MS_SSIM_MIN_PX``.

    Raises:
        ImageShapeError: When the sizes differ.
        UndefinedStatisticError: With the reason.
    """
    check_same_shape(recorded, replayed)
    if min(recorded.shape[:2]) < MS_SSIM_MIN_PX:
        raise UndefinedStatisticError(
            statistic="MS-SSIM",
            reason=f"a side is shorter than {MS_SSIM_MIN_PX} pixels, which five scales need",
        )
    product = 1.0
    for weight in weights[:-1]:
        structure = first.structure if first is not None else _terms(recorded, replayed)[1]
        product *= max(float(structure.mean()), 0.0) ** weight
        recorded, replayed, first = _halved(recorded), _halved(replayed), None
    last = ssim_maps(recorded, replayed).mean(padding)
    return float(product * max(last, 0.0) ** weights[-1])


def _halved(image: np.ndarray) -> np.ndarray:
    height, width = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
    even = image[:height, :width]
    upper = even[0::2, 0::2] + even[0::2, 1::2]
    return np.asarray((upper + even[1::2, 0::2] + even[1::2, 1::2]) / 4.0)


def _padded(image: np.ndarray, mode: Literal["constant", "reflect"]) -> np.ndarray:
    edges = ((BORDER, BORDER), (BORDER, BORDER), (0, 0))
    return np.pad(np.asarray(image, dtype=np.float64), edges, mode=mode)


def _seen(centres: slice) -> slice:
    """Return which padded rows the windows around these rows of the image see."""
    if centres.stop is not None:
        return slice(None, centres.stop + 2 * BORDER)
    if centres.start is not None:
        return slice(centres.start - 2 * BORDER, None)
    return centres


def _terms(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return SSIM, and its contrast-structure factor, of every window that fits inside."""
    height, width, channels = a.shape
    size = (height - 2 * BORDER, width - 2 * BORDER, channels)
    a = np.ascontiguousarray(a, dtype=np.float64).reshape(height, -1)
    b = np.ascontiguousarray(b, dtype=np.float64).reshape(height, -1)
    similar = np.empty((size[0], size[1] * channels))
    structure = np.empty_like(similar)
    step = max(1, _BAND_VALUES // a.shape[1])
    for start in range(0, size[0], step):
        stop = min(start + step, size[0])
        _fill_band(
            a[start : stop + 2 * BORDER],
            b[start : stop + 2 * BORDER],
            channels,
            similar[start:stop],
            structure[start:stop],
        )
    return similar.reshape(size), structure.reshape(size)


def _fill_band(
    a: np.ndarray, b: np.ndarray, channels: int, similar: np.ndarray, structure: np.ndarray
) -> None:
    mean_a, mean_b = _blur(a, channels), _blur(b, channels)
    # Only the sum of both variances is needed: four windowed planes instead of five.
    power = _blur(a * a + b * b, channels)
    cross = _blur(a * b, channels)
    means = mean_a * mean_b
    squares = mean_a * mean_a + mean_b * mean_b
    np.divide(2.0 * (cross - means) + C2, power - squares + C2, out=structure)
    np.multiply((2.0 * means + C1) / (squares + C1), structure, out=similar)


def _blur(plane: np.ndarray, channels: int) -> np.ndarray:
    """Slide the window over rows, then over pixels; channels lie side by side in a row."""
    down = _weighted([plane[k : len(plane) - 2 * BORDER + k] for k in range(WINDOW)])
    length = down.shape[1] - 2 * BORDER * channels
    return _weighted([down[:, k * channels : k * channels + length] for k in range(WINDOW)])


def _weighted(shifted: list[np.ndarray]) -> np.ndarray:
    total = shifted[BORDER] * _WINDOW[BORDER]
    pair = np.empty_like(total)
    for k in range(BORDER):
        np.add(shifted[k], shifted[-1 - k], out=pair)
        pair *= _WINDOW[k]
        total += pair
    return np.asarray(total)
