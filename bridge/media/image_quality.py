"""How much an image is like another one: PSNR and SSIM of RGB images, in float64.

SSIM has two customs at the border of an image; both are here. Every number is computed on 8-bit
images scaled to 0..1, so that rebuild and evaluation give the same one of the same files.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, UInt8

from bridge.errors import BridgeError, UndefinedStatisticError

Alignment = Literal["raw", "gain"]
"""How a replayed image was brightened before it was scored."""
ALIGNMENTS: dict[Alignment, str] = {
    "raw": "no colour alignment",
    "gain": (
        "after one gain per image and channel (least squares on the recorded image, "
        "then clipped to 0..1)"
    ),
}
"""In words, for definitions. Alignment looks at the recorded image, so numbers are named by it."""


class ImageShapeError(BridgeError):
    """Two images that cannot be laid over each other."""

    def __init__(self, *, found: str) -> None:
        """Remember what did not fit."""
        super().__init__(f"{found}. Compare images of the same camera and size.")


def as_float(
    image: UInt8[np.ndarray, "height width 3"] | Float[np.ndarray, "height width 3"],
) -> Float[np.ndarray, "height width 3"]:
    """Scale an 8-bit image to 0..1, or take one that is; no gamma is undone."""
    if image.dtype == np.uint8:
        return np.asarray(np.divide(image, 255.0, dtype=np.float64))
    return np.asarray(image, dtype=np.float64)


def psnr_db(
    recorded: Float[np.ndarray, "height width channels"],
    replayed: Float[np.ndarray, "replayed_height replayed_width channels"],
    *,
    mask: Bool[np.ndarray, "height width"] | None = None,
) -> float:
    """Return the peak signal-to-noise ratio [dB]; with a mask, of its pixels only.

    The replayed axes carry their own names, so that a wrong size gets our message.

    Range: 0 dB and up for images in 0..1, higher is better. Undefined when: the images are equal.
    """
    check_same_shape(recorded, replayed)
    squared = (recorded - replayed) ** 2
    if mask is not None:
        squared = squared[mask]
    if squared.size == 0:
        raise UndefinedStatisticError(statistic="PSNR", reason="the mask holds no pixel")
    error = float(squared.mean())
    if error == 0:
        raise UndefinedStatisticError(statistic="PSNR", reason="the images are identical")
    return -10.0 * math.log10(error)


def aligned(
    recorded_u8: UInt8[np.ndarray, "height width 3"] | Float[np.ndarray, "height width 3"],
    replayed_u8: (
        UInt8[np.ndarray, "replayed_height replayed_width 3"]
        | Float[np.ndarray, "replayed_height replayed_width 3"]
    ),
    alignment: Alignment,
) -> Float[np.ndarray, "height width 3"]:
    """Brighten the replayed image, channel by channel, as near to the recorded one as it gets."""
    check_same_shape(recorded_u8, replayed_u8)
    replayed = as_float(replayed_u8)
    if alignment == "raw":
        return replayed
    recorded = as_float(recorded_u8)
    channels = []
    for a, b in zip(np.moveaxis(replayed, -1, 0), np.moveaxis(recorded, -1, 0), strict=True):
        power = float(np.square(a).sum())
        channels.append(float((a * b).sum()) / power * a if power > 0 else a)
    return np.asarray(np.clip(np.stack(channels, axis=-1), 0.0, 1.0))


def check_same_shape(recorded: np.ndarray, replayed: np.ndarray) -> None:
    """Refuse images of different size."""
    if recorded.shape != replayed.shape:
        raise ImageShapeError(
            found=f"the recorded image is {recorded.shape}, the replayed one {replayed.shape}"
        )


WINDOW = 11
SIGMA = 1.5
BORDER = WINDOW // 2
C1 = 0.01**2
C2 = 0.03**2
_BELL = np.exp(-0.5 * ((np.arange(WINDOW) - BORDER) / SIGMA) ** 2)
_WEIGHTS = _BELL / _BELL.sum()

Padding = Literal["valid", "zero"]
"""What a window sees beyond the border: it never reaches there, or zeros."""


def _map(
    recorded: Float[np.ndarray, "height width channels"],
    replayed: Float[np.ndarray, "height width channels"],
) -> Float[np.ndarray, "height width channels"]:
    """SSIM around each pixel.

    Windowed are u = a + b, v = a - b and their squares, for SSIM needs no more: 2 mu_a mu_b is half
    of mu_u^2 - mu_v^2, mu_a^2 + mu_b^2 half of mu_u^2 + mu_v^2, and so on for the variances.
    """
    from scipy.ndimage import correlate1d  # noqa: PLC0415  # half a second that tables do without

    def windowed(plane: Float[np.ndarray, "height width"]) -> Float[np.ndarray, "height width"]:
        down = correlate1d(plane, _WEIGHTS, axis=0, mode="constant")
        return np.asarray(correlate1d(down, _WEIGHTS, axis=1, mode="constant"))

    channels = []
    for a, b in zip(np.moveaxis(recorded, -1, 0), np.moveaxis(replayed, -1, 0), strict=True):
        u, v = a + b, a - b
        with np.errstate(invalid="ignore"):  # images need not be finite
            bright_u, bright_v = windowed(u) ** 2, windowed(v) ** 2
            spread_u, spread_v = windowed(u * u) - bright_u, windowed(v * v) - bright_v
            structure = (spread_u - spread_v + 2 * C2) / (spread_u + spread_v + 2 * C2)
            bright = (bright_u - bright_v + 2 * C1) / (bright_u + bright_v + 2 * C1)
        channels.append(bright * structure)
    return np.stack(channels, axis=-1)


PADDINGS: dict[Padding, str] = {
    "valid": "windows inside the image only",
    "zero": "zeros beyond the border",
}


@dataclass(frozen=True, kw_only=True)
class SsimMaps:
    """SSIM of every window centre, under either padding."""

    zero: Float[np.ndarray, "height width channels"]

    def mean(
        self, padding: Padding, *, mask: Bool[np.ndarray, "height width"] | None = None
    ) -> float:
        """Average over pixels and channels; with a mask, over window centres inside it."""
        inner = slice(BORDER, -BORDER) if padding == "valid" else slice(None)
        values = self.zero[inner, inner]
        if mask is not None:
            values = values[mask[inner, inner]]
        if values.size == 0:
            raise UndefinedStatisticError(
                statistic="SSIM", reason="the mask holds no window centre away from the border"
            )
        return float(values.mean())


def ssim_maps(
    recorded: Float[np.ndarray, "height width channels"],
    replayed: Float[np.ndarray, "replayed_height replayed_width channels"],
) -> SsimMaps:
    """Compute SSIM (Wang et al. 2004) around every pixel, for both paddings at once.

    Gaussian window of 11 x 11 pixels with sigma 1.5, C1 1e-4, C2 9e-4 for images in 0..1,
    population covariance, each channel alone.
    """
    check_same_shape(recorded, replayed)
    if min(recorded.shape[:2]) < WINDOW:
        raise UndefinedStatisticError(
            statistic="SSIM",
            reason=f"the image is smaller than the {WINDOW} x {WINDOW} window",
        )
    return SsimMaps(zero=_map(recorded, replayed))
