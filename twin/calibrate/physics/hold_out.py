"""Keep episodes back, whole ones, and say what parameters are worth on them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from twin.calibrate.physics.beliefs import Beliefs
from twin.calibrate.physics.case import Case, Prediction
from twin.calibrate.physics.likelihood import features_of, observations_of, score

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
    beliefs: Beliefs,
    num_samples: int,
) -> HeldOut:
    """Compare predictions of held-out cases with what was seen.

    Args:
        cases: The held-out ones.
        predictions: Theirs.
        beliefs: In errors, as the training episodes left them for the same parameters.
        num_samples: Noisy starts behind each share of successes.
    """
    observed = observations_of(cases, num_samples)
    predicted = features_of(cases, predictions)
    found = score(observed, predicted, beliefs=beliefs)
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
