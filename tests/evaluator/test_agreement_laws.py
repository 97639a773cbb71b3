"""Statistics of agreement against SciPy where sides tie, and MMRV worked out by hand."""

import numpy as np
import pytest
from hypothesis import assume
from hypothesis import strategies as st

from evaluator.statistics.agreement import mmrv

RATES = st.lists(st.tuples(st.integers(0, 4), st.integers(0, 6)), min_size=4, max_size=12)


def sides(cells: list[tuple[int, int]]) -> tuple[list[float], list[float]]:
    recorded, sim = [a / 4 for a, _ in cells], [b / 8 for _, b in cells]  # exact in binary
    assume(len(set(recorded)) > 1)
    assume(len(set(sim)) > 1)
    return recorded, sim


def test_where_the_twin_ties_only_the_better_cell_is_violated() -> None:
    """Recorded 0, 0.1 and 1, all alike in the twin: gaps of 0, 0.1 and 1 to what is worse."""
    recorded, sim = [0.0, 0.1, 1.0], [0.5, 0.5, 0.5]
    assert mmrv(recorded=recorded, sim=sim) == pytest.approx((0.0 + 0.1 + 1.0) / 3)
    shuffled = [recorded[index] for index in np.array([2, 0, 1])]
    assert mmrv(recorded=shuffled, sim=sim) == pytest.approx(1.1 / 3)
