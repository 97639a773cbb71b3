"""How likely observations are under predictions: robust, with the twin's own error in it.

Settled poses and held widths follow Student's t with few degrees of freedom, because a twin that
is otherwise right still misses a contact now and then; success is a coin. No model is exact: on top
of what localisation says of its own error there is a discrepancy of the twin, of unknown size. Its
size is chosen anew for every point, so that a point that explains little is not called impossible,
and one that explains much is not held to be exact (Kennedy and O'Hagan, Bayesian calibration of
computer models, 2001, in its simplest form).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.special import gammaln

from twin.calibrate.physics.case import Case, Prediction

DEGREES = 4.0
POSE_DISCREPANCY_M = (0.0005, 0.001, 0.002, 0.004, 0.008, 0.016)
"""Sizes that are tried; the turn has the same at the edge of a 3 cm object."""
LEVER_M = 0.03
WIDTH_DISCREPANCY_M = (0.0003, 0.0006, 0.0012, 0.0024, 0.0048)
EXPECTED_M = {"pose": 0.001, "width": 0.001}
"""Discrepancies believed in beforehand; twice or half of it is one standard deviation away."""
WIDTH_SIGMA_M = 0.0002
"""Of the gripper's own measurement."""
SHARED_WIDTH_M = 0.001
"""What all held widths of one kind of episode are off by alike: contact is not the twin's, and no
number of repetitions makes it so. Two engines differ by about this much at the same friction."""


@dataclass(frozen=True, kw_only=True)
class Observations:
    """The observations of several cases in flat arrays, as the likelihood reads them."""

    settled: Float[np.ndarray, "num_poses 3"]
    covariance: Float[np.ndarray, "num_poses 3 3"]
    """Of localisation before and after together."""
    period_rad: Float[np.ndarray, " num_poses"]
    widths_m: Float[np.ndarray, " num_holds"]
    width_kind: Int[np.ndarray, " num_holds"]
    """Holds of one kind of episode have the same number."""
    success: Float[np.ndarray, " num_judged"]
    """1 or 0."""
    num_samples: int

    @property
    def count(self) -> int:
        """How many numbers there are."""
        return 3 * len(self.settled) + len(self.widths_m) + len(self.success)


@dataclass(frozen=True, kw_only=True)
class Features:
    """The same arrays, predicted."""

    settled: Float[np.ndarray, "num_poses 3"]
    widths_m: Float[np.ndarray, " num_holds"]
    success: Float[np.ndarray, " num_judged"]

    def flat(self) -> Float[np.ndarray, " num_features"]:
        """All in one row, for the emulator."""
        return np.concatenate([self.settled.ravel(), self.widths_m, self.success])


@dataclass(frozen=True, kw_only=True)
class Score:
    """What a point is worth, and the discrepancies that were chosen for it."""

    log_likelihood: float
    pose_discrepancy_m: float
    width_discrepancy_m: float


def observations_of(cases: Sequence[Case], num_samples: int) -> Observations:
    """Put the observations of cases into flat arrays; objects not found again are left out."""
    seen = [np.isfinite(case.settled).all(axis=1) for case in cases]
    rows = list(zip(cases, seen, strict=True))
    none = np.zeros(0)
    kinds = sorted({case.kind for case in cases})
    return Observations(
        settled=np.concatenate([np.zeros((0, 3)), *(case.settled[ok] for case, ok in rows)]),
        covariance=np.concatenate(
            [
                np.zeros((0, 3, 3)),
                *((case.settled_covariance + case.start_covariance)[ok] for case, ok in rows),
            ]
        ),
        period_rad=np.concatenate([none, *(case.turn_period_rad[ok] for case, ok in rows)]),
        widths_m=np.concatenate([none, *(case.held_widths_m for case in cases)]),
        width_kind=np.array(
            [kinds.index(case.kind) for case in cases for _ in case.held_widths_m], dtype=np.int64
        ),
        success=np.array([float(case.success) for case in cases if case.success is not None]),
        num_samples=num_samples,
    )


def features_of(cases: Sequence[Case], predictions: Sequence[Prediction]) -> Features:
    """Put predictions into the same arrays; turns are the ones nearest to what was seen."""
    settled = [np.zeros((0, 3))]
    for case, prediction in zip(cases, predictions, strict=True):
        ok = np.isfinite(case.settled).all(axis=1)
        pose = prediction.settled[ok].copy()
        period = case.turn_period_rad[ok]
        pose[:, 2] -= np.round((pose[:, 2] - case.settled[ok, 2]) / period) * period
        settled.append(pose)
    none = np.zeros(0)
    return Features(
        settled=np.concatenate(settled),
        widths_m=np.concatenate([none, *(item.held_widths_m for item in predictions)]),
        success=np.array(
            [
                item.success
                for case, item in zip(cases, predictions, strict=True)
                if case.success is not None
            ]
        ),
    )


def unflatten(row: Float[np.ndarray, " num_features"], like: Observations) -> Features:
    """The inverse of ``Features.flat``."""
    poses, holds = 3 * len(like.settled), len(like.widths_m)
    return Features(
        settled=row[:poses].reshape(-1, 3),
        widths_m=row[poses : poses + holds],
        success=np.clip(row[poses + holds :], 0.0, 1.0),
    )


def score(
    observed: Observations,
    predicted: Features,
    *,
    discrepancies_m: tuple[float, float] | None = None,
    extra: Float[np.ndarray, " num_features"] | None = None,
) -> Score:
    """Log-likelihood of observations, maximised over the twin's discrepancy.

    Args:
        observed: What was seen.
        predicted: What a point says.
        discrepancies_m: Of poses and widths where they are known, from other episodes.
        extra: Variance of each feature that the prediction has of its own (an emulator's).
    """
    poses = _poses(observed, predicted, extra)
    widths = _widths(observed, predicted, extra)
    total = _coins(observed, predicted)
    chosen = []
    given = discrepancies_m or (None, None)
    for table, sizes, name, known in zip(
        (poses, widths),
        (POSE_DISCREPANCY_M, WIDTH_DISCREPANCY_M),
        ("pose", "width"),
        given,
        strict=True,
    ):
        belief = -0.5 * np.log2(np.array(sizes) / EXPECTED_M[name]) ** 2
        best = int(np.argmax(table + belief)) if known is None else sizes.index(known)
        total += float(table[best]) + (float(belief[best]) if known is None else 0.0)
        chosen.append(sizes[best])
    return Score(log_likelihood=total, pose_discrepancy_m=chosen[0], width_discrepancy_m=chosen[1])


def _poses(
    observed: Observations, predicted: Features, extra: Float[np.ndarray, " num_features"] | None
) -> Float[np.ndarray, " num_sizes"]:
    """Multivariate t, per size of the discrepancy."""
    sizes = np.array(POSE_DISCREPANCY_M)
    if len(observed.settled) == 0:
        return np.zeros(len(sizes))
    r = observed.settled - predicted.settled
    half = observed.period_rad / 2
    r[:, 2] = np.mod(r[:, 2] + half, observed.period_rad) - half
    own = np.diag([1.0, 1.0, LEVER_M**-2])
    S = observed.covariance[None] + (sizes**2)[:, None, None, None] * own
    if extra is not None:
        S = S + np.eye(3) * extra[: r.size].reshape(-1, 1, 3)
    solved = np.linalg.solve(S, np.broadcast_to(r[..., None], (*S.shape[:2], 3, 1)))[..., 0]
    distance = np.sum(solved * r, axis=-1)
    _, log_det = np.linalg.slogdet(S)
    return np.asarray(np.sum(_log_t(distance, 3) - 0.5 * log_det, axis=1))


def _widths(
    observed: Observations, predicted: Features, extra: Float[np.ndarray, " num_features"] | None
) -> Float[np.ndarray, " num_sizes"]:
    sizes = np.array(WIDTH_DISCREPANCY_M)
    if len(observed.widths_m) == 0:
        return np.zeros(len(sizes))
    variance = (sizes**2)[:, None] + WIDTH_SIGMA_M**2
    if extra is not None:
        first = 3 * len(observed.settled)
        variance = variance + extra[first : first + len(observed.widths_m)]
    total = np.zeros(len(sizes))
    for kind in np.unique(observed.width_kind):
        mine = observed.width_kind == kind
        inverse = 1.0 / np.broadcast_to(variance, (len(sizes), len(mine)))[:, mine]
        r = (observed.widths_m - predicted.widths_m)[mine]
        # Sherman and Morrison (1950): a diagonal with one error that all of the kind share.
        share = 1.0 / (SHARED_WIDTH_M**-2 + inverse.sum(axis=1))
        distance = inverse @ r**2 - share * (inverse @ r) ** 2
        log_det = -np.log(inverse).sum(axis=1) + np.log1p(SHARED_WIDTH_M**2 * inverse.sum(axis=1))
        total += _log_t(distance, len(r)) - 0.5 * log_det
    return total


def _log_t(distance: Float[np.ndarray, "*shape"], dimensions: int) -> Float[np.ndarray, "*shape"]:
    """Log-density of Student's t at a squared distance, but for the determinant of its scale."""
    half = (DEGREES + dimensions) / 2
    constant = gammaln(half) - gammaln(DEGREES / 2) - dimensions / 2 * np.log(DEGREES * np.pi)
    return np.asarray(constant - half * np.log1p(distance / DEGREES))


def _coins(observed: Observations, predicted: Features) -> float:
    """Bernoulli with the share of noisy starts that succeed, never quite 0 or 1."""
    if len(observed.success) == 0 or observed.num_samples == 0:
        return 0.0
    count = observed.num_samples
    p = (predicted.success * count + 0.5) / (count + 1)
    return float(np.sum(np.log(np.where(observed.success > 0.5, p, 1 - p))))
