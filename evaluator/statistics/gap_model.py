"""How far the twin follows over all groups of this kind, and in which groups it may be blind.

A population of groups is two curves of log-odds and a copula between them, and a share of groups in
which the twin is blind: there it says something that has nothing to do with what is recorded. Some
thousand populations are drawn once from the prior, each laid out as chances of pairs of rates; what
was counted weighs them. So one product of two matrices gives the posterior, and equal counts give
equal numbers. Where fewer than ``FEW`` populations would count, the weights are flattened until so
many do: intervals are wider then, never narrower than the drawn populations can tell; the weights
as they are tell which group is blind. Groups that share tasks or policies count as fewer, by how
much their rates have in common.
"""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

import numpy as np
from jaxtyping import Float32, Float64, Int64
from scipy.special import betainc, expit, ndtr, ndtri

from evaluator.errors import UndefinedStatisticError
from evaluator.result import Interval
from evaluator.statistics.intervals import LEVEL

METHOD = "populations"
MIN_GROUPS = 3
NODES = 16_384
PARTS = [slice(at, at + 256) for at in range(0, NODES, 256)]
"""Populations that are drawn together: so many stay in a processor's cache."""
FEW = 60.0
CELLS = 21
EDGES = np.concatenate([[-np.inf], np.linspace(-4.6, 4.6, CELLS - 1), [np.inf]])
"""Log-odds between which rates are as good as alike."""
CENTRES = np.concatenate([[-5.3], (EDGES[1:-2] + EDGES[2:-1]) / 2, [5.3]])
MOST = 100
"""A larger side is taken as one of so many trials: its rate is as good as known then."""
AT_END = 0.02
"""An interval that ends this close to 1 or -1 holds it: no population was drawn at the end."""
BEYOND, TOWARD_0 = 0.005, 0.04
"""Chances outside an interval of r, away from 0 and towards it, where its sign is certain: few
groups say less of how strong a correlation is than of its sign. Less where it is not."""
TAIL = (1 - LEVEL) / 2
QUADRATURE = np.linspace(-3.4, 3.4, 21)


@dataclass(frozen=True, kw_only=True)
class GroupCounts:
    """What was counted in one group."""

    recorded: tuple[int, int]
    """Successes and trials that have no partner in the twin."""
    sim: tuple[int, int]
    """The twin's, of trials without a recorded partner."""
    pairs: tuple[int, int, int, int] = (0, 0, 0, 0)
    """Paired trials in which both succeed, only sim, only recorded, neither."""
    shares: tuple[Hashable, ...] = ()
    """What it may share with other groups: its task, its policy."""

    @property
    def totals(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """Successes and trials, recorded and in the twin, over paired and other trials."""
        both, only_sim, only_recorded, _ = self.pairs
        n = sum(self.pairs)
        recorded = (self.recorded[0] + both + only_recorded, self.recorded[1] + n)
        return recorded, (self.sim[0] + both + only_sim, self.sim[1] + n)


Side = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Middle, size and bend of a curve of log-odds, one of each population."""


@dataclass(frozen=True, kw_only=True)
class Populations:
    """Populations drawn from the prior."""

    seeing: Float32[np.ndarray, "nodes cells"]
    """Chance of each pair of cells, recorded by twin, where the twin is not blind."""
    may_be_blind: Int64[np.ndarray, " some"]
    """Populations with a share of blind groups."""
    blind: Float32[np.ndarray, "some cells"]
    """The same chances in these, where the twin is blind."""
    share: Float64[np.ndarray, " nodes"]
    """Of groups in which it is blind."""
    r: Float64[np.ndarray, " nodes"]
    bias: Float64[np.ndarray, " nodes"]

    @cached_property
    def orders(self) -> dict[str, np.ndarray]:
        """How r, bias and share are sorted."""
        return {n: np.argsort(getattr(self, n), kind="stable") for n in ("r", "bias", "share")}


@lru_cache(maxsize=1)
def drawn() -> Populations:
    """Draw populations from the prior; always the same."""
    rng = np.random.default_rng(0)
    z, u = rng.standard_normal((NODES, 8)), rng.random((NODES, 5))
    recorded_at = 1.6 * z[:, 0]
    size = np.maximum(np.abs(2 * z[:, 2]), 0.02)
    sim_size = np.maximum(size * np.exp(0.5 * z[:, 3]), 0.02)
    rho = np.sin(np.pi * (u[:, 0] - 0.5))
    share = np.where(u[:, 1] < 0.5, 0.0, 0.5 * u[:, 2])
    bends = np.where(u[:, 3:] < 0.6, 0.0, u[:, 3:] * 0.95).T
    recorded: Side = (recorded_at, size, bends[0])
    sim: Side = (recorded_at + 1.2 * z[:, 1], sim_size, bends[1])
    blind: Side = (2 * z[:, 4], np.maximum(np.abs(z[:, 5]), 0.05), np.zeros(NODES))
    (x, middle_x), (y, middle_y), (of_blind, _) = (_masses(*s) for s in (recorded, sim, blind))
    seeing, pairs = np.empty((NODES, CELLS, CELLS), np.float32), []
    for part in PARTS:
        near = np.clip(rho[part], -0.97, 0.97)[:, None, None]
        a, b = middle_x[part, :, None], middle_y[part, None, :]
        mine = np.exp(-(near**2 * (a * a + b * b) - 2 * near * a * b) / (2 * (1 - near**2)))
        mine *= x[part, :, None] * y[part, None, :]
        mine /= mine.sum(axis=(1, 2), keepdims=True)
        seeing[part], rows = mine, np.flatnonzero(share[part])
        of_all = mine[rows].sum(axis=2)[:, :, None] * of_blind[part][rows, None, :]
        pairs.append(of_all.reshape(len(rows), -1).astype(np.float32))
    r, bias = _moments(recorded, sim, blind, rho, share)
    return Populations(
        seeing=seeing.reshape(NODES, -1),
        may_be_blind=np.flatnonzero(share),
        blind=np.concatenate(pairs),
        share=share,
        r=r,
        bias=bias,
    )


def _bent(z: np.ndarray, bend: np.ndarray) -> np.ndarray:
    """A straight line, or by ``bend`` two levels with little between them: one row a population."""
    found = np.array(np.broadcast_to(z, (len(bend), *z.shape[1:])))
    rows = np.flatnonzero(bend)
    by = bend[rows].reshape(-1, *[1] * (z.ndim - 1))
    found[rows] = (1 - by) * found[rows] + by * 1.25 * np.tanh(3 * found[rows])
    return found


def _masses(at: np.ndarray, size: np.ndarray, bend: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Chance of each cell of log-odds, and the normal number in its middle."""
    z = np.linspace(-6, 6, 241)
    found = (EDGES[None, 1:-1] - at[:, None]) / size[:, None]
    rows = np.flatnonzero(bend)
    for node, curve in zip(rows, _bent(z[None], bend[rows]), strict=True):
        found[node] = np.interp(found[node], curve, z)
    below = np.concatenate([np.zeros((len(at), 1)), ndtr(found), np.ones((len(at), 1))], axis=1)
    middle = ndtri(np.clip((below[:, 1:] + below[:, :-1]) / 2, 1e-9, 1 - 1e-9))
    return np.diff(below, axis=1) + 1e-12, middle


def _moments(
    recorded: Side, sim: Side, blind: Side, rho: np.ndarray, share: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Correlation and mean difference of both rates in each population."""
    w = np.exp(-0.5 * QUADRATURE**2)
    w /= w.sum()
    z = QUADRATURE[None, :]
    at, size, bend = recorded
    x = expit(at[:, None] + size[:, None] * _bent(z, bend))
    at, size, bend = sim
    other, given, square_y = np.sqrt(1 - rho**2), *np.empty((2, *x.shape))
    for part in PARTS:
        near, far, middle, wide = (v[part, None, None] for v in (rho, other, at, size))
        y = expit(middle + wide * _bent(near * z[:, :, None] + far * z[:, None, :], bend[part]))
        given[part], square_y[part] = y @ w, y**2 @ w
    of_blind = expit(blind[0][:, None] + blind[1][:, None] * z)
    mean_x, square_x = x @ w, x**2 @ w
    mean_y = (1 - share) * (given @ w) + share * (of_blind @ w)
    square_y = (1 - share) * (square_y @ w) + share * (of_blind**2 @ w)
    both = (1 - share) * ((x * given) @ w) + share * mean_x * (of_blind @ w)
    spread = (square_x - mean_x**2) * (square_y - mean_y**2)
    r = (both - mean_x * mean_y) / np.sqrt(np.maximum(spread, 1e-14))
    return np.clip(r, -1, 1), mean_y - mean_x


@dataclass(frozen=True, kw_only=True)
class GapModel:
    """What some groups say of the population that they are from."""

    groups: tuple[GroupCounts, ...]
    weights: Float64[np.ndarray, " nodes"] = field(init=False, repr=False)
    blind_groups: Float64[np.ndarray, " groups"] = field(init=False, repr=False)
    """Probability of each group that the twin is blind in it."""

    def __post_init__(self) -> None:
        """Weigh the populations.

        Raises:
            UndefinedStatisticError: Below three groups, or when a side of one has no trial.
        """
        reason = ""
        if len(self.groups) < MIN_GROUPS:
            reason = f"{len(self.groups)} groups; it needs at least {MIN_GROUPS}"
        elif any(n == 0 for group in self.groups for _, n in group.totals):
            reason = "a group has no trial on one side"
        if reason:
            raise UndefinedStatisticError(statistic="model of agreement", reason=reason)
        there = drawn()
        odds = common_log_odds(self.groups)
        seeing, blind = chances_in(there, [_likelihood(group, odds) for group in self.groups])
        share = there.share[:, None]
        chance = np.maximum((1 - share) * seeing + share * blind, 1e-35)
        logs = np.log(chance).sum(axis=1)
        object.__setattr__(self, "weights", _flattened(logs / self.design_effect))
        # Flat weights would see scatter in place of groups that lie apart from the others.
        sharp = _flattened(logs, few=1.0)
        object.__setattr__(self, "blind_groups", sharp @ (share * blind / chance))

    @cached_property
    def design_effect(self) -> float:
        """How many groups count as one, by the tasks and policies that they share."""
        rates = np.array([[k / n for k, n in group.totals] for group in self.groups])
        found = 1.0
        for place in range(len(self.groups[0].shares)):
            names = [group.shares[place] for group in self.groups]
            found += max(_shared(names, side) for side in rates.T)
        return found

    @cached_property
    def r(self) -> Interval:
        """Correlation of true rates over all groups of this kind."""
        above = float(self.weights @ (drawn().r > 0))
        below, beyond = (BEYOND + (TOWARD_0 - BEYOND) * sure**3 for sure in (above, 1 - above))
        found = self._interval("r", below, beyond)
        low = -1.0 if found.low < AT_END - 1 else found.low
        return replace(found, low=low, high=1.0 if found.high > 1 - AT_END else found.high)

    @property
    def bias(self) -> Interval:
        """Mean of the twin's rate - recorded rate over all groups of this kind."""
        return self._interval("bias")

    @property
    def blind_share(self) -> tuple[float, Interval]:
        """Share of groups of this kind in which the twin is blind: mean and interval."""
        return float(self.weights @ drawn().share), self._interval("share")

    def _interval(self, what: str, below: float = TAIL, beyond: float = TAIL) -> Interval:
        order = drawn().orders[what]
        values = getattr(drawn(), what)
        middle = np.cumsum(self.weights[order]) - self.weights[order] / 2
        low, high = np.interp([below, 1 - beyond], middle, values[order])
        return Interval(low=float(low), high=float(high), level=LEVEL, method=METHOD)


def chances_in(
    there: Populations, tables: Sequence[np.ndarray]
) -> tuple[Float32[np.ndarray, "nodes groups"], Float32[np.ndarray, "nodes groups"]]:
    """Return the chance of each group's counts where the twin sees, and where it is blind."""
    chances = np.stack([table.ravel() for table in tables], axis=1).astype(np.float32)
    blind = np.zeros((len(there.share), len(tables)), dtype=np.float32)
    blind[there.may_be_blind] = there.blind @ chances
    return there.seeing @ chances, blind


def _shared(names: Sequence[Hashable], rates: Float64[np.ndarray, " groups"]) -> float:
    """Groups of a name less one, times how much of the variance of rates names share."""
    places = [np.flatnonzero([other == name for other in names]) for name in dict.fromkeys(names)]
    many = len(names) / len(places)
    if len(places) < 2 or many <= 1:
        return many - 1 if many > 1 and len(places) > 1 else 0.0
    inside = sum(((rates[p] - rates[p].mean()) ** 2).sum() for p in places)
    inside /= len(names) - len(places)
    between = sum(len(p) * (rates[p].mean() - rates.mean()) ** 2 for p in places)
    between /= len(places) - 1
    variance = max((between - inside) / many, 0.0)
    return float((many - 1) * variance / max(variance + inside, 1e-12))


def _flattened(
    logs: Float64[np.ndarray, " nodes"], few: float = FEW
) -> Float64[np.ndarray, " nodes"]:
    """Return weights of sum 1, flattened by a power until enough populations count."""
    power, weights = 1.0, logs
    for _ in range(60):
        weights = np.exp(power * (logs - logs.max()))
        weights /= weights.sum()
        if 1 / (weights**2).sum() >= few:
            break
        power *= 0.9
    return np.asarray(weights)


def _likelihood(group: GroupCounts, odds: float) -> Float64[np.ndarray, "rates rates"]:
    """Chance of a group's counts for each pair of cells, up to a factor."""
    found = np.outer(_binomial(*group.recorded), _binomial(*group.sim))
    if not sum(group.pairs):
        return found
    p, q = expit(CENTRES)[:, None], expit(CENTRES)[None, :]
    both = _both(p, q, float(np.exp(odds)))
    scale = min(1.0, MOST / sum(group.pairs))
    logs = np.zeros_like(found)
    for n, chance in zip(group.pairs, (both, q - both, p - both, 1 - p - q + both), strict=True):
        logs += scale * n * np.log(np.maximum(chance, 1e-300))
    return np.asarray(found * np.exp(logs - logs.max()))


def _binomial(k: int, n: int) -> Float64[np.ndarray, " rates"]:
    """Mean chance of a count over the rates of each cell, 1 without trials."""
    if not n:
        return np.ones(CELLS)
    scale = min(1.0, MOST / n)
    a, b = scale * k + 1, scale * (n - k) + 1
    rates = expit(EDGES)
    return np.asarray(np.diff(betainc(a, b, rates)) / np.diff(rates))


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


def _both(p: np.ndarray, q: np.ndarray, odds: float) -> np.ndarray:
    """Chance that both succeed, from both rates and the odds ratio (Plackett 1965)."""
    if abs(odds - 1) < 1e-9:
        return np.asarray(p * q)
    total = 1 + (odds - 1) * (p + q)
    root = np.sqrt(np.maximum(total**2 - 4 * odds * (odds - 1) * p * q, 0.0))
    return np.asarray(2 * odds * p * q / (total + root))
