"""Are stated success probabilities kept? Intervals, and what a perfect forecaster would show.

Few trials make any forecaster look uncalibrated: one whose probabilities are exactly right has an
expected calibration error of 0.2 over 20 trials.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from evaluator.result import Interval
from evaluator.statistics.gate import NUM_BINS, brier, expected_calibration_error, reliability_bins
from evaluator.statistics.intervals import LEVEL

NUM_DRAWS = 2_000
SEED = 0
PRIOR = 0.5


@dataclass(frozen=True, kw_only=True)
class Perfect:
    """What a forecaster shows whose probabilities are exactly right, over as many trials."""

    mean: float
    low: float
    """Between both ends lie 95 % of what it would show."""
    high: float


def perfect_forecaster(predicted: Sequence[float]) -> tuple[Perfect, Perfect]:
    """Return the Brier score and the calibration error that the same probabilities would show.

    Outcomes are drawn from the stated probabilities themselves, with a fixed seed.
    """
    brier(predicted, [True] * len(predicted))
    p = np.array(predicted, dtype=np.float64)
    happened = np.random.default_rng(SEED).random((NUM_DRAWS, len(p))) < p
    scores = ((p - happened) ** 2).mean(axis=1)
    places = np.minimum((p * NUM_BINS).astype(int), NUM_BINS - 1)
    member = places[:, None] == np.unique(places)
    errors = np.abs((p - happened) @ member).sum(axis=1) / len(p)
    return _shown(scores, float((p * (1 - p)).mean())), _shown(errors, float(errors.mean()))


def _shown(values: Float64[np.ndarray, " draws"], mean: float) -> Perfect:
    low, high = np.quantile(values, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return Perfect(mean=mean, low=float(low), high=float(high))


def brier_interval(predicted: Sequence[float], happened: Sequence[bool]) -> Interval:
    """Return the interval of the expected Brier score of further trials like these.

    Bayesian bootstrap (Rubin 1981) of the squared errors, with half a trial at 0 and half a one at
    1 added: for errors that are only 0 or 1 it is Jeffreys' interval of their rate.
    """
    brier(predicted, happened)
    errors = (np.array(predicted, dtype=np.float64) - np.array(happened)) ** 2
    values = np.concatenate([errors, [0.0, 1.0]])
    rng = np.random.default_rng(SEED)
    weights = rng.standard_gamma([1.0] * len(errors) + [PRIOR] * 2, (NUM_DRAWS, len(values)))
    means = weights @ values / weights.sum(axis=1)
    low, high = np.quantile(means, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return Interval(low=float(low), high=float(high), level=LEVEL, method="bayesian-bootstrap")


def calibration_error_interval(predicted: Sequence[float], happened: Sequence[bool]) -> Interval:
    """Return the interval of the calibration error with the noise of few trials taken out.

    What is estimated is the sum over bins of n_bin / n x |mean probability - true success rate|.
    The observed one differs from it by at most the same sum over |observed - true success rate|,
    by the triangle inequality; of that the larger 95 % quantile counts, under the stated
    probabilities or under Jeffreys' posterior of each bin's rate (drawn with a fixed seed). It
    covers more than 95 %.
    """
    bins = reliability_bins(predicted, happened)
    k = np.array([each.succeeded for each in bins], dtype=np.float64)
    n = np.array([each.n for each in bins], dtype=np.float64)
    rates = np.random.default_rng(SEED).beta(k + PRIOR, n - k + PRIOR, (NUM_DRAWS, len(bins)))
    off = np.abs(rates - k / n) @ n / n.sum()
    most = max(float(np.quantile(off, LEVEL)), perfect_forecaster(predicted)[1].high)
    found = expected_calibration_error(predicted, happened)
    return Interval(
        low=max(0.0, found - most), high=min(1.0, found + most), level=LEVEL, method="jeffreys-bins"
    )
