"""Choose what draws Gaussians: our own code on the CPU, or ``gsplat`` on a CUDA device.

Of gsplat only the documented function ``gsplat.rasterization`` is used, in the mode ``antialiased``
with ``eps2d = 0.1``, which is our mip compensation. Known differences: its Jacobian is held at 15 %
of the image beyond the border where ours is at 30 %, its cuts are fixed, and the depth of a view is
the weighted mean, because gsplat does not say where half of the light is gone.
"""

import importlib
from importlib.util import find_spec
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from bridge.errors import GstError, MissingDependencyError, UsageError
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from twin.scene.gaussians import GaussianCloud, arrays
from twin.scene.harmonics import harmonic_terms
from twin.scene.raster.rasteriser import RasterConfig, Rasteriser, View

MIP_VARIANCE_PX2 = 0.1
NEAR_M = 0.02
FIXED_ALPHA_CUT, FIXED_TRANSMITTANCE_STOP = 1.0 / 255.0, 1e-4
"""Constants inside gsplat's kernels."""
SOLID_ALPHA = 0.5
"""Pixels that are less opaque have no depth."""
CHANNEL_BLOCK = 32
"""Channels that go through one call; memory grows with them."""


class CudaMissingError(MissingDependencyError):
    """There is no CUDA device that torch can use."""

    def __init__(self, *, found: str) -> None:
        """Remember what was found."""
        self.package, self.extra = "CUDA", "gpu"
        GstError.__init__(
            self,
            f"the backend cuda needs an NVIDIA GPU and a torch built for CUDA; found {found}. "
            "Use the backend cpu, or install a CUDA build of torch and 'robot-gst[gpu]'.",
        )


def has_cuda() -> bool:
    """Whether the backend can run here; torch is only imported where gsplat is installed."""
    return find_spec("gsplat") is not None and bool(import_torch().cuda.is_available())


def import_torch(purpose: str = "the backend cuda") -> Any:
    """Import torch, which only the extra [twin] brings."""
    try:
        return importlib.import_module("torch")
    except ImportError as error:
        raise MissingDependencyError(package="torch", extra="twin", purpose=purpose) from error


class CudaRasteriser:
    """Draws one camera after another on a GPU; the interface of ``rasteriser.Rasteriser``.

    Sums on the GPU are in no fixed order: results repeat to about 1e-6, not bit by bit.
    """

    def __init__(self, config: RasterConfig | None = None, *, device: str = "cuda") -> None:
        """Look for the device and for gsplat.

        Raises:
            CudaMissingError: When torch finds no device.
            MissingDependencyError: When gsplat or torch is not installed.
            UsageError: When the configuration asks for other cuts than gsplat has.
        """
        self.config = config or RasterConfig()
        cuts = (self.config.alpha_cut, self.config.transmittance_stop)
        if not np.allclose(cuts, (FIXED_ALPHA_CUT, FIXED_TRANSMITTANCE_STOP), rtol=1e-3, atol=0):
            message = (
                f"the backend cuda drops alpha below 1/255 and stops at 1e-4; {cuts[0]:g} and "
                f"{cuts[1]:g} were asked for. Use the backend cpu for other values."
            )
            raise UsageError(message)
        torch = import_torch()
        if device == "cuda" and not torch.cuda.is_available():
            raise CudaMissingError(found=f"torch {torch.__version__} without a usable device")
        try:
            self._gsplat = importlib.import_module("gsplat")
        except ImportError as error:
            raise MissingDependencyError(
                package="gsplat", extra="gpu", purpose="the backend cuda"
            ) from error
        self._torch = torch
        self._device = torch.device(device)
        self._drawn: tuple[dict[str, Any], Any, Camera] | None = None
        """Arrays, pose and camera of the last image, for further channels."""

    def draw_planes(
        self, cloud: GaussianCloud, camera: Camera, T_base_camera: Float[np.ndarray, "4 4"]
    ) -> Float32[np.ndarray, "5 height width"]:
        """Draw red, green, blue, weighted depth [m] and alpha as five planes over black."""
        torch = self._torch
        leaves = {name: torch.tensor(rows, device=self._device) for name, rows in arrays(cloud)}
        T = se3.invert(T_base_camera).astype(np.float32)
        T_camera_base = torch.tensor(T, device=self._device)
        centre = -T_camera_base[:3, :3].T @ T_camera_base[:3, 3]
        channels = [self._colors(leaves, centre), self._depth_planes(leaves, T_camera_base, camera)]
        drawn, alpha, _ = self._rasterise(leaves, torch.cat(channels, dim=1), T_camera_base, camera)
        # Weighted depth at each pixel, of what was drawn of the depth planes.
        u = torch.arange(camera.width, device=drawn.device) + 0.5 - camera.width / 2
        v = torch.arange(camera.height, device=drawn.device) + 0.5 - camera.height / 2
        sums = drawn[0, ..., 3:]
        depth = sums[..., 0] + u[None] * sums[..., 1] + v[:, None] * sums[..., 2]
        image = torch.cat([drawn[0, ..., :3], depth[..., None], alpha[0]], dim=-1)
        self._drawn = leaves, T_camera_base, camera
        return self._numpy(image.permute(2, 0, 1))

    def view(
        self, cloud: GaussianCloud, camera: Camera, T_base_camera: Float[np.ndarray, "4 4"]
    ) -> View:
        """Draw what one camera sees."""
        planes = self.draw_planes(cloud, camera, T_base_camera)
        alpha = planes[4]
        solid = alpha >= SOLID_ALPHA
        depth = np.where(solid, planes[3] / np.where(solid, alpha, 1.0), 0.0)
        return View(
            image=np.ascontiguousarray(np.moveaxis(planes[:3], 0, -1)),
            depth_m=depth.astype(np.float32),
            alpha=alpha,
        )

    def draw_features(
        self, features: Float32[np.ndarray, "num_splats num_channels"]
    ) -> Float32[np.ndarray, "num_channels height width"]:
        """Draw any channels with the weights of the last ``draw_planes``: A F."""
        if self._drawn is None:
            message = "nothing was drawn yet; call draw_planes first."
            raise UsageError(message)
        leaves, T_camera_base, camera = self._drawn
        blocks = [np.zeros((0, camera.height, camera.width), dtype=np.float32)]
        for start in range(0, features.shape[1], CHANNEL_BLOCK):
            block = features[:, start : start + CHANNEL_BLOCK]
            channels = self._torch.tensor(block, device=self._device)
            image, _, _ = self._rasterise(leaves, channels, T_camera_base, camera)
            blocks.append(self._numpy(image[0].permute(2, 0, 1)))
        return np.concatenate(blocks)

    def _rasterise(
        self, leaves: dict[str, Any], colors: Any, T_camera_base: Any, camera: Camera
    ) -> Any:
        """Call gsplat with activated values."""
        torch = self._torch
        K = torch.tensor(
            [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]],
            device=self._device,
        )
        return self._gsplat.rasterization(
            means=leaves["means_m"],
            quats=leaves["quats_wxyz"],
            scales=torch.exp(leaves["scales_log"]),
            opacities=torch.sigmoid(leaves["opacities_logit"]),
            colors=colors,
            viewmats=T_camera_base[None],
            Ks=K[None],
            width=camera.width,
            height=camera.height,
            near_plane=NEAR_M,
            eps2d=MIP_VARIANCE_PX2,
            packed=False,
            render_mode="RGB",
            rasterize_mode="antialiased",
        )

    def _depth_planes(self, leaves: dict[str, Any], T_camera_base: Any, camera: Camera) -> Any:
        """Depth at the middle of the image and its slopes, of the surface of each Gaussian.

        The same regression of depth on the pixel as in the native code, in three columns.
        """
        torch = self._torch
        R, p = T_camera_base[:3, :3], leaves["means_m"] @ T_camera_base[:3, :3].T
        x, y, z = (p + T_camera_base[:3, 3]).unbind(dim=1)
        z = z.clamp(min=NEAR_M)
        turns = se3.rotation_from_quaternion(leaves["quats_wxyz"].cpu().numpy().astype(np.float64))
        turned = torch.tensor(turns.astype(np.float32), device=self._device)
        shape = R @ turned * leaves["scales_log"].exp()[:, None]
        across_x = camera.fx / z[:, None] * (shape[:, 0] - (x / z)[:, None] * shape[:, 2])
        across_y = camera.fy / z[:, None] * (shape[:, 1] - (y / z)[:, None] * shape[:, 2])
        A = torch.stack([across_x, across_y], dim=1)
        covariance = A @ A.transpose(1, 2) + MIP_VARIANCE_PX2 * torch.eye(2, device=A.device)
        slope = torch.linalg.solve(covariance, A @ shape[:, 2, :, None])[..., 0]
        u = camera.fx * x / z + camera.cx - camera.width / 2
        v = camera.fy * y / z + camera.cy - camera.height / 2
        return torch.stack([z - slope[:, 0] * u - slope[:, 1] * v, *slope.unbind(dim=1)], dim=1)

    def _colors(self, leaves: dict[str, Any], centre: Any) -> Any:
        """Colours as seen from the camera."""
        if "harmonics" not in leaves:
            return leaves["colors"]
        ray = leaves["means_m"] - centre
        x, y, z = (ray / ray.norm(dim=1, keepdim=True).clamp(min=1e-12)).unbind(dim=1)
        basis = self._torch.stack(harmonic_terms(x, y, z), dim=1)
        return leaves["colors"] + (basis[:, :, None] * leaves["harmonics"]).sum(dim=1)

    def _numpy(self, values: Any) -> np.ndarray:
        return np.ascontiguousarray(values.cpu().numpy(), dtype=np.float32)


def open_rasteriser(config: RasterConfig | None = None) -> Rasteriser | CudaRasteriser:
    """Open the backend that ``RasterConfig.backend`` names.

    ``auto`` takes CUDA where both a device and gsplat are there, the CPU otherwise.
    """
    config = config or RasterConfig()
    wants_cuda = config.backend == "cuda" or (config.backend == "auto" and has_cuda())
    return CudaRasteriser(config) if wants_cuda else Rasteriser(config)
