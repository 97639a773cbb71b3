"""One effect over strata, and a drift over the session, against statsmodels and permutations."""

import numpy as np
import pytest
from statsmodels.stats.contingency_tables import StratifiedTable, Table

from evaluator.compare.rows import TrialRow
from evaluator.compare.session_order import session_order
from evaluator.errors import UndefinedStatisticError
from evaluator.statistics.strata import drift, mantel_haenszel

TABLES = [(3, 10, 6, 10), (8, 12, 11, 14), (1, 9, 4, 8)]


@pytest.mark.parity
def test_the_test_over_strata_is_that_of_statsmodels() -> None:
    stacked = [np.array([[k2, n2 - k2], [k1, n1 - k1]], dtype=float) for k1, n1, k2, n2 in TABLES]
    reference = StratifiedTable(stacked).test_null_odds(correction=False)
    found = mantel_haenszel(TABLES)
    assert found.p == pytest.approx(reference.pvalue, abs=1e-10)
    assert 0 < found.difference < 0.4


def test_strata_alike_give_their_own_difference_and_easy_tasks_no_effect() -> None:
    assert mantel_haenszel([(2, 10, 5, 10)] * 3).difference == pytest.approx(0.3)
    simpson = [(9, 10, 90, 100), (10, 100, 1, 10)]  # pooled 19/110 against 91/110
    assert mantel_haenszel(simpson).difference == pytest.approx(0.0)
    assert mantel_haenszel(simpson).p == pytest.approx(1.0)
    with pytest.raises(UndefinedStatisticError, match="no stratum has trials in both"):
        mantel_haenszel([(0, 0, 1, 2)])
    with pytest.raises(UndefinedStatisticError, match="ended the same"):
        mantel_haenszel([(2, 2, 3, 3)])


@pytest.mark.parity
def test_a_drift_in_one_stratum_is_the_trend_test_of_statsmodels() -> None:
    outcomes = [False, False, True, False, True, True, False, True, True, True]
    table = np.array([[not y, y] for y in outcomes], dtype=float).T
    scores = np.arange(len(outcomes), dtype=float)
    reference = Table(table, shift_zeros=False).test_ordinal_association(
        np.array([0.0, 1.0]), scores
    )
    assert drift(outcomes, ["a"] * 10).p == pytest.approx(reference.pvalue, abs=1e-10)


def test_a_hard_task_at_the_end_is_no_drift_and_a_wearing_gripper_is() -> None:
    easy, hard = [True, True, True, False] * 5, [False, True, False, False] * 5
    apart = drift(easy + hard, ["easy"] * 20 + ["hard"] * 20)
    assert apart.p > 0.3
    assert drift(easy + hard, ["all"] * 40).p < 0.05
    worn = drift([True] * 18 + [False] * 2 + [True] * 4 + [False] * 16, ["a", "b"] * 20)
    assert worn.p < 0.001
    assert worn.change < -0.5


def test_no_drift_is_found_as_often_as_the_level_says() -> None:
    rng = np.random.default_rng(3)
    p = [
        drift((rng.random(40) < 0.6).tolist(), (["a", "b"] * 20)).p for _ in range(400)
    ]  # fmt: skip
    assert np.mean(np.array(p) <= 0.05) == pytest.approx(0.05, abs=0.03)
    with pytest.raises(UndefinedStatisticError, match="ended differently"):
        drift([True] * 8, ["a"] * 8)


def session(outcomes: list[bool], began_ns: list[int] | None = None) -> list[TrialRow]:
    return [
        TrialRow(
            episode=f"trial_{place}",
            task="stack",
            condition="with_replanning" if place % 2 else "without_replanning",
            policy="act",
            start_id=str(place // 2),
            cell="lab",
            stand_in=False,
            recorded=outcome,
            began_ns=0 if began_ns is None else began_ns[place],
        )
        for place, outcome in enumerate(outcomes)
    ]


def test_a_session_is_laid_out_by_when_its_trials_were_recorded() -> None:
    worn = [True] * 12 + [False] * 12
    measurements, (table,) = session_order(session(worn))
    found = {each.id: each.value for each in measurements}
    assert found["session.drift_p"] is not None
    assert found["session.drift_p"] < 0.001
    rows = [dict(zip(table.columns, row, strict=True)) for row in table.rows]
    assert sum(row["n"] for row in rows) == 24  # type: ignore[misc]
    assert sum(row["k"] for row in rows) == 12  # type: ignore[misc]
    assert rows[0]["rate"] == 1.0
    assert rows[-1]["rate"] == 0.0
    backwards, _ = session_order(session(worn, began_ns=list(range(24, 0, -1))))
    assert backwards[0].value == pytest.approx(-(measurements[0].value or 0))


def test_few_trials_have_no_order_and_equal_ones_no_drift() -> None:
    assert session_order(session([True] * 7)) == ([], ())
    measurements, tables = session_order(session([True] * 10))
    assert measurements[0].value is None
    assert measurements[0].reason_if_undefined
    assert "ended differently" in measurements[0].reason_if_undefined
    assert tables
