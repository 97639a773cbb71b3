"""Are stated success probabilities kept? Intervals, and what a perfect forecaster would show.

Few trials make any forecaster look uncalibrated.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from evaluator.result import Interval
from evaluator.statistics.gate import brier
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


def perfect_forecaster(predicted: Sequence[float]) -> Perfect:
    """Return the Brier score that the same probabilities would show.

    Outcomes are drawn from the stated probabilities themselves, with a fixed seed.
    """
    brier(predicted, [True] * len(predicted))
    p = np.array(predicted, dtype=np.float64)
    happened = np.random.default_rng(SEED).random((NUM_DRAWS, len(p))) < p
    scores = ((p - happened) ** 2).mean(axis=1)
    low, high = np.quantile(scores, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return Perfect(mean=float((p * (1 - p)).mean()), low=float(low), high=float(high))


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
