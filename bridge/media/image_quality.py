"""How much an image is like another one: PSNR and SSIM of RGB images, in float64.

SSIM has three customs at the border of an image; all three are here. Every number is computed on
8-bit images scaled to 0..1, so that rebuild and evaluation give the same one of the same files.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Float64, UInt8
from numpy.lib.stride_tricks import as_strided

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

    Args:
        recorded: In 0..1.
        replayed: In 0..1.
        mask: Pixels that count; None: all.
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
    """Brighten the replayed image, channel by channel, as near to the recorded one as it gets.

    Args:
        recorded_u8: The one to come near to: 8 bits, or numbers in 0..1.
        replayed_u8: The one to brighten: 8 bits, or numbers in 0..1.
        alignment: ``raw`` changes nothing, ``gain`` fits a factor.
    """
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


# The sliding window as products with small matrices of weights, in float64: a band of rows times a
# matrix that holds the window once for each row, one place further on, is the window slid down;
# blocks of columns times its transpose slide it across. Half of these products are with zeros, and
# BLAS is still much faster than sums of shifted rows. Bands are so small that they stay in the
# cache and that BLAS starts no threads of its own. Windowed are u = a + b, v = a - b and their
# squares, for SSIM needs no more: 2 mu_a mu_b is half of mu_u^2 - mu_v^2, mu_a^2 + mu_b^2 half of
# mu_u^2 + mu_v^2, and so on for the variances.

WINDOW = 11
SIGMA = 1.5
BORDER = WINDOW // 2
C1 = 0.01**2
C2 = 0.03**2
_BELL = np.exp(-0.5 * ((np.arange(WINDOW) - BORDER) / SIGMA) ** 2)
_WEIGHTS = _BELL / _BELL.sum()

Padding = Literal["valid", "zero", "reflect"]
"""What a window sees beyond the border: it never reaches there, zeros, or the mirrored image."""

_BLOCK = 16
"""Window centres in a block, across and down. More means more products with zeros, fewer more
calls."""
_PART = 96
"""Columns that slide down in one product."""
_PLANES = 4


@dataclass(frozen=True, kw_only=True)
class Band:
    """SSIM around some rows of window centres. The next band overwrites it."""

    channel: int
    rows: slice
    similar: Float64[np.ndarray, "num_rows num_columns"]


class SlidWindow:
    """Windows over two images of one size, at least as large as the window."""

    def __init__(
        self,
        first: Float[np.ndarray, "height width channels"],
        second: Float[np.ndarray, "height width channels"],
        padding: Padding,
    ) -> None:
        """Look at both images, which stay as they are."""
        self._images = first, second
        self._mirrored = padding == "reflect"
        self._room = 0 if padding == "valid" else BORDER
        height, width, channels = first.shape
        self.channels: int = channels
        self.rows: int = height + 2 * self._room - 2 * BORDER
        self.columns: int = width + 2 * self._room - 2 * BORDER
        self._block = min(_BLOCK, self.columns)
        self._num_blocks = -(-self.columns // self._block)
        # Columns beyond the image fill up the last block and the last part.
        needed = self._num_blocks * self._block + 2 * BORDER
        self._width = -(-needed // _PART) * _PART
        self._scratch: dict[int, _Scratch] = {}

    @property
    def size(self) -> int:
        """Window centres in all channels."""
        return self.rows * self.columns * self.channels

    def bands(self) -> Iterator[Band]:
        """Yield SSIM channel by channel, from top to bottom, in buffers that are used again."""
        for channel in range(self.channels):
            before: _Scratch | None = None
            for start in range(0, self.rows, _BLOCK):
                count = min(_BLOCK, self.rows - start)
                here, known = self._scratch_of(count), 0
                if before is not None:  # the rows that both bands see
                    known = 2 * BORDER
                    here.seen[:, :known] = before.seen[:, -known:]
                self._look(here.seen[:, known:], channel, start + known - self._room)
                self._slide(here)
                yield self._compared(here.across, channel, slice(start, start + count))
                before = here

    def _scratch_of(self, count: int) -> "_Scratch":
        if count not in self._scratch:
            self._scratch[count] = _Scratch(
                seen=np.zeros((_PLANES, count + 2 * BORDER, self._width)),
                down=np.empty((_PLANES, count, self._width)),
                across=np.empty((_PLANES, count, self._num_blocks * self._block)),
            )
        return self._scratch[count]

    def _look(self, seen: np.ndarray, channel: int, first: int) -> None:
        """Fill in rows of the images from ``first`` on, with what lies beyond the border."""
        a, b = (image[..., channel] for image in self._images)
        height, width = a.shape
        last = first + seen.shape[1]
        start = min(max(first, 0), height)
        inside = slice(start, max(start, min(last, height)))  # empty: a band below the image
        columns = slice(self._room, None)
        for plane, combine in ((0, np.add), (1, np.subtract)):
            into = seen[plane, :, columns][:, :width]
            if inside.stop > inside.start:
                combine(a[inside], b[inside], out=into[inside.start - first : inside.stop - first])
            for row in (*range(first, 0), *range(max(height, first), last)):
                beyond = -row if row < 0 else 2 * height - 2 - row
                into[row - first] = combine(a[beyond], b[beyond]) if self._mirrored else 0.0
        if self._mirrored:
            end = BORDER + width
            seen[:2, :, :BORDER] = seen[:2, :, 2 * BORDER : BORDER : -1]
            seen[:2, :, end : end + BORDER] = seen[:2, :, end - 2 : end - 2 - BORDER : -1]
        np.multiply(seen[:2], seen[:2], out=seen[2:])

    def _slide(self, here: "_Scratch") -> None:
        _, count, width = here.down.shape
        parts = width // _PART
        np.matmul(
            _weights(count),
            here.seen.reshape(_PLANES, -1, parts, _PART).swapaxes(1, 2),
            out=here.down.reshape(_PLANES, count, parts, _PART).swapaxes(1, 2),
        )
        item = here.down.itemsize
        pieces = as_strided(
            here.down,
            shape=(self._num_blocks, _PLANES * count, self._block + 2 * BORDER),
            strides=(self._block * item, width * item, item),
            writeable=False,
        )
        slid = here.across.reshape(_PLANES * count, self._num_blocks, self._block)
        np.matmul(pieces, _weights_across(self._block), out=slid.swapaxes(0, 1))

    def _compared(self, windowed: np.ndarray, channel: int, rows: slice) -> Band:
        mean_u, mean_v, power_u, power_v = windowed
        np.square(windowed[:2], out=windowed[:2])
        power_u -= mean_u
        power_v -= mean_v
        power_u += 2 * C2
        structure = np.subtract(power_u, power_v)
        power_u += power_v
        structure /= power_u
        mean_u += 2 * C1
        similar = np.subtract(mean_u, mean_v, out=power_v)
        mean_u += mean_v
        similar /= mean_u
        similar *= structure
        return Band(channel=channel, rows=rows, similar=similar[:, : self.columns])


@dataclass(frozen=True, kw_only=True)
class _Scratch:
    """Where one band is worked on: u, v and their squares."""

    seen: Float64[np.ndarray, "4 num_seen width"]
    down: Float64[np.ndarray, "4 num_rows width"]
    across: Float64[np.ndarray, "4 num_rows columns"]


@cache
def _weights(count: int) -> Float64[np.ndarray, "count seen"]:
    """Hold the window once in each row, one column further on."""
    weights = np.zeros((count, count + 2 * BORDER))
    for row in range(count):
        weights[row, row : row + WINDOW] = _WEIGHTS
    return weights


@cache
def _weights_across(count: int) -> Float64[np.ndarray, "seen count"]:
    return np.ascontiguousarray(_weights(count).T)  # BLAS is twice as fast than on a transpose


PADDINGS: dict[Padding, str] = {
    "valid": "windows inside the image only",
    "zero": "zeros beyond the border",
    "reflect": "mirrored beyond the border",
}


@dataclass(frozen=True, kw_only=True)
class SsimMaps:
    """SSIM of every window centre, under every padding, and the part of it without brightness."""

    zero: Float[np.ndarray, "height width channels"]
    reflect: Float[np.ndarray, "height width channels"]

    @property
    def valid(self) -> Float[np.ndarray, "inner_height inner_width channels"]:
        """Windows inside the image."""
        return self.zero[BORDER:-BORDER, BORDER:-BORDER]

    def mean(
        self, padding: Padding, *, mask: Bool[np.ndarray, "height width"] | None = None
    ) -> float:
        """Average over pixels and channels; with a mask, over window centres inside it.

        Args:
            mask: Pixels whose windows count; None: all.
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

    Args:
        recorded: In 0..1.
        replayed: In 0..1.
    """
    _refuse_small(recorded, replayed)
    zero = _maps(recorded, replayed, "zero")
    return SsimMaps(zero=zero, reflect=_with_mirrored_border(zero, recorded, replayed))


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

    Args:
        recorded: In 0..1.
        replayed: In 0..1.
        mask: Pixels whose windows count; None: all.
    """
    _refuse_small(recorded, replayed)
    if mask is not None:
        return ssim_maps(recorded, replayed).mean(padding, mask=mask)
    window = SlidWindow(recorded, replayed, padding)
    return math.fsum(float(band.similar.sum()) for band in window.bands()) / window.size


def _refuse_small(recorded: np.ndarray, replayed: np.ndarray) -> None:
    check_same_shape(recorded, replayed)
    if min(recorded.shape[:2]) < WINDOW:
        raise UndefinedStatisticError(
            statistic="SSIM",
            reason=f"the image is smaller than the {WINDOW} x {WINDOW} window",
        )


def _maps(recorded: np.ndarray, replayed: np.ndarray, padding: Padding) -> np.ndarray:
    """Return SSIM around every window centre."""
    window = SlidWindow(recorded, replayed, padding)
    similar = np.empty((window.channels, window.rows, window.columns))
    for band in window.bands():
        similar[band.channel, band.rows] = band.similar
    return np.asarray(np.moveaxis(similar, 0, -1))


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
        reflect[rows, columns] = _maps(a, b, "valid")
    return reflect
