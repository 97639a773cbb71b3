"""From cases to parameters: search, intervals, what is identified, and whether it is promoted."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from twin.calibrate.physics.case import Case, Prediction
from twin.calibrate.physics.hold_out import HeldOut, Split, judge, split_cases
from twin.calibrate.physics.likelihood import Score, features_of, observations_of, score
from twin.calibrate.physics.local import (
    Emulator,
    Interval,
    cloud,
    cloud_size,
    fit_emulator,
    maximise,
    profile,
    spread,
)
from twin.calibrate.physics.parameters import PhysicsParameter
from twin.calibrate.physics.search import search

IDENTIFIED = 0.5
"""A parameter is identified when the data leave at most this share of the prior's width."""
CLOUD_WIDTHS = (0.35, 0.6)
"""Of the first cloud in units of the prior; the widest of the second, which follows the first's
posterior."""
NARROWEST = 0.06
CLOUD_PER_POSTERIOR = 1.5


@runtime_checkable
class Predictor(Protocol):
    """What lives cases through: ``evaluate.Evaluator``, or a formula in a test."""

    @property
    def cases(self) -> Sequence[Case]:
        """All of them."""

    @property
    def num_samples(self) -> int:
        """Noisy starts of each judged trial."""

    def predict(
        self, points: Float[np.ndarray, "num_points num_parameters"], chosen: Sequence[int]
    ) -> list[list[Prediction]]:
        """Predict the chosen cases at every point."""


@dataclass(frozen=True, kw_only=True)
class FitConfig:
    """How hard to look."""

    evaluations: int = 50
    """Points of the search; the intervals take about 60 more."""
    budget_s: float = 900.0
    """Wall time after which the search ends; the intervals are still computed."""
    seed: int = 0
    """Of the search, of the split and of the clouds."""


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
    """In a sentence what was decided and from which numbers."""
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


def fit(
    predictor: Predictor,
    parameters: Sequence[PhysicsParameter],
    config: FitConfig,
    advance: Callable[[int, str], None] = lambda done, note: None,
) -> Fit:
    """Find parameters from the training cases and judge them on the held-out ones.

    Args:
        predictor: With all cases.
        parameters: What is looked for.
        config: How hard.
        advance: Told how many points were tried.
    """
    started = time.monotonic()
    cases, samples = predictor.cases, predictor.num_samples
    split = split_cases(cases, config.seed)
    training = [cases[index] for index in split.training]
    observed = observations_of(training, samples)
    bounds = np.array([item.bounds for item in parameters])

    def score_at(x: Float[np.ndarray, " num_parameters"]) -> Score:
        return score(observed, features_of(training, predictor.predict(x[None], split.training)[0]))

    def worth(points: Float[np.ndarray, "num_points num_parameters"]) -> list[float]:
        rows = predictor.predict(points, split.training)
        return [
            score(observed, features_of(training, row)).log_likelihood - 0.5 * float(x @ x)
            for x, row in zip(points, rows, strict=True)
        ]

    found = search(
        worth,
        bounds,
        evaluations=config.evaluations,
        seed=config.seed + 1,
        has_time=lambda: time.monotonic() - started < config.budget_s,
        advance=advance,
    )
    emulator, count = _emulate(predictor, training, split, found.x, bounds, config, advance)
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
    )


def _emulate(
    predictor: Predictor,
    training: Sequence[Case],
    split: Split,
    centre: Float[np.ndarray, " num_parameters"],
    bounds: Float[np.ndarray, "num_parameters 2"],
    config: FitConfig,
    advance: Callable[[int, str], None],
) -> tuple[Emulator, int]:
    """Two clouds: the first says how wide the second has to be."""
    observed = observations_of(training, predictor.num_samples)
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
    known = [_is_identified(interval) for interval in intervals]
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
) -> Interval:
    """By profile where data say something; the curvature is enough to say that they do not."""
    sigma, at = float(np.sqrt(covariance[index, index])), float(best[index])
    if sigma <= IDENTIFIED:
        return profile(emulator, best, index, covariance)
    return Interval(low=at - 1.96 * sigma, high=at + 1.96 * sigma, sigma=sigma, closed=False)


def _is_identified(interval: Interval) -> bool:
    return interval.closed and interval.sigma <= IDENTIFIED


def _estimate(
    parameter: PhysicsParameter, best: float, final: float, interval: Interval, known: bool
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
        trained.beliefs,
        predictor.num_samples,
    )


def _promote(
    estimates: Sequence[Estimate], split: Split, nominal: HeldOut, calibrated: HeldOut
) -> tuple[bool, str]:
    if not any(item.identified for item in estimates):
        return False, "nothing was identified"
    if not split.held_out:
        return False, "no episode could be held out: record at least two of a kind"
    gain = calibrated.log_likelihood - nominal.log_likelihood
    said = f"log-likelihood of {len(split.held_out)} held-out episodes {gain:+.1f}"
    return gain > 0, f"{said}: {'promoted' if gain > 0 else 'not promoted, nothing changes'}"
