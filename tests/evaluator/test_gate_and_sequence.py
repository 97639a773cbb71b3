"""The gate's worth, reliability, stage funnel, and sequential looking."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from evaluator.errors import UndefinedStatisticError
from evaluator.statistics.calibration import (
    brier_interval,
    calibration_error_interval,
    perfect_forecaster,
)
from evaluator.statistics.funnel import failure_taxonomy, funnel
from evaluator.statistics.gate import (
    Confusion,
    break_even,
    brier,
    brier_of_base_rate,
    cost_curve,
    expected_calibration_error,
    kappa,
    reliability_bins,
)
from evaluator.statistics.intervals import wilson
from evaluator.statistics.sequential import (
    betting_interval,
    capital_log,
    sequence_of,
    stop_or_continue,
)


def table(tp: int, fp: int, fn: int, tn: int) -> Confusion:
    return Confusion(true_positive=tp, false_positive=fp, false_negative=fn, true_negative=tn)


def test_a_gate_pays_until_its_refusals_cost_what_it_avoids() -> None:
    counts = table(5, 1, 2, 4)
    price = break_even(counts)
    assert price == 2
    at, below, above = cost_curve(counts, [price, price / 2, price * 2])
    assert at.with_gate == pytest.approx(at.without_gate)
    assert below.with_gate < below.without_gate
    assert above.with_gate > above.without_gate
    with pytest.raises(UndefinedStatisticError, match="no good plan was refused"):
        break_even(table(5, 1, 0, 4))
    with pytest.raises(UndefinedStatisticError, match="there are no trials"):
        cost_curve(table(0, 0, 0, 0), [1.0])


def test_kappa_by_hand_and_undefined() -> None:
    # Cohen's example form: 20 yes-yes, 5, 10, 15: agreement 0.7, chance 0.5, kappa 0.4.
    assert kappa(table(20, 5, 10, 15)) == pytest.approx(0.4)
    with pytest.raises(UndefinedStatisticError, match="both sides are the same"):
        kappa(table(4, 0, 0, 0))
    assert kappa(table(2, 2, 0, 0)) == 0


def test_reliability_of_a_forecaster_who_is_right_and_of_one_who_is_not() -> None:
    assert brier([1.0, 0.0], [True, False]) == 0
    assert brier([0.5, 0.5], [True, False]) == 0.25 == brier_of_base_rate([True, False])
    assert expected_calibration_error([1.0, 0.0], [False, True]) == 1
    said, happened = [0.05, 0.95, 1.0, 0.1], [False, True, True, True]
    bins = reliability_bins(said, happened)
    assert [(b.low, b.n, b.succeeded) for b in bins] == [(0.0, 1, 0), (0.1, 1, 1), (0.9, 2, 2)]
    # 1/4 x 0.05 + 1/4 x 0.9 + 2/4 x 0.025
    assert expected_calibration_error(said, happened) == pytest.approx(0.25)
    with pytest.raises(UndefinedStatisticError, match="there are no trials"):
        brier([], [])
    with pytest.raises(ValueError, match=r"lies in 0\.\.1"):
        brier([1.2], [True])
    with pytest.raises(ValueError, match="1 probabilities but 2"):
        brier([1.0], [True, False])


def test_a_stage_after_a_failed_one_is_not_reached() -> None:
    trials = [[True, True, True], [True, False, True], [False, True, True], [True, None, True]]
    stages = funnel(trials, ["pick", "carry", "release"])
    assert [(s.reached, s.passed, s.unknown) for s in stages] == [(4, 3, 0), (3, 1, 1), (1, 1, 0)]
    with pytest.raises(ValueError, match="a trial has 1 stages, the task 3"):
        funnel([[True]], ["pick", "carry", "release"])
    with pytest.raises(UndefinedStatisticError, match="no trials with labelled stages"):
        funnel([], ["pick"])


def test_failures_are_counted_most_frequent_first() -> None:
    found = failure_taxonomy([("ik", ""), *[("clearance", "collision")] * 2, ("ik", "")])
    assert [(kind.clause, kind.count) for kind in found] == [("clearance", 2), ("ik", 2)]


def test_all_successes_leave_a_betting_interval_open_upwards() -> None:
    interval = betting_interval(10, 10)
    # KT capital: B(10.5, 0.5) / B(0.5, 0.5) = C(20, 10) / 4^10; low = (that / 20)^(1/10).
    assert interval.low == pytest.approx((math.comb(20, 10) / 4**10 / 20) ** 0.1, abs=1e-12)
    assert interval.high == 1
    assert betting_interval(0, 10).high == pytest.approx(1 - interval.low, abs=1e-12)


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 200).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_a_betting_interval_is_wider_than_one_that_looks_once(count: tuple[int, int]) -> None:
    k, n = count
    anytime, once = betting_interval(k, n), wilson(k, n)
    assert anytime.low <= k / n <= anytime.high
    assert anytime.high - anytime.low > 0.9 * (once.high - once.low)


def test_the_bettors_capital_is_a_martingale_under_the_truth() -> None:
    for n in (1, 5, 12):
        for rate in (0.2, 0.5):
            chances = [math.comb(n, k) * rate**k * (1 - rate) ** (n - k) for k in range(n + 1)]
            mean = sum(c * math.exp(capital_log(k, n, rate)) for k, c in enumerate(chances))
            assert mean == pytest.approx(1, abs=1e-12)


def test_a_sequence_never_widens_and_stops_when_the_question_is_answered() -> None:
    with pytest.raises(UndefinedStatisticError, match="there are no trials"):
        stop_or_continue(sequence_of([]), 0.5)
    outcomes = [True, True, False, *[True] * 20]
    looks = [sequence_of(outcomes[:n]) for n in range(1, len(outcomes) + 1)]
    widths = [look.high - look.low for look in looks]
    assert widths == sorted(widths, reverse=True)
    sequence = looks[-1]
    assert stop_or_continue(sequence, 0.5).answer == "above"
    still_open = stop_or_continue(sequence, 0.9)
    assert not still_open.stop
    assert still_open.more_trials is None or still_open.more_trials > 0
    assert stop_or_continue(sequence, 0.999).answer in ("below", "open")


@settings(max_examples=30, deadline=None)
@given(st.lists(st.booleans(), min_size=1, max_size=60))
def test_all_at_once_is_one_by_one(outcomes: list[bool]) -> None:
    looks = [betting_interval(sum(outcomes[:n]), n) for n in range(1, len(outcomes) + 1)]
    low, high = max(look.low for look in looks), min(look.high for look in looks)
    if low > high:
        with pytest.raises(UndefinedStatisticError, match="the rate has changed"):
            sequence_of(outcomes)
        return
    at_once = sequence_of(outcomes)
    assert (at_once.k, at_once.n) == (sum(outcomes), len(outcomes))
    assert (at_once.low, at_once.high) == pytest.approx((low, high), abs=1e-12)


def test_a_rate_that_changes_is_noticed() -> None:
    with pytest.raises(UndefinedStatisticError, match="the rate has changed"):
        sequence_of([True] * 60 + [False] * 200)


def test_a_perfect_forecaster_shows_an_error_over_few_trials() -> None:
    p = (np.arange(20) + 0.5) / 20
    score, error = perfect_forecaster(p.tolist())
    assert score.mean == pytest.approx((p * (1 - p)).mean())
    rng = np.random.default_rng(8)
    drawn = [rng.random(20) < p for _ in range(400)]
    seen = [expected_calibration_error(p.tolist(), y.tolist()) for y in drawn]
    assert error.mean == pytest.approx(np.mean(seen), abs=0.01)
    assert error.mean > 0.15
    inside = np.mean([error.low <= each <= error.high for each in seen])
    assert inside == pytest.approx(0.95, abs=0.04)
    with pytest.raises(UndefinedStatisticError, match="there are no trials"):
        perfect_forecaster([])


def test_the_brier_interval_of_yes_and_no_is_jeffreys() -> None:
    predicted, happened = [1.0] * 10 + [0.0] * 10, [True] * 7 + [False] * 13
    found = brier_interval(predicted, happened)
    low, high = stats.beta(3.5, 17.5).ppf([0.025, 0.975])  # 3 of 20 were wrong
    assert found.low == pytest.approx(low, abs=0.01)
    assert found.high == pytest.approx(high, abs=0.015)


def test_the_interval_of_the_calibration_error_takes_the_noise_out() -> None:
    p = [0.1, 0.4, 0.6, 0.9] * 5
    kept = [False, False, True, True] * 5
    found = calibration_error_interval(p, kept)
    assert found.low == 0.0
    assert found.low <= expected_calibration_error(p, kept) <= found.high
    wrong = calibration_error_interval([0.95] * 60, [False] * 45 + [True] * 15)
    assert wrong.low > 0.5
    assert wrong.low < 0.95 - 0.25 < wrong.high
