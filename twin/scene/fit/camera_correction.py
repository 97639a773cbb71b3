"""Small corrections of camera poses by what the images say, with the gauge fixed."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int64

from bridge.geometry import se3
from twin.scene.fit.exposure import gain_between
from twin.scene.frames.rgbd import Target
from twin.scene.gaussians import GaussianCloud
from twin.scene.raster.rasteriser import Rasteriser

TURN_RATE_RAD = 5e-4
SHIFT_RATE_M = 1e-3
"""Adam's step sizes at the start; a camera is corrected some fifty times in a minute."""
PRIOR_TURN_RAD = 0.01
PRIOR_SHIFT_M = 0.01
PRIOR_WEIGHT = 1e-3
"""A correction of one prior's size costs this much loss: the poses given are mostly right."""
BETA_1, BETA_2 = 0.9, 0.99
ALIGN_COARSE_STEPS, ALIGN_FINE_STEPS = 40, 20
ALIGN_DECAY = 0.03


def corrected_pose(
    T_base_camera: Float[np.ndarray, "4 4"], correction: Float[np.ndarray, "6"]
) -> Float[np.ndarray, "4 4"]:
    """Turn [rad] and shift [m] the scene before a camera, both along the camera's axes.

    Args:
        T_base_camera: The pose before.
        correction: Rotation vector [rad], then shift [m].
    """
    C = np.eye(4)
    C[:3, :3] = se3.rotation_from_vector(correction[:3])
    C[:3, 3] = correction[3:]
    return np.asarray(T_base_camera @ se3.invert(C))


def correction_gradient(
    d_T_camera_base: Float[np.ndarray, "3 4"], T_base_camera: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "6"]:
    """Gradient on a turn and a shift at zero, from that on the matrix ``T_camera_base``.

    dT = [w]x T + v e4^T, so each column t with gradient g adds t x g to that of the turn w.

    Args:
        d_T_camera_base: Gradient of the loss on each number of the matrix.
        T_base_camera: The pose it was drawn from.
    """
    T_camera_base = se3.invert(T_base_camera)[:3]
    turn = np.cross(T_camera_base.T, d_T_camera_base.T).sum(axis=0)
    return np.concatenate([turn, d_T_camera_base[:, 3]])


@dataclass(frozen=True, kw_only=True)
class CameraCorrections:
    """The corrections of all training views, changed in place by Adam.

    The gauge is fixed twice: the first view stays where it is, and a prior holds all the others,
    so that scene and cameras cannot wander off together.
    """

    values: Float[np.ndarray, "num_views 6"]
    """Turns [rad] and shifts [m]."""
    first: Float[np.ndarray, "num_views 6"]
    second: Float[np.ndarray, "num_views 6"]
    counts: Int64[np.ndarray, " num_views"]

    @staticmethod
    def none(num_views: int) -> "CameraCorrections":
        """Poses as they were given."""
        zeros = [np.zeros((num_views, 6)) for _ in range(3)]
        return CameraCorrections(
            values=zeros[0],
            first=zeros[1],
            second=zeros[2],
            counts=np.zeros(num_views, dtype=np.int64),
        )

    def pose(self, index: int, T_base_camera: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
        """Where a view is now thought to be.

        Args:
            index: Of the view.
            T_base_camera: Where it was thought to be at first.
        """
        if not self.values[index].any():
            return T_base_camera
        return corrected_pose(T_base_camera, self.values[index])

    def update(self, index: int, gradient: Float[np.ndarray, "6"], decay: float) -> None:
        """Follow the gradient of one view's loss; the first view never moves.

        Args:
            index: Of the view.
            gradient: On its turn [1/rad] and shift [1/m] at zero.
            decay: Factor on Adam's step.
        """
        if index == 0:
            return
        sizes = np.array([PRIOR_TURN_RAD] * 3 + [PRIOR_SHIFT_M] * 3)
        pulled = gradient + 2 * PRIOR_WEIGHT * self.values[index] / sizes**2
        self.counts[index] += 1
        self.values[index] -= decay * _adam(
            pulled, self.first[index], self.second[index], int(self.counts[index])
        )


def _adam(gradient: np.ndarray, first: np.ndarray, second: np.ndarray, count: int) -> np.ndarray:
    """The step of Adam for one camera; its moments change in place."""
    first += (1 - BETA_1) * (gradient - first)
    second += (1 - BETA_2) * (np.square(gradient) - second)
    mean, square = first / (1 - BETA_1**count), second / (1 - BETA_2**count)
    rates = np.array([TURN_RATE_RAD] * 3 + [SHIFT_RATE_M] * 3)
    return np.asarray(rates * mean / (np.sqrt(square) + 1e-15))


@dataclass(frozen=True, kw_only=True)
class AlignedView:
    """A pose and a gain fitted to one image of a fixed cloud."""

    T_base_camera: Float[np.ndarray, "4 4"]
    gain: Float[np.ndarray, "3"]
    image: Float32[np.ndarray, "3 height width"]
    """Drawn from there, with the gain, not clipped."""


def align_view(
    cloud: GaussianCloud,
    half: Target,
    full: Target,
    T_base_camera: Float[np.ndarray, "4 4"],
    rasteriser: Rasteriser,
) -> AlignedView:
    """Fit pose (6 parameters) and gain (3) to one recorded image; the cloud stays as it is.

    Numbers made after this are not strictly held out: they tell how good the scene is where pose
    and exposure are known, and must be named as aligned.

    Args:
        cloud: The fitted scene.
        half: The recorded image at half size, for the first steps.
        full: The same at full size.
        T_base_camera: Where the camera was recorded.
        rasteriser: Draws the cloud and its gradients.
    """
    value, first, second = np.zeros((3, 6))
    total = ALIGN_COARSE_STEPS + ALIGN_FINE_STEPS
    for step in range(total):
        T = corrected_pose(T_base_camera, value)
        target = half if step < ALIGN_COARSE_STEPS else full
        planes = rasteriser.draw_planes(cloud, target.camera, T)
        gain = gain_between(planes[:3], target).astype(np.float32)[:, None, None]
        difference = (gain * planes[:3] - target.image()) * target.static_mask
        gradients = np.zeros_like(planes)
        gradients[:3] = gain * difference * np.float32(2 / difference.size)
        pulled = rasteriser.pull_back(planes, gradients).T_camera_base
        change = _adam(correction_gradient(pulled, T), first, second, step + 1)
        value = value - 2 * ALIGN_DECAY ** (step / total) * change
    T = corrected_pose(T_base_camera, value)
    planes = rasteriser.draw_planes(cloud, full.camera, T)
    fitted = gain_between(planes[:3], full)
    image = fitted.astype(np.float32)[:, None, None] * planes[:3]
    return AlignedView(T_base_camera=T, gain=fitted, image=image)
