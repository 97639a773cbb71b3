"""What others recorded or counted becomes a part of a run, or is refused with its row."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from commands import run

from bridge.cli.exchange import export_rosbag2, import_rosbag2
from bridge.episode import schema
from bridge.episode.cdr.messages import string_to_cdr
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.errors import UsageError
from bridge.exchange.trials_csv import read_trials
from bridge.terminal import Output
from evaluator.compare import compare_run

HEAD = "trial_id,task,condition,start_id,recorded,sim_planned,stand_in\r\n"
ROWS = "t1,cube,without_replanning,s1,success,success,false\r\nt2,cube,,,failure,success,false\r\n"


def table(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "table.csv"
    path.write_text(text, newline="")
    return path


def test_an_imported_table_is_what_evaluate_compares(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = table(tmp_path, HEAD + ROWS)
    assert run("open", source, tmp_path / "run") == 0
    assert "trials, 2 rows" in capsys.readouterr().out
    kept = tmp_path / "run" / "notes" / "trials.csv"
    assert read_trials(kept) == read_trials(source)
    assert run("evaluate", tmp_path / "run", "--json") == 0
    results = json.loads(capsys.readouterr().out)
    values = {item["id"]: item for item in results["measurements"]}
    assert values["agreement.sim_planned.rate"]["value"] == 0.5
    assert values["agreement.sim_planned.rate"]["n"] == 2


def test_a_recorded_trial_is_not_counted_twice(
    make_trial: Callable[..., Path], tmp_path: Path
) -> None:
    make_trial(id="t1", cameras=(), num_frames=3)
    source = table(tmp_path, HEAD + ROWS)
    assert run("open", source, tmp_path / "run") == 0
    comparison = compare_run(RunFolder.open(tmp_path / "run"))
    assert [row.episode for row in comparison.rows] == ["t1", "t2"]
    (doubled,) = [item for item in comparison.exclusions if "trials.csv" in item.reason]
    assert doubled.episode == "t1"


@pytest.mark.parametrize(
    ("text", "match", "code"),
    [
        (HEAD + "t1,cube,,,maybe,,\r\n", "table.csv row 2: recorded is 'maybe'", 1),
        ("trial_id\r\nt1\r\n", "is neither a table of trials", 2),
        ("task,policy,outcome\r\n", "table.csv has a header and no row below it", 2),
        ("", "table.csv is empty", 2),
    ],
)
def test_a_bad_row_is_named_and_nothing_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, match: str, code: int
) -> None:
    assert run("open", table(tmp_path, text), tmp_path / "run") == code
    assert match in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_second_import_waits_until_the_first_one_is_deleted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = table(tmp_path, HEAD + ROWS)
    assert run("open", source, tmp_path / "run") == 0
    assert run("open", source, tmp_path / "run") == 2
    assert "Delete it to replace it" in capsys.readouterr().err
    (tmp_path / "run" / "notes" / "trials.csv").unlink()
    assert run("open", source, tmp_path / "run") == 0


QUIET = Output(quiet=True)


@pytest.mark.parametrize("stand_in", [True, False])
def test_a_bag_imported_with_a_task_is_a_trial(tmp_path: Path, stand_in: bool) -> None:
    path = tmp_path / "trial.mcap"
    with EpisodeWriter(path) as writer:
        writer.describe(EpisodeInfo(id="trial", kind="trial", stand_in=stand_in))
        text = string_to_cdr("<robot/>")
        writer.write("/robot_description", text, type_name=schema.STRING, log_time_ns=1)
    export_rosbag2(path, tmp_path / "bag", output=QUIET)
    run = tmp_path / "run"
    import_rosbag2(tmp_path / "bag", run, episode="a", output=QUIET)
    import_rosbag2(tmp_path / "bag", run, episode="b", task="cube_into_box", output=QUIET)
    infos = [Episode.open(run / "episodes" / f"{name}.mcap").info for name in "ab"]
    assert [(info.kind, info.task) for info in infos] == [
        ("imported", ""),
        ("trial", "cube_into_box"),
    ]
    assert [info.stand_in for info in infos] == [stand_in, stand_in]
    with pytest.raises(UsageError, match="no task named 'cube_in_box'"):
        import_rosbag2(tmp_path / "bag", run, episode="c", task="cube_in_box", output=QUIET)
    assert not (run / "episodes" / "c.mcap").exists()
