"""Laws and known answers of paired and unpaired comparisons, and of power."""

from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bridge.exchange.table_text import TableOptions
from evaluator.compare import compare_csv
from evaluator.errors import UndefinedStatisticError
from evaluator.report.front import front
from evaluator.result import Interval
from evaluator.statistics.differences import paired_points, points_of
from evaluator.statistics.intervals import ImpossibleCountError, wilson
from evaluator.statistics.sequential import Evidence, Stratum


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
