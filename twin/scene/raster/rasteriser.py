"""Draw Gaussians, pull gradients back and fit, through the native extension ``twin.scene._splat``.

The slow readable twin of drawing is ``tests/parity/splat_reference.py``. A whole step of a fit
(draw, compare, pull back, Adam) runs in native code; a test holds it equal to the separate steps.
"""

import importlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from types import ModuleType
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Float32, Int64, UInt16

from bridge.geometry import se3
from bridge.geometry.camera import Camera
from twin.errors import TwinError
from twin.scene.frames.rgbd import Target
from twin.scene.gaussians import GaussianCloud, arrays, as_float32


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
    """Import the extension; idle OpenMP threads sleep instead of spinning."""
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
    """What ``backend.open_rasteriser`` opens; ``Rasteriser`` itself is the CPU."""


def native_camera(
    camera: Camera, T_base_camera: Float[np.ndarray, "4 4"]
) -> tuple[Float32[np.ndarray, "3 4"], tuple[int, int, float, float, float, float]]:
    """Pose and intrinsics as the extension takes them."""
    intrinsics = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    return as_float32(se3.invert(T_base_camera)[:3]), intrinsics


NAMES = ("means_m", "quats_wxyz", "scales_log", "opacities_logit", "colors", "harmonics")
STAGES = ("draw", "compare", "pull", "learn")
SAME_EXPOSURE = np.eye(3, 4)
"""Colours as they were drawn."""


@dataclass(frozen=True, kw_only=True)
class StepReport:
    """What one step found, before it changed the cloud."""

    loss: float
    mse: float | None
    """Mean squared colour error over the static pixels; None when there are none."""
    gain: Float[np.ndarray, "3"]
    """Gradient of the loss on the diagonal of the exposure."""
    T_camera_base: Float[np.ndarray, "3 4"]
    """Gradient of the loss on the entries of that matrix, the camera centre of the viewing
    directions being -R^T t of them."""
    seconds: Mapping[str, float]
    """Wall time of each stage: draw, compare, pull, learn."""
    serial_s: float
    """How much of it one thread spent alone: by Amdahl's law it bounds what more threads gain."""


L1_SHARE = 0.8
"""Of the L1 term in the loss 3dgs."""
OFTEN, RARELY = 32, 256
"""Steps from one with the slower number of threads to the next: rarely where it is far slower."""
FAR_SLOWER = 1.3
FORGETS = 0.2
"""Weight of one step's time in the running mean."""


class ThreadPace:
    """How many threads a step takes: all, or one where that was faster of late.

    On a busy machine a step of two threads waits at each of its barriers until the other one is
    given time again, and takes three times as long as one thread alone.
    """

    def __init__(self, most: int) -> None:
        """Nothing was timed yet."""
        self._counts = (1, most)
        self._seconds: dict[tuple[int, int], float] = {}
        self._steps = 0

    def choose(self, size: int) -> int:
        """The number for the next step, for images of some size."""
        self._steps += 1
        for count in self._counts:
            if (size, count) not in self._seconds:
                return count
        fast, slow = sorted(self._counts, key=lambda count: self._seconds[size, count])
        far = self._seconds[size, slow] > FAR_SLOWER * self._seconds[size, fast]
        return slow if self._steps % (RARELY if far else OFTEN) == 0 else fast

    def took(self, size: int, count: int, seconds: float) -> None:
        """Remember how long a step took."""
        before = self._seconds.get((size, count), seconds)
        self._seconds[size, count] = before + FORGETS * (seconds - before)


class FitSession:
    """A cloud being fitted, with the moments of Adam (Kingma and Ba 2015).

    Loss: ``3dgs`` is 0.8 L1 + 0.2 (1 - SSIM), ``paper`` the squared error
    (Eq. 3), both with ``depth_weight`` times the L1 depth error relative to depth. Same bits for
    any number of threads.
    """

    def __init__(
        self,
        cloud: GaussianCloud,
        config: RasterConfig | None = None,
        *,
        loss: Literal["3dgs", "paper"] = "3dgs",
        depth_weight: float = 0.1,
    ) -> None:
        """Copy the cloud; moments start at zero."""
        self.config = config or RasterConfig()
        self.steps = 0
        self._loss = (loss == "3dgs", L1_SHARE, depth_weight)
        self._native = load_native().FitSession(self.config.threads, self.config.isa)
        self._pace = ThreadPace(self.config.threads or os.cpu_count() or 1)
        self.cloud = _own_copy(cloud)
        """As it is now. Its arrays change with each step, and may be written to."""
        self._first = {name: np.zeros_like(rows) for name, rows in arrays(cloud)}
        self._second = {name: np.zeros_like(rows) for name, rows in arrays(cloud)}

    def step(
        self,
        target: Target,
        T_base_camera: Float[np.ndarray, "4 4"],
        rates: Mapping[str, float],
        exposure: Float[np.ndarray, "3 4"] = SAME_EXPOSURE,
    ) -> StepReport:
        """Draw one view, compare it with what was seen, and follow the gradient.

        Args:
            rates: Adam's step size for each array by name; arrays without one stay as they are,
                and so do their moments.
            exposure: Times the drawn (red, green, blue, 1) is compared with the image.
        """
        self.steps += 1
        size = target.depth_m.size
        threads = self._pace.choose(size)
        self._native.use_threads(threads)
        loss, squared, num_static, d_gain, d_pose, seconds, serial_s = self._native.step(
            _tables(dict(arrays(self.cloud))),
            _tables(self._first),
            _tables(self._second),
            *native_camera(target.camera, T_base_camera),
            self.config.alpha_cut,
            self.config.transmittance_stop,
            target.planes_u8,
            target.depth_m,
            target.static_mask,
            as_float32(exposure),
            self._loss,
            tuple(float(rates.get(name, 0.0)) for name in NAMES),
            self.steps,
        )
        self._pace.took(size, threads, sum(seconds))
        return StepReport(
            loss=loss,
            mse=squared / (3 * num_static) if num_static else None,
            gain=np.array(d_gain),
            T_camera_base=d_pose,
            seconds=dict(zip(STAGES, seconds, strict=True)),
            serial_s=serial_s,
        )

    def rearrange(self, cloud: GaussianCloud, parents: Int64[np.ndarray, " num_splats"]) -> None:
        """Go on with another cloud.

        Args:
            parents: For each of its Gaussians the row of the present cloud whose moments it goes
                on with.
        """
        for moments in (self._first, self._second):
            moments |= {name: rows[parents] for name, rows in moments.items()}
        self.cloud = _own_copy(cloud)


def _tables(named: Mapping[str, np.ndarray]) -> tuple[np.ndarray | None, ...]:
    """Arrays as the extension takes them; None for those that are not there."""
    return tuple(named.get(name) for name in NAMES)


def _own_copy(cloud: GaussianCloud) -> GaussianCloud:
    return GaussianCloud(**{name: as_float32(rows).copy() for name, rows in arrays(cloud)})


@dataclass(frozen=True, kw_only=True)
class View:
    """What a camera sees of a cloud."""

    image: Float32[np.ndarray, "height width 3"]
    """Colour over black, not clipped."""
    depth_m: Float32[np.ndarray, "height width"]
    """Of the surface that takes half of the light, along the optical axis; 0 where alpha is below
    one half. What lies within 2 % of it is averaged; what is before and behind has no say."""
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
        """Draw red, green, blue, weighted depth [m] and alpha as five planes over black.

        Depth of a Gaussian is where the ray is densest in it, not where its centre lies.
        """
        *rows, harmonics = _tables(dict(arrays(cloud)))
        place, cuts = native_camera(camera, T_base_camera), self.config
        planes: np.ndarray = self._native.draw(
            *rows, *place, cuts.alpha_cut, cuts.transmittance_stop, harmonics
        )
        return planes

    def draw_over(
        self,
        cloud: GaussianCloud,
        under: Float32[np.ndarray, "5 height width"],
        hidden: Bool[np.ndarray, " num_splats"] | None = None,
    ) -> Float32[np.ndarray, "5 height width"]:
        """Draw a cloud into the last ``draw_planes``, which stays as it is.

        The same bits as drawing both at once, in the time that the tiles take where the cloud is.

        Args:
            under: What that call returned.
            hidden: Gaussians of that call to be left out.
        """
        *rows, harmonics = _tables(dict(arrays(cloud)))
        planes: np.ndarray = self._native.draw_over(*rows, under, hidden, harmonics)
        return planes

    def draw_features(
        self, features: Float32[np.ndarray, "num_splats num_channels"]
    ) -> Float32[np.ndarray, "num_channels height width"]:
        """Draw any channels with the weights A of the last ``draw_planes``: A F."""
        return np.asarray(self._native.draw_features(as_float32(features)))

    def lift(
        self, maps: Float32[np.ndarray, "num_channels height width"]
    ) -> Float32[np.ndarray, "num_splats num_channels"]:
        """Gather maps with the weights A of the last ``draw_planes``: A^T M, not normalised.

        The adjoint of ``draw_features``. A map of ones gives the sum of each Gaussian's weights.
        """
        return np.asarray(self._native.lift(as_float32(maps)))

    def label_map(
        self, labels: UInt16[np.ndarray, " num_splats"]
    ) -> tuple[UInt16[np.ndarray, "height width"], Float32[np.ndarray, "height width"]]:
        """Which label has most weight at each pixel of the last image, and how much.

        Of equal weights the smaller label wins; 0 where nothing was drawn.
        """
        ids, weight = self._native.label_map(np.ascontiguousarray(labels))
        return ids, weight

    def surface_depth(self) -> Float32[np.ndarray, "height width"]:
        """Depth of what is opaque in the last ``draw_planes`` [m], as in ``View``."""
        return np.asarray(self._native.surface_depth())

    def visible_mask(self) -> Bool[np.ndarray, " num_splats"]:
        """Say which Gaussians could touch the last image."""
        return np.asarray(self._native.visible())

    def view(
        self, cloud: GaussianCloud, camera: Camera, T_base_camera: Float[np.ndarray, "4 4"]
    ) -> View:
        """Draw what one camera sees."""
        planes = self.draw_planes(cloud, camera, T_base_camera)
        image = np.ascontiguousarray(np.moveaxis(planes[:3], 0, -1))
        return View(image=image, depth_m=self.surface_depth(), alpha=planes[4])


def psnr_db(mse: float) -> float:
    """Peak signal-to-noise ratio for images in 0..1 [dB]; infinite for identical images."""
    return float("inf") if mse == 0 else -10.0 * float(np.log10(mse))
