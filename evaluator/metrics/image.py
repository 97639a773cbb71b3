"""PSNR and SSIM of a replayed image against the recorded one, each with its protocol named.

Masking, padding and window move these numbers more than any model does, so a number without its
protocol is not a result.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import correlate1d

from evaluator.errors import EvaluatorError, UndefinedStatisticError

SSIM_WINDOW = 11
SSIM_SIGMA = 1.5
SSIM_C1 = 0.01**2
SSIM_C2 = 0.03**2

PSNR_PROTOCOL = "PSNR, sRGB, data range 1, one mean squared error over all pixels and channels"
SSIM_PROTOCOL = (
    f"SSIM (Wang 2004), gaussian {SSIM_WINDOW} x {SSIM_WINDOW} sigma {SSIM_SIGMA}, C1 1e-4, "
    "C2 9e-4, population covariance, valid crop, per channel then mean, sRGB, data range 1"
)
LPIPS_NOT_COMPUTED = (
    "not computed: no backbone (its weights are not shipped and nothing is downloaded)"
)
Alignment = Literal["raw", "gain", "affine"]
"""How a replayed image was brightened before it was scored."""
ALIGNMENTS: dict[Alignment, str] = {
    "raw": "no colour alignment",
    "gain": (
        "after one gain per image and channel (least squares on the recorded image, "
        "then clipped to 0..1)"
    ),
    "affine": (
        "after one gain and offset per image and channel (least squares on the recorded image, "
        "then clipped to 0..1)"
    ),
}
"""In words, for definitions. Alignment looks at the recorded image, so numbers are named by it."""


class ImageShapeError(EvaluatorError):
    """Two images that cannot be laid over each other."""

    def __init__(self, *, found: str) -> None:
        """Remember what did not fit."""
        super().__init__(f"{found}. Compare images of the same camera and size.")


@dataclass(frozen=True, kw_only=True)
class ImageScore:
    """How one replayed image differs from the recorded one."""

    psnr_db: float | None
    """None when both images are identical (infinite)."""
    ssim: float | None
    """None when the image, or what the mask leaves, is smaller than the window."""
    num_pixels: int


def image_from_u8(
    image_u8: UInt8[np.ndarray, "height width 3"],
) -> Float[np.ndarray, "height width 3"]:
    """Scale to 0..1; no gamma is undone."""
    return image_u8.astype(np.float64) / 255.0


def psnr_db(
    recorded: Float[np.ndarray, "height width channels"],
    replayed: Float[np.ndarray, "replayed_height replayed_width channels"],
    *,
    mask: Bool[np.ndarray, "height width"] | None = None,
) -> float:
    """Return the peak signal-to-noise ratio [dB]; with a mask, of its pixels only.

    The replayed axes carry their own names, so that a wrong size gets our message.

    Range: 0 dB and up for images in 0..1, higher is better. Undefined when: the images are equal.

    Raises:
        ImageShapeError: When the sizes differ.
        UndefinedStatisticError: When the error is exactly zero, or the mask is empty.
    """
    _same_shape(recorded, replayed)
    squared = (recorded - replayed) ** 2
    if mask is not None:
        squared = squared[mask]
    if squared.size == 0:
        raise UndefinedStatisticError(statistic="PSNR", reason="the mask holds no pixel")
    error = float(squared.mean())
    if error == 0:
        raise UndefinedStatisticError(statistic="PSNR", reason="the images are identical")
    return -10.0 * math.log10(error)


def ssim(
    recorded: Float[np.ndarray, "height width channels"],
    replayed: Float[np.ndarray, "replayed_height replayed_width channels"],
    *,
    mask: Bool[np.ndarray, "height width"] | None = None,
) -> float:
    """Return the mean structural similarity (``SSIM_PROTOCOL``).

    With a mask, the mean runs over window centres inside it; windows may reach over its edge.

    Range: -1 to 1, 1 is identical. Undefined when: the image is smaller than the window.

    Raises:
        ImageShapeError: When the sizes differ.
        UndefinedStatisticError: With the reason.
    """
    _same_shape(recorded, replayed)
    if min(recorded.shape[:2]) < SSIM_WINDOW:
        raise UndefinedStatisticError(
            statistic="SSIM",
            reason=f"the image is smaller than the {SSIM_WINDOW} x {SSIM_WINDOW} window",
        )
    mean_a, mean_b = _blur(recorded), _blur(replayed)
    var_a = _blur(recorded * recorded) - mean_a * mean_a
    var_b = _blur(replayed * replayed) - mean_b * mean_b
    cov = _blur(recorded * replayed) - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + SSIM_C1) / (mean_a**2 + mean_b**2 + SSIM_C1)
    structure = (2 * cov + SSIM_C2) / (var_a + var_b + SSIM_C2)
    values = luminance * structure
    if mask is not None:
        border = SSIM_WINDOW // 2
        values = values[mask[border:-border, border:-border]]
    if values.size == 0:
        raise UndefinedStatisticError(
            statistic="SSIM", reason="the mask holds no window centre away from the border"
        )
    return float(values.mean())


def aligned(
    recorded_u8: UInt8[np.ndarray, "height width 3"],
    replayed_u8: UInt8[np.ndarray, "replayed_height replayed_width 3"],
    alignment: Alignment,
) -> Float[np.ndarray, "height width 3"]:
    """Brighten the replayed image, channel by channel, as near to the recorded one as it gets.

    Raises:
        ImageShapeError: When the sizes differ.
    """
    _same_shape(recorded_u8, replayed_u8)
    replayed = image_from_u8(replayed_u8)
    if alignment == "raw":
        return replayed
    recorded = image_from_u8(recorded_u8)
    channels = []
    for a, b in zip(np.moveaxis(replayed, -1, 0), np.moveaxis(recorded, -1, 0), strict=True):
        shift_a, shift_b = (a.mean(), b.mean()) if alignment == "affine" else (0.0, 0.0)
        power = float(np.square(a - shift_a).sum())
        gain = float(((a - shift_a) * (b - shift_b)).sum()) / power if power > 0 else 1.0
        channels.append(gain * (a - shift_a) + shift_b)
    return np.asarray(np.clip(np.stack(channels, axis=-1), 0.0, 1.0))


def score_image(
    recorded_u8: UInt8[np.ndarray, "height width 3"],
    replayed_u8: UInt8[np.ndarray, "replayed_height replayed_width 3"],
    *,
    mask: Bool[np.ndarray, "height width"] | None = None,
    alignment: Alignment = "raw",
) -> ImageScore:
    """Return both scores of one pair; what is undefined is None.

    With an alignment, the whole images decide it, whatever the mask.

    Raises:
        ImageShapeError: When the sizes differ.
    """
    recorded = image_from_u8(recorded_u8)
    replayed = aligned(recorded_u8, replayed_u8, alignment)
    try:
        psnr: float | None = psnr_db(recorded, replayed, mask=mask)
    except UndefinedStatisticError:
        psnr = None
    try:
        similarity: float | None = ssim(recorded, replayed, mask=mask)
    except UndefinedStatisticError:
        similarity = None
    pixels = recorded.shape[0] * recorded.shape[1] if mask is None else int(mask.sum())
    return ImageScore(psnr_db=psnr, ssim=similarity, num_pixels=pixels)


def _same_shape(recorded: np.ndarray, replayed: np.ndarray) -> None:
    if recorded.shape != replayed.shape:
        raise ImageShapeError(
            found=f"the recorded image is {recorded.shape}, the replayed one {replayed.shape}"
        )


def _blur(image: Float[np.ndarray, "height width channels"]) -> np.ndarray:
    reach = np.arange(SSIM_WINDOW) - SSIM_WINDOW // 2
    window = np.exp(-0.5 * (reach / SSIM_SIGMA) ** 2)
    window /= window.sum()
    blurred = correlate1d(correlate1d(image, window, axis=0), window, axis=1)
    border = SSIM_WINDOW // 2
    return np.asarray(blurred[border:-border, border:-border])
