"""Student's interval is SciPy's."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from evaluator.statistics.bootstrap import student_interval


@given(st.integers(0, 10**6), st.integers(3, 40), st.sampled_from([0.8, 0.95, 0.99]))
def test_students_interval_is_that_of_scipy(seed: int, count: int, level: float) -> None:
    values = np.random.default_rng(seed).normal(0.3, 0.1, count)
    found = student_interval(values.tolist(), level=level)
    expected = stats.t.interval(level, count - 1, loc=values.mean(), scale=stats.sem(values))
    assert (found.low, found.high) == pytest.approx(expected, rel=1e-9)
