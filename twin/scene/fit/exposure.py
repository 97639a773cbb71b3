"""How bright each image is: exposure in closed form, with Gaussians fixed."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from twin.scene.frames.rgbd import Target
from twin.scene.gaussians import GaussianCloud
from twin.scene.raster.rasteriser import Rasteriser


@dataclass(frozen=True, kw_only=True)
class Allowance:
    """Time until which a stage may run, by the clock of the fit."""

    clock: Callable[[], float] = time.monotonic
    until_s: float = math.inf
    """On that clock; infinite when images are counted instead of time."""

    def is_over(self) -> bool:
        """Say whether nothing more should be begun."""
        return self.clock() >= self.until_s


UNLIMITED = Allowance()


@dataclass(frozen=True, kw_only=True)
class ImageObservation:
    """One image at one size, where it was seen from, and how its colours came out."""

    target: Target
    T_base_camera: Float[np.ndarray, "4 4"]
    gain: Float[np.ndarray, "3"]
    """Times the scene's colour gives the recorded one: a factor per channel."""

    def exposed(
        self, drawn: Float32[np.ndarray, "3 height width"]
    ) -> Float32[np.ndarray, "3 height width"]:
        """Drawn colours as this image would show them, not clipped."""
        return drawn * self.gain.astype(np.float32)[:, None, None]


SATURATED = 250 / 255
"""A channel brighter than this no longer follows the exposure."""
GAIN_PRIOR = 1e-3
"""Pull of a gain towards 1, as a mean squared brightness: decides only black images."""


def solve_gains(
    cloud: GaussianCloud,
    observations: Sequence[ImageObservation],
    rasteriser: Rasteriser,
    allowance: Allowance = UNLIMITED,
) -> Float[np.ndarray, "num_views 3"]:
    """How each image's colours come from the drawn ones; on average they do not change.

    All images twice as bright and all colours half as bright would look the same: the mean over the
    images is held at no change. Least squares over static pixels that are not saturated. Images
    that there is no time for keep the gains they have.
    """
    gains = np.array([item.gain for item in observations], dtype=np.float64)
    for index, item in enumerate(observations):
        if allowance.is_over():
            break
        planes = rasteriser.draw_planes(cloud, item.target.camera, item.T_base_camera)
        gains[index] = gain_between(planes[:3], item.target)
    return np.asarray(gains / gains.mean(axis=0))


def gain_between(
    drawn: Float32[np.ndarray, "3 height width"], target: Target
) -> Float[np.ndarray, "3"]:
    """The factor per channel that brings a drawn image closest to the recorded one."""
    wanted = target.image()
    usable = target.static_mask & (wanted < SATURATED).all(axis=0)
    recorded, own = wanted[:, usable].astype(np.float64), drawn[:, usable].astype(np.float64)
    prior = GAIN_PRIOR * max(int(usable.sum()), 1)
    both = (recorded * own).sum(axis=1) + prior
    return np.asarray(both / (np.square(own).sum(axis=1) + prior))
