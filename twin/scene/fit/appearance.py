"""Colours in closed form: with the geometry fixed, an image is linear in them.

A view is A c with A = alpha T, the weight of each Gaussian in each pixel (paper Eq. 2 with the
product transmittance). All views together make a least-squares problem that a few steps of
conjugate gradients solve; A is never stored, only drawn (A c) and lifted (A^T image).
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32

from twin.scene.frames.rgbd import Target
from twin.scene.gaussians import GaussianCloud, as_float32
from twin.scene.harmonics import harmonic_terms
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


RIDGE_COLOR = 0.05
"""Pull of a colour towards its start, in squared weights of a pixel."""
RIDGE_HARMONICS = 0.5
"""Stronger: a Gaussian seen from few directions says little about the others."""


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


def solve_appearance(
    cloud: GaussianCloud,
    observations: Sequence[ImageObservation],
    rasteriser: Rasteriser,
    *,
    steps: int,
    allowance: Allowance = UNLIMITED,
) -> tuple[GaussianCloud, int]:
    """Minimise sum |E A (c + sum_k Y_k h_k) - I|^2 + ridge |x - x_start|^2 over colours x = (c, h).

    Conjugate gradients with a diagonal preconditioner, the three channels side by side. The
    diagonal is A^T A 1, which bounds A^T A from above. Pixels outside a static mask do not enter,
    Gaussians that no pixel shows keep their colours.

    Args:
        steps: Conjugate gradient steps, at most; more than six follow the noise.
        allowance: What is begun and does not end in time is dropped.

    Returns:
        The cloud, and the conjugate gradient steps done; 0: it is as it was.
    """
    model = _ImageModel(cloud, observations, rasteriser, allowance)
    start = np.concatenate([cloud.colors[:, None], cloud.harmonics], axis=1)
    equations = model.right_side(start)
    if equations is None:
        return cloud, 0
    change, done = conjugate_gradients(model.normal, *equations, steps=steps)
    solved = start + change
    harmonics = as_float32(solved[:, 1:])
    return replace(cloud, colors=as_float32(solved[:, 0]), harmonics=harmonics), done


def conjugate_gradients(
    apply: Callable[[np.ndarray], np.ndarray | None],
    right: Float32[np.ndarray, "num_splats num_terms channels"],
    diagonal: Float32[np.ndarray, "num_splats num_terms channels"],
    *,
    steps: int,
) -> tuple[Float32[np.ndarray, "num_splats num_terms channels"], int]:
    """Solve ``apply(x) = right`` from zero, each channel a system of its own.

    Hestenes and Stiefel 1952 with a diagonal preconditioner. Ends early when ``apply`` gives None.
    Returns x and the steps taken.

    Args:
        apply: The symmetric matrix times a vector; None when there is no time for it.
    """
    x = np.zeros_like(right)
    residual = right.copy()
    scaled = residual / diagonal
    direction = scaled.copy()
    size = _dots(residual, scaled)
    enough = 1e-12 * size
    for step in range(steps):
        if np.all(size <= enough):
            return x, step
        applied = apply(direction)
        if applied is None:
            return x, step
        length = size / np.maximum(_dots(direction, applied), 1e-30)
        x += length.astype(np.float32) * direction
        residual -= length.astype(np.float32) * applied
        scaled = residual / diagonal
        before, size = size, _dots(residual, scaled)
        direction = scaled + (size / np.maximum(before, 1e-30)).astype(np.float32) * direction
    return x, steps


def _dots(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Inner product per channel, summed in double precision."""
    return np.asarray(np.einsum("nkc,nkc->c", a, b, dtype=np.float64))


class _ImageModel:
    """The normal equations of all images, one image in memory at a time."""

    def __init__(
        self,
        cloud: GaussianCloud,
        observations: Sequence[ImageObservation],
        rasteriser: Rasteriser,
        allowance: Allowance,
    ) -> None:
        self._cloud = cloud
        self._allowance = allowance
        self._observations = observations
        self._rasteriser = rasteriser
        ridge = np.array([RIDGE_COLOR] + [RIDGE_HARMONICS] * cloud.num_harmonics)
        self._ridge = ridge.astype(np.float32)[None, :, None]

    def right_side(self, start: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Pull of all images on the start, and the preconditioner.

        None when the time is over before all images were drawn.
        """
        right, diagonal = np.zeros_like(start), np.zeros_like(start)
        diagonal += self._ridge
        for item in self._observations:
            if self._allowance.is_over():
                return None
            mask = item.target.static_mask
            basis = self._basis(item)
            planes = self._draw(start, item)
            missing = (item.target.image() - item.exposed(planes[:3])) * mask
            maps = np.concatenate([item.exposed(missing), (planes[4] * mask)[None]])
            lifted = self._rasteriser.lift(maps)
            right += basis[:, :, None] * lifted[:, None, :3]
            squared = np.square(item.gain).astype(np.float32) * lifted[:, 3:]
            diagonal += np.square(basis)[:, :, None] * squared[:, None, :]
        return right, diagonal

    def normal(self, x: np.ndarray) -> np.ndarray | None:
        """Carry a change of colours into all images and back: (A^T A + ridge) x; None: no time."""
        total = self._ridge * x
        for item in self._observations:
            if self._allowance.is_over():
                return None
            squared = np.square(item.gain).astype(np.float32)[:, None, None]
            drawn = squared * self._draw(x, item)[:3]
            lifted = self._rasteriser.lift(drawn * item.target.static_mask)
            total += self._basis(item)[:, :, None] * lifted[:, None, :]
        return np.asarray(total)

    def _basis(self, item: ImageObservation) -> Float32[np.ndarray, "num_splats num_terms"]:
        """Value of each unknown's harmonic along the ray to each Gaussian; 1 for the colour."""
        basis = np.ones((len(self._cloud), self._ridge.shape[1]), dtype=np.float32)
        if basis.shape[1] > 1:
            ray = self._cloud.means_m - item.T_base_camera[:3, 3].astype(np.float32)
            ray /= np.sqrt(np.einsum("ni,ni->n", ray, ray))[:, None] + np.float32(1e-12)
            basis[:, 1:] = np.stack(harmonic_terms(*ray.T), axis=1)
        return basis

    def _draw(self, x: np.ndarray, item: ImageObservation) -> np.ndarray:
        cloud = replace(self._cloud, colors=as_float32(x[:, 0]), harmonics=as_float32(x[:, 1:]))
        return self._rasteriser.draw_planes(cloud, item.target.camera, item.T_base_camera)


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
