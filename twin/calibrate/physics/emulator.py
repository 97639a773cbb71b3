"""How sure the parameters are: an emulator around the best point, and profiles of the likelihood.

Contact makes the likelihood rough on a small scale. Around the best point every predicted number is
therefore laid through a quadratic (least squares over a cloud of points),
and what the quadratic does not explain counts as the prediction's own variance. On the emulator
maxima and profiles cost next to nothing.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize

from twin.calibrate.physics.likelihood import Observations, Scales, scales_of, score, unflatten

LEVEL = 3.841
"""95 % of chi square with one degree of freedom: Wilks (1938)."""
TRUST = 2.5
"""The emulator is trusted this many widths of its cloud from its centre."""
STEP = 1e-3
POLISH = 6
"""Iterations with which the other parameters follow along a profile; they begin near their best."""
FLOOR = 1e-12
CLEAR = 3.0
"""A term of a quadratic counts when it is this many standard errors from nothing."""


@dataclass(frozen=True, kw_only=True)
class Emulator:
    """Predicted numbers as quadratics of the parameters near a point."""

    centre: Float[np.ndarray, " num_parameters"]
    width: Float[np.ndarray, " num_parameters"]
    coefficients: Float[np.ndarray, "num_terms num_features"]
    bounds: Float[np.ndarray, "num_parameters 2"]
    observed: Observations
    scales: Scales
    """Of the observations, with the variance that the quadratics leave unexplained."""

    def features(self, x: Float[np.ndarray, " num_parameters"]) -> Float[np.ndarray, " n"]:
        """Predict."""
        return np.asarray(_basis((x - self.centre) / self.width)[0] @ self.coefficients)

    def log_posterior(self, x: Float[np.ndarray, " num_parameters"]) -> float:
        """Of a point, whatever the size of the twin's discrepancy."""
        predicted = unflatten(self.features(x), self.observed)
        found = score(self.observed, predicted, scales=self.scales)
        return found.log_likelihood - 0.5 * float(x @ x)

    def trusted(self) -> Float[np.ndarray, "num_parameters 2"]:
        """Where the emulator is trusted."""
        low, high = self.centre - TRUST * self.width, self.centre + TRUST * self.width
        return np.stack(
            [np.maximum(low, self.bounds[:, 0]), np.minimum(high, self.bounds[:, 1])], axis=1
        )


@dataclass(frozen=True, kw_only=True)
class ProfileInterval:
    """A parameter's 95 % interval in units of the prior."""

    low: float
    high: float
    sigma: float
    """Posterior width of the local quadratic, again a share of the prior's."""
    closed: bool
    """Whether the likelihood falls off on both sides within the limits."""


def cloud(
    centre: Float[np.ndarray, " num_parameters"],
    width: Float[np.ndarray, " num_parameters"],
    bounds: Float[np.ndarray, "num_parameters 2"],
    count: int,
    seed: int,
) -> Float[np.ndarray, "num_points num_parameters"]:
    """Draw points around a centre, in pairs opposite to each other.

    Args:
        centre: Where the points lie on average, in units of the prior; it is the first of them.
        width: Standard deviation along each parameter, same units.
        bounds: Lowest and highest value of each parameter; points beyond are moved onto them.
        count: Points around the centre; one more when it is odd.
    """
    rng = np.random.default_rng([707, seed])
    half = rng.standard_normal((-(-count // 2), len(centre)))
    offsets = np.concatenate([np.zeros((1, len(centre))), half, -half])
    return np.asarray(np.clip(centre + width * offsets, bounds[:, 0], bounds[:, 1]))


def cloud_size(num_parameters: int) -> int:
    """Twice as many points as a quadratic has terms."""
    return 2 * (1 + 2 * num_parameters)


def fit_emulator(
    points: Float[np.ndarray, "num_points num_parameters"],
    features: Float[np.ndarray, "num_points num_features"],
    *,
    centre: Float[np.ndarray, " num_parameters"],
    width: Float[np.ndarray, " num_parameters"],
    bounds: Float[np.ndarray, "num_parameters 2"],
    observed: Observations,
) -> Emulator:
    """Lay quadratics without mixed terms through predicted numbers.

    Args:
        points: Where cases were simulated, in units of the prior.
        features: What was predicted there, in the order of ``Features.flat``.
        observed: What was seen in reality; gives the scales of the features.
    """
    basis = _basis((points - centre) / width)
    rows = [_clear_terms(basis, column) for column in features.T]
    variance = np.array([row[1] for row in rows]) + FLOOR
    return Emulator(
        centre=centre,
        width=width,
        coefficients=np.stack([row[0] for row in rows], axis=1),
        bounds=bounds,
        observed=observed,
        scales=scales_of(observed, variance),
    )


def _clear_terms(
    basis: Float[np.ndarray, "num_points num_terms"], column: Float[np.ndarray, " num_points"]
) -> tuple[Float[np.ndarray, " num_terms"], float]:
    """Least squares with the terms that stand out of the noise; coefficients and variance.

    Without this, chance slopes of many rough numbers together look as if they showed something.
    """
    kept = np.arange(basis.shape[1])
    for _ in range(2):
        chosen = basis[:, kept]
        solved, *_ = np.linalg.lstsq(chosen, column, rcond=1e-8)
        rest = column - chosen @ solved
        variance = float(rest @ rest) / max(len(column) - len(kept), 1)
        error = np.sqrt(np.diag(np.linalg.pinv(chosen.T @ chosen)) * (variance + FLOOR))
        clear = np.abs(solved) > CLEAR * error
        clear[0] = True
        if clear.all():
            break
        kept = kept[clear]
    chosen = basis[:, kept]
    solved, *_ = np.linalg.lstsq(chosen, column, rcond=1e-8)
    rest = column - chosen @ solved
    coefficients = np.zeros(basis.shape[1])
    coefficients[kept] = solved
    return coefficients, float(rest @ rest) / max(len(column) - len(kept), 1)


def _basis(z: Float[np.ndarray, "*batch num_parameters"]) -> Float[np.ndarray, "n num_terms"]:
    z = np.atleast_2d(z)
    return np.concatenate([np.ones((len(z), 1)), z, z**2], axis=1)


def maximise(
    emulator: Emulator,
    start: Float[np.ndarray, " num_parameters"],
    fixed: dict[int, float] | None = None,
    iterations: int = 60,
) -> tuple[Float[np.ndarray, " num_parameters"], float]:
    """The emulator's best point, some parameters held where they are told to be.

    Args:
        start: Where the search begins, in units of the prior; moved into what the emulator is
            trusted with.
        fixed: Values of parameters that are held, by their position; None: all are free.
        iterations: At most so many steps of L-BFGS-B.
    """
    limits = emulator.trusted()
    x = np.clip(start, limits[:, 0], limits[:, 1])
    for index, value in (fixed or {}).items():
        x[index] = value
    free = [index for index in range(len(x)) if index not in (fixed or {})]
    if not free:
        return x, emulator.log_posterior(x)
    cost = partial(_cost, emulator=emulator, x=x, free=free)
    found = minimize(
        cost, x[free], method="L-BFGS-B", bounds=limits[free], options={"maxiter": iterations}
    )
    best = x.copy()
    best[free] = found.x
    return best, -float(found.fun)


def _cost(
    u: Float[np.ndarray, " num_free"],
    emulator: Emulator,
    x: Float[np.ndarray, " num_parameters"],
    free: list[int],
) -> float:
    point = x.copy()
    point[free] = u
    return -emulator.log_posterior(point)


def spread(
    emulator: Emulator, x: Float[np.ndarray, " num_parameters"]
) -> Float[np.ndarray, "num_parameters num_parameters"]:
    """Posterior covariance from the curvature at the best point (Laplace), at most the prior's.

    Args:
        x: The best point, in units of the prior.
    """
    size = len(x)
    step = np.maximum(0.2 * emulator.width, STEP)
    H = np.zeros((size, size))
    for i in range(size):
        for j in range(i, size):
            corners = 0.0
            for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
                point = x.copy()
                point[i] += a * step[i]
                point[j] += b * step[j]
                corners += a * b * emulator.log_posterior(point)
            H[i, j] = H[j, i] = -corners / (4 * step[i] * step[j])
    values, vectors = np.linalg.eigh(H)
    # The prior alone curves by 1; a switch between discrepancies can look flatter than it.
    return np.asarray((vectors / np.maximum(values, 1.0)) @ vectors.T)


def profile(
    emulator: Emulator,
    best: Float[np.ndarray, " num_parameters"],
    index: int,
    covariance: Float[np.ndarray, "num_parameters num_parameters"],
) -> ProfileInterval:
    """95 % interval of one parameter by its profile: all others are fitted again at every value.

    Args:
        covariance: Of ``spread``; it says where to begin fitting the others.
    """
    sigma = float(np.sqrt(covariance[index, index]))
    top = emulator.log_posterior(best)
    along = covariance[:, index] / covariance[index, index]
    limits = emulator.trusted()[index]
    ends, closed = [], True
    for sign, limit in ((-1.0, float(limits[0])), (1.0, float(limits[1]))):
        step = 0.7 * max(sigma, STEP)
        before, drop_before = float(best[index]), 0.0
        while True:
            value = before + sign * step
            value = max(value, limit) if sign < 0 else min(value, limit)
            guess = best + along * (value - best[index])
            _, here = maximise(emulator, guess, {index: value}, POLISH)
            drop = 2 * (top - here)
            if drop >= LEVEL:
                # The square root of the drop is nearly a straight line.
                low, high = np.sqrt([max(drop_before, 0.0), drop])
                share = (np.sqrt(LEVEL) - low) / max(high - low, FLOOR)
                ends.append(before + float(share) * (value - before))
                break
            if value == limit:
                # Beyond the cloud nothing was tried; the curvature has to do.
                ends.append(float(best[index]) + sign * 1.96 * sigma)
                closed = closed and bool(abs(ends[-1] - value) < sigma)
                break
            before, drop_before = value, drop
    return ProfileInterval(
        low=min(ends[0], float(best[index])),
        high=max(ends[1], float(best[index])),
        sigma=sigma,
        closed=closed,
    )
