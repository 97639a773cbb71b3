"""What pictures will lack is said before they are drawn, and none are tried without a scene."""

from pathlib import Path

import pytest

from bridge.episode.metadata import EpisodeInfo
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.errors import PathNotFoundError
from bridge.task.task_file import load_task
from bridge.terminal import Output
from twin.replay.config import ReplayRunConfig
from twin.replay.runner import describe_undrawn, replay_run
from twin.scene.store.folder import write_record


def test_pictures_without_a_scene_are_refused_before_anything_is_replayed(tmp_path: Path) -> None:
    run = RunFolder.create(tmp_path / "run")
    with EpisodeWriter(run.episodes_dir / "scan.mcap") as writer:
        writer.describe(EpisodeInfo(id="scan", kind="scan"))
    with pytest.raises(PathNotFoundError, match=r"--render draws it.*robot-gst rebuild RUN"):
        replay_run(run, ReplayRunConfig(render=True), Output(quiet=True))


def test_what_was_not_scanned_and_a_missing_robot_are_named_with_the_reason(tmp_path: Path) -> None:
    run = RunFolder.create(tmp_path / "run")
    run.scene_dir.mkdir()
    record = {
        "schema_version": 1, "key": "k", "scene_hash": "h", "background": {}, "sources": [],
        "views": [], "objects": {"box": {}}, "objects_remark": "cube not found: hidden",
        "robot": {"links": {}, "remark": "no joints"},
    }  # fmt: skip
    write_record(run, record)
    assert describe_undrawn(run, [load_task("cube_into_box")]) == [
        "cube was not scanned: drawn from the task's shape, with colours from before the first "
        "motion (cube not found: hidden)",
        "robot: not in the scene, not in pictures (no joints)",
    ]
