"""SSIM with its three customs at the border of an image, and MS-SSIM, in float64."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from evaluator.errors import UndefinedStatisticError
from evaluator.metrics.image import check_same_shape
from evaluator.metrics.window import BORDER, WINDOW, Padding, SlidWindow

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
    _refuse_small(recorded, replayed)
    zero, structure = _maps(recorded, replayed, "zero")
    inner = slice(BORDER, -BORDER)
    return SsimMaps(
        zero=zero,
        reflect=_with_mirrored_border(zero, recorded, replayed),
        structure=structure[inner, inner],
    )


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
    _refuse_small(recorded, replayed)
    if mask is not None:
        return ssim_maps(recorded, replayed).mean(padding, mask=mask)
    window = SlidWindow(recorded, replayed, padding)
    return math.fsum(float(band.similar.sum()) for band in window.bands()) / window.size


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
        structure = _structure(recorded, replayed) if first is None else first.structure.mean()
        product *= max(float(structure), 0.0) ** weight
        recorded, replayed, first = _halved(recorded), _halved(replayed), None
    last = ssim(recorded, replayed, padding=padding)
    return float(product * max(last, 0.0) ** weights[-1])


def _halved(image: np.ndarray) -> np.ndarray:
    height, width = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
    even = image[:height, :width]
    upper = even[0::2, 0::2] + even[0::2, 1::2]
    return np.asarray((upper + even[1::2, 0::2] + even[1::2, 1::2]) / 4.0)


def _refuse_small(recorded: np.ndarray, replayed: np.ndarray) -> None:
    check_same_shape(recorded, replayed)
    if min(recorded.shape[:2]) < WINDOW:
        raise UndefinedStatisticError(
            statistic="SSIM",
            reason=f"the image is smaller than the {WINDOW} x {WINDOW} window",
        )


def _structure(recorded: np.ndarray, replayed: np.ndarray) -> float:
    """Average contrast times structure over the windows inside the image."""
    window = SlidWindow(recorded, replayed, "valid")
    return math.fsum(float(band.structure.sum()) for band in window.bands()) / window.size


def _maps(
    recorded: np.ndarray, replayed: np.ndarray, padding: Padding
) -> tuple[np.ndarray, np.ndarray]:
    """Return SSIM, and its contrast-structure factor, around every window centre."""
    window = SlidWindow(recorded, replayed, padding)
    similar = np.empty((window.channels, window.rows, window.columns))
    structure = np.empty_like(similar)
    for band in window.bands():
        similar[band.channel, band.rows] = band.similar
        structure[band.channel, band.rows] = band.structure
    return np.moveaxis(similar, 0, -1), np.moveaxis(structure, 0, -1)


def _with_mirrored_border(
    zero: np.ndarray, recorded: np.ndarray, replayed: np.ndarray
) -> np.ndarray:
    """Compute the windows that reach over the border again; the others see the same."""
    reflect = zero.copy(order="K")
    both, before, after = (BORDER, BORDER), (BORDER, 0), (0, BORDER)
    near, far, whole = slice(None, 2 * BORDER), slice(-2 * BORDER, None), slice(None)
    for seen, beyond, rows, columns in (
        ((near, whole), (before, both), slice(None, BORDER), whole),
        ((far, whole), (after, both), slice(-BORDER, None), whole),
        ((whole, near), (both, before), whole, slice(None, BORDER)),
        ((whole, far), (both, after), whole, slice(-BORDER, None)),
    ):
        a, b = (np.pad(i[seen], (*beyond, (0, 0)), mode="reflect") for i in (recorded, replayed))
        reflect[rows, columns] = _maps(a, b, "valid")[0]
    return reflect
