"""What the counts of groups say of true rates: the likelihood of the model of agreement.

The log-odds of a group's recorded and twin rate are a pair of normal numbers; groups of one task
share a part of them. Both sums are quadrature: over a group's log-odds on a grid, over a task's
mean by adaptive Gauss-Hermite nodes (Liu and Pierce 1994). ``hierarchical.py`` integrates over
the parameters.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int64
from scipy.special import expit

EDGE = 18.0
"""Log-odds where the grid ends. A rate is as good as 0 or 1 long before, but how probable rates
are that cannot be told from 0 or 1 is a matter of the tails: cut at 9 they move the mean."""
STEP_ALONE, STEP_IN_TASKS = 0.2, 0.25
"""Step of the grid of log-odds at 0; the pairs of numbers vary by half of it more than sigma
says."""
BEND = 2.0
"""Log-odds about which steps become longer, where counts say less of them: x = bend sinh(t / bend)
with equal steps of t."""
MOST = 200
"""A larger side is taken as one of so many trials: its rate is as good as known then."""
TASK_NODES = 4
"""Nodes for each side of a task's mean."""
BATCH = 200_000
"""Numbers on the grid that are held at once: what a processor's cache holds."""
REACH = 5.5
"""Standard deviations from its centre where a normal density on the grid ends: 4e-8 lies beyond."""
Window = tuple[slice, slice]
"""Rows and columns of the grid."""
WHOLE: Window = (slice(None), slice(None))


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


def common_log_odds(groups: Sequence[GroupCounts]) -> float:
    """Return the log odds ratio of paired outcomes within groups (Mantel and Haenszel 1959).

    Half a pair is added to each cell in all; 0 without pairs.
    """
    tables = [group.pairs for group in groups if sum(group.pairs)]
    if not tables:
        return 0.0
    agree = sum(a * d / (a + b + c + d) for a, b, c, d in tables) + 0.25
    differ = sum(b * c / (a + b + c + d) for a, b, c, d in tables) + 0.25
    return float(np.clip(np.log(agree / differ), -5.0, 5.0))


@dataclass(frozen=True, kw_only=True)
class OfTask:
    """A task's probability, split over where its mean may lie."""

    logs: Float64[np.ndarray, "nodes centres"]
    """Of each centre's share."""
    centres: Float64[np.ndarray, "nodes centres 2"]
    rates: Float64[np.ndarray, "nodes centres groups sides"]
    """Mean recorded and twin rate given parameters and centre; no sides where not asked for."""


class Likelihood:
    """Probability of the counts of every group on a grid of both log-odds."""

    def __init__(self, groups: Sequence[GroupCounts]) -> None:
        """Lay out."""
        names = list(dict.fromkeys(group.task for group in groups))
        self.members = [
            np.array([g for g, group in enumerate(groups) if group.task == name]) for name in names
        ]
        self.in_tasks = 1 < len(names) < len(groups)
        if not self.in_tasks:
            self.members = [np.arange(len(groups))]
        self.step = STEP_IN_TASKS if self.in_tasks else STEP_ALONE
        most = np.ceil(BEND * np.arcsinh(EDGE / BEND) / self.step)
        even = self.step * np.arange(-most, most + 1)
        self.grid = BEND * np.sinh(even / BEND)
        self.steps = self.step * np.cosh(even / BEND)
        """Length of grid that each place stands for."""
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

    def window(self, mean: Float64[np.ndarray, "nodes 2"], spread: Spread) -> Window:
        """Return the part of the grid in which any of some normal densities lies."""
        first, second, _ = spread.entries((self.step / 2) ** 2)
        found = []
        for side, variance in enumerate((first, second)):
            reach = REACH * np.sqrt(variance)
            ends = (mean[:, side] - reach).min(), (mean[:, side] + reach).max()
            low, high = np.searchsorted(self.grid, ends)
            found.append(slice(min(low, len(self.grid) - 1), max(high, 1)))
        return found[0], found[1]

    def weights(
        self, mean: Float64[np.ndarray, "nodes 2"], spread: Spread, window: Window = WHOLE
    ) -> Float32[np.ndarray, "nodes cells"]:
        """Return the normal density of a pair of log-odds on the grid, up to a factor for each."""
        first, second, shared = spread.entries((self.step / 2) ** 2)
        det = first * second - shared**2
        x, y = (self.grid[part][None, :] - mean[:, [side]] for side, part in enumerate(window))
        size = np.log(self.steps)
        rows = np.empty((*x.shape, 3), dtype=np.float32)
        rows[:, :, 0] = size[window[0]] - 0.5 * (second / det)[:, None] * x**2
        rows[:, :, 1] = (shared / det)[:, None] * x
        rows[:, :, 2] = 1.0
        columns = np.empty((len(y), 3, y.shape[1]), dtype=np.float32)
        columns[:, 0] = 1.0
        columns[:, 1] = y
        columns[:, 2] = size[window[1]] - 0.5 * (first / det)[:, None] * y**2
        found = (rows @ columns).reshape(len(mean), -1)  # one pass over memory
        np.exp(found, out=found)
        return np.asarray(found)

    def log(self, phi: Float64[np.ndarray, "nodes parameters"]) -> Float64[np.ndarray, " nodes"]:
        """Return the logarithm of the probability of all counts, for each set of parameters."""
        nodes = Nodes.of(phi)
        found = np.zeros(len(phi))
        for members in self.members:
            found += _log_sum(self.of_task(nodes, members).logs)
        return np.asarray(found)

    def log_and_rates(
        self, phi: Float64[np.ndarray, "nodes parameters"]
    ) -> tuple[Float64[np.ndarray, " nodes"], Float64[np.ndarray, "nodes groups 2"]]:
        """Return ``log``, and the mean recorded and twin rate of every group given parameters."""
        nodes = Nodes.of(phi)
        found, rates = np.zeros(len(phi)), np.empty((len(phi), len(self.table), 2))
        for members in self.members:
            task = self.of_task(nodes, members, with_rates=True)
            total = _log_sum(task.logs)
            found += total
            share = np.exp(task.logs - total[:, None])
            rates[:, members] = np.einsum("nq,nqgs->ngs", share, task.rates)
        return np.asarray(found), rates

    def of_task(
        self, nodes: Nodes, members: Int64[np.ndarray, " groups"], *, with_rates: bool = False
    ) -> "OfTask":
        """Return each centre's share in a task's probability."""
        count = len(nodes.mean)
        centres, log_shares = self.centres(nodes, members)
        each = centres.shape[1]
        flat = centres.reshape(-1, 2)
        spread = Spread(
            **{name: np.repeat(values, each) for name, values in vars(nodes.within).items()}
        )
        table, ones = self.table[members], np.ones((1, self.table.shape[1]), dtype=np.float32)
        sides = [side.astype(np.float32) for side in self.rate_of_cells] if with_rates else []
        columns = np.concatenate([table, *(table * side for side in sides), ones])
        columns = columns.reshape(-1, *self.shape)
        found = np.empty((len(flat), len(columns) - 1))
        # Alike spreads reach over the same part of the grid; that of all others is left out.
        order = np.argsort(np.maximum(spread.first, spread.second), kind="stable")
        at, cells = 0, self.table.shape[1]
        while at < len(flat):
            part = order[at : at + max(1, BATCH // cells)]
            some = Spread(**{name: values[part] for name, values in vars(spread).items()})
            window = self.window(flat[part], some)
            there = columns[:, *window].reshape(len(columns), -1)
            shares = self.weights(flat[part], some, window) @ there.T
            found[part] = shares[:, :-1] / np.maximum(shares[:, -1:], 1e-30)
            at, cells = at + len(part), there.shape[1]
        chance = np.maximum(found[:, : len(members)], 1e-35)
        logs = np.log(chance).sum(axis=1).reshape(count, each)
        rates = found[:, len(members) :].reshape(len(flat), len(sides), len(members))
        return OfTask(
            logs=logs + log_shares,
            centres=centres,
            rates=(rates / chance[:, None]).swapaxes(1, 2).reshape(count, each, len(members), -1)
            if with_rates
            else np.empty((count, each, len(members), 0)),
        )

    @property
    def rate_of_cells(self) -> tuple[np.ndarray, np.ndarray]:
        """Recorded and twin rate of every cell of the grid."""
        ones = np.ones_like(self.rate)
        return np.outer(self.rate, ones).ravel(), np.outer(ones, self.rate).ravel()

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
