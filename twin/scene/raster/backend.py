"""Choose what draws Gaussians: our own code on the CPU, or gsplat on a CUDA device."""

from twin.scene.raster.cuda import CudaRasteriser, has_cuda
from twin.scene.raster.rasteriser import RasterConfig, Rasteriser


def open_rasteriser(config: RasterConfig | None = None) -> Rasteriser | CudaRasteriser:
    """Open the backend that ``RasterConfig.backend`` names.

    ``auto`` takes CUDA where both a device and gsplat are there, the CPU otherwise.

    Raises:
        SplatExtensionMissingError: When the CPU code was never built.
        CudaMissingError: When cuda was asked for and there is no device.
        MissingDependencyError: When cuda was asked for and gsplat is not installed.
    """
    config = config or RasterConfig()
    wants_cuda = config.backend == "cuda" or (config.backend == "auto" and has_cuda())
    return CudaRasteriser(config) if wants_cuda else Rasteriser(config)
