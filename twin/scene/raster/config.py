"""What all users of the native rasteriser share: its settings, its loading, its gradients."""

import importlib
import os
from dataclasses import dataclass
from types import ModuleType
from typing import Literal

import numpy as np
from jaxtyping import Float, Float32

from bridge.geometry import se3
from bridge.geometry.camera import Camera
from twin.errors import TwinError
from twin.scene.gaussians.cloud import as_float32

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


def available_isas() -> list[str]:
    """Instruction sets that this processor and this build have, the plainest first."""
    return [str(name) for name in load_native().available_isas()]


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
    """What ``backend.open_rasteriser`` opens; ``Rasteriser`` itself is the CPU."""


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


def native_camera(
    camera: Camera, T_base_camera: Float[np.ndarray, "4 4"]
) -> tuple[Float32[np.ndarray, "3 4"], tuple[int, int, float, float, float, float]]:
    """Pose and intrinsics as the extension takes them."""
    intrinsics = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    return as_float32(se3.invert(T_base_camera)[:3]), intrinsics
