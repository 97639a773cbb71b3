"""Trials CSV and rates CSV: what is read, and what is refused with its row."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bridge.errors import PathNotFoundError, UsageError
from bridge.exchange import trials_rates
from bridge.exchange.table_text import TableError, read_rows
from bridge.exchange.trials_csv import TrialRecord, read_trials, write_trials
from evaluator.compare import compare_csv, compare_run
from evaluator.compare.spreadsheet import record_from_row, row_from_record

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
