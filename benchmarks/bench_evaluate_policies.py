"""Which policy is better: errors and trials of the comparison, by a protocol fixed beforehand.

Seeds [0, case]; every study is drawn and read by code that is not the evaluator's: outcomes come
from NumPy, fixed designs from SciPy's exact distributions. Written down before the first result:

1. Equal candidates, advice followed: 12 cases, success 10, 30, 50, 90 %, starts shared with
   correlation 0.3, not shared, and shared in half of the trials; 1,000 studies of each
   (``POLICY_STUDIES``). A study begins without a plan at 10 trials of each candidate; each of at
   most 10 looks follows the advice of the look before. Success: a winner is named in at most 5 %
   of the studies of the worst case, within two standard errors of 1,000 studies (6.4 %), and in at
   most 5 % over all of them.
2. Rates 35 and 65 %, 65 and 95 %, starts shared (correlation 0) and not shared, planned by
   ``design`` with the trials of a fixed design of 80 % power: the smallest number from which on
   Boschloo's test (not shared) or McNemar's exact test (shared) has 80 % power. Counted out, not
   simulated. Success: the median number of trials is at most 0.75 of that design's, and at least
   80 % of the studies are decided by its number, in each of the four.
3. The size of a planned study, counted out over success rates of 2 to 98 %, 8 to 200 pairs.
   Success: at most 5 % each.
4. Intervals of the difference, at the look at which a study stops: 35 and 65 %, 65 and 95 %, 50
   and 50 %, starts shared and not. Success: least coverage at least 93 %.
"""

import os
import time
from typing import Any

import numpy as np
from measure import ROOT, Target, report_targets
from scipy import stats

from evaluator.compare.policies import read
from evaluator.statistics.sequential import (
    Evidence,
    Kind,
    Plan,
    Stratum,
    chances,
    decided,
    equal,
    look_pairs,
    planned_limit,
)

FULL_STUDIES = 1000
STUDIES = int(os.environ.get("POLICY_STUDIES", FULL_STUDIES))
if STUDIES != FULL_STUDIES:
    os.environ.setdefault("GST_BENCH_RESULTS", str(ROOT / "build" / "quick_results"))
RATES = ((0.35, 0.65), (0.65, 0.95))
KINDS = ("shared", "other", "half")
PLANNED: tuple[Kind, ...] = ("shared", "other")
MOST_TRIALS, LOOKS, FIRST = 4000, 10, 10
LOCKED = 0.98
"""Share of alpha of a locked plan."""


class Study:
    """Outcomes of both candidates, one of each after another."""

    def __init__(
        self, rates: tuple[float, float], kind: str, size: int, rng: np.random.Generator
    ) -> None:
        """Draw; starts that are shared have outcomes of correlation 0.3 where the rates allow."""
        first, second = rates
        spread = np.sqrt(first * (1 - first) * second * (1 - second))
        both = np.clip(first * second + 0.3 * spread, max(0, first + second - 1), min(rates))
        is_shared = {
            "shared": np.ones(size, bool),
            "other": np.zeros(size, bool),
            "half": np.arange(size) % 2 == 0,
        }[kind]
        a = rng.random(size) < first
        given = np.where(a, both / first, (second - both) / (1 - first))
        b = rng.random(size) < np.where(is_shared, given, second)
        columns = (
            is_shared & b & ~a,
            is_shared & a & ~b,
            is_shared,
            ~is_shared & a,
            ~is_shared & b,
        )
        self.sums = np.cumsum(np.stack(columns, axis=1), axis=0)

    def after(self, pairs: float) -> Evidence:
        """Count the first so many pairs."""
        n = int(np.ceil(pairs - 1e-9))
        up, down, shared, k, j = (int(v) for v in self.sums[n - 1])
        others = n - shared
        stratum = Stratum(
            improved=up, worsened=down, pairs=shared, first=(k, others), second=(j, others)
        )
        return Evidence(strata=(stratum,))


def advised(rate: float, kind: str, case: int) -> float:
    """Share of studies of equal candidates in which following advice ends with a winner."""
    rng = np.random.default_rng([0, case])
    winners = 0
    for _ in range(STUDIES):
        study, size = Study((rate, rate), kind, MOST_TRIALS, rng), FIRST
        for _ in range(LOOKS):
            found = read(Plan(), study.after(size), study.after)
            winners += bool(found.better)
            if found.better or found.more is None or size + found.more > MOST_TRIALS:
                break
            size += found.more
    return winners / STUDIES


def boschloo_pairs(first: float, second: float) -> int:
    """Trials of each from which on Boschloo's test has 80 % power: a region of Fisher's p."""
    grid, reached = np.linspace(0.005, 0.995, 199), 0
    for n in range(10, 200):
        k = np.arange(n + 1)
        # Few successes of the first: the hypergeometric tail, for every pair of counts.
        fisher = stats.hypergeom.cdf(k[:, None], 2 * n, k[:, None] + k[None, :], n)
        mass = [stats.binom.pmf(k, n, p) for p in grid]
        order = np.unique(np.round(fisher, 12))
        low, high = 0, len(order) - 1
        while low < high:  # the largest region of at most 2.5 % whatever the common rate is
            middle = (low + high + 1) // 2
            inside = fisher <= order[middle] + 1e-12
            low, high = (
                (middle, high) if max(m @ inside @ m for m in mass) <= 0.025 else (low, middle - 1)
            )
        inside = fisher <= order[low] + 1e-12
        power = stats.binom.pmf(k, n, first) @ inside @ stats.binom.pmf(k, n, second)
        reached = reached + 1 if power >= 0.8 else 0
        if reached == 4:
            return n - 3
    raise ValueError("no design of fewer than 200")


def mcnemar_pairs(first: float, second: float) -> int:
    """Pairs from which on McNemar's exact test has 80 % power."""
    better, worse, _ = chances(first, second)
    reached = 0
    for n in range(5, 300):
        differ = np.arange(1, n + 1)
        least = stats.binom.ppf(0.025, differ, 0.5)
        least = np.where(stats.binom.cdf(least, differ, 0.5) <= 0.025, least, least - 1)
        shown = stats.binom.cdf(least, differ, worse / (better + worse))
        power = stats.binom.pmf(differ, n, better + worse) @ shown
        reached = reached + 1 if power >= 0.8 else 0
        if reached == 4:
            return n - 3
    raise ValueError("no design of fewer than 300")


def planned(rates: tuple[float, float], kind: Kind) -> dict[str, Any]:
    """Trials and power of a plan of as many pairs as the fixed design has."""
    fixed = (boschloo_pairs if kind == "other" else mcnemar_pairs)(*rates)
    limit = planned_limit(fixed, 0.05 * LOCKED, kind)
    by = decided(fixed, limit, kind, chances(*rates))
    looks = look_pairs(fixed)
    median = next((n for n, chance in zip(looks, by, strict=True) if chance >= 0.5), 2 * fixed)
    return {
        "rates": rates,
        "starts": kind,
        "fixed design": fixed,
        "looks": looks,
        "decided by": [round(float(chance), 4) for chance in by],
        "median": median,
        "median over fixed": median / fixed,
    }


def largest_size() -> tuple[float, str]:
    """Largest chance of a winner between equal candidates in a locked plan, and where."""
    found = (0.0, "")
    for pairs in (8, 12, 20, 27, 32, 45, 51, 80, 120, 121, 160, 200):
        for kind in PLANNED:
            limit = planned_limit(pairs, 0.05 * LOCKED, kind)
            for rate in np.linspace(0.02, 0.5, 25):
                size = float(decided(pairs, limit, kind, equal(kind, rate))[-1])
                found = max(found, (size, f"{pairs} pairs, {kind}, {rate:.2f}"))
    return found


def stopped(rates: tuple[float, float], kind: str, case: int) -> float:
    """Share of planned studies whose interval, at the look where they stop, holds the truth."""
    rng = np.random.default_rng([0, 100 + case])
    plan, held = Plan(pairs=40, locked=True), 0
    interval = None
    for _ in range(STUDIES):
        study = Study(rates, kind, 40, rng)
        for size in look_pairs(40):
            found = read(plan, study.after(size), study.after)
            interval = found.interval
            if found.better:
                break
        truth = rates[1] - rates[0]
        held += interval is not None and interval.low <= truth <= interval.high
    return held / STUDIES


def main() -> None:
    """Measure, print and store."""
    began = time.process_time()
    cases = [(rate, kind) for rate in (0.1, 0.3, 0.5, 0.9) for kind in KINDS]
    equal_ones = {
        f"{rate:g} {kind}": advised(rate, kind, case) for case, (rate, kind) in enumerate(cases)
    }
    print(equal_ones, flush=True)
    plans = [planned(rates, kind) for rates in RATES for kind in PLANNED]
    for plan in plans:
        print(plan, flush=True)
    size, where = largest_size()
    covered = {
        f"{rates} {kind}": stopped(rates, kind, case)
        for case, (rates, kind) in enumerate(
            [(rates, kind) for rates in (*RATES, (0.5, 0.5)) for kind in KINDS[:2]]
        )
    }
    print(where, covered, flush=True)
    report_targets(
        "evaluate_policies",
        [
            Target(
                what="equal candidates, advice followed: a winner, worst case",
                measured=max(equal_ones.values()),
                limit=0.05 + 2 * (0.05 * 0.95 / STUDIES) ** 0.5,
            ),
            Target(
                what="equal candidates, advice followed: a winner, all cases",
                measured=float(np.mean(list(equal_ones.values()))),
                limit=0.05,
            ),
            Target(
                what="median trials over those of a fixed design of 80 % power, worst",
                measured=max(plan["median over fixed"] for plan in plans),
                limit=0.75,
            ),
            Target(
                what="decided by that design's number, least",
                measured=min(plan["decided by"][-1] for plan in plans),
                limit=0.8,
                at_most=False,
            ),
            Target(what="size of a planned study, worst, counted out", measured=size, limit=0.05),
            Target(
                what="interval at the stop, least coverage",
                measured=min(covered.values()),
                limit=0.93,
                at_most=False,
            ),
        ],
        note=f"{STUDIES} studies of each simulated case; seeds [0, case]",
        cpu_seconds=round(time.process_time() - began, 1),
        equal_candidates=equal_ones,
        plans=plans,
        largest_size_at=where,
        coverage=covered,
    )


if __name__ == "__main__":
    main()
