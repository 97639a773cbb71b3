"""What others recorded is a trial as soon as it is imported with a task, and stays a stand-in's."""

from pathlib import Path

import pytest

from bridge.cli.exchange import export_rosbag2, import_rosbag2
from bridge.episode import schema
from bridge.episode.cdr.messages import string_to_cdr
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.writer import EpisodeWriter
from bridge.errors import UsageError
from bridge.terminal import Output

QUIET = Output(quiet=True)


@pytest.mark.parametrize("stand_in", [True, False])
def test_a_bag_imported_with_a_task_is_a_trial(tmp_path: Path, stand_in: bool) -> None:
    path = tmp_path / "trial.mcap"
    with EpisodeWriter(path) as writer:
        writer.describe(EpisodeInfo(id="trial", kind="trial", stand_in=stand_in))
        text = string_to_cdr("<robot/>")
        writer.write("/robot_description", text, type_name=schema.STRING, log_time_ns=1)
    export_rosbag2(path, tmp_path / "bag", output=QUIET)
    run = tmp_path / "run"
    import_rosbag2(tmp_path / "bag", run, episode="a", output=QUIET)
    import_rosbag2(tmp_path / "bag", run, episode="b", task="cube_into_box", output=QUIET)
    infos = [Episode.open(run / "episodes" / f"{name}.mcap").info for name in "ab"]
    assert [(info.kind, info.task) for info in infos] == [
        ("imported", ""),
        ("trial", "cube_into_box"),
    ]
    assert [info.stand_in for info in infos] == [stand_in, stand_in]
    with pytest.raises(UsageError, match="no task named 'cube_in_box'"):
        import_rosbag2(tmp_path / "bag", run, episode="c", task="cube_in_box", output=QUIET)
    assert not (run / "episodes" / "c.mcap").exists()
