"""Replays of imported recordings that have no plan: files, provenance, what is skipped."""

import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.streams import pose_track
from bridge.terminal import Output
from evaluator.compare import compare_run
from twin.calibrate.config import CalibrateConfig
from twin.calibrate.physics.arm_motion import calibrate_physics
from twin.calibrate.physics.imported import ENGINE, replay_imported
from twin.calibrate.physics.push_fit import METHOD, frictions, load_push
from twin.physics.config import PhysicsConfig
from twin.replay.config import ReplayRunConfig
from twin.replay.runner import replay_run
from twin.replay.summary import describe_run
from twin.scene.store.calibration import write_physics

sys.path.insert(0, str(Path(__file__).parent))
import pushed_boxes

QUIET = Output(quiet=True)
TOOL = "/lab/tcp/pose"


@pytest.fixture
def run(tmp_path: Path) -> RunFolder:
    """Two pushes of the made robot, and one recording without a script."""
    load_push.cache_clear()
    folder = RunFolder.create(tmp_path / "run")
    pushed_boxes.write_robot(folder)
    pushed_boxes.write_recording(folder, "push_0001", 0.3, box_end_x_m=0.1)
    pushed_boxes.write_recording(folder, "push_0003", 0.4, box_end_x_m=0.1)
    pushed_boxes.write_recording(folder, "other", 0.4, motion=None)
    return folder


def replay(run: RunFolder, force: bool = False) -> dict[str, Any]:
    config = ReplayRunConfig(force=force, workers=1)
    return replay_run(run, config, QUIET, replay_imported(run, config, QUIET))


def test_each_trajectory_becomes_an_episode_that_says_what_it_is(run: RunFolder) -> None:
    summary = replay(run)
    rows = summary["imported"]
    assert [(row["episode"], row["trajectory"]) for row in rows] == [
        (name, trajectory)
        for name in ("push_0001", "push_0003")
        for trajectory in ("executed", "planned")
    ]
    assert summary["skipped_episodes"] == {}
    assert "executed (measured tool): 2 replays" in describe_run(summary)
    executed = Episode.open(Path(rows[0]["path"]))
    derived = executed.derived
    recorded = Episode.open(run.episodes_dir / "push_0001.mcap")
    assert derived is not None
    assert (derived.source_episode, derived.source_sha256) == ("push_0001", recorded.sha256())
    assert (derived.engine, derived.trajectory, derived.plan_id) == (ENGINE, "executed", None)
    assert derived.settings["fitted_to"] == []
    tool, box = (
        pose_track(executed, topic) for topic in ("/lab/tcp/pose", "/lab/object/cube/pose")
    )
    measured = pose_track(recorded, "/lab/tcp/pose")
    assert tool.p_m == pytest.approx(measured.at(tool.stamps_ns).p_m, abs=0.003)
    # The palm's face ends 0.02 m before the hand's origin, at 0 m; the box is pushed on from there.
    assert 0.06 <= box.p_m[-1, 0] < 0.12
    # Nothing moves by the schedule of the made arm, so neither does the box.
    planned = pose_track(Episode.open(Path(rows[1]["path"])), "/lab/object/cube/pose")
    assert planned.p_m[-1] == pytest.approx([0.0, 0.0, 0.03], abs=1e-6)


def test_a_second_replay_keeps_what_is_there(run: RunFolder) -> None:
    first = {row["path"]: Path(row["path"]).read_bytes() for row in replay(run)["imported"]}
    again = replay(run)["imported"]
    assert all(row["skipped"] for row in again)
    forced = replay(run, force=True)["imported"]
    assert not any(row["skipped"] for row in forced)
    assert {row["path"]: Path(row["path"]).read_bytes() for row in forced} == first


def test_a_calibration_by_pushes_is_used_and_its_runs_do_not_count(run: RunFolder) -> None:
    replay(run)
    own = PhysicsConfig().object_friction
    record = {
        "method": METHOD,
        "promoted": True,
        "identified": {"surface_friction": {"value": 0.3 / own}},
        "parameters": {"finger_rad": {"value": 0.1}},
        "fitted_to": ["push_0001"],
        "id": "x",
    }
    write_physics(run, record)
    rows = replay(run)["imported"]
    settings = Episode.open(Path(rows[0]["path"])).derived.settings
    expected = frictions(0.3, own, PhysicsConfig())
    assert settings["physics"]["surface_friction"] == pytest.approx(expected.surface_friction)
    assert settings["finger_rad"] == 0.1
    comparison = compare_run(run)
    found = comparison.results().get(
        f"body.push.{ENGINE}_executed_calibrated.cube.end_point_median_m"
    )
    assert found.n == 1
    nominal = comparison.results().get(f"body.push.{ENGINE}_executed.cube.end_point_median_m")
    assert nominal.n == 2
    assert [e.episode for e in comparison.exclusions if "fitted" in e.reason] == ["push_0001"] * 2


def test_planned_replays_follow_the_arm_as_it_was_seen_to_move(tmp_path: Path) -> None:
    run = RunFolder.create(tmp_path / "run")
    pushed_boxes.write_robot(run)
    for number in range(1, 5):
        pushed_boxes.write_turning(run, f"turn_{number}", number)
    nominal = [Path(row["path"]) for row in replay(run)["imported"]]
    record, words = calibrate_physics(run, CalibrateConfig(physics=True), QUIET)
    assert record["motion"]["delay_s"]["push"] == pytest.approx(pushed_boxes.DELAY_S, abs=0.02)
    assert "physics" not in record
    assert "physics: 0 pushes" in words
    assert re.search(r"zero of turn .* not determined: only together with (base|tool)", words)
    rows = replay(run)["imported"]
    for row, before in zip(rows, nominal, strict=True):
        recorded = pose_track(Episode.open(run.episodes_dir / f"{row['episode']}.mcap"), TOOL)
        ends = [
            float(np.linalg.norm(pose_track(Episode.open(path), TOOL).p_m[-1] - recorded.p_m[-1]))
            for path in (before, Path(row["path"]))
        ]
        assert ends[0] > 0.004  # though its tool is laid over the recorded one at the start
        assert ends[1] < 0.0015
    derived = Episode.open(Path(rows[1]["path"])).derived
    assert derived.settings["fitted_to"] == ["turn_1", "turn_3"]
    assert derived.calibration_id == record["calibration_id"]


def test_a_robot_that_is_gone_is_named_and_the_rest_goes_on(run: RunFolder) -> None:
    (run.path / "robot" / "hand.urdf").unlink()
    summary = replay(run)
    assert summary["imported"] == []
    assert set(summary["skipped_episodes"]) == {"push_0001", "push_0003"}
    assert "Import the data set again" in summary["skipped_episodes"]["push_0001"]
