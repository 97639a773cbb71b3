"""Statistics of features, in one pass and with bounded memory: min, max, mean, std, count."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

PIXEL_STRIDE = 4
"""Image statistics look at every fourth pixel of both axes."""


@dataclass(kw_only=True)
class RunningStats:
    """Moments of rows of numbers; ``merge`` adds another's."""

    count: int = 0
    low: np.ndarray | None = None
    high: np.ndarray | None = None
    mean: np.ndarray = field(default_factory=lambda: np.zeros(0))
    squares: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """Sum of squared distances from the mean (Welford; Chan et al. 1983 for merging)."""

    def add(self, rows: Float[np.ndarray, "num_rows num_values"]) -> None:
        """Add rows."""
        if not len(rows):
            return
        mean = rows.mean(axis=0)
        self.merge(
            RunningStats(
                count=len(rows),
                low=rows.min(axis=0),
                high=rows.max(axis=0),
                mean=mean,
                squares=((rows - mean) ** 2).sum(axis=0),
            )
        )

    def merge(self, other: "RunningStats") -> None:
        """Add everything another has seen."""
        if other.low is None or other.high is None:
            return
        if self.low is None or self.high is None:
            self.low, self.high = other.low.copy(), other.high.copy()
            self.mean, self.squares = other.mean.copy(), other.squares.copy()
            self.count = other.count
            return
        total = self.count + other.count
        gap = other.mean - self.mean
        self.squares = self.squares + other.squares + gap**2 * (self.count * other.count / total)
        self.mean = self.mean + gap * (other.count / total)
        self.low, self.high = np.minimum(self.low, other.low), np.maximum(self.high, other.high)
        self.count = total

    def record(self) -> dict[str, Any]:
        """Return what ``meta/stats.json`` holds for a vector."""
        return {
            "min": [] if self.low is None else self.low.tolist(),
            "max": [] if self.high is None else self.high.tolist(),
            "mean": self.mean.tolist(),
            "std": np.sqrt(self.squares / max(self.count, 1)).tolist(),
            "count": [self.count],
        }


@dataclass(kw_only=True)
class ImageStats:
    """The same over the pixels of images, per channel, scaled to 0..1; counts images."""

    pixels: RunningStats = field(default_factory=RunningStats)
    images: int = 0

    def add(self, image_u8: UInt8[np.ndarray, "height width 3"]) -> None:
        """Add one image."""
        thinned = image_u8[::PIXEL_STRIDE, ::PIXEL_STRIDE].reshape(-1, 3)
        self.pixels.add(thinned.astype(np.float64) / 255.0)
        self.images += 1

    def merge(self, other: "ImageStats") -> None:
        """Add everything another has seen."""
        self.pixels.merge(other.pixels)
        self.images += other.images

    def record(self) -> dict[str, Any]:
        """Return what ``meta/stats.json`` holds for a camera: channels first, 3 x 1 x 1."""
        record = self.pixels.record()
        shaped = {
            name: [[[value]] for value in record[name]] for name in ("min", "max", "mean", "std")
        }
        return {**shaped, "count": [self.images]}
