"""Colours of Gaussians as a camera sees them, in plain NumPy."""

import numpy as np
from jaxtyping import Float, Float32

from twin.scene.gaussians import GaussianCloud, as_float32
from twin.scene.harmonics import harmonic_terms


def effective_colors(
    cloud: GaussianCloud, camera_centre_m: Float[np.ndarray, "3"]
) -> Float32[np.ndarray, "num_splats 3"]:
    """Colour of each Gaussian as seen from a point of the cloud's frame, not clipped."""
    if cloud.num_harmonics == 0:
        return cloud.colors
    basis = np.stack(harmonic_terms(*view_directions(cloud.means_m, camera_centre_m).T), axis=1)
    return as_float32(cloud.colors + np.einsum("nk,nkc->nc", basis, cloud.harmonics))


def view_directions(
    means_m: Float32[np.ndarray, "num_splats 3"], camera_centre_m: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "num_splats 3"]:
    """Unit vectors from the camera centre to each mean."""
    ray = means_m.astype(np.float64) - camera_centre_m
    return np.asarray(ray / np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-12))
