"""Fit Gaussians to images: half size first, then full size, for a time or a number of images.

Adam moves everything. Between its steps exposures are solved in closed form and Gaussians are split
where the error is large (``densify``). Each of these looks at many images at once, so none may take
more than its share of the budget.

Images alone let a Gaussian slide along its rays as long as the training views agree; the depth term
sees only the mean depth of a pixel, so Gaussians before and behind the surface cancel in it. From
other viewpoints they come apart as a haze of millimetres, and the nearest of them hide the others:
depth comes out too near. So each Gaussian is held within a ``slab`` around the piece of the fused
surface that it began on.
"""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Int64

from bridge.geometry import se3
from bridge.terminal import Advance
from twin.scene.frames.rgbd import Target, TrainingView
from twin.scene.gaussians import (
    GaussianCloud,
    arrays,
    as_float32,
    concatenate,
    morton_order,
    with_harmonics,
)
from twin.scene.raster.rasteriser import (
    SAME_EXPOSURE,
    FitSession,
    RasterConfig,
    Rasteriser,
    psnr_db,
)
from twin.scene.settings import FitConfig


@dataclass(frozen=True, kw_only=True)
class Allowance:
    """Time until which a stage may run, by the clock of the fit."""

    clock: Callable[[], float] = time.monotonic
    until_s: float = math.inf
    """On that clock; infinite when images are counted instead of time."""

    def is_over(self) -> bool:
        """Say whether nothing more should be begun."""
        return self.clock() >= self.until_s


UNLIMITED = Allowance()


@dataclass(frozen=True, kw_only=True)
class ImageObservation:
    """One image at one size, where it was seen from, and how its colours came out."""

    target: Target
    T_base_camera: Float[np.ndarray, "4 4"]
    gain: Float[np.ndarray, "3"]
    """Times the scene's colour gives the recorded one: a factor per channel."""


SATURATED = 250 / 255
"""A channel brighter than this no longer follows the exposure."""
GAIN_PRIOR = 1e-3
"""Pull of a gain towards 1, as a mean squared brightness: decides only black images."""


def solve_gains(
    cloud: GaussianCloud,
    observations: Sequence[ImageObservation],
    rasteriser: Rasteriser,
    allowance: Allowance = UNLIMITED,
) -> Float[np.ndarray, "num_views 3"]:
    """How each image's colours come from the drawn ones; on average they do not change.

    All images twice as bright and all colours half as bright would look the same: the mean over the
    images is held at no change. Least squares over static pixels that are not saturated. Images
    that there is no time for keep the gains they have.
    """
    gains = np.array([item.gain for item in observations], dtype=np.float64)
    for index, item in enumerate(observations):
        if allowance.is_over():
            break
        planes = rasteriser.draw_planes(cloud, item.target.camera, item.T_base_camera)
        gains[index] = gain_between(planes[:3], item.target)
    return np.asarray(gains / gains.mean(axis=0))


def gain_between(
    drawn: Float32[np.ndarray, "3 height width"], target: Target
) -> Float[np.ndarray, "3"]:
    """The factor per channel that brings a drawn image closest to the recorded one."""
    wanted = target.image()
    usable = target.static_mask & (wanted < SATURATED).all(axis=0)
    recorded, own = wanted[:, usable].astype(np.float64), drawn[:, usable].astype(np.float64)
    prior = GAIN_PRIOR * max(int(usable.sum()), 1)
    both = (recorded * own).sum(axis=1) + prior
    return np.asarray(both / (np.square(own).sum(axis=1) + prior))


SLAB = 0.5
"""How far a Gaussian may leave the surface that depth fused, along its normal, in its size."""


@dataclass(frozen=True, kw_only=True)
class SurfacePrior:
    """The plane each Gaussian began on."""

    normals: Float32[np.ndarray, "num_splats 3"]
    heights_m: Float32[np.ndarray, " num_splats"]
    """Of the plane along its normal: normal . p for each of its points."""
    sizes_m: Float32[np.ndarray, " num_splats"]
    """Standard deviation in the plane at the start."""

    @classmethod
    def of(cls, cloud: GaussianCloud) -> "SurfacePrior":
        """Planes through the Gaussians' centres across their thinnest axis."""
        row = np.arange(len(cloud))
        R = se3.rotation_from_quaternion(cloud.quats_wxyz.astype(np.float64))
        normals = R[row, :, cloud.scales_log.argmin(axis=1)].reshape(-1, 3)
        return cls(
            normals=as_float32(normals),
            heights_m=as_float32(np.einsum("ni,ni->n", normals, cloud.means_m)),
            sizes_m=np.exp(cloud.scales_log.max(axis=1, initial=-np.inf)).astype(np.float32),
        )

    def take(self, parents: Int64[np.ndarray, " num_rows"]) -> "SurfacePrior":
        """The planes of Gaussians that come from some of these."""
        return SurfacePrior(**{name: rows[parents] for name, rows in vars(self).items()})

    def hold(self, cloud: GaussianCloud) -> None:
        """Move centres that left the slab back to its border, in place."""
        off_m = np.einsum("ni,ni->n", self.normals, cloud.means_m) - self.heights_m
        limit_m = np.float32(SLAB) * self.sizes_m
        beyond_m = off_m - np.clip(off_m, -limit_m, limit_m)
        cloud.means_m[:] -= beyond_m[:, None] * self.normals


@dataclass(kw_only=True)
class RunningSum:
    """Sums of the cloud's arrays over the last images of a fit, for their mean."""

    sums: dict[str, Float32[np.ndarray, "num_splats ..."]] = field(default_factory=dict)
    count: int = 0

    def add(self, cloud: GaussianCloud) -> None:
        """Count the cloud as it is now; always of the same Gaussians."""
        for name, rows in arrays(cloud):
            if self.count:
                self.sums[name] += rows
            else:
                self.sums[name] = rows.copy()
        self.count += 1

    def put_mean_into(self, cloud: GaussianCloud) -> None:
        """Replace the cloud by the mean, in place; nothing was added: leave it."""
        for name, rows in arrays(cloud) if self.count else ():
            rows[:] = self.sums[name] / np.float32(self.count)


@dataclass(kw_only=True)
class FitState:
    """A fit between two steps; the only thing that changes while fitting."""

    session: FitSession
    """The cloud, the moments of Adam and the number of images seen."""
    size_m: float
    """Median size of the first Gaussians; positions move in units of it."""
    gains: Float[np.ndarray, "num_views 3"]
    surface: SurfacePrior
    """Where the Gaussians began."""
    last: RunningSum = field(default_factory=RunningSum)
    """Of the Gaussians from ``MEAN_FROM`` on."""
    seconds: float = 0.0
    """Time spent so far."""
    events_done: int = 0
    """How much of the schedule of exposures and splits is behind."""
    errors: list[float] = field(default_factory=list)
    """Mean squared errors of the last images."""


MAX_SCORED_VIEWS = 20
"""Views that errors are gathered from; more only cost time."""
TRANSPARENT = 0.03
"""Gaussians with less opacity go."""
UNSEEN_PIXELS = 0.4
"""Gaussians that make up less than this many pixels of all views together go."""
HUGE_FRACTION = 0.15
"""Gaussians whose deviation exceeds this share of an image's width go: fog before the camera."""
FINEST_PX = 0.4
"""Gaussians smaller than this in every view are not split: pixels cannot tell the halves."""
SPLIT_SHRINK = 0.62
"""Standard deviation of a half along the split, in that of the whole."""
SPLIT_SHIFT = 0.78
"""Distance of a half from the middle; with the shrink, s^2 + d^2 = 1: the variance stays."""


@dataclass(frozen=True, kw_only=True)
class Scores:
    """What the views say about each Gaussian."""

    error: Float32[np.ndarray, " num_splats"]
    """Sum over views and pixels of weight times colour error."""
    pixels: Float32[np.ndarray, " num_splats"]
    """Sum of weights: how many pixels it makes up in all views."""
    size_fraction: Float32[np.ndarray, " num_splats"]
    """Largest standard deviation in any image, in image widths."""
    size_px: Float32[np.ndarray, " num_splats"]
    """The same in pixels."""
    complete: bool = True
    """Whether all views that were chosen could be asked in time; else not seen says nothing."""


def score(
    cloud: GaussianCloud,
    observations: Sequence[ImageObservation],
    rasteriser: Rasteriser,
    allowance: Allowance = UNLIMITED,
) -> Scores:
    """Draw the views, evenly chosen where there are many, and lift their errors.

    A^T |error| is a sum over views that needs no extra passes and leaves nothing to chance
    (error-based densification, Rota Bulo et al. 2024, Revising Densification). Views that there is
    no time for are left out.
    """
    step = -(-len(observations) // MAX_SCORED_VIEWS)
    error, pixels, size_px, fraction = (np.zeros(len(cloud), np.float32) for _ in range(4))
    largest_m = np.exp(cloud.scales_log.max(axis=1))
    complete = True
    for item in observations[::step]:
        if allowance.is_over():
            complete = False
            break
        camera, mask = item.target.camera, item.target.static_mask
        planes = rasteriser.draw_planes(cloud, camera, item.T_base_camera)
        exposed = planes[:3] * item.gain.astype(np.float32)[:, None, None]
        wrong = np.abs(exposed - item.target.image()).mean(axis=0) * mask
        lifted = rasteriser.lift(np.stack([wrong, mask.astype(np.float32)]))
        error += lifted[:, 0]
        pixels += lifted[:, 1]
        seen = rasteriser.visible_mask() & (lifted[:, 1] > 0)
        depth_m = (cloud.means_m - item.T_base_camera[:3, 3]) @ item.T_base_camera[:3, 2]
        px = np.where(seen, largest_m * camera.fx / np.maximum(depth_m, 0.05), 0.0)
        np.maximum(size_px, px.astype(np.float32), out=size_px)
        np.maximum(fraction, (px / camera.width).astype(np.float32), out=fraction)
    return Scores(
        error=error, pixels=pixels, size_px=size_px, size_fraction=fraction, complete=complete
    )


def densify(
    cloud: GaussianCloud, scores: Scores, *, max_splats: int, most: int
) -> tuple[GaussianCloud, Int64[np.ndarray, " num_splats"]]:
    """Drop what shows nothing or hides everything, and split where the error is large.

    Returns:
        The rearranged cloud, and which Gaussian of the one before each comes from.
    """
    kept: Bool[np.ndarray, " num_splats"] = cloud.opacities() > TRANSPARENT
    if scores.complete:
        kept &= scores.pixels > UNSEEN_PIXELS
    kept &= scores.size_fraction < HUGE_FRACTION
    if not kept.any():  # nothing is seen at all: images that are masked everywhere
        kept[:] = True
    free = max(min(max_splats - int(kept.sum()), most), 0)
    wanting = np.flatnonzero(kept & (scores.size_px > FINEST_PX) & (scores.error > 0))
    worst = wanting[np.argsort(-scores.error[wanting], kind="stable")[:free]]
    whole = kept.copy()
    whole[worst] = False
    ids = np.concatenate([np.flatnonzero(whole), worst, worst])
    halves = _halves(cloud.take(worst))
    everything = concatenate([cloud.take(whole), *halves])
    order = morton_order(everything.means_m)
    return everything.take(order), ids[order]


def _halves(cloud: GaussianCloud) -> list[GaussianCloud]:
    """Each Gaussian as two beside one another along its longest axis."""
    axis = cloud.scales_log.argmax(axis=1)
    row = np.arange(len(cloud))
    R = se3.rotation_from_quaternion(cloud.quats_wxyz.astype(np.float64))
    length_m = np.exp(cloud.scales_log[row, axis]).astype(np.float64)
    shift_m = SPLIT_SHIFT * length_m[:, None] * R[row, :, axis]
    scales_log = cloud.scales_log.copy()
    scales_log[row, axis] += np.float32(np.log(SPLIT_SHRINK))
    return [
        replace(
            cloud,
            means_m=as_float32(cloud.means_m + sign * shift_m),
            scales_log=scales_log.copy(),
        )
        for sign in (-1.0, 1.0)
    ]


COARSE = 0.6
"""Share of the budget spent at half resolution."""
DEPTH_WEIGHT = 0.5
"""Of the L1 depth term (the paper's lambda_d), relative to depth."""
EXPOSURES_AT = (0.1, 0.3, 0.6, 0.9)
"""Shares of the budget at which exposures are solved."""
SPLIT_AT = (0.1, 0.25, 0.4, 0.6)
"""Shares of the budget at which Gaussians are split and dropped. The last one is where images are
of full size by default: they show errors of a texture that half-size ones have averaged away."""
EXPOSURES_SHARE, SPLIT_SHARE = 0.02, 0.04
"""At most this much of the budget for each of them."""


@dataclass(frozen=True, kw_only=True)
class Progress:
    """How far along the fit is, 0..1 by time or by images."""

    fraction: float
    seconds: float
    clock: Callable[[], float]
    """What the budget is counted in."""
    end_s: float
    """When the budget is used up, on that clock; infinite when images are counted, so that what
    is done does not depend on time."""

    def allowance(self, share: float) -> Allowance:
        """Time for a stage that may take this share of the budget, and no more than is left."""
        if math.isinf(self.end_s):
            return Allowance(clock=self.clock)
        now_s = self.clock()
        budget_s = self.seconds / self.fraction if self.fraction > 0 else self.end_s - now_s
        return Allowance(clock=self.clock, until_s=min(now_s + share * budget_s, self.end_s))


Act = Callable[[FitState, bool, Allowance], None]
"""What is done at one time of the schedule."""


class Events:
    """The schedule of a fit, and what it says to do."""

    def __init__(self, views: list[TrainingView], max_splats: int, rasteriser: Rasteriser) -> None:
        """Plan; nothing is done yet."""
        self._views = views
        self._max_splats = max_splats
        self._rasteriser = rasteriser
        planned: list[tuple[float, float, Act]] = [
            *((at, SPLIT_SHARE, self._densify) for at in SPLIT_AT),
            *((at, EXPOSURES_SHARE, self._solve_exposures) for at in EXPOSURES_AT),
        ]
        self._schedule = sorted(planned, key=lambda event: event[0])
        """When, in which share of the budget at most, and what."""

    def keep(self, state: FitState, at: Progress) -> None:
        """Do what is due; what is already behind is not done again."""
        coarse = at.fraction < COARSE
        for due, share, act in self._schedule[state.events_done :]:
            if due > at.fraction:
                break
            act(state, coarse, at.allowance(share))
            state.events_done += 1

    def _observations(self, state: FitState, coarse: bool) -> list[ImageObservation]:
        return [
            ImageObservation(
                target=view.half if coarse else view.full,
                T_base_camera=view.T_base_color,
                gain=state.gains[index],
            )
            for index, view in enumerate(self._views)
        ]

    def _solve_exposures(self, state: FitState, coarse: bool, allowance: Allowance) -> None:
        seen = self._observations(state, coarse)
        cloud = state.session.cloud
        state.gains = solve_gains(cloud, seen, self._rasteriser, allowance)

    def _densify(self, state: FitState, coarse: bool, allowance: Allowance) -> None:
        cloud = state.session.cloud
        scores = score(cloud, self._observations(state, coarse), self._rasteriser, allowance)
        left = sum(act == self._densify for _, _, act in self._schedule[state.events_done :])
        left_over = max(self._max_splats - len(cloud), 0)
        most = -(-left_over // left)
        cloud, parents = densify(cloud, scores, max_splats=self._max_splats, most=most)
        state.session.rearrange(cloud, parents)
        state.surface = state.surface.take(parents)


def keep_colors_in_range(cloud: GaussianCloud) -> None:
    """Move mean colours outside 0..1 to its border, in place.

    Gaussians of which the images show a sliver explain it with any colour, and are seen whole from
    elsewhere. What depends on the direction may go beyond: it is small where few views show it.
    """
    np.clip(cloud.colors, 0.0, 1.0, out=cloud.colors)


RATES = {
    "means_m": 0.18,  # in units of the median Gaussian's size
    "quats_wxyz": 4e-3,
    "scales_log": 4.5e-2,
    "opacities_logit": 0.12,
    "colors": 2.4e-2,
    "harmonics": 3e-3,
}
"""Adam's step sizes at the start."""
DECAY = 0.1
"""What is left of them at the end."""
HOLD_EVERY = 5
"""Images between two looks at whether Gaussians left the surface."""
SPENT_AT_MOST = 0.5
"""Initialisation uses up this share of the budget at most, so that there always is a fit."""
MEAN_FROM = 0.92
"""From this share of the budget on, the Gaussians are summed at each of these looks; the fit ends
with their mean, which is without the noise of single images. All events are behind by then, so
the Gaussians stay the same."""


@dataclass(frozen=True, kw_only=True)
class FitResult:
    """The fitted cloud and what it took."""

    cloud: GaussianCloud
    iterations: int
    iterations_asked: int | None
    """None: as many as the time allowed."""
    seconds: float
    """Wall time, initialisation included."""
    train_psnr_db: float | None
    """Over the static pixels of the last images seen, at the size they were fitted at; None when
    there were none."""
    gains: Float[np.ndarray, "num_views 3"]
    """How the colours of the scene came out in each training image; on average they did not
    change."""

    @property
    def underfitted(self) -> bool:
        """Whether the time limit struck before all the images asked for were done."""
        return self.iterations < (self.iterations_asked or 0)


def fit(
    cloud: GaussianCloud,
    views: list[TrainingView],
    config: FitConfig,
    advance: Advance,
    *,
    max_splats: int | None = None,
    clock: Callable[[], float] = time.monotonic,
    spent_s: float = 0.0,
) -> FitResult:
    """Minimise the loss over the views with Adam; each step draws one image.

    The time budget covers everything in here, the solutions in closed form included: it is
    exceeded by one image at most. Where images are counted, the time is only a limit, looked at
    between two images: nothing that decides the result depends on it until it strikes.

    Args:
        max_splats: Budget of Gaussians; none: as many as there are at the start.
        spent_s: How much of the budget initialisation has used up; up to half of it counts.
    """
    learner = _Learner(views, config)
    events = Events(views, max_splats or len(cloud), learner.rasteriser)
    raster = learner.rasteriser.config
    session = FitSession(with_harmonics(cloud), raster, depth_weight=DEPTH_WEIGHT)
    state = FitState(
        session=session,
        size_m=float(np.median(np.exp(session.cloud.scales_log.max(axis=1)))),
        gains=np.ones((len(views), 3)),
        surface=SurfacePrior.of(session.cloud),
        seconds=min(spent_s, SPENT_AT_MOST * config.limit_s),
    )
    for at in _steps(config, state, clock):
        events.keep(state, at)
        learner.step(state, at)
        advance(round(100 * at.fraction), _note(state, len(views)))
    state.last.put_mean_into(state.session.cloud)
    state.surface.hold(state.session.cloud)
    return FitResult(
        cloud=state.session.cloud,
        iterations=state.session.steps,
        iterations_asked=config.iterations or None,
        seconds=state.seconds,
        train_psnr_db=_recent_psnr_db(state, len(views)),
        gains=state.gains,
    )


def _steps(config: FitConfig, state: FitState, clock: Callable[[], float]) -> Iterator[Progress]:
    begin_s = clock() - state.seconds
    by_images = config.iterations > 0
    end_s = math.inf if by_images else begin_s + config.limit_s
    while True:
        state.seconds = clock() - begin_s
        seen = state.session.steps
        fraction = seen / config.iterations if by_images else state.seconds / config.limit_s
        if fraction >= 1.0 or state.seconds >= config.limit_s:
            return
        yield Progress(fraction=fraction, seconds=state.seconds, clock=clock, end_s=end_s)


def _recent_psnr_db(state: FitState, num_views: int) -> float | None:
    return psnr_db(float(np.mean(state.errors[-num_views:]))) if state.errors else None


def _note(state: FitState, num_views: int) -> str:
    recent = _recent_psnr_db(state, num_views)
    quality = "" if recent is None else f", training PSNR {recent:.2f} dB"
    return f"image {state.session.steps}{quality}"


class _Learner:
    """One step of the fit."""

    def __init__(self, views: list[TrainingView], config: FitConfig) -> None:
        self._views = views
        self._config = config
        self.rasteriser = Rasteriser(RasterConfig(threads=config.threads))

    def step(self, state: FitState, at: Progress) -> None:
        """Draw one image and follow its gradient."""
        epoch, place = divmod(state.session.steps, len(self._views))
        order = np.random.default_rng([self._config.seed, epoch]).permutation(len(self._views))
        index = int(order[place])
        coarse = at.fraction < COARSE
        view = self._views[index]
        decay = DECAY**at.fraction
        rates = {name: rate * decay for name, rate in RATES.items()}
        rates["means_m"] *= state.size_m
        exposure = state.gains[index][:, None] * SAME_EXPOSURE
        report = state.session.step(
            view.half if coarse else view.full, view.T_base_color, rates, exposure
        )
        keep_colors_in_range(state.session.cloud)
        if state.session.steps % HOLD_EVERY == 0:
            state.surface.hold(state.session.cloud)
            if at.fraction >= MEAN_FROM:
                state.last.add(state.session.cloud)
        if report.mse is not None:
            state.errors = [*state.errors[-len(self._views) :], report.mse]
