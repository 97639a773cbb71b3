"""Trials CSV, rates CSV and spreadsheets as saved: what is read, what is refused with its row."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bridge.errors import PathNotFoundError, UsageError
from bridge.exchange import trials_rates
from bridge.exchange.table_text import TableError, TableOptions, read_rows
from bridge.exchange.trials_csv import COLUMNS, TrialRecord, read_trials, write_trials
from evaluator.compare import compare_csv, compare_run
from evaluator.compare.intake import take
from evaluator.compare.several import compare_several
from evaluator.compare.spreadsheet import record_from_row, row_from_record
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


names = st.text('abcdefghij_-, "é=', min_size=1, max_size=12).map(str.strip).filter(bool)
answers = st.sampled_from([None, True, False])


@st.composite
def trial_records(draw: st.DrawFn) -> list[TrialRecord]:
    ids = draw(st.lists(st.integers(0, 999), unique=True, min_size=1, max_size=6))
    records = []
    for number in ids:
        recorded = draw(answers)
        records.append(
            TrialRecord(
                trial_id=f"t{number}",
                task=draw(names),
                condition=draw(names),
                policy=draw(names),
                start_id=draw(st.none() | names),
                k=None if recorded is None else int(recorded),
                n=None if recorded is None else 1,
                recorded=recorded,
                sim_planned=draw(answers),
                sim_executed=draw(answers),
                verdict=draw(answers),
                p_success=draw(st.none() | st.floats(0, 1)),
                stand_in=draw(answers),
            )
        )
    return records


@settings(max_examples=40, deadline=None)
@given(trial_records())
def test_trials_survive_writing_and_reading(
    tmp_path_factory: pytest.TempPathFactory, records: list[TrialRecord]
) -> None:
    path = tmp_path_factory.mktemp("trials") / "trials.csv"
    assert read_trials(write_trials(path, records)) == records


def test_a_run_exported_as_trials_gives_the_same_numbers(six_trials: Any, tmp_path: Path) -> None:
    comparison = compare_run(six_trials.run)
    again = compare_csv(write_trials(tmp_path / "out.csv", map(record_from_row, comparison.rows)))
    for name in (
        "agreement.sim_planned.rate",
        "agreement.sim_planned.phi",
        "agreement.verdict.ppv",
    ):
        mine, theirs = comparison.results().get(name), again.results().get(name)
        assert (mine.value, mine.k, mine.n) == (theirs.value, theirs.k, theirs.n)
    assert again.stand_in is True


def test_unknown_stays_unknown(write_table: Callable[[str], Path]) -> None:
    path = write_table("trial_id,task,recorded,sim_planned\na,cube,,success\nb,cube,unknown,\n")
    rows = [row_from_record(record) for record in read_trials(path)]
    assert [row.recorded for row in rows] == [None, None]
    assert compare_csv(path).results().get("agreement.sim_planned.rate").value is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("trial_id,task\na,cube\nb,cube\na,cube\n", r"row 4: trial_id 'a' stands in row 2"),
        ("trial_id,task,unit\na,cube,trial\nb,cube,object\n", r"row 3: unit 'object'.*row 2"),
        ("trial_id,task,recorded\na,cube,maybe\n", r"row 2: recorded is 'maybe'"),
        ("trial_id,task,k,n\na,cube,2,1\n", r"2 of 1 is not a possible count"),
        ("trial_id,task,k,n\na,cube,0.5,1\n", r"k is '0.5'"),
        ("trial_id,task,k,n,recorded\na,cube,0,1,success\n", r"success but k is 0"),
        ("trial_id,task,k,n\na,cube,4,5\n", r"one trial counts 5 trials"),
        ("trial_id,task,p_success\na,cube,1.5\n", r"p_success is '1.5'"),
        ("trial_id,task\na,cube,more\n", r"3 fields where the header has 2"),
        ("trial_id,tsk\na,cube\n", r"unknown column 'tsk'. Is it 'task'"),
        ("trial_id,job\na,cube\n", r"no column 'task'.*There are: trial_id, job"),
        ("trial_id,task,recordd\na,cube,good\n", r"unknown column 'recordd'.*recorded=recordd"),
        ("trial_id,task,Task\na,cube,good\n", r"two of 'task'"),
        ("trial_id,task\n", r"a header without rows"),
        ("trial_id,task\n,cube\n", r"trial_id is empty"),
        ("trial_id,task,unit,k,n\na,t,object,1e30,1e30\n", "row 2: k is '1e30'"),
        ("trial_id,task,unit,k,n\na,t,subtask,3,100000\n", "one trial counts 100000 subtasks"),
        ("trial_id;task;k\na;cup;1,234\n", r"k is '1,234'.*decimal comma"),
        ("trial_id,task\na,cu\0p\n", "a NUL"),
    ],
)
def test_a_trial_that_cannot_be_is_refused_with_its_row(
    write_table: Callable[[str], Path], text: str, message: str
) -> None:
    with pytest.raises(TableError, match=message):
        read_trials(write_table(text))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("task,side,n,rate\ncube,real,10,80\n", r"rate is '80'.*rate_percent"),
        ("task,side,n,rate\ncube,left,10,0.8\n", r"side is 'left'"),
        ("task,side,n,rate\ncube,real,1000,0.5\n", None),
        ("task,side,n,rate\ncube,real,1000,0.33\n", None),
        ("task,side,n,rate\ncube,real,997,0.33\n", r"counts of 997 round to 0.33.*Give k"),
        ("task,side,k,n,rate\ncube,real,7,10,0.8\n", r"0.8 is not 7/10"),
        ("task,side,n\ncube,real,10\n", r"neither a rate nor"),
        ("task,side,rate,rate_percent\ncube,real,0.8,80\n", r"both rate and rate_percent"),
        ("task,side,rate\ncube,real,0.8\ncube,real,0.9\n", r"row 3: real of 'cube'.*row 2"),
        (
            "task,condition,side,unit,n,rate\nd,a,sim,trial,10,0.6\nd,a,real,object,50,0.46\n",
            r"row 3: unit 'object'.*row 2 says 'trial'",
        ),
        ("task,side,rate\ncube,real,nan\n", r"neither a rate nor"),
    ],
)
def test_rates_that_cannot_be_are_refused(
    write_table: Callable[[str], Path], text: str, message: str | None
) -> None:
    path = write_table(text)
    if message is None:
        assert trials_rates.rates_of(read_rows(path, ("task", "side"), trials_rates.COLUMNS))
        return
    with pytest.raises(TableError, match=message):
        trials_rates.rates_of(read_rows(path, ("task", "side"), trials_rates.COLUMNS))


def test_a_table_that_excel_saved_in_western_europe_is_read(tmp_path: Path) -> None:
    path = tmp_path / "de.csv"
    path.write_bytes(
        "task;policy;outcome\nWürfel;act;Erfolg\nWürfel;act;Fehlschlag\n".encode("cp1252")
    )
    rate = compare_csv(path).results().get("rate.recorded.W+00fcrfel.-.act")
    assert (rate.k, rate.n) == (1, 2)


def test_a_table_that_is_neither_is_refused(
    write_table: Callable[[str], Path], tmp_path: Path
) -> None:
    with pytest.raises(UsageError, match="neither a table of trials"):
        compare_csv(write_table("a,b\n1,2\n"))
    with pytest.raises(PathNotFoundError):
        compare_csv(tmp_path / "nowhere.csv")
    binary = tmp_path / "binary.csv"
    binary.write_bytes(b"\xfe\xe1\x80\x81")
    with pytest.raises(TableError, match="not a CSV"):
        compare_csv(binary)


@pytest.mark.parametrize(
    ("marks", "word"),
    [
        (("", ""), "recorded"),
        (("false", ""), "recorded"),
        (("false", "false"), "real"),
        (("true", ""), "stand-in"),
    ],
)
def test_trials_of_which_nobody_says_where_they_come_from_are_not_called_real(
    write_table: Callable[[str], Path], marks: tuple[str, str], word: str
) -> None:
    path = write_table(
        f"trial_id,task,recorded,stand_in\na,t,success,{marks[0]}\nb,t,failure,{marks[1]}\n"
    )
    assert compare_csv(path).recorded_word == word
    assert compare_csv(write_table("trial_id,task,recorded\na,t,yes\n")).stand_in is None
