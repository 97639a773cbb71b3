"""Laws and known answers of the statistics; undefined is raised with its reason."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evaluator.errors import UndefinedStatisticError
from evaluator.statistics import agreement
from evaluator.statistics.gate import Confusion, phi
from evaluator.statistics.intervals import ImpossibleCountError, relative_gain, wilson

counts = st.integers(1, 200).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n)))
rates = st.lists(st.fractions(0, 1, max_denominator=20), min_size=3, max_size=8)


@settings(max_examples=40, deadline=None)
@given(counts)
def test_an_interval_holds_its_rate_and_mirrors(count: tuple[int, int]) -> None:
    k, n = count
    interval = wilson(k, n)
    assert 0 <= interval.low <= k / n <= interval.high <= 1
    assert interval.high > interval.low  # never of zero width, also at 0/n and n/n
    assert wilson(n - k, n).low == pytest.approx(1 - interval.high, abs=1e-9)


def test_rates_of_nothing_and_impossible_counts_are_refused() -> None:
    with pytest.raises(UndefinedStatisticError, match="no trials"):
        wilson(0, 0)
    with pytest.raises(ImpossibleCountError, match="11 successes of 10"):
        wilson(11, 10)


def test_a_relative_gain_from_zero_is_undefined() -> None:
    assert relative_gain(0.4, 0.8) == pytest.approx(1.0)
    with pytest.raises(UndefinedStatisticError, match="the rate before is 0"):
        relative_gain(0.0, 0.8)


def test_confusion_counts_said_against_happened() -> None:
    pairs = [(True, True), (True, False), (True, False), (False, True), (False, False)]
    found = Confusion.of(pairs)
    assert (found.true_positive, found.false_positive) == (1, 2)
    assert (found.false_negative, found.true_negative) == (1, 1)
    assert (found.n, found.agreed, found.predicted_success) == (5, 2, 3)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.booleans(), st.booleans()), min_size=2, max_size=40))
def test_phi_is_pearsons_r_of_the_two_columns(pairs: list[tuple[bool, bool]]) -> None:
    said, happened = np.array(pairs, dtype=float).T
    table = Confusion.of(pairs)
    if said.std() == 0 or happened.std() == 0:
        with pytest.raises(UndefinedStatisticError, match="side is the same in all"):
            phi(table)
    else:
        assert phi(table) == pytest.approx(np.corrcoef(said, happened)[0, 1], abs=1e-12)


@settings(max_examples=40, deadline=None)
@given(rates, st.data())
def test_r_does_not_care_about_order_or_scale(
    recorded: list[Fraction], data: st.DataObject
) -> None:
    sim = data.draw(st.permutations(recorded))
    try:
        r = agreement.pearson(recorded, sim)
    except UndefinedStatisticError:
        assert len(set(recorded)) == 1
        return
    assert -1 <= r <= 1
    assert agreement.pearson(sim, recorded) == pytest.approx(r, abs=1e-9)
    assert agreement.pearson(recorded, [v / 2 for v in sim]) == pytest.approx(r, abs=1e-9)


def test_r_of_two_points_and_of_a_constant_side_is_refused() -> None:
    with pytest.raises(UndefinedStatisticError, match="2 groups; it needs at least 3"):
        agreement.pearson([0.1, 0.2], [0.3, 0.4])
    with pytest.raises(UndefinedStatisticError, match="twin rate is 1 in all 3"):
        agreement.pearson([0.1, 0.2, 0.3], [1, 1, 1])


@settings(max_examples=40, deadline=None)
@given(rates)
def test_a_perfect_twin_violates_no_rank(recorded: list[Fraction]) -> None:
    assert agreement.mmrv(recorded=recorded, sim=recorded) == 0
    assert agreement.bias(recorded=recorded, sim=recorded) == 0


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.integers(0, 13), min_size=4, max_size=7, unique=True),
    st.fractions(-1, 1, max_denominator=9),
)
def test_rates_on_a_line_correlate_exactly(counts: list[int], slope: Fraction) -> None:
    recorded = [Fraction(k, 13) for k in counts]
    sim = [slope * rate + Fraction(1, 3) for rate in recorded]
    if slope == 0:
        with pytest.raises(UndefinedStatisticError, match=r"twin rate is .* in all"):
            agreement.pearson(recorded, sim)
        return
    r = agreement.pearson(recorded, sim)
    assert r == (1 if slope > 0 else -1)  # 0.9999999999999998 had an interval of no width


def test_a_single_trial_leaves_the_rate_all_but_open() -> None:
    for k in (0, 1):
        interval = wilson(k, 1)
        assert (interval.low, interval.high)[k] == k
        assert interval.high - interval.low > 0.75
