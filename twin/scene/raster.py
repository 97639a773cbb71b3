"""Draw Gaussians and pull gradients back, through the native extension ``twin.scene._splat``.

The slow readable twin of this module is ``tests/parity/splat_reference.py``.
"""

import importlib
import os
from dataclasses import dataclass
from types import ModuleType
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Float32

from bridge.geometry import se3
from bridge.geometry.camera import Camera
from twin.errors import TwinError
from twin.scene.gaussians import (
    SH_FIRST,
    GaussianCloud,
    as_float32,
    effective_colors,
    harmonic_basis,
    view_directions,
)

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
    """Instruction set: auto, base or v3 (x86-64 with AVX2 and FMA)."""
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
        self._cloud: GaussianCloud | None = None
        self._centre_m = np.zeros(3)

    @property
    def isa(self) -> str:
        """The instruction set that was chosen."""
        return str(self._native.isa)

    def draw_planes(
        self, cloud: GaussianCloud, camera: Camera, T_base_camera: Float[np.ndarray, "4 4"]
    ) -> Float32[np.ndarray, "5 height width"]:
        """Draw red, green, blue, weighted depth [m] and alpha as five planes over black."""
        self._cloud, self._centre_m = cloud, np.asarray(T_base_camera[:3, 3])
        T_camera_base = as_float32(se3.invert(T_base_camera)[:3])
        intrinsics = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        planes: np.ndarray = self._native.draw(
            cloud.means_m,
            cloud.quats_wxyz,
            cloud.scales_log,
            cloud.opacities_logit,
            effective_colors(cloud, T_base_camera[:3, 3]),
            T_camera_base,
            intrinsics,
            self.config.alpha_cut,
            self.config.transmittance_stop,
        )
        return planes

    def pull_back(
        self,
        planes: Float32[np.ndarray, "5 height width"],
        plane_gradients: Float32[np.ndarray, "5 height width"],
    ) -> CloudGradient:
        """Carry a gradient on the planes of the last ``draw_planes`` back to its cloud."""
        means, quats, scales, opacities, colors = self._native.pull(planes, plane_gradients)
        harmonics, through_direction = self._harmonic_gradients(colors)
        return CloudGradient(
            means_m=means + through_direction,
            quats_wxyz=quats,
            scales_log=scales,
            opacities_logit=opacities,
            colors=colors,
            harmonics=harmonics,
        )

    def _harmonic_gradients(self, colors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gradients on harmonics, and on means by way of the viewing direction."""
        cloud = self._cloud
        if cloud is None or cloud.num_harmonics == 0:
            return np.zeros((len(colors), 0, 3), dtype=np.float32), np.zeros_like(colors)
        directions = view_directions(cloud.means_m, self._centre_m)
        basis = harmonic_basis(directions)
        along = np.einsum("nkc,nc->nk", cloud.harmonics, colors)
        d_direction = SH_FIRST * np.stack([-along[:, 2], -along[:, 0], along[:, 1]], axis=1)
        across = d_direction - directions * (d_direction * directions).sum(axis=1, keepdims=True)
        length = np.linalg.norm(cloud.means_m - self._centre_m, axis=1, keepdims=True)
        harmonics = basis[:, :, None] * colors[:, None, :]
        return as_float32(harmonics), as_float32(across / np.maximum(length, 1e-12))

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
