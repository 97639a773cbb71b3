"""How the colours of each image came out, relative to the scene's, solved in closed form.

A factor for each channel (exposure, white balance): least squares of the recorded image on the
drawn one. All images twice as bright and all colours half as
bright would look the same, so the mean over the images is held at no change.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float32

from twin.scene.fit.appearance import UNLIMITED, Allowance, ImageObservation
from twin.scene.frames.rgbd import Target
from twin.scene.gaussians import GaussianCloud
from twin.scene.raster.rasteriser import Rasteriser

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

    Least squares over static pixels that are not saturated. Images that there is no time for keep
    the gains they have.
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
