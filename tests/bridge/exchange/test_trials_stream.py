"""A trials CSV of any length is counted in constant memory, and refused like a short one."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from bridge.errors import PathNotFoundError
from bridge.exchange import trials_stream
from bridge.exchange.table_text import TableError
from bridge.exchange.trials_csv import read_trials
from bridge.exchange.trials_stream import count_trials

ROOT = Path(__file__).parents[3]
HEADER = "trial_id,task,condition,start_id,recorded,sim_planned,p_success\n"


def rows(count: int) -> Iterator[str]:
    yield HEADER
    for i in range(count):
        recorded = "success" if i % 3 else "failure"
        sim = "success" if i % 4 else ""
        yield f"t{i},task_{i % 5},c{i % 2},s{i},{recorded},{sim},0.{i % 97:02}\n"


def write(path: Path, count: int) -> Path:
    with path.open("w") as stream:
        stream.writelines(rows(count))
    return path


def table(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "table.csv"
    path.write_text(text)
    return path


def test_counting_is_reading_and_adding_up(tmp_path: Path) -> None:
    path = write(tmp_path / "trials.csv", 997)
    counted = count_trials(path)
    assert sum(count for _, count in counted) == 997
    whole = read_trials(path)
    for trial, count in counted:
        assert trial.trial_id == ""
        same = [
            t
            for t in whole
            if (t.task, t.condition, t.recorded, t.sim_planned)
            == (trial.task, trial.condition, trial.recorded, trial.sim_planned)
        ]
        assert len(same) == count


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("trial_id,task\na,cube\nb,cube\na,cube\n", r"row 4: trial_id 'a' stands in row 2"),
        ("trial_id,task,unit\na,cube,trial\nb,cube,object\n", r"row 3: unit 'object'.*row 2"),
        ("trial_id,task,recorded\na,cube,maybe\n", r"row 2: recorded is 'maybe'"),
        ("trial_id,task,p_success\na,cube,0.5\nb,cube,1.5\n", r"row 3: p_success is '1.5'"),
        ("trial_id,task\na,cube\nb,cube,more\n", r"row 3: 3 fields where the header has 2"),
        ("trial_id,task\na,cube\n,cube\n", r"row 3: trial_id is empty"),
        ("trial_id,mood\na,good\n", r"no column 'task'"),
        ("trial_id,task\n", r"a header without rows"),
        ("", r"empty"),
    ],
)
def test_what_a_short_table_is_refused_for_a_long_one_is_too(
    tmp_path: Path, text: str, message: str
) -> None:
    with pytest.raises(TableError, match=message):
        count_trials(table(tmp_path, text))


def test_ids_with_the_same_hash_are_not_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trials_stream, "hash", lambda _: 7, raising=False)
    counted = count_trials(table(tmp_path, "trial_id,task\na,cube\nb,cube\nc,cube\n"))
    assert [count for _, count in counted] == [3]
    with pytest.raises(TableError, match="row 3"):
        count_trials(table(tmp_path, "trial_id,task\na,cube\na,cube\n"))


def test_a_table_whose_rows_never_repeat_is_no_table_of_trials(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trials_stream, "MAX_PATTERNS", 5)
    text = "trial_id,task\n" + "".join(f"t{i},task_{i}\n" for i in range(9))
    with pytest.raises(TableError, match="row 7: 5 different rows before it"):
        count_trials(table(tmp_path, text))


def test_binary_and_missing_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "binary.csv"
    path.write_bytes(b"trial_id,task\n\xff\xfe\x00\x80")
    with pytest.raises(TableError, match="not a CSV file"):
        count_trials(path)
    with pytest.raises(PathNotFoundError):
        count_trials(tmp_path / "nowhere.csv")


CHILD = """
import resource, sys
from pathlib import Path
from bridge.exchange.trials_stream import count_trials
count_trials(Path(sys.argv[1]))
first = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
counted = count_trials(Path(sys.argv[2]))
last = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
print(sum(count for _, count in counted), last - first)
"""
