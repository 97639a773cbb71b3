"""Laws and known answers of statistics, comparisons and agreement; undefined has its reason."""

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bridge.exchange.table_text import TableOptions
from evaluator.compare import compare_csv
from evaluator.compare.stages import funnel
from evaluator.errors import UndefinedStatisticError
from evaluator.report.front import front
from evaluator.result import Interval
from evaluator.statistics import agreement
from evaluator.statistics.agreement import mmrv
from evaluator.statistics.differences import paired_points, points_of
from evaluator.statistics.gate import Confusion, kappa, phi
from evaluator.statistics.intervals import ImpossibleCountError, relative_gain, wilson
from evaluator.statistics.sequential import Evidence, Stratum

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


def test_r_of_two_points_and_of_a_constant_side_is_refused() -> None:
    with pytest.raises(UndefinedStatisticError, match="2 groups; it needs at least 3"):
        agreement.pearson([0.1, 0.2], [0.3, 0.4])
    with pytest.raises(UndefinedStatisticError, match="twin rate is 1 in all 3"):
        agreement.pearson([0.1, 0.2, 0.3], [1, 1, 1])


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


def tango_difference(improved: int, worsened: int, n: int, *, level: float = 0.95) -> Interval:
    strata = (Stratum(improved=improved, worsened=worsened, pairs=n),)
    return Evidence(strata=strata).interval(level=level)


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
    assert mirrored.low == pytest.approx(-interval.high, abs=1e-9)
    wider = tango_difference(improved, worsened, n, level=0.99)
    assert wider.low <= interval.low + 1e-9
    assert wider.high >= interval.high - 1e-9


def test_tango_without_any_change_is_the_score_interval_of_nothing() -> None:
    # With no discordant pair the end is z^2 / (n + z^2): Wilson's of 0/n.
    interval = tango_difference(0, 0, 20)
    assert interval.high == pytest.approx(wilson(0, 20).high, abs=1e-9)
    assert interval.low == pytest.approx(-interval.high, abs=1e-9)


def test_pairs_that_cannot_be_are_refused() -> None:
    with pytest.raises(UndefinedStatisticError, match="tried by both"):
        paired_points(0, 0, 0)
    with pytest.raises(ImpossibleCountError, match="6 successes of 5"):
        tango_difference(4, 2, 5)


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
    wanted = points_of([Stratum(first=real, second=sim) for real, sim in counts.values()])[1]
    assert line["bias (pp)"] == pytest.approx(7.25)
    assert (line["low"], line["high"]) == pytest.approx((wanted.low, wanted.high))
    assert line["low"] < 7.25 < line["high"]
    sides = ("sim_planned", "verdict", "sim_executed")
    assert not any(text.startswith(sides) for text in found.missing)
    said = front(found.results())
    assert "without an interval" not in " ".join(
        [*(text for _, text in said.answers), said.tasks[0][1]]
    )


coarse_rates = st.lists(st.fractions(0, 1, max_denominator=10), min_size=3, max_size=7)


@settings(max_examples=40, deadline=None)
@given(coarse_rates, st.data())
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


def test_where_the_twin_ties_only_the_better_cell_is_violated() -> None:
    """Recorded 0, 0.1 and 1, all alike in the twin: gaps of 0, 0.1 and 1 to what is worse."""
    recorded, sim = [0.0, 0.1, 1.0], [0.5, 0.5, 0.5]
    assert mmrv(recorded=recorded, sim=sim) == pytest.approx((0.0 + 0.1 + 1.0) / 3)
    shuffled = [recorded[index] for index in np.array([2, 0, 1])]
    assert mmrv(recorded=shuffled, sim=sim) == pytest.approx(1.1 / 3)


def table(tp: int, fp: int, fn: int, tn: int) -> Confusion:
    return Confusion(true_positive=tp, false_positive=fp, false_negative=fn, true_negative=tn)


def test_kappa_by_hand_and_undefined() -> None:
    # Cohen's example form: 20 yes-yes, 5, 10, 15: agreement 0.7, chance 0.5, kappa 0.4.
    assert kappa(table(20, 5, 10, 15)) == pytest.approx(0.4)
    with pytest.raises(UndefinedStatisticError, match="both sides are the same"):
        kappa(table(4, 0, 0, 0))
    assert kappa(table(2, 2, 0, 0)) == 0


def test_a_stage_after_a_failed_one_is_not_reached() -> None:
    trials = [[True, True, True], [True, False, True], [False, True, True], [True, None, True]]
    stages = funnel(trials, ["pick", "carry", "release"])
    assert [(s.reached, s.passed, s.unknown) for s in stages] == [(4, 3, 0), (3, 1, 1), (1, 1, 0)]
