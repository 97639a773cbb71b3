"""Is a stated success probability kept? Brier score, calibration error, reliability bins."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from evaluator.errors import UndefinedStatisticError

NUM_BINS = 10


@dataclass(frozen=True, kw_only=True)
class ReliabilityBin:
    """The predictions of one bin against what happened."""

    low: float
    high: float
    """The last bin holds its upper end, the others do not."""
    n: int
    mean_said: float
    succeeded: int


def brier(said: Sequence[float], happened: Sequence[bool]) -> float:
    """Return the mean of (p - outcome)^2 (Brier 1950).

    Range: 0 to 1, 0 is perfect; always saying 1/2 gives 1/4.

    Raises:
        UndefinedStatisticError: Without trials.
        ValueError: For probabilities outside 0..1.
    """
    p = _checked("Brier score", said, happened)
    return float(np.mean((p - np.array(happened, dtype=np.float64)) ** 2))


def brier_of_base_rate(happened: Sequence[bool]) -> float:
    """Return the Brier score of always saying the observed rate: what knowing nothing reaches.

    Raises:
        UndefinedStatisticError: Without trials.
    """
    if not happened:
        raise UndefinedStatisticError(statistic="Brier score", reason="there are no trials")
    rate = sum(happened) / len(happened)
    return rate * (1 - rate)


def expected_calibration_error(
    said: Sequence[float], happened: Sequence[bool], *, num_bins: int = NUM_BINS
) -> float:
    """Return sum over bins of n_bin / n x |mean probability - success rate|.

    Bins of equal width over 0..1, empty ones count nothing (Naeini et al. 2015; Guo et al. 2017,
    equation 3). Biased upwards for few trials: with n = 10 a perfect forecaster has about 0.2.

    Range: 0 to 1, 0 is perfect.

    Raises:
        UndefinedStatisticError: Without trials.
        ValueError: For probabilities outside 0..1.
    """
    bins = reliability_bins(said, happened, num_bins=num_bins)
    return sum(abs(b.mean_said * b.n - b.succeeded) for b in bins) / len(happened)


def reliability_bins(
    said: Sequence[float], happened: Sequence[bool], *, num_bins: int = NUM_BINS
) -> list[ReliabilityBin]:
    """Return the bins that hold trials, in order.

    Raises:
        UndefinedStatisticError: Without trials.
        ValueError: For probabilities outside 0..1.
    """
    p = _checked("reliability", said, happened)
    answers = np.array(happened, dtype=bool)
    places = np.minimum((p * num_bins).astype(int), num_bins - 1)
    return [
        ReliabilityBin(
            low=place / num_bins,
            high=(place + 1) / num_bins,
            n=int((places == place).sum()),
            mean_said=float(p[places == place].mean()),
            succeeded=int(answers[places == place].sum()),
        )
        for place in np.unique(places).tolist()
    ]


def _checked(statistic: str, said: Sequence[float], happened: Sequence[bool]) -> np.ndarray:
    if len(said) != len(happened):
        message = f"{len(said)} probabilities but {len(happened)} outcomes"
        raise ValueError(message)
    if not len(said):
        raise UndefinedStatisticError(statistic=statistic, reason="there are no trials")
    p = np.array(said, dtype=np.float64)
    if not ((p >= 0) & (p <= 1)).all():
        message = "a success probability lies in 0..1"
        raise ValueError(message)
    return p
