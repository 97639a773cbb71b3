"""Fit Gaussians to images: half size first, then full size, for a time or a number of images.

Adam moves everything; what happens between its steps is in ``events``.
"""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from bridge.terminal import Advance
from twin.scene.fit.camera_correction import correction_gradient
from twin.scene.fit.events import Events, Progress, order_of_views
from twin.scene.fit.state import Checkpoint, FitState, first_state, load_state, save_state
from twin.scene.frames.training_view import TrainingView
from twin.scene.gaussians.cloud import NUM_FIRST, GaussianCloud, with_harmonics
from twin.scene.raster.losses import psnr_db
from twin.scene.raster.rasteriser import RasterConfig, Rasteriser
from twin.scene.raster.session import FitSession
from twin.scene.settings import FitConfig

RATES = {
    "means_m": 0.18,  # in units of the median Gaussian's size
    "quats_wxyz": 1.2e-2,
    "scales_log": 4.5e-2,
    "opacities_logit": 0.12,
    "colors": 2.4e-2,
    "harmonics": 3e-3,
}
"""Adam's step sizes at the start."""
DECAY = 0.05
"""What is left of them at the end."""
HOLD_EVERY = 5
"""Images between two looks at whether Gaussians left the surface."""
SPENT_AT_MOST = 0.5
"""Initialisation uses up this share of the budget at most, so that there always is a fit."""
POSES_FROM = 0.15
"""Cameras are moved only once the scene is good enough to say where to."""


@dataclass(frozen=True, kw_only=True)
class FitResult:
    """The fitted cloud and what it took."""

    cloud: GaussianCloud
    iterations: int
    coarse_iterations: int
    seconds: float
    """Wall time, initialisation and that of an interrupted fit before included."""
    cpu_seconds: float
    """Of this process, this time."""
    train_psnr_db: float | None
    """Over the static pixels of the last images seen, at the size they were fitted at; None when
    there were none."""
    gains: Float[np.ndarray, "num_views 3"]
    """Brightness of each training image over that of the scene, per channel; their mean is 1."""
    Ts_base_color: Float[np.ndarray, "num_views 4 4"]
    """Where the training views were in the end; as given unless poses were refined."""
    num_split: int
    num_pruned: int
    colour_steps: int
    """Conjugate gradient steps that solved colours; 0 when there was no time for them."""


def fit(
    cloud: GaussianCloud,
    views: list[TrainingView],
    config: FitConfig,
    advance: Advance,
    *,
    max_splats: int | None = None,
    checkpoint: Checkpoint | None = None,
    clock: Callable[[], float] = time.monotonic,
    spent_s: float = 0.0,
) -> FitResult:
    """Minimise the loss over the views with Adam; each step draws one image.

    The time budget covers everything in here, the solutions in closed form included: it is
    exceeded by one image at most.

    Args:
        cloud: Where to start.
        views: Training images; never the held-out ones.
        config: Budget, loss and seed.
        advance: Told the percentage done, the recent PSNR and the time left.
        max_splats: Budget of Gaussians; none: as many as there are at the start.
        checkpoint: Where to keep the state; a state of the same key is gone on with.
        clock: Seconds that the budget is counted in.
        spent_s: How much of the budget initialisation has used up; up to half of it counts.
    """
    learner = _Learner(views, config)
    events = Events(views, config, max_splats or len(cloud), learner.rasteriser)
    state = None if checkpoint is None else load_state(checkpoint, learner.session)
    if state is None or len(state.gains) != len(views):
        harmonics = NUM_FIRST if config.harmonics else cloud.num_harmonics
        state = first_state(learner.session(with_harmonics(cloud, harmonics)), len(views))
        state.seconds = min(spent_s, SPENT_AT_MOST * config.budget_s)
    cpu_start, last_saved = time.process_time(), state.seconds
    for at in _steps(config, state, clock):
        events.keep(state, at)
        learner.step(state, at)
        advance(round(100 * at.fraction), _note(state, at, len(views)))
        if checkpoint is not None and at.seconds - last_saved >= checkpoint.period_s:
            state.seconds = last_saved = at.seconds
            save_state(checkpoint, state)
    if config.slab:
        state.surface.hold(state.session.cloud, config.slab)
    return FitResult(
        cloud=state.session.cloud,
        iterations=state.session.steps,
        coarse_iterations=state.coarse_steps,
        seconds=state.seconds,
        cpu_seconds=time.process_time() - cpu_start,
        train_psnr_db=_recent_psnr_db(state, len(views)),
        gains=state.gains,
        Ts_base_color=np.stack([learner.pose(state, index) for index in range(len(views))]),
        num_split=state.num_split,
        num_pruned=state.num_pruned,
        colour_steps=state.colour_steps,
    )


def _steps(config: FitConfig, state: FitState, clock: Callable[[], float]) -> Iterator[Progress]:
    begin_s = clock() - state.seconds
    by_images = config.iterations > 0
    end_s = math.inf if by_images else begin_s + config.budget_s
    while True:
        state.seconds = clock() - begin_s
        seen = state.session.steps
        fraction = seen / config.iterations if by_images else state.seconds / config.budget_s
        if fraction >= 1.0:
            return
        yield Progress(fraction=fraction, seconds=state.seconds, clock=clock, end_s=end_s)


def _recent_psnr_db(state: FitState, num_views: int) -> float | None:
    return psnr_db(float(np.mean(state.errors[-num_views:]))) if state.errors else None


def _note(state: FitState, at: Progress, num_views: int) -> str:
    recent = _recent_psnr_db(state, num_views)
    said = "" if recent is None else f", training PSNR {recent:.2f} dB"
    left = at.seconds / at.fraction - at.seconds if at.fraction > 0 else None
    return f"image {state.session.steps}{said}" + ("" if left is None else f", {left:.0f} s left")


class _Learner:
    """One step of the fit."""

    def __init__(self, views: list[TrainingView], config: FitConfig) -> None:
        self._views = views
        self._config = config
        self.rasteriser = Rasteriser(RasterConfig(threads=config.threads))

    def session(self, cloud: GaussianCloud) -> FitSession:
        """What draws, compares and learns, from a cloud on."""
        return FitSession(
            cloud,
            self.rasteriser.config,
            loss=self._config.loss,
            depth_weight=self._config.depth_weight,
        )

    def pose(self, state: FitState, index: int) -> np.ndarray:
        """Where a view is now thought to be."""
        return state.cameras.pose(index, self._views[index].T_base_color)

    def step(self, state: FitState, at: Progress) -> None:
        """Draw one image and follow its gradient."""
        epoch, place = divmod(state.session.steps, len(self._views))
        index = int(order_of_views(self._config.seed, epoch, len(self._views))[place])
        coarse = at.fraction < self._config.coarse_fraction
        state.coarse_steps += coarse
        view, pose = self._views[index], self.pose(state, index)
        decay = DECAY**at.fraction
        rates = {name: rate * decay for name, rate in RATES.items()}
        rates["means_m"] *= state.size_m
        report = state.session.step(
            view.half if coarse else view.full, pose, rates, state.gains[index]
        )
        if self._config.slab and state.session.steps % HOLD_EVERY == 0:
            state.surface.hold(state.session.cloud, self._config.slab)
        if self._config.refine_poses and at.fraction >= POSES_FROM:
            pulled = correction_gradient(report.T_camera_base, pose)
            state.cameras.update(index, pulled, decay)
        if report.mse is not None:
            state.errors = [*state.errors[-len(self._views) :], report.mse]
