"""How the colours of each image came out, relative to the scene's, solved in closed form.

``gain``: a factor for each channel (exposure, white balance). ``affine``: a 3 x 3 matrix and an
offset, which also takes what a camera does to saturation, hue and the black level. Both are least
squares of the recorded image on the drawn one. All images twice as bright and all colours half as
bright would look the same, so the mean over the images is held at no change.
"""

from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Float32

from twin.scene.fit.appearance import UNLIMITED, Allowance, ImageObservation
from twin.scene.frames.rgbd import Target
from twin.scene.gaussians import GaussianCloud
from twin.scene.raster.rasteriser import Rasteriser

SATURATED = 250 / 255
"""A channel brighter than this no longer follows the exposure."""
GAIN_PRIOR = 1e-3
"""Pull of a gain towards 1, as a mean squared brightness: decides only black images."""
AFFINE_PRIOR = 1e-2
"""Pull of a matrix and offset towards the gain alone, as a mean squared brightness. With less they
take up what a wrong pose does to an image (kitchen: 1e-3 costs 0.3 dB of the held-out views)."""
OPAQUE = 0.5
"""Where less light is stopped a hole would look like an offset."""


def gain_exposure(gain: Float[np.ndarray, "*images 3"]) -> Float[np.ndarray, "*images 3 4"]:
    """Factors for the channels as exposures."""
    return np.asarray(gain[..., None] * np.eye(3, 4))


def solve_exposures(
    cloud: GaussianCloud,
    observations: Sequence[ImageObservation],
    rasteriser: Rasteriser,
    kind: Literal["gain", "affine"],
    allowance: Allowance = UNLIMITED,
) -> Float[np.ndarray, "num_views 3 4"]:
    """How each image's colours come from the drawn ones; on average they do not change.

    Least squares over static pixels that are not saturated. Images that there is no time for keep
    the exposures they have.

    Args:
        cloud: The scene as it is fitted so far.
        observations: Images with the exposures they have now.
        rasteriser: Draws the cloud.
        kind: What an exposure may be.
        allowance: Time until which images are looked at.
    """
    exposures = np.array([item.exposure for item in observations], dtype=np.float64)
    for index, item in enumerate(observations):
        if allowance.is_over():
            break
        planes = rasteriser.draw_planes(cloud, item.target.camera, item.T_base_camera)
        if kind == "gain":
            exposures[index] = gain_exposure(gain_between(planes[:3], item.target))
        else:
            exposures[index] = affine_between(planes, item.target)
    return _without_mean(exposures, kind)


def _without_mean(
    exposures: Float[np.ndarray, "num_views 3 4"], kind: Literal["gain", "affine"]
) -> Float[np.ndarray, "num_views 3 4"]:
    """The same differences between images, with a mean that changes nothing."""
    if kind == "gain":
        gains = np.ascontiguousarray(np.diagonal(exposures, axis1=1, axis2=2))
        return gain_exposure(gains / gains.mean(axis=0))
    mean = np.vstack([exposures.mean(axis=0), [0.0, 0.0, 0.0, 1.0]])
    return np.asarray(exposures @ np.linalg.inv(mean))


def gain_between(
    drawn: Float32[np.ndarray, "3 height width"], target: Target
) -> Float[np.ndarray, "3"]:
    """The factor per channel that brings a drawn image closest to the recorded one.

    Args:
        drawn: Colour planes, 0..1.
        target: What was recorded, and which pixels of it count.
    """
    wanted = target.image()
    usable = _usable(wanted, target)
    recorded, own = wanted[:, usable].astype(np.float64), drawn[:, usable].astype(np.float64)
    prior = GAIN_PRIOR * max(int(usable.sum()), 1)
    both = (recorded * own).sum(axis=1) + prior
    return np.asarray(both / (np.square(own).sum(axis=1) + prior))


def affine_between(
    planes: Float32[np.ndarray, "5 height width"], target: Target
) -> Float[np.ndarray, "3 4"]:
    """The matrix and offset that bring a drawn image closest to the recorded one.

    Args:
        planes: As drawn; pixels in which little was drawn do not count.
        target: What was recorded, and which pixels of it count.
    """
    wanted = target.image()
    usable = _usable(wanted, target) & (planes[4] > OPAQUE)
    recorded = wanted[:, usable].astype(np.float64)
    own = np.vstack([planes[:3, usable], np.ones(int(usable.sum()))]).astype(np.float64)
    prior = AFFINE_PRIOR * max(int(usable.sum()), 1)
    gain = gain_exposure(gain_between(planes[:3], target))
    both = recorded @ own.T + prior * gain
    return np.asarray(np.linalg.solve(own @ own.T + prior * np.eye(4), both.T).T)


def _usable(wanted: np.ndarray, target: Target) -> Bool[np.ndarray, "height width"]:
    return np.asarray(target.static_mask & (wanted < SATURATED).all(axis=0))
