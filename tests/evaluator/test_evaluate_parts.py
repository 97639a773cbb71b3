"""The parts of an evaluation on trials: what they say with data, and without."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bridge.task.record import check_record
from evaluator.compare import Comparison, compare_csv, compare_run

HEADER = "trial_id,task,condition,policy,start_id,recorded,sim_planned,verdict,p_success\n"


def trials(write_table: Callable[[str], Path], lines: list[str]) -> Comparison:
    return compare_csv(write_table(HEADER + "\n".join(lines) + "\n"))


def line(
    number: int,
    recorded: bool | None,
    sim: bool | None,
    *,
    condition: str = "without_replanning",
    verdict: str = "",
    p: str = "",
    policy: str = "x",
) -> str:
    words = {True: "success", False: "failure", None: ""}
    start = f"s{number % 1000}"
    return (
        f"t{number},cube,{condition},{policy},{start},{words[recorded]},{words[sim]},{verdict},{p}"
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


def test_subtasks_make_a_funnel(write_table: Callable[[str], Path]) -> None:
    text = "trial_id,task,unit,k,n\na,tidy,subtask,3,3\nb,tidy,subtask,1,3\nc,tidy,subtask,0,3\n"
    comparison = compare_csv(write_table(text))
    funnel = next(table for table in comparison.tables if table.id == "funnel")
    assert [row[2:5] for row in funnel.rows] == [
        ("subtask_1", 3, 2),
        ("subtask_2", 2, 1),
        ("subtask_3", 1, 1),
    ]
    stage = comparison.results().get("stage.tidy.-.subtask_2")
    assert (stage.k, stage.n) == (1, 2)
    assert stage.interval is not None


def test_labelled_stages_of_an_episode_make_a_funnel(maker: Any) -> None:
    from bridge.episode.catalogue import label_episode
    from bridge.episode.metadata import Outcome

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
    from bridge.episode.catalogue import label_episode
    from bridge.episode.metadata import Outcome

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
        start, p = (
            draw(st.sampled_from(["", "s1", "s2"])),
            draw(st.sampled_from(["", "0", "1", "0.5"])),
        )
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
