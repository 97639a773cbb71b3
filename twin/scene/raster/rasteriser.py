"""Draw Gaussians and pull gradients back, through the native extension ``twin.scene._splat``.

The slow readable twin of this module is ``tests/parity/splat_reference.py``.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt16

from bridge.geometry.camera import Camera
from twin.scene.gaussians.cloud import GaussianCloud, as_float32
from twin.scene.raster.config import (
    NUM_PLANES,
    CloudGradient,
    RasterConfig,
    SplatExtensionMissingError,
    available_isas,
    load_native,
    native_camera,
)
from twin.scene.raster.session import FitSession, StepReport

__all__ = [
    "NUM_PLANES",
    "CloudGradient",
    "FitSession",
    "RasterConfig",
    "Rasteriser",
    "SplatExtensionMissingError",
    "StepReport",
    "View",
    "available_isas",
    "load_native",
    "view_of_planes",
]


@dataclass(frozen=True, kw_only=True)
class View:
    """What a camera sees of a cloud."""

    image: Float32[np.ndarray, "height width 3"]
    """Colour over black, not clipped."""
    depth_m: Float32[np.ndarray, "height width"]
    """Weighted mean depth along the optical axis; 0 where alpha is below one half."""
    alpha: Float32[np.ndarray, "height width"]

    def image_u8(self) -> np.ndarray:
        """Colour as 8-bit sRGB."""
        return np.asarray(np.rint(np.clip(self.image, 0.0, 1.0) * 255.0), dtype=np.uint8)


class Rasteriser:
    """Draws one camera after another, keeping its buffers.

    Paper Eq. 2 with the product transmittance of the errata. Pixel centres are at +0.5; the
    image covariance gets 0.1 px^2 and the opacity sqrt(det/det') (mip compensation).
    """

    def __init__(self, config: RasterConfig | None = None) -> None:
        """Load the native code."""
        self.config = config or RasterConfig()
        self._native = load_native().Rasteriser(self.config.threads, self.config.isa)

    @property
    def isa(self) -> str:
        """The instruction set that was chosen."""
        return str(self._native.isa)

    def draw_planes(
        self, cloud: GaussianCloud, camera: Camera, T_base_camera: Float[np.ndarray, "4 4"]
    ) -> Float32[np.ndarray, "5 height width"]:
        """Draw red, green, blue, weighted depth [m] and alpha as five planes over black."""
        planes: np.ndarray = self._native.draw(
            cloud.means_m,
            cloud.quats_wxyz,
            cloud.scales_log,
            cloud.opacities_logit,
            cloud.colors,
            *native_camera(camera, T_base_camera),
            self.config.alpha_cut,
            self.config.transmittance_stop,
            cloud.harmonics if cloud.num_harmonics else None,
        )
        return planes

    def pull_back(
        self,
        planes: Float32[np.ndarray, "5 height width"],
        plane_gradients: Float32[np.ndarray, "5 height width"],
    ) -> CloudGradient:
        """Carry a gradient on the planes of the last ``draw_planes`` back to its cloud."""
        means, quats, scales, opacities, colors, harmonics, pose = self._native.pull(
            planes, plane_gradients
        )
        return CloudGradient(
            means_m=means,
            quats_wxyz=quats,
            scales_log=scales,
            opacities_logit=opacities,
            colors=colors,
            harmonics=harmonics,
            T_camera_base=pose,
        )

    def draw_features(
        self, features: Float32[np.ndarray, "num_splats num_channels"]
    ) -> Float32[np.ndarray, "num_channels height width"]:
        """Draw any channels with the weights A of the last ``draw_planes``: A F.

        Raises:
            ValueError: When there is not one row per Gaussian of that drawing.
        """
        planes: np.ndarray = self._native.draw_features(as_float32(features))
        return planes

    def lift(
        self, maps: Float32[np.ndarray, "num_channels height width"]
    ) -> Float32[np.ndarray, "num_splats num_channels"]:
        """Gather maps with the weights A of the last ``draw_planes``: A^T M, not normalised.

        The adjoint of ``draw_features``. A map of ones gives the sum of each Gaussian's weights.

        Raises:
            ValueError: When the maps are not of that drawing's size.
        """
        features: np.ndarray = self._native.lift(as_float32(maps))
        return features

    def label_map(
        self, labels: UInt16[np.ndarray, " num_splats"]
    ) -> tuple[UInt16[np.ndarray, "height width"], Float32[np.ndarray, "height width"]]:
        """Which label has most weight at each pixel of the last image, and how much.

        Of equal weights the smaller label wins; 0 where nothing was drawn.
        """
        ids, weight = self._native.label_map(np.ascontiguousarray(labels))
        return ids, weight

    def visible_mask(self) -> Bool[np.ndarray, " num_splats"]:
        """Say which Gaussians could touch the last image."""
        mask: np.ndarray = self._native.visible()
        return mask

    def view(
        self, cloud: GaussianCloud, camera: Camera, T_base_camera: Float[np.ndarray, "4 4"]
    ) -> View:
        """Draw what one camera sees."""
        return view_of_planes(self.draw_planes(cloud, camera, T_base_camera))


def view_of_planes(planes: Float32[np.ndarray, "5 height width"]) -> View:
    """Turn weighted sums into what a camera sees."""
    alpha = planes[4]
    solid = alpha >= 0.5
    depth = np.where(solid, planes[3] / np.where(solid, alpha, 1.0), 0.0)
    return View(
        image=np.ascontiguousarray(np.moveaxis(planes[:3], 0, -1)),
        depth_m=depth.astype(np.float32),
        alpha=alpha,
    )
