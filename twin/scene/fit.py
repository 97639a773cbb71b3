"""Fit Gaussians to images: half size first, then full size, for a time or a number of images.

Adam moves everything; on the way gains and colours are solved in closed form (``appearance``) and
Gaussians are split where the error is large (``densify``).
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from bridge.terminal import Advance
from twin.scene.appearance import Observation, solve_appearance, solve_gains
from twin.scene.camera_correction import correction_gradient
from twin.scene.densify import densify, score
from twin.scene.fit_session import FitSession
from twin.scene.fit_state import Checkpoint, FitState, first_state, load_state, save_state
from twin.scene.gaussians import NUM_FIRST, GaussianCloud, with_harmonics
from twin.scene.losses import psnr_db
from twin.scene.raster import RasterConfig, Rasteriser
from twin.scene.settings import FitConfig
from twin.scene.training_view import TrainingView

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
SOLVE_AT = (0.9,)
"""Shares of the budget at which colours are solved. Not at the start: a sharp solution for blurred
Gaussians leads Adam astray (0.4 dB of 34 on the clean tabletop); near the end it adds 0.2 dB."""
GAINS_AT = (0.1, 0.3, 0.6)
"""Shares of the budget at which gains are solved, besides with the colours."""
SPLIT_AT = (0.1, 0.2, 0.3)
"""Shares of the budget at which Gaussians are split and dropped."""
POSES_FROM = 0.15
"""Cameras are moved only once the scene is good enough to say where to."""


@dataclass(frozen=True, kw_only=True)
class FitResult:
    """The fitted cloud and what it took."""

    cloud: GaussianCloud
    iterations: int
    coarse_iterations: int
    seconds: float
    """Wall time, that of an interrupted fit before included."""
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


@dataclass(frozen=True, kw_only=True)
class _Progress:
    """How far along the fit is, 0..1 by time or by images."""

    fraction: float
    seconds: float


def fit(
    cloud: GaussianCloud,
    views: list[TrainingView],
    config: FitConfig,
    advance: Advance,
    *,
    max_splats: int | None = None,
    checkpoint: Checkpoint | None = None,
    clock: Callable[[], float] = time.monotonic,
) -> FitResult:
    """Minimise the loss over the views with Adam; each step draws one image.

    Args:
        cloud: Where to start.
        views: Training images; never the held-out ones.
        config: Budget, loss and seed.
        advance: Told the percentage done, the recent PSNR and the time left.
        max_splats: Budget of Gaussians; none: as many as there are at the start.
        checkpoint: Where to keep the state; a state of the same key is gone on with.
        clock: Seconds that the budget is counted in.
    """
    learner = _Learner(views, config, max_splats or len(cloud))
    state = None if checkpoint is None else load_state(checkpoint, learner.session)
    if state is None:
        harmonics = NUM_FIRST if config.harmonics else cloud.num_harmonics
        state = first_state(learner.session(with_harmonics(cloud, harmonics)), len(views))
    cpu_start, last_saved = time.process_time(), state.seconds
    for at in _steps(config, state, clock):
        learner.keep_schedule(state, at)
        learner.step(state, at)
        advance(round(100 * at.fraction), _note(state, at, len(views)))
        if checkpoint is not None and at.seconds - last_saved >= checkpoint.period_s:
            state.seconds = last_saved = at.seconds
            save_state(checkpoint, state)
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
    )


def _steps(config: FitConfig, state: FitState, clock: Callable[[], float]) -> Iterator[_Progress]:
    begin = clock() - state.seconds
    while True:
        state.seconds = clock() - begin
        by_images = config.iterations > 0
        seen = state.session.steps
        fraction = seen / config.iterations if by_images else state.seconds / config.budget_s
        if fraction >= 1.0:
            return
        yield _Progress(fraction=fraction, seconds=state.seconds)


def _recent_psnr_db(state: FitState, num_views: int) -> float | None:
    return psnr_db(float(np.mean(state.errors[-num_views:]))) if state.errors else None


def _note(state: FitState, at: _Progress, num_views: int) -> str:
    recent = _recent_psnr_db(state, num_views)
    said = "" if recent is None else f", training PSNR {recent:.2f} dB"
    left = at.seconds / at.fraction - at.seconds if at.fraction > 0 else None
    return f"image {state.session.steps}{said}" + ("" if left is None else f", {left:.0f} s left")


class _Learner:
    """One step of the fit, and the events of its schedule."""

    def __init__(self, views: list[TrainingView], config: FitConfig, max_splats: int) -> None:
        self._views = views
        self._config = config
        self._max_splats = max_splats
        self._rasteriser = Rasteriser(RasterConfig(threads=config.threads))

    def session(self, cloud: GaussianCloud) -> FitSession:
        """What draws, compares and learns, from a cloud on."""
        return FitSession(
            cloud,
            self._rasteriser.config,
            loss=self._config.loss,
            depth_weight=self._config.depth_weight,
        )

    def pose(self, state: FitState, index: int) -> np.ndarray:
        """Where a view is now thought to be."""
        return state.cameras.pose(index, self._views[index].T_base_color)

    @cached_property
    def _schedule(self) -> list[tuple[float, Callable[[FitState, bool], None]]]:
        events: list[tuple[float, Callable[[FitState, bool], None]]] = []
        if self._config.densify:
            events += [(at, self._densify) for at in SPLIT_AT]
        if self._config.gain:
            events += [(at, self._solve_gains) for at in GAINS_AT]
        if self._config.appearance_steps:
            events += [(at, self._solve_colours) for at in SOLVE_AT]
        return sorted(events, key=lambda event: event[0])

    def keep_schedule(self, state: FitState, at: _Progress) -> None:
        """Do what is due; what is already behind is not done again."""
        while (
            state.events_done < len(self._schedule)
            and self._schedule[state.events_done][0] <= at.fraction
        ):
            coarse = at.fraction < self._config.coarse_fraction
            self._schedule[state.events_done][1](state, coarse)
            state.events_done += 1

    def _observations(self, state: FitState, coarse: bool) -> list[Observation]:
        return [
            Observation(
                target=view.half if coarse else view.full,
                T_base_camera=self.pose(state, index),
                gain=state.gains[index],
            )
            for index, view in enumerate(self._views)
        ]

    def _solve_gains(self, state: FitState, coarse: bool) -> None:
        observations = self._observations(state, coarse)
        state.gains = solve_gains(state.session.cloud, observations, self._rasteriser)

    def _solve_colours(self, state: FitState, coarse: bool) -> None:
        if self._config.gain:
            self._solve_gains(state, coarse)
        solved = solve_appearance(
            state.session.cloud,
            self._observations(state, coarse),
            self._rasteriser,
            steps=self._config.appearance_steps,
        )
        state.session.cloud.colors[:] = solved.cloud.colors
        state.session.cloud.harmonics[:] = solved.cloud.harmonics

    def _densify(self, state: FitState, coarse: bool) -> None:
        cloud = state.session.cloud
        scores = score(cloud, self._observations(state, coarse), self._rasteriser)
        left = sum(1 for _, event in self._schedule[state.events_done :] if event == self._densify)
        room = self._max_splats - len(cloud)
        done = densify(cloud, scores, max_splats=self._max_splats, most=-(-max(room, 0) // left))
        state.session.rearrange(done.cloud, done.parents)
        state.num_split += done.num_split
        state.num_pruned += done.num_pruned

    def step(self, state: FitState, at: _Progress) -> None:
        """Draw one image and follow its gradient."""
        epoch, place = divmod(state.session.steps, len(self._views))
        order = np.random.default_rng([self._config.seed, epoch]).permutation(len(self._views))
        index = int(order[place])
        coarse = at.fraction < self._config.coarse_fraction
        state.coarse_steps += coarse
        view, pose = self._views[index], self.pose(state, index)
        decay = DECAY**at.fraction
        rates = {name: rate * decay for name, rate in RATES.items()}
        rates["means_m"] *= state.size_m
        report = state.session.step(
            view.half if coarse else view.full, pose, rates, state.gains[index]
        )
        if self._config.refine_poses and at.fraction >= POSES_FROM:
            pulled = correction_gradient(report.T_camera_base, pose)
            state.cameras.update(index, pulled, decay)
        if report.mse is not None:
            state.errors = [*state.errors[-len(self._views) :], report.mse]
