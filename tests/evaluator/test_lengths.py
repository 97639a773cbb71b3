"""Intervals of lengths: the median's holds for any distribution."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import quantile_test

from evaluator.errors import UndefinedStatisticError
from evaluator.statistics.intervals import cluster_means, median_interval, median_rank


@pytest.mark.parametrize(
    ("n", "rank"), [(5, 0), (6, 1), (8, 1), (9, 2), (10, 2), (20, 6), (100, 40)]
)
def test_ranks_are_those_of_the_tables(n: int, rank: int) -> None:
    # Sign-test ranks at 5 %, two-sided: Conover, Practical Nonparametric Statistics, table A3.
    assert median_rank(n) == rank


@pytest.mark.parametrize("n", range(6, 60))
def test_the_interval_is_no_wider_than_scipys(n: int) -> None:
    values = np.random.default_rng(n).lognormal(size=n)
    ours = median_interval(values.tolist())
    theirs = quantile_test(values, q=0, p=0.5).confidence_interval(0.95)
    assert theirs.low <= ours.low <= ours.high <= theirs.high


@settings(max_examples=30)
@given(st.lists(st.floats(0, 100), min_size=6, max_size=60))
def test_a_rising_function_moves_the_interval_with_it(values: list[float]) -> None:
    plain, doubled = median_interval(values), median_interval([2 * value + 1 for value in values])
    assert doubled.low == pytest.approx(2 * plain.low + 1)
    assert doubled.high == pytest.approx(2 * plain.high + 1)
    assert plain.low <= np.median(values) <= plain.high


def test_five_values_have_no_median_interval() -> None:
    with pytest.raises(UndefinedStatisticError, match="5 values; at 95 % it needs at least 6"):
        median_interval([1.0] * 5)


def test_clusters_count_once_each() -> None:
    assert cluster_means([1.0, 3.0, 10.0], ["a", "a", "b"]) == [2.0, 10.0]
    assert cluster_means([], []) == []
