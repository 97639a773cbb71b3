"""What is said of replays that were not all made in one scene with the same settings."""

from pathlib import Path
from typing import Any

import pytest

from bridge.episode.metadata import Derived, EpisodeInfo
from bridge.episode.writer import EpisodeWriter
from evaluator.compare import Comparison, compare_run
from evaluator.report.write import write_report

OLD, NEW = "0123456789ab", "ba9876543210"


def said_of_replays(comparison: Comparison) -> list[str]:
    """Return the notes about replays."""
    tables = [table for table in comparison.tables if table.id == "notes"]
    return [str(text) for table in tables for about, text in table.rows if about == "replays"]


def settings(**config: Any) -> dict[str, Any]:
    """Return what a replay says of its making."""
    return {"replay_version": 18, "calibration_id": None, "config": {"mode": "dynamic", **config}}


@pytest.fixture
def two(maker: Any) -> Any:
    """Two trials without a replay."""
    for name in ("a", "b"):
        maker.trial(name, start_id=name)
    return maker


def views_of(maker: Any, scene_hash: str) -> Path:
    """Write held-out views of a scene; they hold no image."""
    path = Path(maker.run.derived_dir / f"scan.views.{scene_hash}.mcap")
    with EpisodeWriter(path) as writer:
        derived = Derived(
            kind="views", source_episode="scan", source_sha256="", scene_hash=scene_hash
        )
        writer.describe(EpisodeInfo(id="scan", kind="scan"), derived=derived)
    return path


def test_nothing_is_said_of_replays_that_were_made_alike(two: Any) -> None:
    views_of(two, NEW)
    for name in ("a", "b"):
        two.replay(name, scene_hash=NEW, settings=settings(seed=1, grasp="friction"))
    two.replay(
        "a", trajectory="executed", scene_hash=NEW, settings=settings(seed=2, grasp="friction")
    )
    assert said_of_replays(compare_run(two.run)) == []


def test_replays_of_two_scenes_in_one_rate_are_named(two: Any) -> None:
    two.replay("a", scene_hash=OLD)
    two.replay("b", scene_hash=NEW)
    (said,) = said_of_replays(compare_run(two.run))
    assert f"1 in scene {OLD}" in said
    assert f"1 in scene {NEW}" in said
    assert "robot-gst replay RUN" in said


@pytest.mark.parametrize(
    ("scene_hash", "word"), [(OLD, f"made in scene {OLD}"), (None, "made in no scene")]
)
def test_replays_of_another_scene_than_the_views_are_named(
    two: Any, scene_hash: str | None, word: str
) -> None:
    views_of(two, NEW)
    for name in ("a", "b"):
        two.replay(name, scene_hash=scene_hash)
    (said,) = said_of_replays(compare_run(two.run))
    assert said.startswith(word)
    assert f"held-out views are of scene {NEW}" in said


def test_the_setting_in_which_replays_differ_is_named(two: Any) -> None:
    two.replay("a", settings=settings(grasp="friction", physics={"object_friction": 0.5}))
    two.replay("b", settings=settings(grasp="friction", physics={"object_friction": 0.9}))
    (said,) = said_of_replays(compare_run(two.run))
    assert "physics.object_friction 0.5 in 1, 0.9 in 1" in said


def test_of_a_replay_with_other_settings_beside_it_the_one_that_counts_is_named(two: Any) -> None:
    for name in ("a", "b"):
        two.replay(name, settings=settings(grasp="friction"))
        two.replay(name, settings=settings(grasp="attach"), tag="b")
    (said,) = said_of_replays(compare_run(two.run))
    assert said.startswith("2 of the 2 that count were also made with other settings")
    assert "grasp attach in what counts, friction beside it" in said


@pytest.mark.parametrize("newer", ["replay_version", "calibration_id"])
def test_what_an_older_program_or_calibration_left_is_not_mentioned(two: Any, newer: str) -> None:
    for name in ("a", "b"):
        two.replay(name, settings=settings(grasp="friction"))
        two.replay(name, settings=settings(grasp="attach") | {newer: "next"}, tag="b")
    assert said_of_replays(compare_run(two.run)) == []


def test_the_report_says_so_beside_the_rates_it_is_about(two: Any, tmp_path: Path) -> None:
    two.replay("a", scene_hash=OLD)
    two.replay("b", scene_hash=NEW)
    report = write_report(compare_run(two.run), tmp_path / "out").report.read_text()
    rates, note, cells = (
        report.index(text) for text in ('id="success"', f"1 in scene {OLD}", 'id="agreement"')
    )
    assert rates < note < cells
    assert "1 groups" not in report
