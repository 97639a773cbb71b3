"""The gate's worth, reliability, and the stage funnel."""

import numpy as np
import pytest
from scipy import stats

from evaluator.errors import UndefinedStatisticError
from evaluator.statistics.calibration import (
    brier_interval,
    perfect_forecaster,
)
from evaluator.statistics.funnel import failure_taxonomy, funnel
from evaluator.statistics.gate import (
    Confusion,
    break_even,
    brier,
    brier_of_base_rate,
    cost_curve,
    kappa,
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


def test_a_perfect_forecaster_shows_what_its_own_outcomes_would() -> None:
    p = (np.arange(20) + 0.5) / 20
    score = perfect_forecaster(p.tolist())
    assert score.mean == pytest.approx((p * (1 - p)).mean())
    rng = np.random.default_rng(8)
    drawn = [rng.random(20) < p for _ in range(400)]
    seen = [brier(p.tolist(), y.tolist()) for y in drawn]
    inside = np.mean([score.low <= each <= score.high for each in seen])
    assert inside == pytest.approx(0.95, abs=0.04)
    with pytest.raises(UndefinedStatisticError, match="there are no trials"):
        perfect_forecaster([])


def test_the_brier_interval_of_yes_and_no_is_jeffreys() -> None:
    predicted, happened = [1.0] * 10 + [0.0] * 10, [True] * 7 + [False] * 13
    found = brier_interval(predicted, happened)
    low, high = stats.beta(3.5, 17.5).ppf([0.025, 0.975])  # 3 of 20 were wrong
    assert found.low == pytest.approx(low, abs=0.01)
    assert found.high == pytest.approx(high, abs=0.015)
