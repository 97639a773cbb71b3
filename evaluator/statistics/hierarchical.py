"""One model of both sides: true rates of groups, their correlation and the twin's bias.

The log-odds of a group's recorded and twin success rates are a pair of normal numbers around a
common mean; groups of one task share a part of it. Counts are binomial, and where trials are paired
through their start, both outcomes of a pair go together by a common odds ratio. So the noise of few
trials is taken out of correlations, and rates of small groups are drawn towards the others.

Everything is quadrature: ``group_likelihood.py`` has the groups; over the parameters go importance
weights on Sobol nodes. Equal counts give equal numbers. Parameters are the means mu (normal, sd
2.5), the spreads sigma (half-normal, 2.5) and correlations rho, whose arcsine is uniform; those
within and between tasks are alike rather than not (a normal copula of 0.5). Nodes are
placed in coordinates in which each has a standard normal prior: there no edge cuts the posterior
off, as 0 does for a spread and 1 for a correlation.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float32, Float64, Int64
from scipy.special import chdtri, expit, ndtr, ndtri

from evaluator.errors import UndefinedStatisticError
from evaluator.result import Interval
from evaluator.statistics.group_likelihood import BATCH, GroupCounts, Likelihood, Nodes, Spread
from evaluator.statistics.intervals import LEVEL
from evaluator.statistics.sobol import sobol

WHAT = "model of agreement"
METHOD = "hierarchical"
MIN_GROUPS = 3
PRIOR_MEAN_SD = 2.5
PRIOR_SPREAD = 2.5
LEAST_SPREAD = 1e-9
"""Below it, a spread is none; but its square is still a number."""
PRIOR_ALIKE = 0.5
"""Correlation, before any data, of the normal numbers that the correlations within and between
tasks stand for: a twin that is right about tasks is more often right inside them, too."""
ROUNDS = 4
"""Times that the nodes are moved to where the posterior lies."""
FREEDOM, WIDER = 7, 1.25
"""Of Student's t, as which the nodes lie, and how much wider than the posterior: with lighter tails
than the posterior has, few far nodes would carry much of it."""
FEW = 80.0
"""Nodes that have to count while they are being moved."""
NUM_DRAWS = 4_000
DRAWN_NUMBERS = 200_000_000


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """Mean, standard deviation and central interval of a posterior."""

    mean: float
    sd: float
    low: float
    high: float

    def interval(self, factor: float = 1.0, *, over: str = "") -> Interval:
        """Return both ends, in another unit by ``factor``; ``over`` completes the method's name."""
        method = f"{METHOD}-{over}" if over else METHOD
        low, high = factor * self.low, factor * self.high
        return Interval(low=low, high=high, level=LEVEL, method=method)


def estimate(
    values: Float64[np.ndarray, " nodes"], weights: Float64[np.ndarray, " nodes"] | None = None
) -> Estimate:
    """Sum up a posterior that is given by values and their weights.

    Args:
        weights: Together 1; all alike without.
    """
    weights = np.full(len(values), 1 / len(values)) if weights is None else weights
    order = np.argsort(values, kind="stable")
    ordered, mass = values[order], weights[order]
    middle = np.cumsum(mass) - mass / 2
    tail = (1 - LEVEL) / 2
    low, high = np.interp([tail, 1 - tail], middle, ordered)
    mean = float(weights @ values)
    sd = float(np.sqrt(weights @ (values - mean) ** 2))
    return Estimate(mean=mean, sd=sd, low=float(low), high=float(high))


WITHIN_RHO, BETWEEN_RHO = 4, 7
"""Places of both correlations among the parameters."""


def from_normal(
    z: Float64[np.ndarray, "nodes parameters"],
) -> Float64[np.ndarray, "nodes parameters"]:
    """Return the parameters (as ``Nodes.of`` reads them) of which standard normal numbers stand.

    A standard normal number has the prior of its parameter: it is carried by equal probability.
    """
    z = z.copy()
    if z.shape[1] > BETWEEN_RHO:
        z[:, BETWEEN_RHO] *= np.sqrt(1 - PRIOR_ALIKE**2)
        z[:, BETWEEN_RHO] += PRIOR_ALIKE * z[:, WITHIN_RHO]
    phi = PRIOR_MEAN_SD * z
    for at in range(2, z.shape[1], 3):
        # From the upper tail, which stays exact: P(sigma > s) = P(number > z).
        size = -PRIOR_SPREAD * ndtri(ndtr(-z[:, at : at + 2]) / 2)
        phi[:, at : at + 2] = np.maximum(size, LEAST_SPREAD)
        phi[:, at + 2] = np.pi * (ndtr(z[:, at + 2]) - 0.5)
    return np.asarray(phi)


def to_normal(phi: Float64[np.ndarray, " parameters"]) -> Float64[np.ndarray, " parameters"]:
    """Return the standard normal numbers of one set of parameters."""
    z = phi / PRIOR_MEAN_SD
    for at in range(2, len(phi), 3):
        z[at : at + 2] = -ndtri(2 * ndtr(-phi[at : at + 2] / PRIOR_SPREAD))
        z[at + 2] = ndtri(phi[at + 2] / np.pi + 0.5)
    if len(z) > BETWEEN_RHO:
        z[BETWEEN_RHO] -= PRIOR_ALIKE * z[WITHIN_RHO]
        z[BETWEEN_RHO] /= np.sqrt(1 - PRIOR_ALIKE**2)
    return np.asarray(z)


@dataclass(frozen=True, kw_only=True)
class Draws:
    """True rates of the groups as they may be, seeded."""

    recorded: Float64[np.ndarray, "draws groups"]
    sim: Float64[np.ndarray, "draws groups"]

    @cached_property
    def gap(self) -> Float64[np.ndarray, "draws groups"]:
        """Rate of the twin minus the recorded one."""
        return np.asarray(self.sim - self.recorded)

    @cached_property
    def pearson(self) -> Float64[np.ndarray, " draws"]:
        """Correlation of the true rates of these groups; 0 where one side is constant."""
        x, y = (side - side.mean(axis=1, keepdims=True) for side in (self.recorded, self.sim))
        size = np.sqrt((x**2).sum(axis=1) * (y**2).sum(axis=1))
        return np.asarray((x * y).sum(axis=1) / np.maximum(size, 1e-12))


class AgreementModel:
    """The posterior of the model, given the counts of some groups."""

    def __init__(
        self, groups: Sequence[GroupCounts], *, num_nodes: int | None = None, seed: int = 0
    ) -> None:
        """Find the posterior.

        Raises:
            UndefinedStatisticError: Below three groups, or when a side of one has no trial.
        """
        if len(groups) < MIN_GROUPS:
            reason = f"{len(groups)} groups; it needs at least {MIN_GROUPS}"
            raise UndefinedStatisticError(statistic=WHAT, reason=reason)
        if any(n == 0 for group in groups for _, n in group.totals):
            reason = "a group has no trial on one side"
            raise UndefinedStatisticError(statistic=WHAT, reason=reason)
        self.groups = tuple(groups)
        self.likelihood = Likelihood(groups)
        self._seed = seed
        wanted = num_nodes or self._enough()
        self.phi, self.weights, self._rates = self._integrate(wanted)
        self.nodes = Nodes.of(self.phi)

    @property
    def in_tasks(self) -> bool:
        """Whether groups share tasks, so that correlations within and between them differ."""
        return self.likelihood.in_tasks

    def _enough(self) -> int:
        """As many as take some seconds."""
        count = len(self.groups)
        if not self.in_tasks:
            return 8192
        return 8192 if count <= 16 else 2048 if count <= 40 else 1024

    def _integrate(self, num_nodes: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Move nodes to the posterior in some rounds, then weigh as many as were asked for.

        Returns:
            Nodes, weights, and the mean rates of every group on both sides.
        """
        centre, scale = self._start()
        chol = np.diag(scale)
        for turn in range(ROUNDS):
            u, log_w, _ = self._weigh(centre, chol, max(num_nodes // 8, 512), turn)
            weights = _flattened(log_w)
            centre = weights @ u
            off = u - centre
            cov = (weights[:, None] * off).T @ off + 1e-4 * np.eye(len(centre))
            chol = np.linalg.cholesky(cov)
        u, log_w, rates = self._weigh(centre, WIDER * chol, num_nodes, ROUNDS, with_rates=True)
        weights = np.exp(log_w - log_w.max())
        weights /= weights.sum()
        phi = from_normal(self._spread_out(u)[0])
        return phi, weights, np.einsum("n,ngs->gs", weights, rates)

    def _start(self) -> tuple[np.ndarray, np.ndarray]:
        """Guess the normal numbers and how far off the guess may be."""
        like = self.likelihood
        noise = like.noise.mean(axis=0)
        shares = [like.logits[members] for members in like.members]
        inside = np.concatenate([share - share.mean(axis=0) for share in shares])
        left = max(len(inside) - len(shares), 1)
        within = np.clip((inside**2).sum(axis=0) / left - noise, 0.1, 9.0)
        few = 1 / np.sqrt(len(self.groups))
        size = np.sqrt(within)
        start = [*like.logits.mean(axis=0), *size, 0.7]
        spread = [*(0.1 + 2 * few * size), min(0.3 + 2 * few, 1.0)]
        scale = [2 * few, 2 * few, *spread]
        if self.in_tasks:
            few = 1 / np.sqrt(len(shares))
            means = np.stack([share.mean(axis=0) for share in shares])
            rest = (noise + within) * len(shares) / len(inside)
            size = np.sqrt(np.clip(means.var(axis=0) - rest, 0.1, 9.0))
            start += [*size, 0.7]
            scale[:2] = [2 * few, 2 * few]
            scale += [*(0.1 + 2 * few * size), min(0.3 + 2 * few, 1.0)]
        guess, reach = np.array(start), np.array(scale) / 2
        low, high = guess - reach, guess + reach
        low[2:] = np.maximum(low[2:], 0.02)
        centre, size = to_normal(guess), np.clip(to_normal(high) - to_normal(low), 0.1, 0.8)
        centre[:2], size[:2] = 0.0, 1.0  # as they are spread out
        return centre, size

    def _spread_out(
        self, u: Float64[np.ndarray, "nodes parameters"]
    ) -> tuple[Float64[np.ndarray, "nodes parameters"], Float64[np.ndarray, " nodes"]]:
        """Return the normal numbers of some nodes, and the log of the volume that each stands for.

        How far off a mean may be depends on the spreads: with wide ones, and few groups, very far.
        So the first two coordinates are about where the counts put the means, in units of that.
        """
        like, z = self.likelihood, u.copy()
        z[:, :2] = 0.0
        phi = from_normal(z)
        count = len(self.groups)
        variance = (phi[:, 2:4] ** 2 + like.noise.mean(axis=0)) / count
        if self.in_tasks:
            variance += phi[:, 5:7] ** 2 / len(like.members)
        size = 1 / np.sqrt(1 + PRIOR_MEAN_SD**2 / variance)
        middle = (1 - size**2) * like.logits.mean(axis=0) / PRIOR_MEAN_SD
        z[:, :2] = middle + size * u[:, :2]
        return z, np.log(size).sum(axis=1)

    def _weigh(
        self,
        centre: np.ndarray,
        chol: np.ndarray,
        num_nodes: int,
        turn: int,
        *,
        with_rates: bool = False,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Place Sobol nodes as Student's t, and return them with the log of their weights."""
        dim = len(centre)
        rng = np.random.default_rng([self._seed, turn])
        cube = np.clip(sobol(num_nodes, dim + 1, rng), 1e-9, 1 - 1e-9)
        stretch = np.sqrt(FREEDOM / chdtri(FREEDOM, 1 - cube[:, -1]))
        t = ndtri(cube[:, :-1]) * stretch[:, None]
        u = centre + t @ chol.T
        z, log_size = self._spread_out(u)
        log_t = -0.5 * (FREEDOM + dim) * np.log1p((t**2).sum(axis=1) / FREEDOM)
        prior = -0.5 * (z**2).sum(axis=1)
        found = np.full(num_nodes, -np.inf)
        near = prior > prior.max() - 60
        rates = np.zeros((num_nodes, len(self.groups) if with_rates else 0, 2))
        if with_rates:
            found[near], rates[near] = self.likelihood.log_and_rates(from_normal(z[near]))
        else:
            found[near] = self.likelihood.log(from_normal(z[near]))
        found += prior + log_size - log_t
        return u, found, rates

    def of_nodes(self, values: Float64[np.ndarray, " nodes"]) -> Estimate:
        """Sum up a function of the parameters, given at every node."""
        return estimate(values, self.weights)

    @cached_property
    def others(self) -> tuple[np.ndarray, np.ndarray]:
        """Correlation and mean difference over all groups of this kind, at every node."""
        return population(self.nodes)

    @property
    def pearson_others(self) -> Estimate:
        """Correlation of true rates over all groups of this kind, of new tasks too."""
        return self.of_nodes(self.others[0])

    @property
    def bias_others(self) -> Estimate:
        """Mean of the twin's rate - recorded rate over all groups of this kind."""
        return self.of_nodes(self.others[1])

    @property
    def within(self) -> Estimate:
        """Correlation of log-odds between groups of one task."""
        return self.of_nodes(self.nodes.within.rho)

    @property
    def between(self) -> Estimate:
        """Correlation of the mean log-odds of tasks.

        Raises:
            UndefinedStatisticError: When no two groups share a task.
        """
        if self.nodes.between is None:
            raise UndefinedStatisticError(statistic=WHAT, reason="no two groups share a task")
        return self.of_nodes(self.nodes.between.rho)

    @property
    def opposed(self) -> float:
        """Probability that the correlations within and between tasks have different signs."""
        if self.nodes.between is None:
            return 0.0
        return float(self.weights[self.nodes.within.rho * self.nodes.between.rho < 0].sum())

    @cached_property
    def draws(self) -> Draws:
        """Rates of these groups, drawn from the posterior with a fixed seed."""
        like = self.likelihood
        cells = like.table.shape[1]
        count = int(np.clip(DRAWN_NUMBERS / (cells * len(self.groups)), 400, NUM_DRAWS))
        rng = np.random.default_rng([self._seed, 99])
        order = np.argsort(self.phi[:, 1] - self.phi[:, 0])  # every bias has its share of draws
        places = np.searchsorted(np.cumsum(self.weights[order]), (np.arange(count) + 0.5) / count)
        nodes = Nodes.of(self.phi[order[np.minimum(places, len(order) - 1)]])
        recorded, sim = (np.empty((count, len(self.groups))) for _ in range(2))
        for members in like.members:
            task = like.of_task(nodes, members)
            shares, centres = task.logs, task.centres
            mass = np.cumsum(np.exp(shares - shares.max(axis=1, keepdims=True)), axis=1)
            picked = (mass < _strata(count, rng)[:, None] * mass[:, -1:]).sum(axis=1)
            at = centres[np.arange(count), picked]
            shares_of = {group: [_strata(count, rng) for _ in range(2)] for group in members}
            size = max(1, BATCH // cells)
            for first in range(0, count, size):
                part = slice(first, first + size)
                some = Spread(**{n: v[part] for n, v in vars(nodes.within).items()})
                prior = like.weights(at[part], some)
                for group in members:
                    mass = (prior * like.table[group]).reshape(len(prior), *like.shape)
                    row = _draw_places(mass.sum(axis=2), shares_of[group][0][part])
                    column = _draw_places(
                        mass[np.arange(len(mass)), row], shares_of[group][1][part]
                    )
                    for side, drawn in ((recorded, row), (sim, column)):
                        inside = like.steps[drawn] * (rng.random(len(mass)) - 0.5)
                        side[part, group] = expit(like.grid[drawn] + inside)
        # Draws are few: they are moved to the mean that the quadrature finds.
        moved = [
            np.clip(side + (mean - side.mean(axis=0)), 0.0, 1.0)
            for side, mean in zip((recorded, sim), self._rates.T, strict=True)
        ]
        return Draws(recorded=moved[0], sim=moved[1])


def _flattened(log_w: Float64[np.ndarray, " nodes"]) -> Float64[np.ndarray, " nodes"]:
    """Return weights of sum 1, flattened by a power until enough nodes count."""
    power = 1.0
    weights = np.zeros_like(log_w)
    for _ in range(40):
        weights = np.exp(power * (log_w - log_w.max()))
        weights /= weights.sum()
        if 1 / (weights**2).sum() >= FEW:
            break
        power *= 0.8
    return np.asarray(weights)


def _strata(count: int, rng: np.random.Generator) -> Float64[np.ndarray, " count"]:
    """Draw numbers between 0 and 1, one from each of equal parts, in random order."""
    return np.asarray((rng.permutation(count) + rng.random(count)) / count)


def _draw_places(
    mass: Float32[np.ndarray, "draws places"], share: Float64[np.ndarray, " draws"]
) -> Int64[np.ndarray, " draws"]:
    """Draw a place of each row by its mass, which lies that share of the way through."""
    total = np.cumsum(mass, axis=1, dtype=np.float64)
    return np.asarray((total < share[:, None] * total[:, -1:]).sum(axis=1))


POPULATION_NODES = 33


def pooled_others(models: Sequence[AgreementModel]) -> tuple[Estimate, Estimate]:
    """Return r and the bias over all groups of this kind, each model's posterior counting alike.

    For counts of which there are several, as likely one as another: a mixture of posteriors that
    each hold what they promise holds it too, and is as wide as they lie apart.
    """
    weights = np.concatenate([model.weights for model in models]) / len(models)
    r, bias = (np.concatenate([model.others[side] for model in models]) for side in (0, 1))
    return estimate(r, weights), estimate(bias, weights)


def population(
    nodes: Nodes,
) -> tuple[Float64[np.ndarray, " nodes"], Float64[np.ndarray, " nodes"]]:
    """Return correlation and mean difference of true rates over all groups, for each node."""
    size = max(1, BATCH // POPULATION_NODES**2)
    first, second, shared = nodes.total
    found = [
        _population(nodes.mean[part], first[part], second[part], shared[part])
        for part in (slice(at, at + size) for at in range(0, len(first), size))
    ]
    r, gap = (np.concatenate(each) for each in zip(*found, strict=True))
    return r, gap


def _population(
    mean: Float64[np.ndarray, "nodes 2"],
    first: Float64[np.ndarray, " nodes"],
    second: Float64[np.ndarray, " nodes"],
    shared: Float64[np.ndarray, " nodes"],
) -> tuple[Float64[np.ndarray, " nodes"], Float64[np.ndarray, " nodes"]]:
    z = np.linspace(-4.0, 4.0, POPULATION_NODES)
    w = np.exp(-0.5 * z**2)
    w /= w.sum()
    recorded = expit(mean[:, [0]] + np.sqrt(first)[:, None] * z)
    slope = shared / np.sqrt(first)
    rest = np.sqrt(np.maximum(second - slope**2, 0.0))
    middle = mean[:, [1]] + slope[:, None] * z
    sim = expit(middle[:, :, None] + (rest[:, None] * z)[:, None, :])
    given = sim @ w
    mean_r, mean_s = recorded @ w, given @ w
    var_r = (recorded**2) @ w - mean_r**2
    var_s = (sim**2 @ w) @ w - mean_s**2
    together = (recorded * given) @ w - mean_r * mean_s
    r = together / np.sqrt(np.maximum(var_r * var_s, 1e-18))
    return np.clip(r, -1.0, 1.0), mean_s - mean_r


def chosen_is_best(
    draws: Draws, picked: Sequence[int], over: Callable[[np.ndarray], np.ndarray]
) -> float:
    """Return the probability that the twin's choice has the highest recorded rate."""
    rates = over(draws.recorded)
    top = (rates == rates.max(axis=1, keepdims=True)).astype(np.float64)
    best = (top / top.sum(axis=1, keepdims=True)).mean(axis=0)
    return float(best[list(picked)].mean())
