"""Rebuild from frames in memory and score held-out views."""

import time
from dataclasses import dataclass

import numpy as np

from bridge.episode.streams import RgbdFrame
from twin.scene.fit.initialise import fuse
from twin.scene.fit.optimise import FitResult, fit
from twin.scene.frames.rgbd import DepthLimits, FrameSurface, training_view
from twin.scene.gaussians import GaussianCloud
from twin.scene.raster.rasteriser import RasterConfig, Rasteriser, psnr_db
from twin.scene.settings import FitConfig, InitialiseConfig

MAX_DEPTH_M = 5.0
MAX_POINTS = 3_000_000


@dataclass(frozen=True, kw_only=True)
class Scores:
    """Means over held-out images."""

    psnr_db: float
    ssim: float


@dataclass(frozen=True, kw_only=True)
class Rebuilt:
    """A scene made within a budget that includes everything after reading the images."""

    first: GaussianCloud
    result: FitResult
    seconds: float


def rebuild(
    frames: list[RgbdFrame], *, budget_s: float, initialise: InitialiseConfig, config: FitConfig
) -> Rebuilt:
    """Back-project, fuse and fit; the fit gets what the others leave of the budget."""
    from dataclasses import replace

    start = time.monotonic()
    limits = DepthLimits(max_depth_m=MAX_DEPTH_M, flying_fraction=initialise.flying_fraction)
    surfaces = [FrameSurface(frame, limits) for frame in frames]
    pixels = len(frames) * frames[0].depth_m.size
    stride = max(1, round(float(np.sqrt(pixels / MAX_POINTS))))
    views = [training_view(surface) for surface in surfaces]
    first = fuse([surface.points(stride) for surface in surfaces], initialise.first_splats, views)
    left = budget_s - (time.monotonic() - start)
    result = fit(
        first,
        views,
        replace(config, budget_s=left),
        lambda *_: None,
        max_splats=initialise.max_splats,
    )
    return Rebuilt(first=first, result=result, seconds=time.monotonic() - start)


def score(cloud: GaussianCloud, frames: list[RgbdFrame]) -> Scores:
    """Draw held-out views from the poses given and compare, nothing aligned."""
    rasteriser = Rasteriser(RasterConfig())
    drawn = [
        rasteriser.view(cloud, frame.color_camera, frame.T_base_color).image_u8()
        for frame in frames
    ]
    return compare(drawn, frames)


def median_depth_error_m(cloud: GaussianCloud, frames: list[RgbdFrame]) -> float:
    """Over the pixels of held-out views where depth was recorded and the scene has some [m]."""
    from splat.depth import depth_scores

    rasteriser = Rasteriser(RasterConfig())
    limits = DepthLimits(max_depth_m=MAX_DEPTH_M, flying_fraction=0.03)
    views = [training_view(FrameSurface(frame, limits)) for frame in frames]
    drawn = {"scene": lambda camera, T: rasteriser.view(cloud, camera, T).depth_m}
    return depth_scores(drawn, views)["scene"].median_abs_m


def mean_image_psnr_db(train: list[RgbdFrame], held_out: list[RgbdFrame]) -> float:
    """What the mean of the training images scores: a scene of one view would make it high."""
    mean = np.rint(np.mean([frame.image_u8 for frame in train], axis=0)).astype(np.uint8)
    return compare([mean] * len(held_out), held_out).psnr_db


def compare(drawn: list[np.ndarray], frames: list[RgbdFrame]) -> Scores:
    """PSNR of each image, then the mean; SSIM with the 11 x 11 Gaussian window of Wang 2004."""
    from skimage.metrics import structural_similarity

    values, similarities = [], []
    for image_u8, frame in zip(drawn, frames, strict=True):
        a, b = image_u8.astype(np.float32) / 255, frame.image_u8.astype(np.float32) / 255
        values.append(psnr_db(float(np.square(a - b, dtype=np.float64).mean())))
        similarities.append(
            structural_similarity(
                a,
                b,
                gaussian_weights=True,
                sigma=1.5,
                use_sample_covariance=False,
                channel_axis=-1,
                data_range=1.0,
            )
        )
    return Scores(psnr_db=float(np.mean(values)), ssim=float(np.mean(similarities)))
