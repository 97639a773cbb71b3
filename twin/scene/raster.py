"""Draw Gaussians and pull gradients back, through the native extension ``twin.scene._splat``.

The slow readable twin of this module is ``tests/parity/splat_reference.py``.
"""

import importlib
import os
from dataclasses import dataclass
from types import ModuleType
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt16

from bridge.geometry import se3
from bridge.geometry.camera import Camera
from twin.errors import TwinError
from twin.scene.gaussians import GaussianCloud, as_float32

NUM_PLANES = 5
"""Red, green, blue, sum of weighted depth, sum of weights."""


class SplatExtensionMissingError(TwinError):
    """The compiled part of ``twin.scene`` is not there."""

    def __init__(self, *, reason: str) -> None:
        """Remember why the import failed."""
        self.reason = reason
        super().__init__(
            f"the splat rasteriser is not built ({reason}). Build it with a C++17 compiler: "
            "pip install --no-build-isolation -e . (or pip install .) in the checkout."
        )


def load_native() -> ModuleType:
    """Import the extension; idle OpenMP threads sleep instead of spinning.

    Raises:
        SplatExtensionMissingError: When it was never built.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # read once, when libgomp is loaded
    try:
        return importlib.import_module("twin.scene._splat")
    except ImportError as error:
        raise SplatExtensionMissingError(reason=str(error)[:160]) from error


@dataclass(frozen=True, kw_only=True)
class RasterConfig:
    """How precisely to draw."""

    alpha_cut: float = 1.0 / 255.0
    """Contributions with less alpha are dropped."""
    transmittance_stop: float = 1e-4
    """A tile ends once no pixel of it lets more light through."""
    threads: int = 0
    """0: all that OpenMP offers. The result has the same bits for any number."""
    isa: str = "auto"
    """Instruction set: auto, base (x86-64-v2, or what the compiler takes for another processor),
    v3 (AVX2 and FMA) or v4 (AVX-512)."""
    backend: Literal["auto", "cpu", "cuda"] = "cpu"
    """What ``twin.scene.backend.open_rasteriser`` opens; ``Rasteriser`` itself is the CPU."""


@dataclass(frozen=True, kw_only=True)
class CloudGradient:
    """Gradient of a scalar with respect to each array of a ``GaussianCloud``."""

    means_m: Float32[np.ndarray, "num_splats 3"]
    quats_wxyz: Float32[np.ndarray, "num_splats 4"]
    scales_log: Float32[np.ndarray, "num_splats 3"]
    opacities_logit: Float32[np.ndarray, " num_splats"]
    colors: Float32[np.ndarray, "num_splats 3"]
    harmonics: Float32[np.ndarray, "num_splats num_harmonics 3"]
    T_camera_base: Float[np.ndarray, "3 4"]
    """With respect to the twelve entries of the upper part of that matrix, the camera centre of
    the viewing directions being -R^T t of them."""


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
        T_camera_base = as_float32(se3.invert(T_base_camera)[:3])
        intrinsics = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        planes: np.ndarray = self._native.draw(
            cloud.means_m,
            cloud.quats_wxyz,
            cloud.scales_log,
            cloud.opacities_logit,
            cloud.colors,
            T_camera_base,
            intrinsics,
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
