"""Joint estimates of what failure goes with: against closed forms, and without any signal."""

from typing import Any

import numpy as np
import pytest

from evaluator.compare.rows import TrialRow
from evaluator.compare.sensitivity import holm, sensitivity_table
from evaluator.errors import UndefinedStatisticError
from evaluator.statistics.firth import firth


def test_a_saturated_fit_adds_half_a_trial_to_every_cell() -> None:
    """Of a 2 x 2 table Firth's estimate is the log-odds ratio with 1/2 added to each cell."""
    cells = {(0, 0): 7, (0, 1): 3, (1, 0): 2, (1, 1): 8}
    x = np.array([[1.0, a] for (a, _), count in cells.items() for _ in range(count)])
    y = np.array([float(b) for (_, b), count in cells.items() for _ in range(count)])
    half = {key: count + 0.5 for key, count in cells.items()}
    expected = np.log(half[1, 1] * half[0, 0] / (half[1, 0] * half[0, 1]))
    constant, effect = firth(x, y)
    assert effect.value == pytest.approx(expected, abs=1e-6)
    assert constant.value == pytest.approx(np.log(3.5 / 7.5), abs=1e-6)
    assert effect.low is not None
    assert effect.high is not None
    assert 0 < effect.low < effect.value < effect.high


def test_separation_stays_finite_and_its_interval_reaches_far() -> None:
    x = np.array([[1.0, i % 2] for i in range(12)])
    effect = firth(x, x[:, 1].copy())[1]
    assert effect.value == pytest.approx(2 * np.log(6.5 / 0.5), abs=1e-6)
    assert effect.p < 0.001
    assert effect.high is None or effect.high > 5


def test_what_cannot_be_estimated_is_refused() -> None:
    x = np.array([[1.0, i % 2] for i in range(12)])
    with pytest.raises(UndefinedStatisticError, match="the same in all 12 trials"):
        firth(x, np.ones(12))
    with pytest.raises(UndefinedStatisticError, match="depend on each other"):
        firth(np.column_stack([x, x[:, 1]]), x[:, 1].copy())


def test_an_interval_of_nothing_holds_one_in_most_simulations() -> None:
    """Twenty trials, two factors, no effect: 95 % intervals hold it in nine of ten."""
    rng = np.random.default_rng(0)
    held = found = 0
    for _ in range(15):
        x = np.column_stack([np.ones(20), rng.random(20) < 0.5, rng.normal(size=20)])
        y = (rng.random(20) < 0.4).astype(float)
        if y.min() == y.max() or np.linalg.matrix_rank(x) < 3:
            continue
        for effect in firth(x, y)[1:]:
            found += 1
            low, high = effect.low, effect.high
            held += (low is None or low <= 0) and (high is None or high >= 0)
    assert held / found >= 0.9


def rows_of(failing: str, n: int = 40) -> list[TrialRow]:
    def row(i: int) -> TrialRow:
        light, region = ("dim", "bright")[i % 2], ("near", "far")[i // 2 % 2]
        fails = (light if failing == "light" else region) in ("dim", "far") and i % 5 != 0
        return TrialRow(
            episode=f"t{i}",
            task="cup",
            condition="",
            policy="",
            start_id=None,
            cell="",
            stand_in=None,
            recorded=not fails,
            sim_planned=True,
            tags=(("light", light), ("region", region)),
            start_positions_m={"cup": (0.01 * (i % 7), 0.3, 0.0)},
        )

    return [row(i) for i in range(n)]


def line_of(rows: list[TrialRow], outcome: str, factor: str) -> dict[str, Any]:
    (table,) = sensitivity_table(rows)
    lines = [dict(zip(table.columns, row, strict=True)) for row in table.rows]
    (found,) = [x for x in lines if (x["outcome"], x["factor"]) == (outcome, factor)]
    return found


@pytest.mark.parametrize(("cause", "other"), [("light", "region"), ("region", "light")])
def test_the_factor_that_fails_is_found_and_the_other_is_not(cause: str, other: str) -> None:
    rows = rows_of(cause)
    guilty, innocent = line_of(rows, "failure", cause), line_of(rows, "failure", other)
    assert guilty["p (Holm)"] < 0.01
    assert not 0.5 < guilty["odds ratio"] < 2
    assert innocent["low"] < 1 < innocent["high"]
    # The twin always says yes, so that it disagrees exactly where the robot fails.
    assert line_of(rows, "disagreement", cause)["odds ratio"] == guilty["odds ratio"]
    assert line_of(rows, "failure", "start of cup")["level"] == "x, per 20 mm"


def test_few_trials_claim_nothing() -> None:
    (table,) = sensitivity_table(rows_of("light", n=8))
    assert {row[-1] for row in table.rows} == {"8 trials; a joint estimate needs 10"}
    assert sensitivity_table([]) == ()


def test_holm_multiplies_the_smallest_most() -> None:
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
