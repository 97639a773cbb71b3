"""Which files of a run are episodes, and which are parts of one."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.episode import run_folder


def run_with(folder: Path, *names: str) -> run_folder.RunFolder:
    run = run_folder.RunFolder.create(folder / "run")
    for name in names:
        (run.episodes_dir / name).write_bytes(b"")
    return run


def listed(run: run_folder.RunFolder) -> list[str]:
    return [path.name for path in run.episodes()]


def test_a_split_episode_is_listed_once_and_all_its_parts_are_found(tmp_path: Path) -> None:
    names = [run_folder.part_name("t1", index) for index in range(1, 12)]
    run = run_with(tmp_path, *reversed(names), "t2.mcap")
    assert listed(run) == ["t1.mcap", "t2.mcap"]
    assert [path.name for path in run_folder.part_paths(run.episodes()[0])] == names
    assert run_folder.part_paths(run.episodes()[1]) == [run.episodes()[1]]


def test_parts_behind_a_missing_one_go_with_their_episode(tmp_path: Path) -> None:
    run = run_with(tmp_path, "t1.mcap", "t1.3.mcap", "t1.4.mcap", "t2.10.mcap", "t2.2.mcap")
    assert listed(run) == ["t1.mcap", "t2.2.mcap"]
    found = [[path.name for path in run_folder.part_paths(first)] for first in run.episodes()]
    assert found == [["t1.mcap", "t1.3.mcap", "t1.4.mcap"], ["t2.2.mcap", "t2.10.mcap"]]


@pytest.mark.parametrize(
    "name", ["t1.02.mcap", "t1.1.mcap", "t1.0.mcap", "t1.x.mcap", "a.b.2.mcap"]
)
def test_a_name_that_only_looks_like_a_part_stands_for_itself(tmp_path: Path, name: str) -> None:
    run = run_with(tmp_path, "t1.mcap", "a.b.mcap", name)
    assert name in listed(run)
    parts = [part.name for path in run.episodes() for part in run_folder.part_paths(path)]
    assert parts == listed(run)


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


@given(st.sets(st.integers(1, 12)))
def test_every_file_belongs_to_exactly_one_episode(indices: set[int]) -> None:
    names = [run_folder.part_name("a", index) for index in sorted(indices)]
    assert list(run_folder.grouped_parts(names[::-1]).items()) == [
        (name, names) for name in names[:1]
    ]


def test_parts_of_a_file_that_is_not_there_are_the_file_alone(tmp_path: Path) -> None:
    assert run_folder.part_paths(tmp_path / "t9.mcap") == [tmp_path / "t9.mcap"]
