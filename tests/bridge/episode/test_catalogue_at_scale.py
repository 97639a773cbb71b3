"""Thousands of episodes, several processes, and commands as a person runs them."""

import os
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import pytest

from bridge.episode import catalogue
from bridge.episode.catalogue import list_episodes
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter

ROOT = Path(__file__).resolve().parents[3]
NUM_EPISODES = int(os.environ.get("GST_LISTED", "2500"))
"""``make soak`` lists ten thousand."""

pytestmark = pytest.mark.slow


def fill(run: RunFolder, count: int) -> None:
    """Copies of one tiny episode; what they say differs only in their names."""
    first = run.episodes_dir / "t00000.mcap"
    with EpisodeWriter(first) as writer:
        writer.describe(EpisodeInfo(id="t", kind="trial", task="cube"))
        writer.write_foreign("/x", b"x", schema_record=None, log_time_ns=1)
    data = first.read_bytes()
    for index in range(1, count):
        (run.episodes_dir / f"t{index:05}.mcap").write_bytes(data)


def ls(run: RunFolder, *arguments: str) -> list[str]:
    """The lines that the command prints."""
    done = subprocess.run(
        [sys.executable, "robot_gst.py", "ls", str(run.path), *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.splitlines()


def test_thousands_of_episodes_are_listed_without_opening_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``make bench BENCH=record_catalogue`` measures how long that takes."""
    run = RunFolder.create(tmp_path / "run")
    fill(run, NUM_EPISODES)
    long_ago_ns = time.time_ns() - 10**11  # young files are not trusted to stay as they are
    for path in run.episodes():
        os.utime(path, ns=(long_ago_ns, long_ago_ns))
    assert len(list_episodes(run)) == NUM_EPISODES
    opened: list[Path] = []
    monkeypatch.setattr(catalogue, "read_entry", lambda run, path: opened.append(path))
    assert len(list_episodes(run)) == NUM_EPISODES
    assert opened == []
    lines = ls(run, "--task", "cube", "--sort", "start", "--reverse", "--limit=9")
    assert (len(lines), lines[1].split()[0]) == (10, f"t{NUM_EPISODES - 1:05}")
    (run.episodes_dir / "t00500.mcap").unlink()
    assert len(ls(run)) == NUM_EPISODES  # with the header


def list_again_and_again(path: Path) -> set[int]:
    return {len(list_episodes(RunFolder(path))) for _ in range(10)}


def test_processes_that_list_at_once_all_get_the_answer(tmp_path: Path) -> None:
    run = RunFolder.create(tmp_path / "run")
    fill(run, 100)
    with ProcessPoolExecutor(4) as pool:
        assert set.union(*pool.map(list_again_and_again, [run.path] * 8)) == {100}
