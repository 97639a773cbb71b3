"""The parts of an evaluation say what they say with data, without, and where nobody planned."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from joint_samples import at_positions

from bridge.episode import schema
from bridge.episode.catalogue import label_episode
from bridge.episode.executions import NO_PLAN
from bridge.episode.metadata import EpisodeInfo, Outcome
from bridge.episode.reader import Episode
from bridge.episode.writer import EpisodeWriter
from bridge.task.record import check_record
from evaluator.compare import Comparison, compare_csv, compare_run
from evaluator.compare.attribution import (
    ACTIONS,
    AGREE,
    UNKNOWN,
    WORLD,
    attributed,
    attribution_table,
)
from evaluator.report.front import front
from evaluator.report.wording import headlines

STEP_NS = 8_000_000


def moved(maker: Any, name: str, result: str) -> None:
    """A trial of joints that rest, turn by one radian and rest again."""
    info = EpisodeInfo(id=name, kind="trial", task="cube_into_box", policy="act")
    outcome = Outcome(result=result, k=int(result == "success"))
    turn = np.interp(np.arange(600), [200, 400], [0.0, 1.0])
    with EpisodeWriter(maker.run.episodes_dir / f"{name}.mcap") as writer:
        writer.describe(info, outcome=outcome)
        for number, angle in enumerate(turn.tolist()):
            stamp_ns = 10**18 + number * STEP_NS
            data = at_positions(stamp_ns, ("a",), np.array([angle])).to_cdr()
            writer.write(
                "/c/joint_states", data, type_name=schema.JOINT_STATE, log_time_ns=stamp_ns
            )


def test_agreement_is_that_of_what_was_executed_and_says_so(maker: Any) -> None:
    answers = {"t1": ("success", True), "t2": ("failure", True), "t3": ("failure", False)}
    for name, (result, accepted) in answers.items():
        moved(maker, name, result)
        maker.replay(name, plan_id=NO_PLAN, trajectory="executed", accepted=accepted)
    comparison = compare_run(maker.run)
    results = comparison.results()
    assert results.get("rate.recorded.cube_into_box.-.act").k == 1
    agreed = results.get("agreement.sim_executed.rate")
    assert (agreed.k, agreed.n) == (2, 3)
    assert results.get("agreement.sim_planned.rate").value is None
    assert "planned: 3 of 3 trials had no plan" in comparison.missing
    assert not [e for e in comparison.exclusions if "planned" in e.reason]
    named = {label: m.id for label, _, m in headlines(results)}
    assert named["Executed in twin and recorded outcome agree"] == "agreement.sim_executed.rate"
    assert not any("sim_planned" in name for name in named.values())
    row = comparison.rows[0]
    assert (row.plan_id, row.num_plans, row.num_plans_sent) == (NO_PLAN, 0, 0)
    assert not row.nothing_executed


def test_a_trial_in_which_nothing_moved_was_not_executed(maker: Any) -> None:
    moved(maker, "t1", "failure")
    with EpisodeWriter(maker.run.episodes_dir / "t2.mcap") as writer:
        writer.describe(EpisodeInfo(id="t2", kind="trial", task="cube_into_box"))
    plans = {row.episode: row.plan_id for row in compare_run(maker.run).rows}
    assert plans == {"t1": NO_PLAN, "t2": None}


def test_trials_with_plans_keep_their_headline(maker: Any) -> None:
    moved(maker, "t1", "success")
    maker.replay("t1", plan_id=NO_PLAN, trajectory="executed")
    maker.trial("t2")
    maker.replay("t2")
    results = compare_run(maker.run).results()
    assert results.get("agreement.sim_planned.rate").n == 1
    assert any(m.id == "agreement.sim_planned.rate" for _, _, m in headlines(results))


@pytest.mark.parametrize("field", ["started_ns", "ended_ns"])
def test_when_it_was_executed_follows_from_the_joints(maker: Any, field: str) -> None:
    from evaluator.run_reader.episodes import read_recorded

    moved(maker, "t1", "success")
    facts = read_recorded(maker.run, maker.run.episodes_dir / "t1.mcap")
    expected = 10**18 + {"started_ns": 200, "ended_ns": 400}[field] * STEP_NS
    assert abs(getattr(facts, field) - expected) <= 50_000_000


def rolled(maker: Any, name: str, success: bool) -> None:
    """A rollout of a trial's policy from its start."""
    told = {"policy": "act", "task": "cube_into_box", "start_id": name, "success": success}
    path = maker.replay(name, plan_id="rollout", trajectory="rollout", tag="r")
    derived = Episode.open(path).derived
    assert derived is not None
    derived = replace(derived, kind="rollout", settings={"rollout": told | {"number": 0}})
    with EpisodeWriter(path.with_name(f"{name}.rollout.act.mcap")) as writer:
        writer.describe(EpisodeInfo(id=f"{name}-rollout", kind="trial"), derived=derived)
    path.unlink()


def test_a_rollout_that_ends_otherwise_is_put_down_to_the_world_or_to_what_was_done(
    maker: Any,
) -> None:
    """The trial's motion in the twin decides, by its end alone: these replays touch the box."""
    cases = {
        # recorded, rolled out, whether the trial's motion does the task in the twin
        "t1": ("success", True, True, AGREE),
        "t2": ("failure", True, True, WORLD),
        "t3": ("success", False, True, ACTIONS),
        "t4": ("success", False, None, UNKNOWN),
    }
    for name, (result, success, does, _) in cases.items():
        moved(maker, name, result)
        rolled(maker, name, success)
        if does is not None:
            maker.replay(name, plan_id=NO_PLAN, trajectory="executed", accepted=False)
    comparison = compare_run(maker.run)
    assert {row.episode: attributed(row) for row in comparison.rows} == {
        name: case[-1] for name, case in cases.items()
    }
    (table,) = (table for table in comparison.tables if table.id == "attribution")
    assert table.rows[-1] == ("", "all", 4, 1, 1, 1, 1)
    assert attribution_table([replace(comparison.rows[0], plan_id="p")]) == ()


HEADER = "trial_id,task,condition,policy,start_id,recorded,sim_planned,verdict,p_success\n"


def trials(write_table: Callable[[str], Path], lines: list[str]) -> Comparison:
    return compare_csv(write_table(HEADER + "\n".join(lines) + "\n"))


def line(number: int, recorded: bool | None, sim: bool | None, **more: str) -> str:
    words = {True: "success", False: "failure", None: ""}
    found = {"condition": "without_replanning", "verdict": "", "p": "", "policy": "x"} | more
    return (
        f"t{number},cube,{found['condition']},{found['policy']},s{number % 1000},{words[recorded]},"
        f"{words[sim]},{found['verdict']},{found['p']}"
    )


def test_a_run_without_data_for_a_part_says_no_data(six_trials: Any) -> None:
    missing = " | ".join(compare_run(six_trials.run).missing)
    parts = ("stage funnel", "final states")
    for part in parts:
        assert f"{part}" in missing
    assert missing.count("no data") == len(parts)


def test_the_gate_is_judged_where_it_was_not_obeyed(write_table: Callable[[str], Path]) -> None:
    lines = [line(i, True, True, verdict="accepted") for i in range(6)]
    lines += [line(10 + i, False, False, verdict="refused") for i in range(4)]
    lines += [line(20 + i, True, False, verdict="refused") for i in range(2)]
    results = trials(write_table, lines).results()
    assert results.get("agreement.verdict_unheeded.phi").value == pytest.approx(0.7071, abs=1e-4)


def test_two_trials_of_a_policy_from_one_start_are_held_against_each_other(
    write_table: Callable[[str], Path],
) -> None:
    """Each once: a third has no other, one of another policy or without an end is none."""
    starts = [(True, True), (True, False), (False, False, True), (None, False, False), (True,)]
    starts += [(True, True)] * 7
    lines = [
        line(1000 * turn + start, end, True)
        for start, ends in enumerate(starts)
        for turn, end in enumerate(ends)
    ]
    results = trials(write_table, [*lines, line(5004, False, True, policy="y")]).results()
    told = dict(front(results).answers)["In numbers"]
    assert "The cell agrees with itself in 10 of 11 pairs of trials from one start (91 %)." in told


def test_subtasks_make_a_funnel(write_table: Callable[[str], Path]) -> None:
    text = "trial_id,task,unit,k,n\na,tidy,subtask,3,3\nb,tidy,subtask,1,3\nc,tidy,subtask,0,3\n"
    comparison = compare_csv(write_table(text))
    funnel = next(table for table in comparison.tables if table.id == "funnel")
    passed = [("subtask_1", 3, 2), ("subtask_2", 2, 1), ("subtask_3", 1, 1)]
    assert [row[2:5] for row in funnel.rows] == passed
    stage = comparison.results().get("stage.tidy.-.subtask_2")
    assert (stage.k, stage.n) == (1, 2)
    assert stage.interval is not None


def test_labelled_stages_of_an_episode_make_a_funnel(maker: Any) -> None:
    for name, second in (("t1", "success"), ("t2", "failure"), ("t3", "unknown")):
        maker.trial(name, start_id=name)
        stages = ({"id": "grasp", "result": "success"}, {"id": "release", "result": second})
        result = second if second != "unknown" else "success"
        label_episode(
            maker.run, name, Outcome(result=result, k=int(result == "success"), stages=stages)
        )
    comparison = compare_run(maker.run)
    results = comparison.results()
    assert (results.get("stage.cube_into_box.without_replanning.release").k) == 1
    assert (results.get("stage.cube_into_box.without_replanning.release").n) == 2
    failures = next(table for table in comparison.tables if table.id == "failures")
    assert ("stand-in", "release", "", 1) in failures.rows


def test_units_mixed_in_one_cell_are_undefined_and_named(maker: Any) -> None:
    for name, unit in (("t1", "object"), ("t2", "subtask")):
        maker.trial(name, start_id=name)
        label_episode(maker.run, name, Outcome(result="success", unit=unit, k=2, n=2))
    results = compare_run(maker.run).results()
    rate = results.get("rate.recorded_object.cube_into_box.without_replanning.scripted")
    assert rate.value is None
    assert "t1 in objects and t2 in subtasks" in str(rate.reason_if_undefined)


WORDS = st.sampled_from(["success", "failure", "", "unknown"])


@st.composite
def tables(draw: st.DrawFn) -> str:
    names = ["recorded", "sim_planned", "sim_executed", "verdict"]
    count = draw(st.integers(1, 14))
    lines = [f"trial_id,task,condition,policy,start_id,p_success,{','.join(names)}"]
    for number in range(count):
        condition = draw(st.sampled_from(["without_replanning", "with_replanning", "other, one"]))
        task, policy = draw(st.sampled_from("ab")), draw(st.sampled_from(["", "x", "y/../z"]))
        start = draw(st.sampled_from(["", "s1", "s2"]))
        p = draw(st.sampled_from(["", "0", "1", "0.5"]))
        answers = ",".join(draw(WORDS) for _ in names)
        lines.append(f't{number},{task},"{condition}",{policy},{start},{p},{answers}')
    return "\n".join(lines) + "\n"


@settings(max_examples=12, deadline=None)
@given(tables())
def test_whatever_the_trials_say_the_results_fit_the_schema(
    tmp_path_factory: pytest.TempPathFactory, text: str
) -> None:
    """One task, constant sides, all success, nothing known: a number or a reason, never a crash."""
    path = tmp_path_factory.mktemp("any") / "trials.csv"
    path.write_text(text)
    results = compare_csv(path).results()
    check_record(results.to_record(), name="results", package="evaluator")
    ids = [measurement.id for measurement in results.measurements]
    assert len(ids) == len(set(ids))
    for m in results.measurements:
        if m.interval is not None:
            is_best = m.id == "decision.regret_pp" and m.interval.high == 0  # none may be better
            assert m.interval.low < m.interval.high or m.unit == "count" or is_best, m.id
