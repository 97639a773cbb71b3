"""A recording that a person calls a trial is one for every reader, and not a byte of it changes."""

from pathlib import Path

import pytest

from bridge.cli.episodes import label
from bridge.episode.catalogue import find_episodes
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.streams import task_file
from bridge.episode.writer import EpisodeWriter
from bridge.errors import EpisodeError, UsageError
from bridge.terminal import Output

QUIET = Output(quiet=True)


def run_with(tmp_path: Path, info: EpisodeInfo, attached: str = "") -> tuple[RunFolder, Path]:
    run = RunFolder.create(tmp_path / "run")
    path = run.episodes_dir / f"{info.id}.mcap"
    with EpisodeWriter(path) as writer:
        writer.describe(info)
        if attached:
            text = (Path("datasets/tasks") / f"{attached}.toml").read_bytes()
            writer.attach("task.toml", text, media_type="application/toml", log_time_ns=1)
    return run, path


def test_an_imported_episode_becomes_a_trial_of_a_task_from_a_start(tmp_path: Path) -> None:
    run, path = run_with(tmp_path, EpisodeInfo(id="bag", kind="imported"))
    before = path.read_bytes()
    assert [(entry.kind, entry.outcome) for entry in find_episodes(run)] == [
        ("imported", "unknown")
    ]
    arguments = {"task": "cube_into_box", "start": "s7", "policy": "act", "result": "success"}
    assert label(run.path, "bag", **arguments, output=QUIET) == 0
    info = Episode.open(path).info
    assert (info.kind, info.task, info.start_id, info.policy) == (
        "trial",
        "cube_into_box",
        "s7",
        "act",
    )
    (entry,) = find_episodes(run)
    assert (entry.kind, entry.task, entry.outcome, entry.start_id) == (
        "trial", "cube_into_box", "success", "s7",
    )  # fmt: skip
    assert path.read_bytes() == before
    label(run.path, "bag", task="cube_on_block", output=QUIET)
    info = Episode.open(path).info
    assert (info.task, info.start_id, info.policy) == ("cube_on_block", "s7", "act"), (
        "the rest stays"
    )


def test_another_task_is_read_from_its_own_file_and_not_from_the_attachment(tmp_path: Path) -> None:
    info = EpisodeInfo(id="t", kind="trial", task="cube_into_box")
    run, path = run_with(tmp_path, info, attached="cube_into_box")
    assert task_file(Episode.open(path)).task().name == "cube_into_box"
    label(run.path, "t", task="cube_on_block", output=QUIET)
    assert task_file(Episode.open(path)).task().name == "cube_on_block"


def test_what_would_count_nowhere_is_refused_with_the_way_out(tmp_path: Path) -> None:
    run, _ = run_with(tmp_path, EpisodeInfo(id="bag", kind="imported"))
    with pytest.raises(UsageError, match="no trial yet: say of which task, --task NAME"):
        label(run.path, "bag", result="success", output=QUIET)
    with pytest.raises(UsageError, match="add --task NAME"):
        label(run.path, "bag", start="s1", output=QUIET)
    with pytest.raises(UsageError, match="cube_into_box"):
        label(run.path, "bag", task="cube_in_box", output=QUIET)
    scans, _ = run_with(tmp_path / "scans", EpisodeInfo(id="scan", kind="scan"))
    with pytest.raises(UsageError, match="scan is a scan"):
        label(scans.path, "scan", task="cube_into_box", output=QUIET)


@pytest.mark.parametrize("text", ["", "[]", "{", '{"task": 3}', '{"start_id": "s"}', "[" * 5000])
def test_a_damaged_note_is_named(tmp_path: Path, text: str) -> None:
    run, path = run_with(tmp_path, EpisodeInfo(id="bag", kind="imported"))
    run.notes_dir.mkdir(exist_ok=True)
    (run.notes_dir / "bag.trial.json").write_text(text)
    with pytest.raises(EpisodeError, match=r"bag\.trial\.json.*label RUN EPISODE --task NAME"):
        _ = Episode.open(path).info
