"""Rank agreement, error and resampling over groups."""

from fractions import Fraction

from hypothesis import given, settings
from hypothesis import strategies as st

from evaluator.statistics import agreement

rates = st.lists(st.fractions(0, 1, max_denominator=10), min_size=3, max_size=7)


@settings(max_examples=40, deadline=None)
@given(rates, st.data())
def test_errors_keep_their_order(recorded: list[Fraction], data: st.DataObject) -> None:
    sim = data.draw(st.permutations(recorded))
    absolute = agreement.mean_absolute_error(recorded=recorded, sim=sim)
    assert abs(agreement.bias(recorded=recorded, sim=sim)) <= absolute + 1e-12
    gaps = [abs(s - r) for r, s in zip(recorded, sim, strict=True)]
    assert min(gaps) - 1e-12 <= absolute <= max(gaps) + 1e-12


def test_exact_counts_see_ties_that_floats_would_miss() -> None:
    # 3 x 0.1 is not 0.3 as a float; as counts 3/10 of ten and of thirty are the same rate.
    recorded = [Fraction(3, 10), Fraction(9, 30), Fraction(5, 10)]
    sim = [Fraction(1, 10), Fraction(2, 10), Fraction(9, 10)]
    assert agreement.mmrv(recorded=recorded, sim=sim) == 0
