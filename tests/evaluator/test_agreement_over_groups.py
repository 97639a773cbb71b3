"""Rank agreement, error and resampling over groups."""

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evaluator.errors import UndefinedStatisticError
from evaluator.statistics import agreement
from evaluator.statistics.bootstrap import (
    GroupSample,
    student_interval,
)

rates = st.lists(st.fractions(0, 1, max_denominator=10), min_size=3, max_size=7)


@settings(max_examples=40, deadline=None)
@given(rates, st.data())
def test_errors_keep_their_order(recorded: list[Fraction], data: st.DataObject) -> None:
    sim = data.draw(st.permutations(recorded))
    absolute = agreement.mean_absolute_error(recorded=recorded, sim=sim)
    assert abs(agreement.bias(recorded=recorded, sim=sim)) <= absolute + 1e-12
    gaps = [abs(s - r) for r, s in zip(recorded, sim, strict=True)]
    assert min(gaps) - 1e-12 <= absolute <= max(gaps) + 1e-12


def test_order_accuracy_counts_ties_of_the_twin_as_half() -> None:
    found = agreement.order_accuracy(recorded=[0.1, 0.2, 0.2, 0.4], sim=[0.5, 0.5, 0.9, 0.7])
    # Pairs that differ when recorded: 5; tied in sim: 1, right: 3 (1-3, 1-4, 2-4), wrong: 3-4.
    assert (found.right, found.pairs) == (Fraction(7, 2), 5)
    assert found.value == pytest.approx(0.7)
    with pytest.raises(UndefinedStatisticError, match="recorded side is constant"):
        agreement.order_accuracy(recorded=[1, 1], sim=[0, 1])


def test_exact_counts_see_ties_that_floats_would_miss() -> None:
    # 3 x 0.1 is not 0.3 as a float; as counts 3/10 of ten and of thirty are the same rate.
    recorded = [Fraction(3, 10), Fraction(9, 30), Fraction(5, 10)]
    sim = [Fraction(1, 10), Fraction(2, 10), Fraction(9, 10)]
    assert agreement.order_accuracy(recorded=recorded, sim=sim).pairs == 2
    assert agreement.mmrv(recorded=recorded, sim=sim) == 0


def test_clusters_are_left_out_together() -> None:
    recorded = [0.1, 0.2, 0.5, 0.6, 0.8, 0.9, 0.3, 0.4]
    sim = [0.3, 0.1, 0.6, 0.7, 1.0, 0.8, 0.4, 0.6]
    sample = GroupSample(recorded=recorded, sim=sim, clusters=list("aabbccdd"))
    gaps = np.subtract(sim, recorded)
    without = [gaps[np.arange(8) // 2 != left].mean() for left in range(4)]
    error = math.sqrt(3 / 4 * float(((without - np.mean(without)) ** 2).sum()))
    found = sample.interval("bias")
    assert (found.high - found.low) / 2 == pytest.approx(3.182446 * error, abs=1e-6)
    assert found.method == "jackknife-clusters"


def test_too_few_units_and_one_that_all_depends_on_are_refused() -> None:
    few = GroupSample(recorded=[0, 1, 1], sim=[0, 1, 0])
    with pytest.raises(UndefinedStatisticError, match="3 units; it needs at least 4"):
        few.interval("bias")
    constant = GroupSample(recorded=[0, 1, 1, 1], sim=[0.1, 0.5, 0.2, 0.3])
    with pytest.raises(UndefinedStatisticError, match="undefined when one unit is left out"):
        constant.interval("pearson")


def test_student_gives_no_interval_of_no_width() -> None:
    with pytest.raises(UndefinedStatisticError, match="all 3 values are the same"):
        student_interval([Fraction(1, 3)] * 3)
    with pytest.raises(UndefinedStatisticError, match="2 values"):
        student_interval([1, 2])
