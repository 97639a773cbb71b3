"""Rank agreement, error and resampling over groups."""

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evaluator.cache import SummaryCache
from evaluator.compare import compare_csv
from evaluator.compare.agreement import group_agreement
from evaluator.statistics import agreement, gap_model

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


def test_a_run_draws_populations_once_and_other_counts_change_the_model(
    tmp_path: Path, write_table: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    head, counts = "policy,real,sim\n", "A,2/9,3/9\nB,5/9,4/9\nC,7/9,8/9\nD,1/9,1/9\n"
    tables = (head + counts, head + counts.replace("5/9", "6/9"))
    groups, others = (compare_csv(write_table(table)).groups for table in tables)
    alone = [group_agreement(each) for each in (groups, others)]
    with SummaryCache(tmp_path / "cache") as cache:
        assert group_agreement(groups, cache) == alone[0]
    monkeypatch.setattr(gap_model, "drawn", lambda: pytest.fail("drawn anew"))
    with SummaryCache(tmp_path / "cache") as cache:
        assert [group_agreement(each, cache) for each in (groups, others)] == alone
    assert alone[0][0].interval != alone[1][0].interval
