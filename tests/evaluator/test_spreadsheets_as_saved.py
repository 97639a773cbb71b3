"""Tables as people save them, and several sources in one study."""

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
from evaluator.compare import compare_csv
from evaluator.compare.intake import take
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


def test_names_that_differ_by_case_are_refused(write_table: Callable[[str], Path]) -> None:
    with pytest.raises(AlikeNamesError, match=r"'Cup' \(a\) and 'cup' \(b\).*Spell them alike"):
        compare_csv(write_table(ALIKE))
    path = write_table("policy,real,sim\nACT,7/10,8/10\nact,5/10,6/10\n")
    with pytest.raises(AlikeNamesError, match=r"'ACT' \(row 2\) and 'act' \(row 3\)"):
        compare_csv(path)


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


def test_what_is_neither_run_nor_table_is_refused(tmp_path: Path) -> None:
    (tmp_path / "rates.csv").write_text("policy,real,sim\nACT,7/10,8/10\n")
    (tmp_path / "trials.csv").write_text(ALIKE.replace("cup", "Cup"))
    (tmp_path / "trials.json").write_text('[{"task": "g/0", "recorded": 1}]')
    with pytest.raises(UsageError, match=r"holds no episodes. Give a run folder, or tables"):
        compare_several([tmp_path])
    with pytest.raises(UsageError, match="Save it as a table"):
        compare_csv(tmp_path / "trials.json")
    with pytest.raises(UsageError, match=r"rates.csv holds rates, and other sources hold trials"):
        compare_several([tmp_path / "trials.csv", tmp_path / "rates.csv"])


def test_a_copy_of_a_table_is_refused_and_a_cell_counts_once(tmp_path: Path) -> None:
    first, copy, other = (tmp_path / f"{name}.csv" for name in ("first", "copy", "other"))
    first.write_text("policy,real,sim\nACT,7/10,8/10\n")
    copy.write_text(first.read_text())
    with pytest.raises(UsageError, match=r"copy.csv is given twice, once as .*first.csv"):
        compare_several([first, copy])
    other.write_text("task,policy,real,sim\nfirst,ACT,6/10,8/10\n")
    with pytest.raises(UsageError, match=r"first, ACT, real stands in .*first.csv and in"):
        compare_several([first, other])
    other.write_text("task,policy,real,sim\nhook,ACT,6/10,8/10\n")
    assert [group.task for group in compare_several([first, other]).groups] == ["first", "hook"]


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
