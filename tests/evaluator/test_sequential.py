"""The sequential comparison: what it counts out, against enumeration, SciPy and simulation."""

import math
from itertools import islice, product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import optimize, stats

from evaluator.errors import UndefinedStatisticError
from evaluator.statistics.sequential import (
    Evidence,
    Plan,
    Stratum,
    chances,
    decided,
    equal,
    look_pairs,
    pairs_for_power,
    plan_power,
    planned_limit,
)


@pytest.mark.parametrize(("kind", "rates"), [("other", (0.3, 0.7)), ("shared", (0.6, 0.6))])
def test_every_course_of_a_short_study_is_counted_out(
    kind: str, rates: tuple[float, float]
) -> None:
    """Against all 4^6 courses of six pairs, one after another."""
    p, q = rates
    found = 0.0
    for course in product([(a, b) for a in (0, 1) for b in (0, 1)], repeat=6):
        chance = math.prod([(p if a else 1 - p) * (q if b else 1 - q) for a, b in course])
        for look in look_pairs(6):
            k, j = (sum(side) for side in zip(*course[:look], strict=True))
            differ = sum(a != b for a, b in course[:look])
            rate = (k + j) / (2 * look)
            variance = differ if kind == "shared" else 2 * look * rate * (1 - rate)
            if variance and (j - k) ** 2 >= 1.9**2 * variance * 6 / look - 1e-9:
                found += chance
                break
    assert decided(6, 1.9, kind, chances(p, q))[-1] == pytest.approx(found, abs=1e-9)  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", ["other", "shared"])
@pytest.mark.parametrize("pairs", [9, 27, 60, 150])
def test_equal_candidates_get_a_winner_as_rarely_as_promised(kind: str, pairs: int) -> None:
    limit = planned_limit(pairs, 0.049, kind)
    rates = np.linspace(0.01, 0.5, 60)
    sizes = [decided(pairs, limit, kind, equal(kind, rate))[-1] for rate in rates]  # type: ignore[arg-type]
    assert max(sizes) <= 0.0505
    if pairs <= 60:
        tighter = [decided(pairs, limit - 0.15, kind, equal(kind, r))[-1] for r in rates]  # type: ignore[arg-type]
        assert max(tighter) > 0.049


def test_power_is_that_of_simulated_studies() -> None:
    pairs = pairs_for_power(chances(0.4, 0.8, 0.2))
    rng = np.random.default_rng(5)
    better, worse, both = chances(0.4, 0.8, 0.2)
    kinds = rng.choice(4, p=[better, worse, both, 1 - better - worse - both], size=(4000, pairs))
    up, down = (np.cumsum(kinds == kind, axis=1) for kind in (0, 1))
    limit = planned_limit(pairs, 0.049, "shared")
    won = np.zeros(4000, dtype=bool)
    for look in look_pairs(pairs):
        b, c = up[:, look - 1], down[:, look - 1]
        z = (b - c) / np.sqrt(np.maximum(b + c, 1))
        won |= np.abs(z) >= limit * np.sqrt(pairs / look) - 1e-9
    found = plan_power(pairs, chances(0.4, 0.8, 0.2))[-1]
    assert found >= 0.8
    assert won.mean() == pytest.approx(found, abs=0.025)
    with pytest.raises(UndefinedStatisticError, match="the rates are equal"):
        pairs_for_power(chances(0.5, 0.5))


def test_interim_looks_are_dearer_and_extensions_cost_their_share() -> None:
    looks = list(islice(Plan(pairs=20, locked=True).looks("shared"), 8))
    assert [look.pairs for look in looks] == [5, 10, 15, 20, 30, 40, 60, 80]
    limits = [look.limit for look in looks]
    assert limits[:4] == sorted(limits[:4], reverse=True)
    # The extension has one half of what the plan left, each of its two looks half of that.
    assert 2 * stats.norm.sf(looks[4].limit) == pytest.approx(0.05 * 0.01 / 2)


counts = st.integers(1, 40).flatmap(
    lambda n: st.tuples(st.integers(0, n), st.just(n), st.integers(0, n))
)


@settings(max_examples=60, deadline=None)
@given(counts)
def test_an_interval_holds_what_was_found_mirrors_and_says_what_the_score_says(
    count: tuple[int, int, int],
) -> None:
    k, n, j = count
    found = Evidence(strata=(Stratum(first=(k, n), second=(j, n)),))
    mirrored = Evidence(strata=(Stratum(first=(j, n), second=(k, n)),)).interval()
    interval = found.interval()
    assert -1 <= interval.low <= (j - k) / n <= interval.high <= 1
    assert (interval.low, interval.high) == pytest.approx((-mirrored.high, -mirrored.low), abs=1e-6)
    assert interval.high - interval.low > 0
    is_shown = abs(found.z()) > stats.norm.ppf(0.975)
    assert is_shown == (interval.low > 0 or interval.high < 0)


@pytest.mark.parametrize(
    ("k", "n", "j", "m"), [(12, 40, 34, 40), (4, 10, 8, 12), (9, 31, 7, 19), (0, 9, 4, 7)]
)
def test_the_score_interval_ends_where_the_restricted_score_does(
    k: int, n: int, j: int, m: int
) -> None:
    """With the restricted maximum found by a general optimiser (Farrington and Manning 1990)."""
    mine = Evidence(strata=(Stratum(first=(k, n), second=(j, m)),)).interval()
    for d, sign in ((mine.low, 1), (mine.high, -1)):

        def minus_log(p: float, d: float = d) -> float:
            cells = ((k, p), (n - k, 1 - p), (j, p + d), (m - j, 1 - p - d))
            return -sum(count * math.log(max(chance, 1e-300)) for count, chance in cells if count)

        p = optimize.minimize_scalar(
            minus_log,
            bounds=(max(0.0, -d), min(1.0, 1 - d)),
            method="bounded",
            options={"xatol": 1e-12},
        ).x
        error = np.sqrt(p * (1 - p) / n + (p + d) * (1 - p - d) / m)
        assert sign * (j / m - k / n - d) / error == pytest.approx(1.959964, abs=1e-4)


def test_starts_that_overlap_in_part_and_tasks_add_up() -> None:
    shared, other = Stratum(improved=5, worsened=1, pairs=9), Stratum(first=(2, 6), second=(5, 12))
    both = Stratum(improved=5, worsened=1, pairs=9, first=(2, 6), second=(5, 12))
    apart = Evidence(strata=(shared, other))
    assert apart.pairs == pytest.approx(9 + 8)
    assert apart.z() == pytest.approx(Evidence(strata=(both,)).z())
    assert apart.kind == "mixed"
    assert apart.difference == pytest.approx((4 + 8 * (5 / 12 - 1 / 3)) / 17)
    with pytest.raises(UndefinedStatisticError, match="tried by both"):
        _ = Evidence(strata=(Stratum(first=(1, 2)),)).difference
