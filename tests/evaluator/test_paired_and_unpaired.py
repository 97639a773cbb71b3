"""Laws and known answers of paired and unpaired comparisons, and of power."""

from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from bridge.exchange.table_text import TableOptions
from evaluator.compare.spreadsheet import compare_csv
from evaluator.errors import UndefinedStatisticError
from evaluator.report.front import front
from evaluator.statistics.differences import (
    boschloo,
    guaranteed_difference,
    mean_of_intervals,
    newcombe_difference,
    sign_test,
    tango_difference,
)
from evaluator.statistics.intervals import ImpossibleCountError, jeffreys, wilson
from evaluator.statistics.power import (
    detectable_rate,
    power_paired,
    trials_needed,
)

pairs = st.integers(1, 40).flatmap(
    lambda n: st.tuples(st.integers(0, n), st.just(n)).flatmap(
        lambda t: st.tuples(st.just(t[0]), st.integers(0, t[1] - t[0]), st.just(t[1]))
    )
)


@settings(max_examples=60, deadline=None)
@given(pairs)
def test_tango_holds_the_difference_mirrors_and_is_never_of_no_width(
    counts: tuple[int, int, int],
) -> None:
    improved, worsened, n = counts
    interval = tango_difference(improved, worsened, n)
    difference = (improved - worsened) / n
    assert -1 <= interval.low <= difference + 1e-12
    assert difference - 1e-12 <= interval.high <= 1
    assert interval.high > interval.low
    mirrored = tango_difference(worsened, improved, n)
    assert mirrored.low == pytest.approx(-interval.high, abs=1e-12)
    wider = tango_difference(improved, worsened, n, level=0.99)
    assert wider.low <= interval.low + 1e-12
    assert wider.high >= interval.high - 1e-12


def test_tango_without_any_change_is_the_score_interval_of_nothing() -> None:
    # With no discordant pair the end is z^2 / (n + z^2): Wilson's of 0/n.
    interval = tango_difference(0, 0, 20)
    assert interval.high == pytest.approx(wilson(0, 20).high, abs=1e-12)
    assert interval.low == pytest.approx(-interval.high, abs=1e-12)


def test_pairs_that_cannot_be_are_refused() -> None:
    with pytest.raises(UndefinedStatisticError, match="there are no pairs"):
        tango_difference(0, 0, 0)
    with pytest.raises(ImpossibleCountError, match="6 successes of 5"):
        tango_difference(4, 2, 5)


def test_the_sign_test_counts_with_whole_numbers() -> None:
    assert sign_test(4, 0) == (0.125, 0.0625)
    assert sign_test(0, 4) == (0.125, 0.0625)
    assert sign_test(3, 3)[0] == 1.0
    # 2000 pairs: 2^-2000 is no float, the ratio of whole numbers is right all the same.
    assert 0 < sign_test(1060, 940)[0] < 0.01


def test_jeffreys_reaches_the_ends_where_it_must() -> None:
    assert jeffreys(0, 10).low == 0
    assert jeffreys(10, 10).high == 1
    assert jeffreys(3, 10).low < 0.3 < jeffreys(3, 10).high


@pytest.mark.parametrize("table", [(15, 90, 31, 100), (3, 200, 2, 7), (99, 100, 70, 80)])
def test_boschloo_leaves_out_nothing_that_counts(table: tuple[int, int, int, int]) -> None:
    k1, n1, k2, n2 = table
    expected = stats.boschloo_exact([[k1, k2], [n1 - k1, n2 - k2]], n=16).pvalue
    # SciPy looks at few rates; ours may only be larger, where it looked between them.
    assert boschloo(*table) == pytest.approx(expected, rel=2e-2)
    assert boschloo(*table) > expected * (1 - 1e-6)


def test_boschloo_of_rates_worlds_apart_is_hardly_above_nothing() -> None:
    assert 0 <= boschloo(100, 1667, 1500, 1667) < 1e-300


def test_boschloo_of_what_cannot_be_counted_out_says_so() -> None:
    with pytest.raises(UndefinedStatisticError, match="more than 4000000 tables"):
        boschloo(1, 3000, 2, 3000)
    with pytest.raises(UndefinedStatisticError, match="no trials"):
        boschloo(0, 0, 1, 2)


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 30), st.data())
def test_the_guaranteed_difference_holds_newcombes_centre(n: int, data: st.DataObject) -> None:
    first, second = data.draw(st.integers(0, n)), data.draw(st.integers(0, n))
    wide = guaranteed_difference(first, n, second, n)
    assert wide.low <= (second - first) / n <= wide.high
    assert wide.high - wide.low >= newcombe_difference(first, n, second, n).high - (
        newcombe_difference(first, n, second, n).low
    )


@pytest.mark.parametrize(
    ("first", "second", "needed"),
    [(0.4, 0.8, 23), (0.55, 0.8, 54), (0.6, 0.8, 82), (0.8, 0.9, 199), (0.5, 0.6, 388)],
)
def test_trials_needed_are_those_of_the_design_page(
    first: float, second: float, needed: int
) -> None:
    assert trials_needed(first, second) == needed
    assert trials_needed(second, first) == needed


def test_ten_trials_show_little() -> None:
    assert detectable_rate(0.4, 23) == pytest.approx(0.795, abs=0.005)
    with pytest.raises(UndefinedStatisticError, match="not even a rate of 100 %"):
        detectable_rate(0.9, 10)
    with pytest.raises(UndefinedStatisticError, match="the rates are equal"):
        trials_needed(0.5, 0.5)


def test_paired_power_by_hand_and_in_the_limit() -> None:
    # Six pairs that all differ, always for the better: 2 / 2^6 = 0.03 is significant.
    assert power_paired(1.0, 0.0, 6) == pytest.approx(1.0)
    assert power_paired(1.0, 0.0, 5) == 0.0
    # Under no effect the exact test is conservative.
    assert power_paired(0.2, 0.2, 60) < 0.05
    with pytest.raises(UndefinedStatisticError, match="no probabilities"):
        power_paired(0.0, 0.0, 10)


def test_trials_of_either_side_of_two_policies_have_a_bias_with_its_interval(
    write_table: Callable[[str], Path],
) -> None:
    counts = {"a": ((14, 20), (150, 200)), "b": ((9, 20), (109, 200))}
    rows = [
        f"place,{policy},{side},{'success' if number < k else 'failure'}"
        for policy, sides in counts.items()
        for side, (k, n) in zip(("real", "sim"), sides, strict=True)
        for number in range(n)
    ]
    path = write_table("\n".join(["task,policy,side,result", *rows]))
    found = compare_csv(path, options=TableOptions(map="outcome=result"))
    table = next(table for table in found.tables if table.id == "conclusions")
    line = dict(zip(table.columns, table.rows[0], strict=True))
    each = [newcombe_difference(*real, *sim) for real, sim in counts.values()]
    wanted = mean_of_intervals([0.05, 0.095], each)
    assert line["bias (pp)"] == pytest.approx(7.25)
    assert (line["low"], line["high"]) == pytest.approx(
        (100 * wanted.low, 100 * wanted.high), abs=0.05
    )
    sides = ("sim_planned", "verdict", "sim_executed")
    assert not any(text.startswith(sides) for text in found.missing)
    said = front(found.results())
    assert "without an interval" not in said.summary + said.tasks[0][1]
