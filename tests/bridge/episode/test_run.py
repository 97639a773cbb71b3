"""Which files of a run are episodes."""

import errno
import os
from pathlib import Path

import pytest

from bridge.episode import run_folder
from bridge.errors import BridgeError, PathNotFoundError, UsageError


def run_with(folder: Path, *names: str) -> run_folder.RunFolder:
    run = run_folder.RunFolder.create(folder / "run")
    for name in names:
        (run.episodes_dir / name).write_bytes(b"")
    return run


def listed(run: run_folder.RunFolder) -> list[str]:
    return [path.name for path in run.episodes()]


def test_files_of_takes_still_open_are_no_episodes(tmp_path: Path) -> None:
    run = run_with(tmp_path, "t1.mcap.part", "t1.2.mcap.part", "notes.txt")
    assert listed(run) == []
    assert [path.name for path in run.unfinished()] == ["t1.2.mcap.part", "t1.mcap.part"]


def test_derived_files_are_found_by_a_pattern_and_unfinished_ones_are_told_apart(
    tmp_path: Path,
) -> None:
    run = run_with(tmp_path)
    assert run.derived() == []
    run.derived_dir.mkdir()
    names = ["t1.localised.mcap", "t1.replay.planned.mcap", "t2.replay.planned.mcap"]
    for name in (*reversed(names), "t3.replay.planned.mcap.part", "notes.txt"):
        (run.derived_dir / name).write_bytes(b"")
    assert [path.name for path in run.derived()] == names
    assert [path.name for path in run.derived("*.replay.*")] == names[1:]
    assert run.derived("t1.*") == [run.derived_dir / name for name in names[:2]]
    assert run.unfinished() == [run.derived_dir / "t3.replay.planned.mcap.part"]


def test_a_file_is_not_called_missing(tmp_path: Path) -> None:
    path = tmp_path / "trial_0001.mcap"
    path.write_bytes(b"")
    with pytest.raises(UsageError, match="is a file, not a run") as caught:
        run_folder.RunFolder.open(path)
    assert not isinstance(caught.value, PathNotFoundError)


def test_a_folder_that_is_not_there_is_called_missing(tmp_path: Path) -> None:
    with pytest.raises(PathNotFoundError, match="run folder not found"):
        run_folder.RunFolder.open(tmp_path / "nowhere")


def test_two_commands_do_not_write_into_one_folder_at_once(tmp_path: Path) -> None:
    run = run_with(tmp_path, "t1.mcap")
    taken = pytest.raises(UsageError, match="another command writes into")
    with run.alone_in(run.derived_dir), run.alone_in(run.scene_dir), taken:
        run.alone_in(run.derived_dir).__enter__()
    with run.alone_in(run.derived_dir):
        assert list(run.derived_dir.iterdir()) == []


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS])
def test_a_disk_that_takes_nothing_is_found_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    run_folder.refuse_full(tmp_path / "scene")
    assert list((tmp_path / "scene").iterdir()) == []
    monkeypatch.setattr(os, "posix_fallocate", refuse)
    with pytest.raises(BridgeError, match=os.strerror(number)):
        run_folder.refuse_full(tmp_path / "scene")
