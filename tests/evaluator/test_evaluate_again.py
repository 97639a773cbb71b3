"""Evaluating a run again: only what changed is read, and the answer is that of a first time."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from bridge.episode.catalogue import label_episode
from bridge.episode.metadata import Outcome
from bridge.episode.provenance import hash_file
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from evaluator.cache import FOLDER, SummaryCache
from evaluator.cli import evaluate
from evaluator.compare import Comparison, compare_run
from evaluator.result import write_results
from evaluator.run_reader import contents

pytestmark = pytest.mark.usefixtures("unchecked")  # a first evaluation is checked elsewhere


def again(run: RunFolder, **asked: Any) -> Comparison:
    """Evaluate as the command does, with the run's own cache."""
    with SummaryCache(run.results_dir / FOLDER, **asked) as cache:
        return compare_run(run, cache=cache)


def settle(run: RunFolder) -> None:
    """Let all files of a run look old enough to be trusted by their stamps."""
    for path in [*run.episodes(), *run.derived()]:
        os.utime(path, ns=(10**18, 10**18))


def written(comparison: Comparison, folder: Path) -> bytes:
    """Return the bytes of results.json."""
    return write_results(comparison.results(), folder / "results.json").read_bytes()


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the episodes that were opened."""
    names: list[str] = []
    really_open = Episode.open

    def open_and_note(path: Path) -> Episode:
        names.append(path.name)
        return really_open(path)

    monkeypatch.setattr(Episode, "open", staticmethod(open_and_note))
    return names


@pytest.fixture
def hashed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the episodes whose bytes were read whole."""
    names: list[str] = []
    really_hash = contents.hash_file

    def hash_and_note(path: Path) -> str:
        if path.suffix == ".mcap":
            names.append(path.name)
        return really_hash(path)

    monkeypatch.setattr(contents, "hash_file", hash_and_note)
    return names


def test_kept_and_read_give_the_same_bytes(six_trials: Any, tmp_path: Path) -> None:
    run = six_trials.run
    label_episode(run, "a2", Outcome(result="success", k=1, n=1, by="reviewer"))
    plain = written(compare_run(run), tmp_path / "plain")
    assert written(again(run), tmp_path / "first") == plain
    assert written(again(run), tmp_path / "second") == plain


def test_nothing_is_opened_or_hashed_twice(
    six_trials: Any, opened: list[str], hashed: list[str]
) -> None:
    settle(six_trials.run)
    again(six_trials.run)
    assert set(opened) == set(hashed)
    assert len(hashed) == 18
    opened.clear()
    hashed.clear()
    again(six_trials.run)
    assert (opened, hashed) == ([], [])


def test_young_files_are_hashed_again_but_not_read_again(
    six_trials: Any, opened: list[str], hashed: list[str]
) -> None:
    for path in six_trials.run.episodes():
        os.utime(path)
    again(six_trials.run)
    opened.clear()
    hashed.clear()
    again(six_trials.run)
    assert opened == []
    assert {path.name for path in six_trials.run.episodes()} <= set(hashed)


def test_a_touched_file_with_other_bytes_is_read_again(six_trials: Any) -> None:
    run = six_trials.run
    settle(run)
    assert len(again(run).rows) == 6
    path = run.episodes_dir / "a1.mcap"
    path.unlink()
    six_trials.trial("a1", recorded="failure")
    comparison = again(run)
    assert comparison.provenance["episodes"]["episodes/a1.mcap"] == hash_file(path)
    (row,) = [row for row in comparison.rows if row.episode == "a1"]
    assert row.recorded is False
    reasons = [e.reason for e in comparison.exclusions if e.episode == "a1"]
    assert any("another version of the episode" in reason for reason in reasons)


def test_other_bytes_under_the_old_size_and_time_are_noticed(six_trials: Any) -> None:
    run = six_trials.run
    settle(run)
    before = again(run).provenance
    path = run.derived()[0]
    data = bytearray(path.read_bytes())
    data[-9] ^= 1  # of the footer
    path.write_bytes(data)
    os.utime(path, ns=(10**18, 10**18))
    after = again(run)
    name = f"derived/{path.name}"
    assert name in before["derived"]
    assert name not in after.provenance["derived"]
    assert any(e.episode == path.name and "CRC" in e.reason for e in after.exclusions)


def test_removed_episodes_vanish(six_trials: Any) -> None:
    settle(six_trials.run)
    again(six_trials.run)
    (six_trials.run.episodes_dir / "a1.mcap").unlink()
    for path in six_trials.run.derived("b1.replay.*"):
        path.unlink()
    comparison = again(six_trials.run)
    assert [row.episode for row in comparison.rows] == ["a2", "a3", "b1", "b2", "b3"]
    assert comparison.results().get("agreement.sim_planned.rate").n == 4
    assert "episodes/a1.mcap" not in comparison.provenance["episodes"]


def test_a_label_given_between_two_evaluations_counts(six_trials: Any, hashed: list[str]) -> None:
    settle(six_trials.run)
    assert again(six_trials.run).rows[0].recorded is True
    label_episode(six_trials.run, "a1", Outcome(result="failure", k=0, n=1, by="reviewer"))
    hashed.clear()
    assert again(six_trials.run).rows[0].recorded is False
    assert hashed == []  # gigabytes are not hashed again for a label


def test_a_run_that_was_moved_gives_the_same_answer(six_trials: Any, tmp_path: Path) -> None:
    run = six_trials.run
    (run.derived_dir / "broken.replay.mcap").write_bytes(b"")
    first = again(run)
    moved = RunFolder(Path(shutil.move(run.path, tmp_path / "elsewhere" / run.path.name)))
    second = again(moved)
    assert second.measurements == first.measurements
    assert str(run.path) not in " ".join(e.reason for e in second.exclusions)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda path: path.write_bytes(b""),
        lambda path: path.write_bytes(b"\x89MCAP0\r\n" * 50),
        lambda path: path.write_bytes(path.read_bytes()[:-40]),
        lambda path: (path.unlink(), path.symlink_to("nowhere")),
        lambda path: (path.unlink(), path.mkdir()),
    ],
)
def test_a_broken_file_costs_itself_only_and_is_named_each_time(
    six_trials: Any, spoil: Callable[[Path], object]
) -> None:
    spoil(six_trials.run.episodes_dir / "a1.mcap")
    spoil(six_trials.run.derived("b1.replay.planned*")[0])
    for _ in range(2):
        comparison = again(six_trials.run)
        assert len(comparison.rows) == 5
        named = {e.episode for e in comparison.exclusions if e.scope == "everything"}
        assert "a1.mcap" in named
        assert any(name.startswith("b1.replay.planned") for name in named)


def test_the_command_keeps_and_forgets(
    six_trials: Any, opened: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    settle(six_trials.run)
    assert evaluate(six_trials.run.path) == 0
    first = (six_trials.run.results_dir / "results.json").read_bytes()
    opened.clear()
    assert evaluate(six_trials.run.path) == 0
    assert opened == []
    assert (six_trials.run.results_dir / "results.json").read_bytes() == first
    shutil.rmtree(six_trials.run.results_dir / "cache")
    assert evaluate(six_trials.run.path) == 0
    assert opened != []
    assert (six_trials.run.results_dir / "results.json").read_bytes() == first
    assert "results/cache" not in capsys.readouterr().err
