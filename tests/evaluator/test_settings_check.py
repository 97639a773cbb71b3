"""What is said of replays that were not all made in one scene with the same settings."""

from pathlib import Path
from typing import Any

import pytest

from bridge.episode.metadata import Derived, EpisodeInfo
from bridge.episode.writer import EpisodeWriter
from evaluator.compare import Comparison, compare_run
from evaluator.compare.trial import CELLS_ENGINE
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


def test_the_report_says_so_beside_the_rates_it_is_about(two: Any, tmp_path: Path) -> None:
    two.replay("a", scene_hash=OLD)
    two.replay("b", scene_hash=NEW)
    report = write_report(compare_run(two.run), tmp_path / "out").report.read_text()
    note = f"1 in scene {OLD}"
    meaning, rates, cells = (
        report.index(f'id="{part}"') for part in ("meaning", "success", "agreement")
    )
    assert meaning < report.index(note) < rates  # on the first page
    assert rates < report.index(note, rates) < cells
    assert "1 groups" not in report


def measured(comparison: Comparison, name: str) -> tuple[float | None, int | None]:
    (found,) = [m for m in comparison.measurements if m.id == name]
    return found.value, found.n


def test_what_the_engine_of_the_cell_says_is_passed_over_and_counted_in_a_note(two: Any) -> None:
    for name in ("a", "b"):
        two.replay(name, accepted=True, engine="pybullet-1")
    before = measured(compare_run(two.run), "agreement.sim_planned.rate")
    for name in ("a", "b"):  # newer, and of the opposite opinion
        two.replay(name, accepted=False, engine="mujoco-2", tag="b")
    comparison = compare_run(two.run)
    assert measured(comparison, "agreement.sim_planned.rate") == before == (1.0, 2)
    assert said_of_replays(comparison) == [
        "2 that never count were made in mujoco-2, the same engine as the cell"
    ]
    assert not [e for e in comparison.exclusions if "mujoco" in e.reason]


def test_the_cells_own_engine_is_held_beside_the_twin_and_never_counted(two: Any) -> None:
    two.replay("a", engine="pybullet-1")
    two.replay("a", accepted=False, engine="mujoco-2", tag="b")
    comparison = compare_run(two.run)
    row = next(row for row in comparison.rows if row.episode == "a")
    assert row.sim_planned is True
    assert dict(row.baselines) == {CELLS_ENGINE: False}
    rate = next(
        m for m in comparison.measurements if m.id == "baseline.sim_planned.cell_s_own_engine.rate"
    )
    assert (rate.k, rate.n) == (0, 1)


@pytest.mark.parametrize("engine", ["mujoco-2", "pybullet-1 and mujoco-2"])
def test_a_trial_with_nothing_but_the_cells_own_engine_is_left_out_with_the_reason(
    two: Any, engine: str
) -> None:
    two.replay("a", engine="pybullet-1")
    path = two.replay("b", engine=engine)
    comparison = compare_run(two.run)
    assert measured(comparison, "agreement.sim_planned.rate") == (1.0, 1)
    reasons = [e.reason for e in comparison.exclusions if e.episode == "b"]
    assert f"{path.name} does not count: made in {engine}, the same engine as the cell" in reasons


def test_of_a_real_cell_mujoco_counts_unless_it_was_asked_beside_another(maker: Any) -> None:
    maker.trial("a", stand_in=False)
    maker.replay("a", engine="mujoco-2", stand_in=False)
    assert measured(compare_run(maker.run), "agreement.sim_planned.rate") == (1.0, 1)
    maker.replay(
        "a", accepted=False, engine="mujoco-3", tag="b", stand_in=False,
        settings={"second_engine": True},
    )  # fmt: skip
    comparison = compare_run(maker.run)
    assert measured(comparison, "agreement.sim_planned.rate") == (1.0, 1)
    assert said_of_replays(comparison) == [
        "1 that never count were made in mujoco-3, beside the engine that decides"
    ]


def test_a_verdict_of_a_gate_in_the_cells_own_engine_does_not_count(maker: Any) -> None:
    maker.trial("a", gate=True, gate_engine="pybullet-1")
    maker.trial("b", gate=True, gate_engine="mujoco-2")
    comparison = compare_run(maker.run)
    assert measured(comparison, "agreement.verdict.rate") == (1.0, 1)
    (reason,) = [e.reason for e in comparison.exclusions if "gate" in e.reason]
    assert reason == (
        "the gate's verdict does not count: made in mujoco-2, the same engine as the cell"
    )
