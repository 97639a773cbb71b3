"""The twin's answers beside forecasts without a twin, over the same trials."""

from collections.abc import Sequence

import pytest

from evaluator.compare.baselines import GEOMETRIC_RULE, RuleSummary, baseline_results, with_rule
from evaluator.compare.rows import TrialRow
from evaluator.compare.success import WITHOUT
from evaluator.result import Measurement
from evaluator.statistics.differences import paired_points


def trial(
    number: int,
    recorded: bool,
    twin: bool | None,
    rule: bool | None,
    *,
    task: str = "cube_into_box",
) -> TrialRow:
    """One trial without replanning; the rule may be unknown."""
    return TrialRow(
        episode=f"trial_{number:04d}",
        task=task,
        condition=WITHOUT,
        policy="nominal",
        start_id=None,
        cell="cell",
        stand_in=True,
        recorded=recorded,
        sim_planned=twin,
        verdict=twin,
        baselines=() if rule is None else ((GEOMETRIC_RULE, rule),),
    )


def study() -> list[TrialRow]:
    """60 trials: the twin is right in 50, the rule in 40; 15 only the twin, 5 only the rule."""
    made = []
    for count, twin_right, rule_right in (
        (35, True, True),
        (15, True, False),
        (5, False, True),
        (5, False, False),
    ):
        for k in range(count):
            outcome = k % 2 == 0
            made.append((outcome, outcome == twin_right, outcome == rule_right))
    return [
        trial(number, *answers, task="stack" if number % 3 else "push")
        for number, answers in enumerate(made)
    ]


def by_id(measurements: Sequence[Measurement]) -> dict[str, Measurement]:
    return {m.id: m for m in measurements}


def test_the_paired_difference_counts_the_trials_only_one_got_right() -> None:
    found = by_id(baseline_results(study()))
    gain = found["baseline.sim_planned.geometric_rule.twin_gain_pp"]
    expected = paired_points(15, 5, 60)[1]
    assert gain.value == pytest.approx(100 * 10 / 60)
    assert (gain.interval.low, gain.interval.high) == pytest.approx((expected.low, expected.high))
    accuracy = found["baseline.sim_planned.geometric_rule.rate"]
    assert (accuracy.k, accuracy.n) == (40, 60)


def test_always_yes_is_right_as_often_as_trials_succeed() -> None:
    rows = study()
    succeeded = sum(row.recorded for row in rows)
    base = by_id(baseline_results(rows))["baseline.sim_planned.base_rate"]
    assert (base.k, base.n) == (succeeded, 60)


def test_both_are_judged_over_the_trials_where_both_spoke() -> None:
    rows = [trial(0, True, True, True), trial(1, True, True, None), trial(2, False, None, False)]
    found = by_id(baseline_results(rows))
    assert found["baseline.sim_planned.geometric_rule.rate"].n == 1
    assert found["baseline.sim_planned.base_rate"].n == 2


def test_a_run_without_the_rules_answers_still_names_its_base_rate() -> None:
    found = by_id(baseline_results([trial(0, True, True, None)]))
    assert found["baseline.sim_planned.base_rate"].value == 1.0
    assert not any(GEOMETRIC_RULE.replace(" ", "_") in key for key in found)


def test_without_answers_of_the_twin_nothing_is_compared() -> None:
    assert baseline_results([trial(0, True, None, True)]) == []


def test_the_rule_enters_the_row_of_its_trial_only() -> None:
    rows = [trial(0, True, True, None), trial(1, True, True, None)]
    plain, judged = with_rule(rows, [RuleSummary(episode="trial_0001", value=False)])
    assert plain == rows[0]
    assert judged.baselines == ((GEOMETRIC_RULE, False),)
    unknown = [RuleSummary(episode="trial_0001", value=None)]
    assert with_rule(rows, unknown) == rows
