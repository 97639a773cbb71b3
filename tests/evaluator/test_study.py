"""A study of replanning: starts by arm, what is not executed, what is void, and the pooled test."""

from dataclasses import replace

import pytest

from bridge.episode.executions import NO_PLAN
from bridge.episode.metadata import EpisodeInfo, Outcome, treatment_of
from evaluator.compare.from_rows import compare_rows
from evaluator.compare.policies import compare_policies
from evaluator.compare.rows import TrialRow
from evaluator.compare.study import retry_table, study_results, study_starts
from evaluator.compare.success import rate_groups, side_rates
from evaluator.compare.tables import success_table
from evaluator.result import Measurement

ARMS = ("without", "with", "control")
CONDITION = {
    "without": "without_replanning",
    "with": "with_replanning",
    "control": "without_replanning",
}


def row(start: int, arm: str, success: bool | None, **more: object) -> TrialRow:
    task = str(more.pop("task", "stack"))
    values: dict[str, object] = {
        "episode": f"{task}_{start}_{arm}",
        "task": task,
        "condition": treatment_of(CONDITION[arm], arm),
        "study_arm": arm,
        "policy": "nominal",
        "start_id": f"{task}/{start}",
        "cell": "standin",
        "stand_in": True,
        "recorded": success,
        "plan_id": "p",
        "num_plans": 1,
        "num_plans_sent": 1,
    }
    return TrialRow(**{**values, **more})  # type: ignore[arg-type]


def study(outcomes: list[tuple[bool, bool, bool]], task: str = "stack") -> list[TrialRow]:
    return [
        row(start, arm, success, task=task)
        for start, results in enumerate(outcomes)
        for arm, success in zip(ARMS, results, strict=True)
    ]


def by_id(rows: list[TrialRow]) -> dict[str, Measurement]:
    return {each.id: each for each in study_results(rows)[0]}


FIRST = study([(False, True, False)] * 6 + [(True, False, True)] * 1 + [(True, True, True)] * 3)
SECOND = study([(False, True, True)] * 3 + [(False, False, False)] * 2, task="push")


@pytest.mark.parametrize(
    "label",
    [
        {"recorded": None, "why_unknown": "nothing executed, no verdict"},
        {"recorded": False, "nothing_executed": True},  # as the stand-in cell labels it
    ],
)
def test_what_was_not_executed_is_a_failure_and_per_protocol_it_is_left_out(
    label: dict[str, object],
) -> None:
    rows = [
        replace(each, plan_id=None, **label)  # type: ignore[arg-type]
        if each.study_arm == "with" and each.start_id == "stack/0"
        else each
        for each in FIRST
    ]
    found, full = by_id(rows), by_id(FIRST)
    answers = compare_policies(rows)
    assert [(each.counts, each.reading.evidence.strata[0].improved) for each in answers] == [
        (((4, 10), (8, 10)), 5)
    ]
    assert found["study.not_executed.with.stack.nominal"].value == pytest.approx(0.1)
    assert full["study.not_executed.with.stack.nominal"].value == 0.0


def test_a_void_trial_takes_its_start_out_of_all_arms() -> None:
    void = replace(FIRST[1], recorded=None, plan_id=None, why_unknown="interrupted")
    starts, left_out = study_starts([FIRST[0], void, *FIRST[2:]])
    assert len(starts) == 9
    assert {each.episode for each in left_out} == {f"stack_0_{arm}" for arm in ARMS}
    assert all("void in all arms" in each.reason for each in left_out)
    starts, _ = study_starts([FIRST[0], void, *FIRST[2:]], void_causes=("power cut",))
    assert len(starts) == 10  # not a cause that was named: a failure of its arm


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda rows: rows[1:], "was not tried in the arms without"),
        (lambda rows: [*rows, rows[0]], "more than once in one arm"),
        (lambda rows: [replace(rows[0], start_id=None), *rows[1:]], "no start_id"),
        (
            lambda rows: [
                replace(rows[0], recorded=None, why_unknown="nobody labelled it"),
                *rows[1:],
            ],
            "was executed, and nobody knows how it ended",
        ),
    ],
)
def test_a_start_that_is_not_whole_is_left_out_with_the_reason(change: object, why: str) -> None:
    _, left_out = study_starts(change(list(FIRST)))  # type: ignore[operator]
    assert why in " ".join(each.reason for each in left_out)


def test_the_control_is_a_group_of_its_own_and_pairs_only_in_the_study() -> None:
    found = compare_rows(FIRST, run="r", source="run", stand_in=True)
    groups = {group.condition: group for group in found.groups}
    assert set(groups) == {"without_replanning", "with_replanning", "control"}
    assert groups["without_replanning"].recorded.n == 10
    ids = [each.id for each in found.measurements]
    assert any(each.startswith("rate.recorded.stack.control") for each in ids)
    assert {"study_arms", "comparisons"} <= {table.id for table in found.tables}


def test_without_a_study_there_is_nothing_of_it() -> None:
    rows = [replace(each, study_arm="") for each in FIRST if each.study_arm != "control"]
    assert study_results(rows) == ([], (), [])


def test_retries_are_counted_by_treatment_and_nothing_else_is() -> None:
    def one(kind: str, condition: str, result: str | None) -> tuple[EpisodeInfo, Outcome | None]:
        info = EpisodeInfo(id="x", kind=kind, task="stack", condition=condition, policy="nominal")
        return info, None if result is None else Outcome(result=result)

    recorded = [
        one("trial", "with_replanning", "failure"),
        one("retry", "with_replanning", "success"),
        one("retry", "with_replanning", "failure"),
        one("retry", "with_replanning", None),
        one("retry", "without_replanning", "failure"),
    ]
    (table,) = retry_table(recorded)
    assert table.rows == (
        ("stack", "nominal", "with_replanning", 1, 3, 1),
        ("stack", "nominal", "without_replanning", 0, 1, 0),
    )
    assert retry_table(recorded[:1]) == ()


def test_without_plans_what_was_executed_is_shown_and_enters_no_statistic() -> None:
    rows = [
        row(start, "without", True, plan_id=NO_PLAN, sim_executed=start > 0) for start in range(3)
    ]
    (group,) = rate_groups(rows, side_rates(rows))
    assert (group.shown_sim.k, group.shown_sim.n) == (2, 3)
    assert (group.sim.value, group.sim.reason_if_undefined, group.sim_rate) == (
        None,
        "no plan",
        None,
    )
    assert [line[3] for line in success_table([group], "real").rows] == ["executed in twin", "real"]
    (planned,) = rate_groups([replace(rows[0], plan_id="p")], side_rates(rows[:1]))
    assert planned.shown_sim is planned.sim
