"""The gain over paired starts, looked at after every pair."""

import math
from functools import lru_cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import optimize

from evaluator.errors import UndefinedStatisticError
from evaluator.statistics.differences import tango_difference
from evaluator.statistics.intervals import ImpossibleCountError
from evaluator.statistics.sequential import (
    pairs_advice,
    pairs_capital_log,
    pairs_sequence,
)

tables = st.tuples(st.integers(0, 15), st.integers(0, 15), st.integers(0, 15)).filter(
    lambda counts: sum(counts) > 0
)


@lru_cache
def one_look(improved: int, worsened: int, n: int) -> tuple[float, float]:
    """The differences not refuted by these counts alone, by a general root finder."""

    def excess(difference: float) -> float:
        return pairs_capital_log(improved, worsened, n, difference) - math.log(20)

    def end(outside: float) -> float:
        if excess(outside) < 0:
            return outside
        return float(optimize.bisect(excess, (improved - worsened) / n, outside, xtol=1e-13))

    return end(-1.0), end(1.0)


def best_log_likelihood(counts: tuple[int, int, int], d: float) -> float:
    """Largest log likelihood of three outcomes with a given difference, by a general optimiser."""
    improved, worsened, same = counts

    def minus(p: float) -> float:
        terms = ((improved, p), (worsened, p - d), (same, 1 - 2 * p + d))
        return -sum(k * math.log(max(chance, 1e-300)) for k, chance in terms if k)

    low, high = max(0.0, d), (1 + d) / 2
    found = optimize.minimize_scalar(
        minus, bounds=(low, high), method="bounded", options={"xatol": 1e-13}
    )
    return -min(float(found.fun), minus(low), minus(high))


@given(tables, st.floats(-0.95, 0.95))
def test_the_chances_that_fit_best_are_those_of_a_general_optimiser(
    counts: tuple[int, int, int], d: float
) -> None:
    improved, worsened, _ = counts
    n = sum(counts)
    mixture = sum(math.lgamma(k + 0.5) - math.lgamma(0.5) for k in counts)
    mixture -= math.lgamma(n + 1.5) - math.lgamma(1.5)
    mine = pairs_capital_log(improved, worsened, n, d)
    assert mine == pytest.approx(mixture - best_log_likelihood(counts, d), abs=1e-6)


def test_the_bettors_capital_is_no_more_than_a_martingale_under_the_truth() -> None:
    """Its mean over all outcomes is at most 1 when the difference is the true one."""
    n, p, q = 8, 0.3, 0.2
    total = 0.0
    for b in range(n + 1):
        for c in range(n + 1 - b):
            ways = math.factorial(n) / math.prod(map(math.factorial, (b, c, n - b - c)))
            chance = ways * p**b * q**c * (1 - p - q) ** (n - b - c)
            total += chance * math.exp(pairs_capital_log(b, c, n, p - q))
    assert total <= 1


@settings(max_examples=40)
@given(st.lists(st.sampled_from((-1, 0, 1)), min_size=1, max_size=12))
def test_a_sequence_is_all_that_every_look_leaves_and_mirrors_when_conditions_swap(
    changes: list[int],
) -> None:
    looks = [
        one_look(changes[:n].count(1), changes[:n].count(-1), n) for n in range(1, len(changes) + 1)
    ]
    low, high = max(low for low, _ in looks), min(high for _, high in looks)
    try:
        found = pairs_sequence(changes)
    except UndefinedStatisticError:
        assert low > high - 1e-9
        return
    assert (found.low, found.high) == pytest.approx((low, high), abs=1e-9)
    swapped = pairs_sequence([-change for change in changes])
    assert (swapped.low, swapped.high) == pytest.approx((-found.high, -found.low), abs=1e-9)


def test_looking_at_any_time_costs_width() -> None:
    (low, high), once = one_look(9, 2, 30), tango_difference(9, 2, 30)
    assert low < once.low < once.high < high


@pytest.mark.parametrize(("better", "worse"), [(0.3, 0.3), (0.5, 0.1), (0.05, 0.0)])
def test_a_true_gain_is_hardly_ever_lost_at_any_time(better: float, worse: float) -> None:
    rng = np.random.default_rng(8)
    lost, paths, ruin = 0, 200, math.log(20)
    known: dict[tuple[int, int, int], bool] = {}
    for _ in range(paths):
        b = c = 0
        for n, draw in enumerate(rng.random(60), start=1):
            b, c = b + int(draw < better), c + int(better <= draw < better + worse)
            if (b, c, n) not in known:
                known[b, c, n] = pairs_capital_log(b, c, n, better - worse) > ruin
            if known[b, c, n]:
                lost += 1
                break
    assert lost / paths <= 0.05


def test_a_sequence_narrows_and_says_when_to_stop() -> None:
    changes = [1, 0, 1, 1, 0, 1, 1, 0]
    found = pairs_sequence(changes)
    low, high = one_look(5, 0, 8)
    assert found.low >= low - 1e-9
    assert found.high <= high + 1e-9
    advice = pairs_advice(changes, found)
    assert not advice.stop
    assert advice.more_trials is not None
    more = changes + [1, 1, 0, 1, 1, 0, 1, 1] * 3
    later = pairs_sequence(more)
    assert pairs_advice(more, later).answer == "above"
    assert pairs_advice([-c for c in more], pairs_sequence([-c for c in more])).answer == "below"


def test_pairs_without_a_difference_have_no_end_in_sight() -> None:
    changes = [1, -1, 0, 0]
    advice = pairs_advice(changes, pairs_sequence(changes))
    assert (advice.stop, advice.more_trials) == (False, None)


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(UndefinedStatisticError, match="there are no pairs"):
        pairs_sequence([])
    with pytest.raises(ImpossibleCountError):
        pairs_capital_log(3, 2, 4, 0.0)
    with pytest.raises(UndefinedStatisticError, match="no constant difference fits"):
        pairs_sequence([1] * 60 + [-1] * 120)
