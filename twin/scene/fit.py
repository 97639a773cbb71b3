"""Fit Gaussians to images: half size first, then full size, for a time or a number of images."""

import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bridge.terminal import Advance
from twin.scene.gaussians import GaussianCloud, arrays
from twin.scene.losses import Loss, psnr_db
from twin.scene.raster import RasterConfig, Rasteriser, load_native
from twin.scene.settings import FitConfig
from twin.scene.training_view import Target, TrainingView

RATES = {
    "means_m": 0.18,  # in units of the median Gaussian's size
    "quats_wxyz": 1.2e-2,
    "scales_log": 4.5e-2,
    "opacities_logit": 0.12,
    "colors": 2.4e-2,
}
"""Adam's step sizes at the start; they decay by the factor below."""
DECAY = 0.05


@dataclass(frozen=True, kw_only=True)
class FitResult:
    """The fitted cloud and what it took."""

    cloud: GaussianCloud
    iterations: int
    coarse_iterations: int
    seconds: float
    cpu_seconds: float
    train_psnr_db: float | None
    """Over the static pixels of the last images seen, at the size they were fitted at; None when
    there were none."""


@dataclass(frozen=True, kw_only=True)
class _Progress:
    """How far along the fit is, 0..1 by time or by images."""

    fraction: float
    step: int


def _steps(config: FitConfig, advance: Advance) -> Iterator[_Progress]:
    start = time.monotonic()
    step = 0
    while True:
        seconds = time.monotonic() - start
        fraction = step / config.iterations if config.iterations else seconds / config.budget_s
        if fraction >= 1.0:
            return
        step += 1
        yield _Progress(fraction=fraction, step=step)


class _Adam:
    """Adam (Kingma and Ba 2015) on each array of a cloud, in place."""

    def __init__(self, cloud: GaussianCloud, threads: int) -> None:
        self.cloud = GaussianCloud(**{name: rows.copy() for name, rows in arrays(cloud)})
        self._moments = {
            name: (np.zeros_like(rows), np.zeros_like(rows)) for name, rows in arrays(cloud)
        }
        size = float(np.median(np.exp(cloud.scales_log.max(axis=1))))
        self._rates = RATES | {"means_m": RATES["means_m"] * size}
        self._threads = threads
        self._step = load_native().adam_step

    def update(self, gradient: object, at: _Progress) -> None:
        decay = DECAY**at.fraction
        for name, rows in arrays(self.cloud):
            first, second = self._moments[name]
            self._step(
                rows,
                getattr(gradient, name),
                first,
                second,
                at.step,
                self._rates[name] * decay,
                threads=self._threads,
            )


def fit(
    cloud: GaussianCloud, views: list[TrainingView], config: FitConfig, advance: Advance
) -> FitResult:
    """Minimise the loss over the views with Adam; each step draws one image.

    Args:
        cloud: Where to start.
        views: Training images; never the held-out ones.
        config: Budget, loss and seed.
        advance: Told the percentage done and the recent PSNR.
    """
    rng = np.random.default_rng(config.seed)
    rasteriser = Rasteriser(RasterConfig(threads=config.threads))
    loss = Loss(config.loss, depth_weight=config.depth_weight, threads=config.threads)
    adam = _Adam(cloud, config.threads)
    errors: list[float] = []
    queue: list[int] = []
    coarse = 0
    start, cpu_start = time.monotonic(), time.process_time()
    at = _Progress(fraction=0.0, step=0)
    for at in _steps(config, advance):
        if not queue:
            queue = rng.permutation(len(views)).tolist()
        view = views[queue.pop()]
        half = at.fraction < config.coarse_fraction
        coarse += half
        target = view.half if half else view.full
        error = _step(adam, at, rasteriser, loss, view, target)
        errors += [] if error is None else [error]
        recent = _recent_psnr_db(errors, len(views))
        said = "" if recent is None else f", training PSNR {recent:.2f} dB"
        advance(round(100 * at.fraction), f"image {at.step}{said}")
    return FitResult(
        cloud=adam.cloud,
        iterations=at.step,
        coarse_iterations=coarse,
        seconds=time.monotonic() - start,
        cpu_seconds=time.process_time() - cpu_start,
        train_psnr_db=_recent_psnr_db(errors, len(views)),
    )


def _recent_psnr_db(errors: list[float], num_views: int) -> float | None:
    return psnr_db(float(np.mean(errors[-num_views:]))) if errors else None


def _step(
    adam: _Adam,
    at: _Progress,
    rasteriser: Rasteriser,
    loss: Loss,
    view: TrainingView,
    target: Target,
) -> float | None:
    """Draw one image and follow its gradient; returns the mean squared error where it counts."""
    planes = rasteriser.draw_planes(adam.cloud, target.camera, view.T_base_color)
    # Where something moving stood, the image is compared with itself: no error, no gradient.
    wanted = np.where(target.static_mask, target.image(), planes[:3])
    _, mse, gradient = loss(planes, wanted, target.depth_m)
    adam.update(rasteriser.pull_back(planes, gradient), at)
    static = float(target.static_mask.mean())
    return mse / static if static > 0 else None
