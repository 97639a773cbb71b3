"""Two runs of the same trials: the page shows what the evaluator finds, no more."""

import re
import shutil
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from visible import words

from bridge.episode.run_folder import RunFolder
from bridge.terminal import Output
from dashboards.guard import Admission
from dashboards.library import Library
from evaluator.compare.several import with_against
from evaluator.result import Table


@pytest.fixture
def runs(shared_run: RunFolder, synthetic: ModuleType, tmp_path: Path) -> tuple[RunFolder, ...]:
    """Return a run, and a copy of it in whose twin trial 2 succeeds, in another engine."""
    first, second = (tmp_path / name for name in ("monday", "tuesday"))
    for path in (first, second):
        shutil.copytree(shared_run.path, path)
    other = RunFolder.open(second)
    for path in other.derived_dir.glob("trial_0002.replay.planned.*"):
        path.unlink()
    synthetic.write_replay(other, synthetic.TRIALS[1], "planned", True, engine="rigid-two")
    return RunFolder.open(first), other


def cells(table: Table, row: int = 0) -> dict[str, Any]:
    return dict(zip(table.columns, table.rows[row], strict=True))


def test_two_runs_show_what_evaluate_against_finds(
    runs: tuple[RunFolder, ...], synthetic: ModuleType
) -> None:
    first, second = runs
    text = synthetic.browser_of(first, second).get("/compare?with=tuesday").text
    seen = words(text)
    comparison = synthetic.compare_run(first)
    found = with_against(comparison, first.path, second.path, output=Output(quiet=True))
    (against,) = (table for table in found.tables if table.id == "against")
    for row in range(len(against.rows)):
        for name in ("monday", "tuesday", "difference"):
            value = cells(against, row)[name]
            assert value is None or f"{value:.3f}".replace("-", "−") in seen
    assert "Trials that flip: 1 of 3" in seen
    assert re.findall(r'<a href="/episode/(\w+)\?run=monday', text) == ["trial_0002"]
    assert re.search(
        r"Settings of the replays that differ: 1 .* engine bullet bullet, rigid-two", seen
    )
    assert "robot-gst evaluate" in seen
    back = words(synthetic.browser_of(second, first).get("/compare?with=monday").text)
    assert "Trials that flip: 1 of 3" in back


def test_runs_without_a_common_trial_show_only_the_numbers_that_differ(
    runs: tuple[RunFolder, ...], synthetic: ModuleType
) -> None:
    first, second = runs
    for path in (second.episodes_dir, second.derived_dir):
        for file in path.iterdir():
            file.unlink()
    for trial in synthetic.TRIALS[:1]:
        synthetic.write_trial(second, replace(trial, id="other", start_id="s9"), images=False)
    comparison = synthetic.compare_run(second)
    synthetic.write_results(comparison.results(), second.results_dir / "results.json")
    text = synthetic.browser_of(first, second).get("/compare?with=tuesday").text
    seen = words(text)
    assert "No trial has an outcome and an answer of both twins" in seen
    assert "Numbers that differ" in seen
    assert "these are not pairs" in seen
    assert "rate.recorded.cube_into_box.without" in text.replace("<wbr>", "")
    again = words(synthetic.browser_of(first, first).get("/compare").text)
    assert "Numbers that differ" not in again


def test_what_cannot_be_compared_is_said(browser: Any, own_run: RunFolder, synthetic: Any) -> None:
    assert browser.get("/compare").status_code == 200
    assert browser.get("/compare?with=..%2F..%2Fetc").status_code == 404
    alone = words(synthetic.browser_of(own_run).get("/compare").text)
    assert "nothing to hold this run against" in alone


def test_runs_beside_a_run_are_offered_on_the_loopback_address_alone(
    runs: tuple[RunFolder, ...], synthetic: ModuleType, tmp_path: Path
) -> None:
    (tmp_path / "no_run").mkdir()
    assert list(Library.open([runs[0].path]).others(runs[0], beside=True)) == ["tuesday"]
    assert "with=tuesday" in synthetic.browser_of(runs[0]).get("/compare").text
    outside = Admission(host="127.0.0.1.example", token=None)
    app = synthetic.create_app(Library.open([runs[0].path]), outside)
    hidden = synthetic.Browser(app).get("/compare", headers={"Host": "127.0.0.1.example"})
    assert hidden.status_code == 200
    assert "tuesday" not in hidden.text
