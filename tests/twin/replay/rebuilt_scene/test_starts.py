"""Where a replay starts: from localisation, or from nothing with a reason."""

from pathlib import Path

import pytest

from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.errors import UsageError
from bridge.task.task_file import load_task
from bridge.terminal import Output
from twin.cli import replay
from twin.replay.scene import localised_starts


def test_an_episode_without_cameras_starts_from_nothing_and_says_why(tmp_path: Path) -> None:
    run = RunFolder.create(tmp_path)
    with EpisodeWriter(run.episodes_dir / "trial_0001.mcap") as writer:
        writer.describe(EpisodeInfo(id="trial_0001", kind="trial", cell="standin"))
        writer.write_json(
            "/standin/event",
            {"schema_version": 1, "stamp_ns": 5, "type": "mark"},
            type_name="gst/Event",
            log_time_ns=5,
        )
    episode = Episode.open(run.episodes_dir / "trial_0001.mcap")
    task = load_task("cube_into_box")
    start = localised_starts(run, episode, task, scene_hash=None).at(10)
    assert not start.Ts_base_object
    assert set(start.reasons) == {"cube", "box"}
    assert all(start.reasons.values())


def test_the_command_refuses_a_run_without_episodes(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no episodes in"):
        replay(RunFolder.create(tmp_path / "run").path, output=Output(quiet=True, json=True))
