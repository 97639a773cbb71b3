"""Which of two candidates succeeds more often, asked while the trials are still being run?

Group-sequential (O'Brien and Fleming 1979): a plan of N pairs of trials is looked at after a
quarter, a half, three quarters and all of them, and decided at the first look at which the score
statistic reaches its limit. Extending it goes on by doubling, looked at after 3/2 and 2 of what was
planned, and each extension has its share of the error, so no number of looks or extensions raises
the error of all above alpha. Between two looks nothing is decided.

A pair is two trials of one start, or one trial of each candidate where starts are not shared; with
unequal numbers n and m it is 2nm/(n + m) pairs. Over tasks, and over shared and other starts, score
and variance add up.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import count, pairwise
from typing import Literal, TypeVar

import numpy as np
from jaxtyping import Complex, Float64

from evaluator.errors import UndefinedStatisticError
from evaluator.result import Interval
from evaluator.statistics.intervals import LEVEL, check_count, normal_quantile

ALPHA, POWER = 0.05, 0.8
LOOKS = (0.25, 0.5, 0.75, 1.0)
"""Shares of the plan at which it is looked at; an extension at the last two of its double."""
UNPLANNED = 20
"""Pairs that are supposed to be planned where no protocol says so."""
SHARES = {True: 0.98, False: 0.5}
"""Of alpha that the plan itself has, by whether it was locked beforehand; each extension has half
of what is left."""
COUNTED = 120
"""Pairs up to which limits are counted out; beyond, sums of pairs are as good as normal."""
NUISANCE = tuple(np.linspace(0.02, 0.5, 13))
"""Rates (not shared) and half the shares of pairs that differ (shared) at which they are."""
LATTICE = 0.04
"""Added to limits that are not counted out: sums of few differing pairs are no normal numbers."""
FARTHEST = 64
"""A decision that is likely only beyond so many times the plan is not promised."""
BISECTIONS = 48
Kind = Literal["shared", "other", "mixed"]


@dataclass(frozen=True, kw_only=True)
class Stratum:
    """What was counted in one task."""

    improved: int = 0
    """Pairs of one start in which only the second candidate succeeded."""
    worsened: int = 0
    pairs: int = 0
    first: tuple[int, int] = (0, 0)
    """Successes and trials of the first candidate on starts that the second has not tried."""
    second: tuple[int, int] = (0, 0)

    def __post_init__(self) -> None:
        """Refuse what cannot be counted."""
        if self.pairs:
            check_count(self.improved + self.worsened, self.pairs)
        for k, n in (self.first, self.second):
            if n:
                check_count(k, n)

    @property
    def others(self) -> float:
        """Pairs that the trials without a shared start are worth."""
        return pairs_equivalent(self.first[1], self.second[1])

    @property
    def score(self) -> float:
        """Successes of the second candidate more than of the first, over so many pairs."""
        if not self.others:
            return float(self.improved - self.worsened)
        (k, n), (j, m) = self.first, self.second
        return self.improved - self.worsened + self.others * (j / m - k / n)

    def variance(self, d: float) -> float:
        """Variance of the score if the rates differ by ``d``: Tango 1998, Farrington 1990."""
        found = 0.0
        if self.pairs:
            b, c, n = self.improved, self.worsened, self.pairs
            linear = (2 * n - b + c) * d - b - c
            worse = (math.sqrt(max(0.0, linear**2 + 8 * n * c * d * (1 - d))) - linear) / (4 * n)
            found += n * max(0.0, 2 * worse + d * (1 - d))
        if self.others:
            (k, n), (j, m) = self.first, self.second
            p, q = _restricted(k / n, j / m, n / m, d)
            found += self.others**2 * (p * (1 - p) / n + q * (1 - q) / m)
        return found


def pairs_equivalent(n: int, m: int) -> float:
    """Pairs that so many trials of either candidate are worth: as many as say as much."""
    return 2 * n * m / (n + m) if n and m else 0.0


def _restricted(first: float, second: float, ratio: float, d: float) -> tuple[float, float]:
    """Both rates that are most likely if they differ by ``d``; ratio: trials of first by second."""
    a = 1 + ratio
    b = -(a + second + ratio * first + d * (ratio + 2))
    c = d * d + d * (2 * second + a) + second + ratio * first
    rest = -second * d * (1 + d)
    v = (b / (3 * a)) ** 3 - b * c / (6 * a * a) + rest / (2 * a)
    u = math.copysign(math.sqrt(max(0.0, (b / (3 * a)) ** 2 - c / (3 * a))), v)
    angle = (math.pi + math.acos(max(-1.0, min(1.0, v / u**3 if u else 0.0)))) / 3
    found = min(1.0, max(0.0, d, 2 * u * math.cos(angle) - b / (3 * a)))
    return min(1.0, max(0.0, found - d)), found


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """What was counted over all tasks."""

    strata: tuple[Stratum, ...]

    @cached_property
    def pairs(self) -> float:
        """Pairs that all trials are worth."""
        return sum(each.pairs + each.others for each in self.strata)

    @cached_property
    def difference(self) -> float:
        """Rate of the second candidate less that of the first, weighted by pairs."""
        if not self.pairs:
            reason = "no start, and no task, was tried by both"
            raise UndefinedStatisticError(statistic="difference", reason=reason)
        return sum(each.score for each in self.strata) / self.pairs

    @property
    def counted(self) -> tuple[int, int, int]:
        """Pairs of one start that improved, that worsened, and all of them."""
        parts = [(each.improved, each.worsened, each.pairs) for each in self.strata]
        improved, worsened, pairs = (sum(part) for part in zip(*parts, strict=True))
        return improved, worsened, pairs

    @property
    def kind(self) -> Kind:
        """Whether starts are shared."""
        shared = any(each.pairs for each in self.strata)
        others = any(each.others for each in self.strata)
        return "mixed" if shared and others else "shared" if shared else "other"

    def z(self, d: float = 0.0) -> float:
        """Standard errors between what was found and a difference ``d``."""
        distance = self.pairs * (self.difference - d)
        variance = sum(each.variance(d) for each in self.strata)
        if variance <= 0:
            return math.copysign(math.inf, distance) if abs(distance) > 1e-12 else 0.0
        return distance / math.sqrt(variance)

    @cached_property
    def of_no_difference(self) -> float:
        """Standard errors between what was found and no difference."""
        return self.z()

    def interval(self, z: float | None = None, *, level: float = LEVEL) -> Interval:
        """Return all differences from which less than ``z`` standard errors lie.

        At the limit of a look it leaves zero out exactly when the look decides.
        """
        reach = normal_quantile(0.5 + level / 2) if z is None else z
        method = "tango" if self.kind == "shared" else "score"
        method = method if z is None else "repeated-score"
        found = self.difference
        ends = []
        for limit, sign in ((-1.0, 1), (1.0, -1)):
            inside, outside = found, limit
            if abs(found - outside) < 1e-12:
                ends.append(outside)
                continue
            for _ in range(BISECTIONS):
                middle = (inside + outside) / 2
                within = sign * self.z(middle) < reach
                inside, outside = (middle, outside) if within else (inside, middle)
            ends.append(inside)
        return Interval(low=ends[0], high=ends[1], level=level, method=method)


@dataclass(frozen=True, kw_only=True)
class Look:
    """One look at the trials."""

    pairs: float
    limit: float
    """Standard errors of the score from which on it decides."""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """How many pairs were planned, and what a false winner may cost."""

    pairs: int = UNPLANNED
    locked: bool = False
    alpha: float = ALPHA

    def places(self) -> Iterator[float]:
        """Yield the pairs after which it is looked at, without end."""
        yield from map(float, look_pairs(self.pairs))
        for turn in count():
            yield 1.5 * self.pairs * 2**turn
            yield 2.0 * self.pairs * 2**turn

    def looks(self, kind: Kind) -> Iterator[Look]:
        """Yield the looks in their order, without end."""
        share = SHARES[self.locked]
        limit = planned_limit(self.pairs, self.alpha * share, kind)
        num_planned, left = len(look_pairs(self.pairs)), 1 - share
        for number, place in enumerate(self.places()):
            if number < num_planned:
                yield Look(pairs=place, limit=limit * math.sqrt(self.pairs / place))
                continue
            left /= 1 if (number - num_planned) % 2 else 2  # both looks of an extension share it
            yield Look(pairs=place, limit=normal_quantile(1 - self.alpha * left / 4))

    def likely_at(self, evidence: Evidence) -> float | None:
        """Return the pairs at whose look a decision is more likely than not, as rates look now."""
        if not evidence.pairs or not evidence.difference:
            return None
        z = abs(evidence.z()) / math.sqrt(evidence.pairs)
        for look in self.looks(evidence.kind):
            if look.pairs > FARTHEST * self.pairs:
                return None
            if look.pairs > evidence.pairs and z * math.sqrt(look.pairs) >= look.limit:
                return look.pairs
        return None


def look_pairs(pairs: int) -> list[int]:
    """Return the pairs after which a plan is looked at."""
    return sorted({max(1, math.floor(part * pairs)) for part in LOOKS})


@lru_cache(maxsize=256)
def planned_limit(pairs: int, alpha: float, kind: Kind) -> float:
    """Return z at the last look of a plan; at one of n pairs it is sqrt(pairs / n) times that.

    The smallest with which equal candidates get a winner with a chance of at most ``alpha``,
    whatever their rate is: counted out at rates close to each other.
    """
    if kind == "mixed":
        return max(planned_limit(pairs, alpha, "shared"), planned_limit(pairs, alpha, "other"))
    if pairs > COUNTED:
        return _limit_of_normal(alpha) + LATTICE
    low, high = 1.0, 6.0
    nuisance = equal(kind, np.array(NUISANCE))
    for _ in range(14):
        middle = (low + high) / 2
        size = float(decided(pairs, middle, kind, nuisance)[-1].max())
        low, high = (low, middle) if size <= alpha else (middle, high)
    return high


Number = TypeVar("Number", float, np.ndarray)
Chances = tuple[float, float, float]
"""Of the score of one pair: second alone, first alone, both succeed."""


def equal(kind: Kind, rate: Number) -> tuple[Number, Number, Number]:
    """Return the chances of equal candidates: independent ones of a rate, or of shared starts."""
    if kind == "shared":
        return rate, rate, 0 * rate
    return rate * (1 - rate), rate * (1 - rate), rate * rate


def chances(first: float, second: float, correlation: float = 0.0) -> Chances:
    """Return the chances of a pair from both rates and the correlation of a start's outcomes."""
    both = first * second + correlation * math.sqrt(first * (1 - first) * second * (1 - second))
    both = min(max(both, 0.0, first + second - 1), first, second)
    return second - both, first - both, both


def decided(
    pairs: int, limit: float, kind: Kind, of_pair: Sequence[float | np.ndarray]
) -> Float64[np.ndarray, "looks *rates"]:
    """Return the chance that a plan is decided by each of its looks.

    Counted out: counts of both candidates, or of pairs that improve and worsen, are carried from
    look to look by the characteristic function of one pair.
    """
    better, worse, both = (np.asarray(chance)[..., None, None] for chance in of_pair)
    turn = np.exp(-2j * np.pi * np.arange(pairs + 1) / (pairs + 1))
    first, second = turn[:, None], turn[None, :]
    neither = 1 - better - worse - (both if kind == "other" else 0.0)
    one: Complex[np.ndarray, "*rates k k"] = neither + worse * first + better * second
    if kind == "other":
        one = one + both * first * second
    a, b = np.arange(pairs + 1)[:, None], np.arange(pairs + 1)[None, :]
    mass = np.zeros(one.shape)
    mass[..., 0, 0] = 1.0
    found, total = [], np.zeros(one.shape[:-2])
    for before, now in pairwise([0, *look_pairs(pairs)]):
        mass = np.fft.ifft2(np.fft.fft2(mass) * one ** (now - before)).real
        rate = np.clip((a + b) / (2 * now), 0, 1)
        variance = a + b if kind == "shared" else 2 * now * rate * (1 - rate)
        stops = (b - a) ** 2 >= limit**2 * variance * pairs / now - 1e-9
        stops &= a != b
        total = total + mass[..., stops].sum(axis=-1)
        mass[..., stops] = 0.0
        found.append(total)
    return np.array(found)


@lru_cache(maxsize=64)
def _limit_of_normal(alpha: float) -> float:
    """The same for sums that are normal: Brownian motion that leaves a strip at a look."""
    low, high = 1.0, 6.0
    x = np.linspace(-1, 1, 801)
    while high - low > 1e-4:
        middle = (low + high) / 2
        at = x * middle
        kernel = np.exp(-2 * (at[:, None] - at[None, :]) ** 2) * (at[1] - at[0])
        kernel *= math.sqrt(2 / math.pi)
        mass = np.exp(-2 * at**2) * math.sqrt(2 / math.pi)
        for _ in LOOKS[1:]:
            mass = kernel @ mass
        left = 1 - float(mass.sum() * (at[1] - at[0]))
        low, high = (low, middle) if left <= alpha else (middle, high)
    return high


def pairs_for_power(
    of_pair: Chances, *, alpha: float = ALPHA, power: float = POWER, kind: Kind = "shared"
) -> int:
    """Return the smallest plan that is decided with this power.

    Raises:
        UndefinedStatisticError: Without a difference, or beyond 4,000 pairs.
    """
    gap = abs(of_pair[0] - of_pair[1])
    if gap < 1e-9:
        reason = "the rates are equal; no number of pairs shows a difference"
        raise UndefinedStatisticError(statistic="pairs", reason=reason)
    variance = of_pair[0] + of_pair[1]
    sum_z = (_limit_of_normal(alpha) + LATTICE) * math.sqrt(variance) + normal_quantile(
        power
    ) * math.sqrt(max(variance - gap**2, 0.0))
    guess = math.ceil((sum_z / gap) ** 2)
    if guess > 4000:
        reason = "more than 4000 pairs would be needed"
        raise UndefinedStatisticError(statistic="pairs", reason=reason)
    if guess > COUNTED:
        return guess
    while guess > 4 and plan_power(guess - 1, of_pair, alpha=alpha, kind=kind)[-1] >= power:
        guess -= 1
    while plan_power(guess, of_pair, alpha=alpha, kind=kind)[-1] < power:
        guess += 1
    return guess


def plan_power(
    pairs: int, of_pair: Chances, *, alpha: float = ALPHA, kind: Kind = "shared"
) -> Sequence[float]:
    """Return the chance that a locked plan is decided by each of its looks."""
    limit = planned_limit(pairs, alpha * SHARES[True], kind)
    if pairs <= COUNTED:
        return [float(each) for each in decided(pairs, limit, kind, of_pair)]
    gap, variance = abs(of_pair[0] - of_pair[1]), of_pair[0] + of_pair[1]
    spread = math.sqrt(max(variance - gap**2, 1e-12))
    if kind == "other":
        mean = (of_pair[0] + of_pair[1]) / 2 + of_pair[2]
        variance = 2 * mean * (1 - mean)
    found = []
    for now in look_pairs(pairs):  # of one look alone: at the next it is higher
        z = (gap * now - limit * math.sqrt(pairs * variance)) / (spread * math.sqrt(now))
        found.append(0.5 * math.erfc(-z / math.sqrt(2)))
    return found
