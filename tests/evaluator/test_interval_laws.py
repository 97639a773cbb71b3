"""Student's interval is SciPy's, and the expanded bootstrap is as wide as it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from evaluator.statistics.bootstrap import expanded_tail, student_interval


@given(st.integers(0, 10**6), st.integers(3, 40), st.sampled_from([0.8, 0.95, 0.99]))
def test_students_interval_is_that_of_scipy(seed: int, count: int, level: float) -> None:
    values = np.random.default_rng(seed).normal(0.3, 0.1, count)
    found = student_interval(values.tolist(), level=level)
    expected = stats.t.interval(level, count - 1, loc=values.mean(), scale=stats.sem(values))
    assert (found.low, found.high) == pytest.approx(expected, rel=1e-9)


@given(st.integers(4, 200), st.floats(0.001, 0.2))
def test_the_expanded_tail_makes_up_for_what_the_bootstrap_is_too_narrow(
    num_units: int, tail: float
) -> None:
    """Resampled means spread sqrt((n - 1) / n) times too little (Hesterberg 2015, section 4.4)."""
    narrow = np.sqrt((num_units - 1) / num_units)
    reached = stats.norm.ppf(expanded_tail(tail, num_units)) * narrow
    assert reached == pytest.approx(stats.t.ppf(tail, num_units - 1), rel=1e-6)
