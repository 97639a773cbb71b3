"""From cases to parameters: search, intervals, what is identified, and whether it is promoted."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from cmaes import CMA
from jaxtyping import Float

from twin.calibrate.config import CalibrateConfig
from twin.calibrate.physics.cases import Case, Prediction
from twin.calibrate.physics.emulator import (
    Emulator,
    ProfileInterval,
    cloud,
    cloud_size,
    fit_emulator,
    maximise,
    profile,
    spread,
)
from twin.calibrate.physics.likelihood import (
    DiscrepancyPosterior,
    Score,
    features_of,
    observations_of,
    score,
)
from twin.calibrate.physics.parameters import PhysicsParameter

SHARE = 0.3
SPLIT_STREAM = 808


@dataclass(frozen=True, kw_only=True)
class Split:
    """Numbers of the cases that are learned from, and of those that are not."""

    training: tuple[int, ...]
    held_out: tuple[int, ...]


def split_cases(cases: Sequence[Case], seed: int) -> Split:
    """Hold out a share of each kind of episode; of a kind with one episode nothing."""
    rng = np.random.default_rng([SPLIT_STREAM, seed])
    held: list[int] = []
    for kind in sorted({case.kind for case in cases}):
        mine = [index for index, case in enumerate(cases) if case.kind == kind]
        count = max(round(SHARE * len(mine)), 1) if len(mine) > 1 else 0
        held += rng.permutation(mine)[:count].tolist()
    training = [index for index in range(len(cases)) if index not in held]
    return Split(training=tuple(training), held_out=tuple(sorted(held)))


@dataclass(frozen=True, kw_only=True)
class HeldOut:
    """What one set of parameters says about episodes it was not fitted to."""

    log_likelihood: float
    settled_error_m: tuple[float, ...]
    """Per object: how far it was found from where it was predicted to settle."""
    width_error_m: tuple[float, ...]

    def to_record(self) -> dict[str, Any]:
        """Return plain numbers; a median of nothing is None."""
        return {
            "log_likelihood": self.log_likelihood,
            "num_poses": len(self.settled_error_m),
            "settled_error_median_m": _median(self.settled_error_m),
            "settled_error_mean_m": _mean(self.settled_error_m),
            "settled_errors_m": list(self.settled_error_m),
            "num_widths": len(self.width_error_m),
            "width_error_median_m": _median(self.width_error_m),
        }


def judge(
    cases: Sequence[Case],
    predictions: Sequence[Prediction],
    posterior: DiscrepancyPosterior,
) -> HeldOut:
    """Compare predictions of held-out cases with what was seen."""
    observed = observations_of(cases)
    predicted = features_of(cases, predictions)
    found = score(observed, predicted, prior=posterior)
    off = np.linalg.norm((observed.settled - predicted.settled)[:, :2], axis=1)
    return HeldOut(
        log_likelihood=found.log_likelihood,
        settled_error_m=tuple(off.tolist()),
        width_error_m=tuple(np.abs(observed.widths_m - predicted.widths_m).tolist()),
    )


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if values else None


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None


# Look for the best point: the covariance matrix adaptation evolution strategy.
# Hansen, "The CMA evolution strategy: a tutorial" (2016), in the package ``cmaes``.
SIGMA = 0.6
"""First step size in units of the prior."""
NARROW = 0.03
"""The search ends when every parameter is searched for within this."""

Objective = Callable[[Float[np.ndarray, "num_points num_parameters"]], list[float]]
"""Log-posterior of each point."""


@dataclass(frozen=True, kw_only=True)
class Best:
    """Where the search ended."""

    x: Float[np.ndarray, " num_parameters"]
    log_posterior: float
    num_evaluations: int
    out_of_time: bool
    """The number of points did not end the search, nor did its own precision."""


def search(
    objective: Objective,
    bounds: Float[np.ndarray, "num_parameters 2"],
    *,
    evaluations: int,
    seed: int,
    has_time: Callable[[], bool],
    advance: Callable[[int, str], None],
) -> Best:
    """Maximise from the nominal point.

    Args:
        evaluations: At most so many points; a generation that was begun is finished.
        has_time: Asked before each generation. A last resort: what is found without time depends
            on the machine's speed.
    """
    start = np.zeros(len(bounds))
    best, highest, out_of_time = start, objective(start[None])[0], False
    if len(bounds) < 2:  # the package asks for at least two dimensions
        bounds = np.concatenate([bounds, [[-1.0, 1.0]]])
    size = len(start)
    optimiser = CMA(mean=np.zeros(len(bounds)), sigma=SIGMA, bounds=bounds, seed=seed)
    count = 1
    while count < evaluations:
        if not has_time():
            out_of_time = True
            break
        points = np.stack([optimiser.ask() for _ in range(optimiser.population_size)])
        values = objective(points[:, :size])
        optimiser.tell([(x, -value) for x, value in zip(points, values, strict=True)])
        count += len(points)
        top = int(np.argmax(values))
        if values[top] > highest:
            best, highest = points[top, :size], values[top]
        advance(count, f"best log-posterior {highest:.1f}")
        spread = np.std(points[:, :size], axis=0)
        if optimiser.should_stop() or float(spread.max()) < NARROW:
            break
    return Best(x=best, log_posterior=highest, num_evaluations=count, out_of_time=out_of_time)


IDENTIFIED = 0.5
"""A parameter is identified when the data leave at most this share of the prior's width."""
CLOUD_WIDTHS = (0.35, 0.6)
"""Of the first cloud in units of the prior; the widest of the second, which follows the first's
posterior."""
NARROWEST = 0.06
CLOUD_PER_POSTERIOR = 1.5


@runtime_checkable
class Predictor(Protocol):
    """What simulates cases: ``simulate.Evaluator``, or a formula in a test."""

    @property
    def cases(self) -> Sequence[Case]:
        """All of them."""

    def predict(
        self, points: Float[np.ndarray, "num_points num_parameters"], chosen: Sequence[int]
    ) -> list[list[Prediction]]:
        """Predict the chosen cases at every point.

        Args:
            points: Parameters, in units of the prior.
        """


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """What the data say of one parameter, in its own unit."""

    parameter: PhysicsParameter
    value: float
    """Used when promoted: the best value, or the nominal one where nothing was identified."""
    best: float
    """The best value, identified or not."""
    low: float
    high: float
    identified: bool
    why: str
    """What was decided and from which numbers."""
    sigma_share: float
    """Posterior width as a share of the prior's."""


@dataclass(frozen=True, kw_only=True)
class Fit:
    """The outcome of a calibration."""

    estimates: tuple[Estimate, ...]
    split: Split
    nominal: HeldOut
    calibrated: HeldOut
    calibrated_score: Score
    num_evaluations: int
    promoted: bool
    why: str
    cut_short: str
    """After how many points the time limit struck; empty when it did not."""


def fit(
    predictor: Predictor,
    parameters: Sequence[PhysicsParameter],
    config: CalibrateConfig,
    advance: Callable[[int, str], None] = lambda done, note: None,
) -> Fit:
    """Find parameters from the training cases and judge them on the held-out ones."""
    started = time.monotonic()
    cases = predictor.cases
    split = split_cases(cases, config.seed)
    training = [cases[index] for index in split.training]
    observed = observations_of(training)
    bounds = np.array([item.bounds for item in parameters])

    def score_at(x: Float[np.ndarray, " num_parameters"]) -> Score:
        return score(observed, features_of(training, predictor.predict(x[None], split.training)[0]))

    def objective(points: Float[np.ndarray, "num_points num_parameters"]) -> list[float]:
        rows = predictor.predict(points, split.training)
        return [
            score(observed, features_of(training, row)).log_likelihood - 0.5 * float(x @ x)
            for x, row in zip(points, rows, strict=True)
        ]

    found = search(
        objective,
        bounds,
        evaluations=config.evaluations,
        seed=config.seed + 1,
        has_time=lambda: time.monotonic() - started < config.budget_s,
        advance=advance,
    )
    emulator, count = _emulate(predictor, training, split, found.x, bounds, config, advance)
    cut_short = ""
    if found.out_of_time:
        cut_short = (
            f"the time limit of {config.budget_s:g} s struck after {found.num_evaluations} of "
            f"{config.evaluations} points"
        )
    count += found.num_evaluations
    best, _ = maximise(emulator, found.x)
    estimates = _estimates(parameters, emulator, best)
    final = np.array([item.parameter.units(item.value) for item in estimates], dtype=np.float64)
    nominal_score, final_score = score_at(np.zeros(len(parameters))), score_at(final)
    nominal = _held_out(predictor, split, np.zeros(len(parameters)), nominal_score)
    calibrated = _held_out(predictor, split, final, final_score)
    promoted, why = _promote(estimates, split, nominal, calibrated)
    return Fit(
        estimates=estimates,
        split=split,
        nominal=nominal,
        calibrated=calibrated,
        calibrated_score=final_score,
        num_evaluations=count + 2,
        promoted=promoted,
        why=why,
        cut_short=cut_short,
    )


def _emulate(
    predictor: Predictor,
    training: Sequence[Case],
    split: Split,
    centre: Float[np.ndarray, " num_parameters"],
    bounds: Float[np.ndarray, "num_parameters 2"],
    config: CalibrateConfig,
    advance: Callable[[int, str], None],
) -> tuple[Emulator, int]:
    """Two clouds: the first says how wide the second has to be."""
    observed = observations_of(training)
    width = np.full(len(centre), CLOUD_WIDTHS[0])
    count = 0
    emulator: Emulator | None = None
    for turn in range(2):
        if emulator is not None:
            centre, _ = maximise(emulator, centre)
            wanted = CLOUD_PER_POSTERIOR * np.sqrt(np.diag(spread(emulator, centre)))
            width = np.clip(wanted, NARROWEST, CLOUD_WIDTHS[1])
        points = cloud(centre, width, bounds, cloud_size(len(centre)), config.seed + turn)
        rows = predictor.predict(points, split.training)
        features = np.stack([features_of(training, row).flat() for row in rows])
        count += len(points)
        advance(config.evaluations + count, "intervals")
        emulator = fit_emulator(
            points, features, centre=centre, width=width, bounds=bounds, observed=observed
        )
    if emulator is None:
        raise AssertionError
    return emulator, count


def _estimates(
    parameters: Sequence[PhysicsParameter],
    emulator: Emulator,
    best: Float[np.ndarray, " num_parameters"],
) -> tuple[Estimate, ...]:
    """Decide what is identified, then fit that again with everything else left nominal."""
    covariance = spread(emulator, best)
    intervals = [_interval(emulator, best, index, covariance) for index in range(len(best))]
    known = [item.closed and item.sigma <= IDENTIFIED for item in intervals]
    fixed = {index: 0.0 for index, yes in enumerate(known) if not yes}
    final, _ = maximise(emulator, best, fixed)
    return tuple(
        _estimate(item, float(best[index]), float(final[index]), intervals[index], known[index])
        for index, item in enumerate(parameters)
    )


def _interval(
    emulator: Emulator,
    best: Float[np.ndarray, " num_parameters"],
    index: int,
    covariance: Float[np.ndarray, "num_parameters num_parameters"],
) -> ProfileInterval:
    """By profile where data say something; the curvature is enough to say that they do not."""
    sigma, at = float(np.sqrt(covariance[index, index])), float(best[index])
    if sigma <= IDENTIFIED:
        return profile(emulator, best, index, covariance)
    return ProfileInterval(low=at - 1.96 * sigma, high=at + 1.96 * sigma, sigma=sigma, closed=False)


def _estimate(
    parameter: PhysicsParameter, best: float, final: float, interval: ProfileInterval, known: bool
) -> Estimate:
    share = interval.sigma
    low, high = parameter.value(interval.low), parameter.value(interval.high)
    if known:
        final = min(max(final, interval.low), interval.high)
        why = f"the data leave {share:.0%} of the prior's width"
    elif interval.sigma > IDENTIFIED:
        why = (
            f"the data leave {share:.0%} of the prior's width, more than {IDENTIFIED:.0%}: "
            "not moved"
        )
    else:
        why = "the likelihood does not fall off on both sides: not moved"
    return Estimate(
        parameter=parameter,
        value=parameter.value(final) if known else parameter.nominal,
        best=parameter.value(best),
        low=low,
        high=high,
        identified=known,
        why=why,
        sigma_share=share,
    )


def _held_out(
    predictor: Predictor, split: Split, x: Float[np.ndarray, " num_parameters"], trained: Score
) -> HeldOut:
    return judge(
        [predictor.cases[index] for index in split.held_out],
        predictor.predict(x[None], split.held_out)[0],
        trained.posterior,
    )


def _promote(
    estimates: Sequence[Estimate], split: Split, nominal: HeldOut, calibrated: HeldOut
) -> tuple[bool, str]:
    if not any(item.identified for item in estimates):
        return False, "nothing was identified"
    if not split.held_out:
        return False, "no episode could be held out: record at least two of a kind"
    gain = calibrated.log_likelihood - nominal.log_likelihood
    change = f"log-likelihood of {len(split.held_out)} held-out episodes {gain:+.1f}"
    return gain > 0, f"{change}: {'promoted' if gain > 0 else 'not promoted, nothing changes'}"
