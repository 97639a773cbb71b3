"""Tables as people save them, several sources in one study, and folders of results."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bridge.errors import UsageError
from bridge.exchange.table_text import TableOptions, read_rows
from bridge.exchange.trials_csv import COLUMNS, read_trials
from evaluator.cli import evaluate
from evaluator.compare import compare_csv
from evaluator.compare.axes import axis_tables
from evaluator.compare.intake import look_through, take
from evaluator.compare.several import compare_several
from evaluator.errors import AlikeNamesError

PLAIN = "trial_id,task,policy,recorded,sim_planned,p_success\na,cup,A,success,failure,0.85\n"
MAPPED = TableOptions(map="outcome=Result,task=Scenario")


@pytest.mark.parametrize(
    "text",
    [
        "sep=;\r\nTrial ID;Task ;policy;Recorded;Sim planned;p success;Operator\r\n"
        "a;cup;A;pass;fail;0,85;Jo\r\n",
        "\ufefftrial-id\ttask\tpolicy\trecorded\tsim_planned\tp_success\na\tcup\tA\tY\tn\t0.85\n",
        'TRIAL_ID,Task,POLICY,Recorded,SIM_PLANNED,P_success\na,cup,A,1.0,0.0,"0,85"\n',
        "trial_id;task;policy;recorded;sim_planned;p_success\na;cup;A;1,0;0;0,85;;\n",
    ],
)
def test_a_table_is_read_alike_however_it_was_saved(
    write_table: Callable[[str], Path], text: str
) -> None:
    plain = read_trials(write_table(PLAIN))
    path = write_table("")
    path.write_bytes(text.encode())
    assert read_trials(path) == plain


def test_what_was_understood_is_said(write_table: Callable[[str], Path]) -> None:
    path = write_table("Task;Recorded;Result;Day\ncup;pass;x;Monday\n")
    said = take(path).summary
    assert "trials, 1 row" in said
    assert "semicolons" in said
    assert "'Result', 'Day'" in said
    path = write_table("Scenario;Result;sim_planned\ncup;pass;\n")
    assert "'Result' read as recorded" in take(path, MAPPED).summary
    path = write_table("task,sim_planned,Result\ncup,yes,pass\n")
    assert take(path).trials[0].recorded is True
    assert "'Result' read as recorded" in take(path).summary


@pytest.mark.parametrize("unknown", ["", "NA", "n/a", "NaN", "-", "?", "none"])
def test_what_nobody_knows_stays_unknown(write_table: Callable[[str], Path], unknown: str) -> None:
    path = write_table(f"trial_id,task,recorded,k,n,p_success\na,cup,{unknown},,,{unknown}\n")
    (trial,) = read_trials(path)
    assert (trial.recorded, trial.p_success) == (None, None)


@pytest.mark.parametrize(
    ("text", "message"),
    [("outcome", "not COLUMN=THEIRS"), ("outcme=Result", "recorded"), ("task=a,task=b", "task=b")],
)
def test_a_mapping_that_means_nothing_is_wrong_use(
    write_table: Callable[[str], Path], text: str, message: str
) -> None:
    with pytest.raises(UsageError, match=message):
        take(write_table(PLAIN), TableOptions(map=text))


cells = (
    st.text('abcXYZ é";,\t', min_size=1, max_size=8)
    .map(str.strip)
    .filter(lambda text: text and not text.startswith("#"))
)


@settings(max_examples=30, deadline=None)
@given(st.lists(cells, min_size=1, max_size=5), st.sampled_from([",", ";", "\t"]))
def test_no_delimiter_changes_a_name(
    tmp_path_factory: pytest.TempPathFactory, tasks: list[str], delimiter: str
) -> None:
    path = tmp_path_factory.mktemp("saved") / "table.csv"
    quoted = ['"' + task.replace('"', '""') + '"' for task in tasks]
    lines = [delimiter.join(("trial_id", "task", "recorded"))]
    lines += [delimiter.join((str(i), task, "yes")) for i, task in enumerate(quoted)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    assert [row.text("task") for row in read_rows(path, ("task",), COLUMNS)] == tasks


ALIKE = "trial_id,task,recorded,sim_planned\na,Cup,yes,yes\nb,cup,no,yes\nc,Cube,no,no\n"


def test_names_that_differ_by_case_are_asked_about(write_table: Callable[[str], Path]) -> None:
    path = write_table(ALIKE)
    with pytest.raises(AlikeNamesError, match=r"'Cup' \(a\) and 'cup' \(b\).*--names merge"):
        compare_csv(path)
    merged = compare_csv(path, options=TableOptions(names="merge"))
    assert [(g.task, g.recorded.n) for g in merged.groups] == [("Cube", 1), ("Cup", 2)]
    assert "task 'cup' counted as 'Cup'" in merged.provenance["read_as"]
    apart = compare_csv(path, options=TableOptions(names="apart"))
    assert [g.task for g in apart.groups] == ["Cube", "Cup", "cup"]


def test_runs_and_tables_are_one_study_and_keep_their_own_ids(
    six_trials: Any, tmp_path: Path
) -> None:
    run = six_trials.run.path
    table = tmp_path / "more.csv"
    names = [row.episode for row in compare_several([run]).rows]
    table.write_text(
        "trial_id,task,recorded,sim_planned,stand_in\n"
        f"{names[0]},elsewhere,yes,no,yes\nnew,elsewhere,no,no,yes\n"
    )
    together = compare_several([run, table])
    assert {row.episode for row in together.rows} == {*names, f"more/{names[0]}", "new"}
    assert together.results().get("agreement.sim_planned.rate").n == len(
        [r for r in together.rows if r.recorded is not None and r.sim_planned is not None]
    )
    with pytest.raises(UsageError, match="given twice"):
        compare_several([run, run])


def test_a_copied_run_counts_no_trial_twice(six_trials: Any, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(six_trials.run.path, copy)
    alone, both = (
        compare_several([six_trials.run.path]),
        compare_several([six_trials.run.path, copy]),
    )
    assert [g.recorded.n for g in alone.groups] == [g.recorded.n for g in both.groups]
    copies = [e for e in both.exclusions if "the same file" in e.reason]
    assert len(copies) == len(alone.rows)


def test_a_folder_of_results_is_read_and_what_is_left_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "results"
    for policy, successes in (("act", [1, 0]), ("dp", [1, 1])):
        (folder / policy).mkdir(parents=True)
        trials = [{"task": "g/0", "policy": policy, "sim_planned": each} for each in successes]
        (folder / policy / "trials.json").write_text(json.dumps(trials))
    (folder / "lengths.csv").write_text("episode,episode_length\n0,100\n")
    (folder / "real.json").write_text(json.dumps([{"task": "g/0", "policy": "act", "recorded": 1}]))
    (folder / "rates.csv").write_text("task,side,rate\nx,real,0.5\n")
    (folder / "notes.md").write_text("monday")
    assert evaluate(folder, out=tmp_path / "out") == 0
    err = capsys.readouterr().err
    assert "neither a table of trials" in err
    taken, left = look_through(folder)
    assert {each.kind for each in taken} == {"trials", "rates"}
    assert {one.path.name for one in left} == {"lengths.csv", "notes.md"}
    comparison = compare_several([folder])
    sides = {(g.task, g.policy): (g.recorded.n, g.sim.n) for g in comparison.groups}
    assert sides == {("g/0", "act"): (1, 2), ("g/0", "dp"): (0, 2)}
    (intake,) = (table for table in comparison.tables if table.id == "intake")
    assert len(intake.rows) == 6
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "a.txt").write_text("hello\n")
    with pytest.raises(UsageError, match="could be read as results"):
        compare_several([tmp_path / "empty"])


def test_agreement_along_axes(write_table: Callable[[str], Path]) -> None:
    lines = ["trial_id;task;recorded;sim_planned;progress;sim_progress;tags;Start region"]
    for i in range(8):
        light, real, sim = ("dim", i % 2, 1) if i < 4 else ("bright", 1, 1)
        lines.append(f"{i};cup;{real};{sim};0,{i};0,{i + 1};lighting={light};R{i % 2}")
    path = write_table("\n".join(lines) + "\n")
    comparison = compare_csv(path, options=TableOptions(axes="Start region"))
    (axes,) = axis_tables(comparison.rows, comparison.recorded_word)
    assert axes in comparison.tables
    assert {row[0] for row in axes.rows} == {"lighting", "start_region"}
    by_value = {row[1]: dict(zip(axes.columns, row, strict=True)) for row in axes.rows}
    assert (by_value["dim"]["agree k"], by_value["dim"]["agree n"]) == (2, 4)
    assert by_value["dim"]["sim - recorded (pp)"] == pytest.approx(50)
    assert by_value["bright"]["sim - recorded (pp)"] == 0
    assert set(by_value) == {"dim", "bright", "R0", "R1"}


def test_a_table_of_single_rollouts_on_either_side_is_an_unpaired_study(
    write_table: Callable[[str], Path],
) -> None:
    """Twenty on the robot and two hundred in the twin, as studies are published."""
    lines = ["Task,Policy,Side,Result"]
    for policy, real, sim in (("A", 14, 160), ("B", 8, 90)):
        lines += [f"place,{policy},real,{'success' if i < real else 'failure'}" for i in range(20)]
        lines += [f"place,{policy},Sim,{'success' if i < sim else 'failure'}" for i in range(200)]
    table = write_table("\n".join(lines) + "\n")
    comparison = compare_csv(table)
    assert comparison.stand_in is False
    groups = {group.policy: group for group in comparison.groups}
    assert (groups["A"].recorded.k, groups["A"].recorded.n) == (14, 20)
    assert (groups["A"].sim.k, groups["A"].sim.n) == (160, 200)
    assert (groups["B"].recorded.k, groups["B"].sim.k) == (8, 90)
    note = next(table.note for table in comparison.tables if table.id == "success")
    assert "Each side counts its own trials" in note
    assert "both sides are known" not in note
