"""A study of replanning: starts by arm, what is not executed, what is void, and the pooled test."""

from dataclasses import replace

import pytest

from bridge.episode.executions import NO_PLAN
from bridge.episode.metadata import treatment_of
from evaluator.compare.from_rows import compare_rows
from evaluator.compare.policies import compare_policies, void_starts
from evaluator.compare.rows import TrialRow
from evaluator.compare.success import rate_groups, side_rates
from evaluator.compare.tables import success_table

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
    answers = compare_policies(rows)
    assert [(each.counts, each.reading.evidence.strata[0].improved) for each in answers] == [
        (((4, 10), (8, 10)), 5)
    ]


def test_a_void_trial_takes_its_start_out_of_all_arms() -> None:
    void = replace(FIRST[1], recorded=None, plan_id=None, why_unknown="interrupted")
    rows = [FIRST[0], void, *FIRST[2:]]
    reasons = {each.episode: each.reason for each in void_starts(rows, ("interrupted",))}
    assert reasons == {
        "stack_0_with": "void: interrupted",
        "stack_0_without": "start stack/0 is void in all arms: stack_0_with: interrupted",
        "stack_0_control": "start stack/0 is void in all arms: stack_0_with: interrupted",
    }
    assert compare_policies(rows)[0].counts == ((4, 9), (8, 9))
    assert compare_rows(rows, run="r", source="run", stand_in=True).exclusions[0].episode in reasons
    # Not a cause that was named: a failure of its arm.
    assert void_starts(rows, ("power cut",)) == []
    assert compare_policies(rows, void_causes=("power cut",))[0].counts == ((4, 10), (8, 10))


def test_the_control_is_a_group_of_its_own_and_pairs_only_in_the_study() -> None:
    found = compare_rows(FIRST, run="r", source="run", stand_in=True)
    groups = {group.condition: group for group in found.groups}
    assert set(groups) == {"without_replanning", "with_replanning", "control"}
    assert groups["without_replanning"].recorded.n == 10
    ids = [each.id for each in found.measurements]
    assert any(each.startswith("rate.recorded.stack.control") for each in ids)
    assert "comparisons" in {table.id for table in found.tables}


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
