"""One model of both sides: true rates of groups, their correlation and the twin's bias.

The log-odds of a group's recorded and twin success rates are a pair of normal numbers around a
common mean; groups of one task share a part of it. Counts are binomial, and where trials are paired
through their start, both outcomes of a pair go together by a common odds ratio. So the noise of few
trials is taken out of correlations, and rates of small groups are drawn towards the others.

Everything is quadrature: over the log-odds of a group on a grid, over a task's mean by adaptive
Gauss-Hermite nodes (Liu and Pierce 1994), over the parameters by importance weights on Sobol nodes.
Equal counts give equal numbers. Parameters are the means mu (normal, sd 2.5), the spreads sigma
(half-normal, 2.5) and correlations rho, whose arcsine is uniform.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float32, Float64, Int64
from scipy.special import expit, ndtri
from scipy.stats import chi2, qmc

from evaluator.errors import UndefinedStatisticError
from evaluator.result import Interval
from evaluator.statistics.intervals import LEVEL

WHAT = "model of agreement"
METHOD = "hierarchical"
MIN_GROUPS = 3
PRIOR_MEAN_SD = 2.5
PRIOR_SPREAD = 2.5
EDGE = 9.0
"""Log-odds beyond which a rate is as good as 0 or 1."""
STEP_ALONE, STEP_IN_TASKS = 0.2, 0.3
"""Grid of the log-odds; the pairs of numbers vary by half a step more than sigma says."""
MOST = 200
"""A larger side is taken as one of so many trials: its rate is as good as known then."""
TASK_NODES = 3
"""Nodes for each side of a task's mean."""
ROUNDS = 4
"""Times that the nodes are moved to where the posterior lies."""
FREEDOM = 5
FEW = 80.0
"""Nodes that have to count while they are being moved."""
BATCH = 12_000_000
"""Numbers on the grid that are held at once."""
NUM_DRAWS = 1_000
DRAWN_NUMBERS = 120_000_000


@dataclass(frozen=True, kw_only=True)
class GroupCounts:
    """What was counted in one group."""

    recorded: tuple[int, int]
    """Successes and trials that have no partner in the twin."""
    sim: tuple[int, int]
    """The twin's, of trials without a recorded partner."""
    pairs: tuple[int, int, int, int] = (0, 0, 0, 0)
    """Paired trials in which both succeed, only sim, only recorded, neither."""
    task: str = ""
    """Groups of one task share a part of their mean."""

    @property
    def totals(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """Successes and trials, recorded and in the twin, over paired and other trials."""
        both, only_sim, only_recorded, _ = self.pairs
        paired = sum(self.pairs)
        recorded = (self.recorded[0] + both + only_recorded, self.recorded[1] + paired)
        return recorded, (self.sim[0] + both + only_sim, self.sim[1] + paired)


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
        values: One for each node or draw.
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


@dataclass(frozen=True, kw_only=True)
class Spread:
    """Covariance of pairs of numbers, one for each node."""

    first: Float64[np.ndarray, " nodes"]
    """Standard deviation of the recorded side's log-odds."""
    second: Float64[np.ndarray, " nodes"]
    rho: Float64[np.ndarray, " nodes"]

    def entries(self, more: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return variance, variance and covariance, with ``more`` variance on both sides."""
        shared = self.rho * self.first * self.second
        return self.first**2 + more, self.second**2 + more, shared


@dataclass(frozen=True, kw_only=True)
class Nodes:
    """Parameters of the model, one set for each node."""

    mean: Float64[np.ndarray, "nodes 2"]
    within: Spread
    """Between groups of one task; between all groups where each has its own task."""
    between: Spread | None
    """Between tasks."""

    @staticmethod
    def of(phi: Float64[np.ndarray, "nodes parameters"]) -> "Nodes":
        """Read coordinates: both means, then of each spread sigma twice and the arcsine of rho."""
        spreads = [
            Spread(
                first=phi[:, at],
                second=phi[:, at + 1],
                rho=np.sin(phi[:, at + 2]),
            )
            for at in range(2, phi.shape[1], 3)
        ]
        between = spreads[1] if len(spreads) > 1 else None
        return Nodes(mean=phi[:, :2], within=spreads[0], between=between)

    @property
    def total(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Variances and covariance of groups of a new task."""
        found = self.within.entries()
        if self.between is None:
            return found
        first, second, shared = (a + b for a, b in zip(found, self.between.entries(), strict=True))
        return first, second, shared


def log_prior(phi: Float64[np.ndarray, "nodes parameters"]) -> Float64[np.ndarray, " nodes"]:
    """Return the logarithm of the prior density of coordinates, up to a constant."""
    found = -0.5 * (phi[:, :2] ** 2).sum(axis=1) / PRIOR_MEAN_SD**2
    for at in range(2, phi.shape[1], 3):
        sizes, angle = phi[:, at : at + 2], phi[:, at + 2]
        found -= 0.5 * (sizes**2).sum(axis=1) / PRIOR_SPREAD**2
        found[(sizes <= 0).any(axis=1) | (np.abs(angle) >= np.pi / 2)] = -np.inf
    return np.asarray(found)


def common_log_odds(groups: Sequence[GroupCounts]) -> float:
    """Return the log odds ratio of paired outcomes within groups (Mantel and Haenszel 1959).

    Half a pair is added to each cell in all; 0 without pairs.

    Args:
        groups: Their ``pairs`` are looked at.
    """
    tables = [group.pairs for group in groups if sum(group.pairs)]
    if not tables:
        return 0.0
    agree = sum(a * d / (a + b + c + d) for a, b, c, d in tables) + 0.25
    differ = sum(b * c / (a + b + c + d) for a, b, c, d in tables) + 0.25
    return float(np.clip(np.log(agree / differ), -5.0, 5.0))


class Likelihood:
    """Probability of the counts of every group on a grid of both log-odds."""

    def __init__(self, groups: Sequence[GroupCounts]) -> None:
        """Lay out.

        Args:
            groups: At least one trial on each side of each.
        """
        names = list(dict.fromkeys(group.task for group in groups))
        self.members = [
            np.array([g for g, group in enumerate(groups) if group.task == name]) for name in names
        ]
        self.in_tasks = 1 < len(names) < len(groups)
        if not self.in_tasks:
            self.members = [np.arange(len(groups))]
        self.step = STEP_IN_TASKS if self.in_tasks else STEP_ALONE
        self.grid = np.arange(-EDGE, EDGE + self.step / 2, self.step)
        self.rate = expit(self.grid)
        self.shape = (len(self.grid), len(self.grid))
        odds = common_log_odds(groups)
        self.log_odds = odds
        table = np.stack([self._of(group, odds).ravel() for group in groups])
        self.table: Float32[np.ndarray, "groups cells"] = np.exp(
            table - table.max(axis=1, keepdims=True)
        ).astype(np.float32)
        totals = np.array([group.totals for group in groups], dtype=np.float64)
        k, n = totals[:, :, 0], totals[:, :, 1]
        self.logits = np.log((k + 0.5) / (n - k + 0.5))
        self.noise = 1 / (k + 0.5) + 1 / (n - k + 0.5)

    def _of(self, group: GroupCounts, odds: float) -> Float64[np.ndarray, "recorded sim"]:
        recorded, sim = (_binomial(*side, self.grid) for side in (group.recorded, group.sim))
        found = recorded[:, None] + sim[None, :]
        if not sum(group.pairs):
            return np.asarray(found)
        both = _both(self.rate[:, None], self.rate[None, :], float(np.exp(odds)))
        cells = (
            both,
            self.rate[None, :] - both,
            self.rate[:, None] - both,
            1 - self.rate[:, None] - self.rate[None, :] + both,
        )
        scale = min(1.0, MOST / sum(group.pairs))
        for count, chance in zip(group.pairs, cells, strict=True):
            found = found + scale * count * np.log(np.maximum(chance, 1e-300))
        return np.asarray(found)

    def weights(
        self, mean: Float64[np.ndarray, "nodes 2"], spread: Spread
    ) -> Float32[np.ndarray, "nodes cells"]:
        """Return the normal density of a pair of log-odds on the grid, up to a factor for each."""
        first, second, shared = spread.entries((self.step / 2) ** 2)
        det = first * second - shared**2
        x, y = (self.grid[None, :] - mean[:, [side]] for side in (0, 1))
        one = (-0.5 * (second / det)[:, None] * x**2).astype(np.float32)
        two = (-0.5 * (first / det)[:, None] * y**2).astype(np.float32)
        skew = ((shared / det)[:, None] * x).astype(np.float32)
        found = skew[:, :, None] * y.astype(np.float32)[:, None, :]
        found += one[:, :, None]
        found += two[:, None, :]
        found = found.reshape(len(mean), -1)
        np.exp(found, out=found)
        return np.asarray(found)

    def log(self, phi: Float64[np.ndarray, "nodes parameters"]) -> Float64[np.ndarray, " nodes"]:
        """Return the logarithm of the probability of all counts, for each set of parameters."""
        nodes = Nodes.of(phi)
        found = np.zeros(len(phi))
        for members in self.members:
            found += _log_sum(self.of_task(nodes, members)[0])
        return np.asarray(found)

    def of_task(
        self, nodes: Nodes, members: Int64[np.ndarray, " groups"]
    ) -> tuple[Float64[np.ndarray, "nodes centres"], Float64[np.ndarray, "nodes centres 2"]]:
        """Return the log of each centre's share in a task's probability, and the centres.

        Args:
            nodes: Parameters.
            members: Places of the task's groups.
        """
        count = len(nodes.mean)
        centres, log_shares = self.centres(nodes, members)
        each = centres.shape[1]
        flat = centres.reshape(-1, 2)
        spread = Spread(
            **{name: np.repeat(values, each) for name, values in vars(nodes.within).items()}
        )
        ones = np.ones((1, self.table.shape[1]), dtype=np.float32)
        columns = np.concatenate([self.table[members], ones]).T
        found = np.empty((len(flat), len(members)))
        size = max(1, BATCH // self.table.shape[1])
        for at in range(0, len(flat), size):
            part = slice(at, at + size)
            some = Spread(**{name: values[part] for name, values in vars(spread).items()})
            shares = self.weights(flat[part], some) @ columns
            found[part] = shares[:, :-1] / np.maximum(shares[:, -1:], 1e-30)
        logs = np.log(np.maximum(found, 1e-35)).sum(axis=1).reshape(count, each)
        return logs + log_shares, centres

    def centres(
        self, nodes: Nodes, members: Int64[np.ndarray, " groups"]
    ) -> tuple[Float64[np.ndarray, "nodes centres 2"], Float64[np.ndarray, "nodes centres"]]:
        """Place nodes where a task's mean probably lies, with the log of their weights."""
        if nodes.between is None:
            return nodes.mean[:, None, :], np.zeros((len(nodes.mean), 1))
        prior = _matrix(*nodes.between.entries(1e-4))
        inverse = np.linalg.inv(prior)
        precision, pull = inverse.copy(), np.einsum("nij,nj->ni", inverse, nodes.mean)
        for group in members:
            first, second, shared = nodes.within.entries((self.step / 2) ** 2)
            noise = self.noise[group]
            inside = np.linalg.inv(_matrix(first + noise[0], second + noise[1], shared))
            precision += inside
            pull += inside @ self.logits[group]
        cov = np.linalg.inv(precision) * 1.3
        middle = np.einsum("nij,nj->ni", np.linalg.inv(precision), pull)
        chol = np.linalg.cholesky(cov)
        x, w = np.polynomial.hermite_e.hermegauss(TASK_NODES)
        z = np.stack(np.meshgrid(x, x, indexing="ij"), axis=-1).reshape(-1, 2)
        log_w = np.log(np.outer(w, w).ravel()) + 0.5 * (z**2).sum(axis=1)
        centres = middle[:, None, :] + np.einsum("nij,qj->nqi", chol, z)
        off = centres - nodes.mean[:, None, :]
        prior_log = -0.5 * np.einsum("nqi,nij,nqj->nq", off, inverse, off)
        prior_log -= 0.5 * np.linalg.slogdet(prior)[1][:, None] + np.log(2 * np.pi)
        size = np.log(np.linalg.det(chol))[:, None]
        return centres, prior_log + size + log_w[None, :]


def _binomial(k: int, n: int, grid: Float64[np.ndarray, " grid"]) -> Float64[np.ndarray, " grid"]:
    scale = min(1.0, MOST / n) if n else 0.0
    return np.asarray(-scale * (k * np.logaddexp(0, -grid) + (n - k) * np.logaddexp(0, grid)))


def _both(
    first: Float64[np.ndarray, "#a #b"], second: Float64[np.ndarray, "#a #b"], odds: float
) -> Float64[np.ndarray, "a b"]:
    """Chance that both succeed, from both rates and the odds ratio (Plackett 1965)."""
    if abs(odds - 1) < 1e-9:
        return np.asarray(first * second)
    total = 1 + (odds - 1) * (first + second)
    root = np.sqrt(np.maximum(total**2 - 4 * odds * (odds - 1) * first * second, 0.0))
    return np.asarray(2 * odds * first * second / (total + root))


def _matrix(first: np.ndarray, second: np.ndarray, shared: np.ndarray) -> np.ndarray:
    return np.stack([np.stack([first, shared], -1), np.stack([shared, second], -1)], -2)


def _log_sum(logs: Float64[np.ndarray, "nodes parts"]) -> Float64[np.ndarray, " nodes"]:
    top = logs.max(axis=1)
    return np.asarray(top + np.log(np.exp(logs - top[:, None]).sum(axis=1)))


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

        Args:
            groups: At least three, each with a trial on both sides.
            num_nodes: Parameter sets that carry the posterior; by the number of groups without.
            seed: Scrambles the nodes; another seed shows how exact the quadrature is.

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
        self.phi, self.weights = self._integrate(wanted)
        self.nodes = Nodes.of(self.phi)

    @property
    def in_tasks(self) -> bool:
        """Whether groups share tasks, so that correlations within and between them differ."""
        return self.likelihood.in_tasks

    @property
    def counting(self) -> float:
        """How many equally weighted nodes would carry as much (Kish's effective number)."""
        return float(1 / (self.weights**2).sum())

    def _enough(self) -> int:
        if not self.in_tasks:
            return 4096 if len(self.groups) <= 40 else 2048
        return 2048 if len(self.groups) <= 40 else 1024

    def _integrate(self, num_nodes: int) -> tuple[np.ndarray, np.ndarray]:
        """Move nodes to the posterior in some rounds, then weigh as many as were asked for."""
        start, scale = self._start()
        centre, chol = np.array(start), np.diag(scale)
        for turn in range(ROUNDS):
            phi, log_w = self._weigh(centre, chol, max(num_nodes // 4, 512), turn)
            weights = _flattened(log_w)
            centre = weights @ phi
            off = phi - centre
            cov = (weights[:, None] * off).T @ off + 1e-4 * np.eye(len(centre))
            chol = np.linalg.cholesky(cov)
        phi, log_w = self._weigh(centre, chol, num_nodes, ROUNDS)
        weights = np.exp(log_w - log_w.max())
        return phi, weights / weights.sum()

    def _start(self) -> tuple[list[float], list[float]]:
        """Guess the coordinates and how far off the guess may be."""
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
        return start, scale

    def _weigh(
        self, centre: np.ndarray, chol: np.ndarray, num_nodes: int, turn: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Place Sobol nodes as Student's t, and return them with the log of their weights."""
        dim = len(centre)
        rng = np.random.default_rng([self._seed, turn])
        cube = qmc.Sobol(dim + 1, scramble=True, rng=rng).random(num_nodes)
        cube = np.clip(cube, 1e-9, 1 - 1e-9)
        stretch = np.sqrt(FREEDOM / chi2.ppf(cube[:, -1], FREEDOM))
        z = ndtri(cube[:, :-1]) * stretch[:, None]
        phi = centre + z @ chol.T
        log_t = -0.5 * (FREEDOM + dim) * np.log1p((z**2).sum(axis=1) / FREEDOM)
        prior = log_prior(phi)
        found = np.full(num_nodes, -np.inf)
        near = prior > prior.max() - 60
        found[near] = self.likelihood.log(phi[near]) + prior[near] - log_t[near]
        return phi, found

    def of_nodes(self, values: Float64[np.ndarray, " nodes"]) -> Estimate:
        """Sum up a function of the parameters, given at every node."""
        return estimate(values, self.weights)

    @cached_property
    def _others(self) -> tuple[np.ndarray, np.ndarray]:
        return population(self.nodes)

    @property
    def pearson_others(self) -> Estimate:
        """Correlation of true rates over all groups of this kind, of new tasks too."""
        return self.of_nodes(self._others[0])

    @property
    def bias_others(self) -> Estimate:
        """Mean of the twin's rate - recorded rate over all groups of this kind."""
        return self.of_nodes(self._others[1])

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
        places = np.searchsorted(np.cumsum(self.weights), (np.arange(count) + 0.5) / count)
        nodes = Nodes.of(self.phi[np.minimum(places, len(self.phi) - 1)])
        recorded, sim = (np.empty((count, len(self.groups))) for _ in range(2))
        for members in like.members:
            shares, centres = like.of_task(nodes, members)
            mass = np.cumsum(np.exp(shares - shares.max(axis=1, keepdims=True)), axis=1)
            picked = (mass < rng.random((count, 1)) * mass[:, -1:]).sum(axis=1)
            at = centres[np.arange(count), picked]
            size = max(1, BATCH // cells)
            for first in range(0, count, size):
                part = slice(first, first + size)
                some = Spread(**{n: v[part] for n, v in vars(nodes.within).items()})
                prior = like.weights(at[part], some)
                for group in members:
                    mass = prior * like.table[group]
                    cells_drawn = _draw_cells(mass.reshape(len(mass), *like.shape), rng)
                    for side, drawn in zip((recorded, sim), cells_drawn, strict=True):
                        inside = like.step * (rng.random(len(mass)) - 0.5)
                        side[part, group] = expit(like.grid[drawn] + inside)
        return Draws(recorded=recorded, sim=sim)


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


def _draw_cells(
    mass: Float32[np.ndarray, "draws recorded sim"], rng: np.random.Generator
) -> tuple[Int64[np.ndarray, " draws"], Int64[np.ndarray, " draws"]]:
    """Draw a cell of each table: its row by the sums of rows, then its column."""
    row = _draw_places(mass.sum(axis=2), rng)
    return row, _draw_places(mass[np.arange(len(mass)), row], rng)


def _draw_places(
    mass: Float32[np.ndarray, "draws places"], rng: np.random.Generator
) -> Int64[np.ndarray, " draws"]:
    total = np.cumsum(mass, axis=1, dtype=np.float64)
    return np.asarray((total < rng.random((len(mass), 1)) * total[:, -1:]).sum(axis=1))


POPULATION_NODES = 33


def population(
    nodes: Nodes,
) -> tuple[Float64[np.ndarray, " nodes"], Float64[np.ndarray, " nodes"]]:
    """Return correlation and mean difference of true rates over all groups, for each node."""
    first, second, shared = nodes.total
    z = np.linspace(-4.0, 4.0, POPULATION_NODES)
    w = np.exp(-0.5 * z**2)
    w /= w.sum()
    recorded = expit(nodes.mean[:, [0]] + np.sqrt(first)[:, None] * z)
    slope = shared / np.sqrt(first)
    rest = np.sqrt(np.maximum(second - slope**2, 0.0))
    logits = (
        nodes.mean[:, 1, None, None]
        + slope[:, None, None] * z[:, None]
        + rest[:, None, None] * z[None, :]
    )
    sim = expit(logits)
    given = sim @ w
    mean_r, mean_s = recorded @ w, given @ w
    var_r = (recorded**2) @ w - mean_r**2
    var_s = (sim**2 @ w) @ w - mean_s**2
    together = (recorded * given) @ w - mean_r * mean_s
    r = together / np.sqrt(np.maximum(var_r * var_s, 1e-18))
    return np.clip(r, -1.0, 1.0), mean_s - mean_r


@dataclass(frozen=True, kw_only=True)
class Ranked:
    """One candidate's place in a ranking."""

    name: str
    mean: float
    """Posterior mean of its recorded rate."""
    best: float
    """Probability that its recorded rate is the highest."""
    tie: int
    """From 1; candidates of one number cannot be told apart."""


def ranking(
    names: Sequence[str], draws: Float64[np.ndarray, "draws candidates"], *, level: float = LEVEL
) -> list[Ranked]:
    """Rank candidates; one whose order to the first of a tie is not certain belongs to that tie.

    Args:
        names: The candidates.
        draws: Their true rates.
        level: Probability of an order from which on two candidates differ.
    """
    means = draws.mean(axis=0)
    top = (draws == draws.max(axis=1, keepdims=True)).astype(np.float64)
    best = (top / top.sum(axis=1, keepdims=True)).mean(axis=0)
    found: list[Ranked] = []
    leader, tie = -1, 0
    for place in np.argsort(-means, kind="stable"):
        if leader < 0 or (draws[:, leader] > draws[:, place]).mean() >= level:
            leader, tie = int(place), tie + 1
        found.append(
            Ranked(name=names[place], mean=float(means[place]), best=float(best[place]), tie=tie)
        )
    return found


def chosen_is_best(
    draws: Draws, picked: Sequence[int], over: Callable[[np.ndarray], np.ndarray]
) -> float:
    """Return the probability that the twin's choice has the highest recorded rate.

    Args:
        draws: True rates of the groups.
        picked: Places of the candidates that the twin calls best; of several the mean counts.
        over: Averages the groups of every candidate.
    """
    rates = over(draws.recorded)
    top = (rates == rates.max(axis=1, keepdims=True)).astype(np.float64)
    best = (top / top.sum(axis=1, keepdims=True)).mean(axis=0)
    return float(best[list(picked)].mean())
