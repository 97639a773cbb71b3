"""Gaussians that other viewers draw as we do: the anti-aliasing goes into sizes and opacities.

We add 0.1 px^2 to the covariance on the image and lower the opacity by what that spreads (mip
compensation, Yu et al. 2024); viewers after Kerbl et al. 2023 add 0.3 px^2 and lower nothing, so
thin and distant Gaussians come out wider and denser. Seen from about one distance this is taken
back: 0.2 px^2 less along each axis, and an opacity that leaves what a Gaussian covers in total.
"""

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from bridge.geometry.camera import Camera
from twin.scene.gaussians import GaussianCloud, as_float32
from twin.scene.raster.backend import MIP_VARIANCE_PX2

THEIR_VARIANCE_PX2 = 0.3
"""What viewers after the reference implementation of 3D Gaussian splatting add."""
LEAST_VARIANCE_PX2 = 1e-3
"""Of a Gaussian that was thinner than what is taken away."""
NEAR_M = 0.1
OPACITY_ENDS = (1e-4, 1 - 1e-4)


def for_other_viewers(
    cloud: GaussianCloud, camera: Camera, T_base_camera: Float[np.ndarray, "4 4"]
) -> GaussianCloud:
    """The same scene for viewers without mip compensation, at the distances of one camera.

    From elsewhere it looks as much sharper or softer as the distance differs.

    Args:
        cloud: In the run's root frame.
        camera: Its focal length says how large a pixel is.
        T_base_camera: Where it stands.
    """
    p = se3.apply(se3.invert(T_base_camera), cloud.means_m.astype(np.float64))
    pixel_m = np.maximum(np.linalg.norm(p, axis=1), NEAR_M) / np.sqrt(camera.fx * camera.fy)
    variance = np.exp(2.0 * cloud.scales_log.astype(np.float64)) / pixel_m[:, None] ** 2
    less = np.maximum(variance - (THEIR_VARIANCE_PX2 - MIP_VARIANCE_PX2), LEAST_VARIANCE_PX2)
    less = np.minimum(less, variance)
    directions = p / np.maximum(np.linalg.norm(p, axis=1, keepdims=True), 1e-9)
    directions = directions @ T_base_camera[:3, :3].T
    across = _across(cloud, directions)
    before = _on_image(across, variance)
    after = _on_image(across, less) + THEIR_VARIANCE_PX2 * np.eye(2)
    share = np.sqrt(np.maximum(np.linalg.det(before), 0.0) / np.linalg.det(after))
    opacity = np.clip(cloud.opacities() * np.minimum(share, 1.0), *OPACITY_ENDS)
    return GaussianCloud(
        means_m=cloud.means_m,
        quats_wxyz=cloud.quats_wxyz,
        scales_log=as_float32(0.5 * np.log(less * pixel_m[:, None] ** 2)),
        opacities_logit=as_float32(np.log(opacity / (1.0 - opacity))),
        colors=cloud.colors,
        harmonics=cloud.harmonics,
        completed=cloud.completed,
    )


def _across(
    cloud: GaussianCloud, directions: Float[np.ndarray, "num_splats 3"]
) -> Float[np.ndarray, "num_splats 2 3"]:
    """Two directions across each line of sight, in the axes of the Gaussian."""
    q = cloud.quats_wxyz.astype(np.float64)
    R = se3.rotation_from_quaternion(q / np.linalg.norm(q, axis=1, keepdims=True))
    other = np.where(np.abs(directions[:, :1]) < 0.5, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.cross(directions, other)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.asarray(np.stack([first, np.cross(directions, first)], axis=1) @ R)


def _on_image(
    across: Float[np.ndarray, "num_splats 2 3"], variance_px2: Float[np.ndarray, "num_splats 3"]
) -> Float[np.ndarray, "num_splats 2 2"]:
    """Covariances across the line of sight [px^2]."""
    return np.asarray((across * variance_px2[:, None, :]) @ np.swapaxes(across, 1, 2))
