"""The sliding window of SSIM as products with small matrices of weights, in float64.

A band of rows times a matrix that holds the window once for each row, one place further on, is the
window slid down; blocks of columns times its transpose slide it across. Half of these products are
with zeros, and BLAS is still much faster than sums of shifted rows. Bands are so small that they
stay in the cache and that BLAS starts no threads of its own.

Windowed are u = a + b, v = a - b and their squares, for SSIM needs no more: 2 mu_a mu_b is half of
mu_u^2 - mu_v^2, mu_a^2 + mu_b^2 half of mu_u^2 + mu_v^2, and so on for the variances.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Float64
from numpy.lib.stride_tricks import as_strided

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
    structure: Float64[np.ndarray, "num_rows num_columns"]
    """Contrast times structure: SSIM without brightness."""


class SlidWindow:
    """Windows over two images of one size, at least as large as the window."""

    def __init__(
        self,
        first: Float[np.ndarray, "height width channels"],
        second: Float[np.ndarray, "height width channels"],
        padding: Padding,
    ) -> None:
        """Look at both images, which stay as they are."""
        self._images, broken = _without_broken(first, second)
        self._spoilt = None if broken is None else _windows_seeing(broken, padding)
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
        similar, structure = similar[:, : self.columns], structure[:, : self.columns]
        if self._spoilt is not None:
            spoilt = self._spoilt[rows, :, channel]
            similar[spoilt] = structure[spoilt] = np.nan
        return Band(channel=channel, rows=rows, similar=similar, structure=structure)


@dataclass(frozen=True, kw_only=True)
class _Scratch:
    """Where one band is worked on: u, v and their squares."""

    seen: Float64[np.ndarray, "4 num_seen width"]
    down: Float64[np.ndarray, "4 num_rows width"]
    across: Float64[np.ndarray, "4 num_rows columns"]


def _without_broken(
    first: np.ndarray, second: np.ndarray
) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray | None]:
    """Set values that are not finite to 0, for their product with 0 would spoil whole blocks."""
    with np.errstate(invalid="ignore", over="ignore"):
        if math.isfinite(float(first.sum()) + float(second.sum())):
            return (first, second), None
    broken = ~(np.isfinite(first) & np.isfinite(second))
    return (np.where(broken, 0.0, first), np.where(broken, 0.0, second)), broken


def _windows_seeing(
    broken: Bool[np.ndarray, "height width channels"], padding: Padding
) -> Bool[np.ndarray, "num_rows num_columns channels"]:
    from scipy.ndimage import maximum_filter  # noqa: PLC0415  # hardly ever needed

    mode = "mirror" if padding == "reflect" else "constant"
    near = maximum_filter(broken, size=(WINDOW, WINDOW, 1), mode=mode)
    inner = slice(BORDER, -BORDER)
    return np.asarray(near[inner, inner] if padding == "valid" else near)


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
