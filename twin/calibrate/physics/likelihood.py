"""How likely observations are under predictions: robust, with the twin's own error in it.

Settled poses and held widths follow Student's t with few degrees of freedom, because a twin that
is otherwise right still misses a contact now and then. No model is exact: on top
of localisation's noise there is a discrepancy of the twin, of unknown size, for each kind of
episode one of its own: where pushed objects stop is nearly certain, how far they slide is not.
Every size has its say by how likely it is (Kennedy and O'Hagan, Bayesian calibration of computer
models, 2001, in its simplest form; ``DiscrepancyPosterior`` holds the sizes).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import gammaln

from twin.calibrate.physics.cases import Case, Prediction, planar

# Errors whose size nobody knows: the twin's own, and localisation's noise.
# Probabilities over a few sizes, as logarithms. Episodes turn a prior into a posterior by Bayes'
# rule, so held-out episodes are judged with what the training episodes taught.

NOISE_SHARE = (1.0, 0.5, 0.25, 0.125)
"""Of the error that localisation states, as standard deviations: what changes from pose to pose.
The rest all poses of a run have in common, because it comes from where the cameras are; the bias
explains that. Each is as likely as the next beforehand."""
POSE_DISCREPANCY_M = (0.00025, 0.0005, 0.001, 0.002, 0.004, 0.008, 0.016)
"""Sizes that are tried; the turn has the same at the edge of a 3 cm object."""
WIDTH_DISCREPANCY_M = (0.0003, 0.0006, 0.0012, 0.0024, 0.0048)
EXPECTED_M = 0.001
"""Discrepancy expected beforehand; twice or half of it is one standard deviation away."""
EXPECTED_OF_KIND_M = {"slide": 0.003}
"""Of the kinds of which more is known. Three slides may agree by chance; at the true friction they
are off by 2.4 mm along their way and 5 mm beside it (19 slides, the scale of a Student's t)."""


def log_total(logs: Float[np.ndarray, "*rows num"]) -> Float[np.ndarray, "*rows"]:
    """Logarithm of the sum of exponentials; SciPy's checks cost more than the sum of so few."""
    top = logs.max(axis=-1)
    return np.asarray(top + np.log(np.exp(logs - top[..., None]).sum(axis=-1)))


def _normalised(logs: Float[np.ndarray, "*rows num"]) -> Float[np.ndarray, "*rows num"]:
    return np.asarray(logs - log_total(logs)[..., None])


def _beforehand(
    sizes_m: tuple[float, ...], expected_m: float = EXPECTED_M
) -> Float[np.ndarray, " num_sizes"]:
    return _normalised(-0.5 * np.log2(np.array(sizes_m) / expected_m) ** 2)


_SHARE = _normalised(np.zeros(len(NOISE_SHARE)))
_WIDTH = _beforehand(WIDTH_DISCREPANCY_M)
_POSE = np.tile(_beforehand(POSE_DISCREPANCY_M), (len(NOISE_SHARE), 1))
_POSE_OF_KIND = {
    kind: np.tile(_beforehand(POSE_DISCREPANCY_M, expected_m), (len(NOISE_SHARE), 1))
    for kind, expected_m in EXPECTED_OF_KIND_M.items()
}


@dataclass(frozen=True, kw_only=True)
class DiscrepancyPosterior:
    """Log-probabilities; as built, those before any episode."""

    share: Float[np.ndarray, " num_shares"] = field(default_factory=lambda: _SHARE)
    pose: Mapping[str, Float[np.ndarray, "num_shares num_sizes"]] = field(default_factory=dict)
    """Of the twin's discrepancy per kind of episode, given the share."""
    width: Float[np.ndarray, " num_width_sizes"] = field(default_factory=lambda: _WIDTH)

    def of_kind(self, kind: str) -> Float[np.ndarray, "num_shares num_sizes"]:
        """Of a kind that no episode has shown yet, the prior."""
        return self.pose.get(kind, _POSE_OF_KIND.get(kind, _POSE))

    def after(
        self,
        poses: Mapping[str, Float[np.ndarray, "num_shares num_sizes"]],
        widths: Float[np.ndarray, " num_width_sizes"],
    ) -> tuple["DiscrepancyPosterior", float]:
        """Learn from the log-likelihoods of observations.

        Args:
            poses: Per kind of episode, for every share and size.

        Returns:
            The posterior, and the log-likelihood of everything under the prior.
        """
        share, pose = self.share, dict(self.pose)
        if poses:
            joint = np.stack([table + self.of_kind(kind) for kind, table in poses.items()])
            each = log_total(joint)
            share = share + each.sum(axis=0)
            pose.update(zip(poses, joint - each[..., None], strict=True))
        width = self.width + widths
        of_share, of_width = log_total(share), log_total(width)
        after = DiscrepancyPosterior(share=share - of_share, pose=pose, width=width - of_width)
        return after, float(of_share + of_width)

    def most_likely(self) -> dict[str, float | dict[str, float]]:
        """The likeliest share of the noise, and discrepancies [m] given it, as plain numbers."""
        share = int(np.argmax(self.share))
        return {
            "noise_share": NOISE_SHARE[share],
            "pose_m": {
                kind: POSE_DISCREPANCY_M[int(np.argmax(table[share]))]
                for kind, table in self.pose.items()
            },
            "width_m": WIDTH_DISCREPANCY_M[int(np.argmax(self.width))],
        }


DEGREES = 4.0
LEVER_M = 0.03
"""The discrepancy of a turn is that of the edge of an object this far from its axis."""
WIDTH_SIGMA_M = 0.0002
"""Of the gripper's own measurement."""
STAYED_M = 0.002
SHARED_WAY = 0.5
"""Part of the discrepancy of a kind that all its objects are off by alike along their way: at the
same friction all slides may end early in one engine, and all squeezed boxes be turned less before
they jam; no number of them makes up for it."""
SHARED_WIDTH_M = 0.001
"""What all held widths of one kind of episode are off by alike: contact is not the twin's, and no
number of repetitions makes it so. Two engines differ by about this much at the same friction."""
SHARED_WIDTH_AT = np.linspace(-3.0, 3.0, 41)
SHARED_WAY_AT = np.linspace(-3.0, 3.0, 21)
"""Standard normal errors at which what episodes share is tried. Evenly spaced: that sums a smooth
peak to many digits as long as it is no narrower than half a step."""


@dataclass(frozen=True, kw_only=True)
class Observations:
    """The observations of several cases in flat arrays, as the likelihood reads them."""

    settled: Float[np.ndarray, "num_poses 3"]
    covariance: Float[np.ndarray, "num_poses 3 3"]
    """Of localisation before and after together."""
    held: Bool[np.ndarray, " num_poses"]
    """Fingers held the object. How they jammed is seen in their opening and again in its turn; only
    the opening counts, or one chance would be counted twice."""
    period_rad: Float[np.ndarray, " num_poses"]
    way: Float[np.ndarray, "num_poses 3"]
    """How x, y and turn of an object changed, per metre of change; zero where it stayed."""
    kinds: tuple[str, ...]
    """Kinds of episodes; the numbers below count in them."""
    pose_kind: Int[np.ndarray, " num_poses"]
    widths_m: Float[np.ndarray, " num_holds"]
    width_kind: Int[np.ndarray, " num_holds"]

    @property
    def count(self) -> int:
        """How many numbers there are."""
        return 3 * len(self.settled) + len(self.widths_m)


@dataclass(frozen=True, kw_only=True)
class Features:
    """The same arrays, predicted."""

    settled: Float[np.ndarray, "num_poses 3"]
    widths_m: Float[np.ndarray, " num_holds"]

    def flat(self) -> Float[np.ndarray, " num_features"]:
        """All in one row, for the emulator."""
        return np.concatenate([self.settled.ravel(), self.widths_m])


@dataclass(frozen=True, kw_only=True)
class Score:
    """How likely a point is, and the posterior of errors if it is the right one."""

    log_likelihood: float
    posterior: DiscrepancyPosterior


def observations_of(cases: Sequence[Case]) -> Observations:
    """Put the observations of cases into flat arrays; objects not found again are left out."""
    seen = [np.isfinite(case.settled).all(axis=1) for case in cases]
    rows = list(zip(cases, seen, strict=True))
    none = np.zeros(0)
    kinds = tuple(sorted({case.kind for case in cases}))
    return Observations(
        settled=np.concatenate([np.zeros((0, 3)), *(case.settled[ok] for case, ok in rows)]),
        covariance=np.concatenate(
            [
                np.zeros((0, 3, 3)),
                *((case.settled_covariance + case.start_covariance)[ok] for case, ok in rows),
            ]
        ),
        held=np.array(
            [len(case.hold_times_s) > 0 for case, ok in rows for _ in range(ok.sum())], dtype=bool
        ),
        period_rad=np.concatenate([none, *(case.turn_period_rad[ok] for case, ok in rows)]),
        way=np.concatenate([np.zeros((0, 3)), *(_way(case)[ok] for case, ok in rows)]),
        kinds=kinds,
        pose_kind=np.array(
            [kinds.index(case.kind) for case, ok in rows for _ in range(ok.sum())], dtype=np.int64
        ),
        widths_m=np.concatenate([none, *(case.held_widths_m for case in cases)]),
        width_kind=np.array(
            [kinds.index(case.kind) for case in cases for _ in case.held_widths_m], dtype=np.int64
        ),
    )


def _way(case: Case) -> Float[np.ndarray, "num_objects 3"]:
    moved = case.settled - np.stack([planar(case.Ts_base_start[key]) for key in case.objects])
    moved[:, 2] -= np.round(moved[:, 2] / case.turn_period_rad) * case.turn_period_rad
    distance = np.linalg.norm(moved * [1.0, 1.0, LEVER_M], axis=1, keepdims=True)
    return np.asarray(np.where(distance > STAYED_M, moved / np.maximum(distance, STAYED_M), 0.0))


def features_of(cases: Sequence[Case], predictions: Sequence[Prediction]) -> Features:
    """Put predictions into the same arrays; turns are the ones nearest to what was seen.

    Args:
        cases: What was recorded; says which poses and turns are compared.
        predictions: What the twin gives for each of the cases, in their order.
    """
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
    )


def unflatten(row: Float[np.ndarray, " num_features"], like: Observations) -> Features:
    """The inverse of ``Features.flat``."""
    poses, holds = 3 * len(like.settled), len(like.widths_m)
    return Features(
        settled=row[:poses].reshape(-1, 3),
        widths_m=row[poses : poses + holds],
    )


@dataclass(frozen=True, kw_only=True)
class Scales:
    """How far observations may be off, for every size of the errors; the same at every point."""

    inverse: Float[np.ndarray, "num_shares num_sizes num_poses 3 3"]
    """Of the scale matrices of settled poses."""
    log_det: Float[np.ndarray, "num_shares num_sizes num_poses"]
    width_inverse: Float[np.ndarray, "num_width_sizes num_holds"]
    """One over the variance of each width, what they share left aside."""


def scales_of(
    observed: Observations, extra: Float[np.ndarray, " num_features"] | None = None
) -> Scales:
    """Add localisation's noise and the twin's discrepancy.

    Args:
        extra: Variance of each feature that the prediction has of its own (an emulator's).
    """
    poses = observed.settled.size
    own = np.square(POSE_DISCREPANCY_M)[:, None, None, None] * np.diag([1.0, 1.0, LEVER_M**-2])
    S = np.square(NOISE_SHARE)[:, None, None, None, None] * observed.covariance + own
    holds = len(observed.widths_m)
    variance = np.square(WIDTH_DISCREPANCY_M)[:, None] + np.full(holds, WIDTH_SIGMA_M**2)
    if extra is not None:
        S = S + np.eye(3) * extra[:poses].reshape(-1, 1, 3)
        variance = variance + extra[poses : poses + holds]
    held = observed.held
    S[..., held, 2, :] = S[..., held, :, 2] = 0.0
    S[..., held, 2, 2] = 1.0
    inverse, log_det = np.linalg.inv(S), np.linalg.slogdet(S)[1]
    inverse[..., held, 2, 2] = 0.0
    return Scales(inverse=inverse, log_det=log_det, width_inverse=1.0 / variance)


def score(
    observed: Observations,
    predicted: Features,
    *,
    prior: DiscrepancyPosterior | None = None,
    scales: Scales | None = None,
) -> Score:
    """Log-likelihood of observations, whatever the sizes of the errors are.

    Args:
        prior: Of errors, from other episodes; None: the one before any.
        scales: Of the same observations; None: without any variance of the prediction's own.
    """
    known = scales_of(observed) if scales is None else scales
    before = DiscrepancyPosterior() if prior is None else prior
    after, total = before.after(
        _poses(observed, predicted, known), _widths(observed, predicted, known)
    )
    return Score(log_likelihood=total, posterior=after)


def _poses(
    observed: Observations, predicted: Features, scales: Scales
) -> dict[str, Float[np.ndarray, "num_shares num_sizes"]]:
    """Multivariate t, per kind, share of localisation's error, and size of the discrepancy."""
    r = observed.settled - predicted.settled
    half = observed.period_rad / 2
    r[:, 2] = np.mod(r[:, 2] + half, observed.period_rad) - half
    own, both, along = (
        np.sum((scales.inverse @ right[..., None])[..., 0] * left, axis=-1)
        for left, right in ((r, r), (observed.way, r), (observed.way, observed.way))
    )
    size = (SHARED_WAY * np.outer(SHARED_WAY_AT, POSE_DISCREPANCY_M))[:, None, :, None]
    squared = own - 2 * size * both + size**2 * along
    each = _log_t(squared, 3.0 - observed.held) - 0.5 * scales.log_det
    tables = _over_shared(each @ _members(observed.pose_kind, observed), SHARED_WAY_AT)
    tables = np.moveaxis(tables, -1, 0)
    return {observed.kinds[number]: tables[number] for number in np.unique(observed.pose_kind)}


def _widths(
    observed: Observations, predicted: Features, scales: Scales
) -> Float[np.ndarray, " num_width_sizes"]:
    r = observed.widths_m - predicted.widths_m
    off = (r - SHARED_WIDTH_M * SHARED_WIDTH_AT[:, None])[:, None]
    each = _log_t(scales.width_inverse * off**2, np.ones(1)) + 0.5 * np.log(scales.width_inverse)
    tables = _over_shared(each @ _members(observed.width_kind, observed), SHARED_WIDTH_AT)
    return np.asarray(tables.sum(axis=-1))


def _members(
    numbers: Int[np.ndarray, " num_rows"], observed: Observations
) -> Float[np.ndarray, "num_rows num_kinds"]:
    """1 where a row belongs to a kind of episode."""
    return np.asarray(numbers[:, None] == np.arange(len(observed.kinds)), dtype=np.float64)


def _over_shared(
    logs: Float[np.ndarray, "num_shared *rest"], at: Float[np.ndarray, " num_shared"]
) -> Float[np.ndarray, "*rest"]:
    """Log-likelihood over all values of an error that the episodes of a kind have in common."""
    weight = -0.5 * at**2
    return log_total(np.moveaxis(logs, 0, -1) + weight - np.log(np.exp(weight).sum()))


def _log_t(
    distance: Float[np.ndarray, "*shape num"], dimensions: Float[np.ndarray, " each"]
) -> Float[np.ndarray, "*shape num"]:
    """Log-density of Student's t at a squared distance, but for the determinant of its scale."""
    half = (DEGREES + dimensions) / 2
    constant = gammaln(half) - gammaln(DEGREES / 2) - dimensions / 2 * np.log(DEGREES * np.pi)
    return np.asarray(constant - half * np.log1p(distance / DEGREES))
