"""The feature term of the paper's Eq. 3, minimised in closed form.

lambda_f sum |A f - F|^2 is quadratic in the features f of the Gaussians and meets the other terms
only through the geometry in A. With the geometry that colour and depth gave, its minimum is a
linear solve like that of the colours and does not depend on lambda_f.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32

from bridge.geometry.camera import Camera
from twin.scene.fit.appearance import conjugate_gradients
from twin.scene.gaussians.cloud import GaussianCloud
from twin.scene.raster.rasteriser import Rasteriser

RIDGE = 0.05
"""Pull of a feature towards its start, in squared weights of a pixel."""


@dataclass(frozen=True, kw_only=True)
class FeatureObservation:
    """One map of image features, at whatever size the network gave it."""

    camera: Camera
    """Of the map: ``camera.scaled(1 / stride)``."""
    T_base_camera: Float[np.ndarray, "4 4"]
    values: Float32[np.ndarray, "num_features height width"]
    valid_mask: Bool[np.ndarray, "height width"]


def solve_features(
    cloud: GaussianCloud,
    observations: Sequence[FeatureObservation],
    rasteriser: Rasteriser,
    *,
    steps: int,
    start: Float32[np.ndarray, "num_splats num_features"] | None = None,
) -> Float32[np.ndarray, "num_splats num_features"]:
    """Features of the Gaussians that explain all maps best; the start where nothing is seen.

    Args:
        cloud: Geometry and opacity, fixed.
        observations: Maps of the same features.
        rasteriser: Draws and lifts.
        steps: Conjugate gradient steps, at most.
        start: Where to begin, and what features are pulled to; zero if not given.
    """
    num_features = observations[0].values.shape[0]
    begin = np.zeros((len(cloud), num_features), dtype=np.float32) if start is None else start
    right = np.zeros((len(cloud), 1, num_features), dtype=np.float32)
    diagonal = np.full((len(cloud), 1, 1), RIDGE, dtype=np.float32)
    for item in observations:
        alpha = rasteriser.draw_planes(cloud, item.camera, item.T_base_camera)[4:]
        missing = item.values - rasteriser.draw_features(np.ascontiguousarray(begin))
        right[:, 0] += rasteriser.lift(np.where(item.valid_mask, missing, np.float32(0.0)))
        diagonal[:, 0] += rasteriser.lift(alpha * item.valid_mask)

    def normal(x: np.ndarray) -> np.ndarray:
        total = np.float32(RIDGE) * x
        for item in observations:
            drawn = _draw(cloud, x[:, 0], item, rasteriser)
            total[:, 0] += rasteriser.lift(drawn * item.valid_mask)
        return np.asarray(total)

    whole = np.broadcast_to(diagonal, right.shape)
    change, _ = conjugate_gradients(normal, right, np.ascontiguousarray(whole), steps=steps)
    return np.asarray(begin + change[:, 0])


def feature_loss(
    cloud: GaussianCloud,
    features: Float32[np.ndarray, "num_splats num_features"],
    observations: Sequence[FeatureObservation],
    rasteriser: Rasteriser,
) -> float:
    """Mean squared difference of drawn and given features where they are valid (Eq. 3)."""
    total, count = 0.0, 0
    for item in observations:
        drawn = _draw(cloud, features, item, rasteriser)
        wrong = (drawn - item.values)[:, item.valid_mask]
        total += float(np.square(wrong, dtype=np.float64).sum())
        count += wrong.size
    return total / max(count, 1)


def _draw(
    cloud: GaussianCloud, features: np.ndarray, item: FeatureObservation, rasteriser: Rasteriser
) -> np.ndarray:
    rasteriser.draw_planes(cloud, item.camera, item.T_base_camera)
    return rasteriser.draw_features(np.ascontiguousarray(features))
