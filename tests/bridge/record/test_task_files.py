"""A task file travels with the command to start, into the episode and into the run."""

from pathlib import Path

import pytest

from bridge.clock import AnchoredClock
from bridge.data_files import datasets_folder
from bridge.episode import streams
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.recover import recover_parts
from bridge.episode.run_folder import RunFolder
from bridge.errors import UsageError
from bridge.record.control import parse_task_file
from bridge.record.errors import ControlError
from bridge.record.recorder import Recorder
from bridge.task.check import TaskFileError
from bridge.task.find import ATTACHMENT, MissingTaskError
from bridge.task.task_file import MAX_BYTES, TaskFile

TEXT = (datasets_folder() / "tasks" / "cube_into_box.toml").read_text()
MINE = TaskFile(TEXT.replace("cube_into_box", "my_task").encode(), "my_task.toml")
SCAN = EpisodeInfo(id="scan", kind="scan")


def recorded(recorder: Recorder, info: EpisodeInfo, task: TaskFile | None) -> dict[str, object]:
    answer = recorder.start(info, task)
    recorder.stop()
    return answer


def test_the_text_is_in_the_episode_and_in_the_run_and_every_reader_finds_it(
    recorder: Recorder, run: RunFolder
) -> None:
    answer = recorded(recorder, SCAN, MINE)
    episode = Episode.open(run.episodes_dir / "scan.mcap")
    assert episode.attachment(ATTACHMENT) == MINE.data
    assert episode.info.task == "my_task"
    assert episode.info.task_sha256 == MINE.sha256
    assert episode.info.instruction == MINE.task().instruction
    assert answer["task_file"] == str(run.tasks_dir / "my_task.toml")
    assert (run.tasks_dir / "my_task.toml").read_bytes() == MINE.data
    assert streams.task_file(episode).task() == MINE.task()
    (run.tasks_dir / "my_task.toml").unlink()
    assert streams.task_file(episode).task() == MINE.task()


def test_another_file_of_the_same_name_is_kept_beside_the_first(
    recorder: Recorder, run: RunFolder
) -> None:
    other = TaskFile(MINE.data + b"# later\n", "my_task.toml")
    recorded(recorder, SCAN, MINE)
    answer = recorded(recorder, EpisodeInfo(id="scan_2", kind="scan"), other)
    assert "is another file; kept as my_task." in str(answer["task_remark"])
    for name, file in (("scan", MINE), ("scan_2", other)):
        episode = Episode.open(run.episodes_dir / f"{name}.mcap")
        assert streams.task_file(episode).data == file.data


def test_a_recorder_with_a_task_file_gives_it_to_episodes_that_name_no_other(
    run: RunFolder,
) -> None:
    recorder = Recorder(run, now_ns=AnchoredClock().now_ns, task=MINE)
    recorded(recorder, SCAN, None)
    recorded(recorder, EpisodeInfo(id="t1", kind="trial", task="my_task"), None)
    recorded(recorder, EpisodeInfo(id="t2", kind="trial", task="cube_into_box"), None)
    recorded(recorder, EpisodeInfo(id="t3", kind="trial", task="nobody knows it"), None)
    recorder.close()
    found = {path.stem: Episode.open(path).info for path in run.episodes()}
    assert found["scan"].task_sha256 == found["t1"].task_sha256 == MINE.sha256
    assert found["t2"].task_sha256 == TaskFile(TEXT.encode(), "").sha256
    assert (found["t3"].task, found["t3"].task_sha256) == ("nobody knows it", "")
    with pytest.raises(MissingTaskError, match=r"t3\.mcap: carries no task\.toml"):
        streams.task_file(Episode.open(run.episodes_dir / "t3.mcap"))


def test_a_recovered_episode_still_has_its_task(run: RunFolder) -> None:
    recorder = Recorder(run, now_ns=AnchoredClock().now_ns)
    recorder.start(SCAN, MINE)
    cut = next(run.episodes_dir.glob("scan.mcap.*part"))
    data = cut.read_bytes()
    recorder.stop()
    recorder.close()
    (run.episodes_dir / "scan.mcap").unlink()
    cut.write_bytes(data)
    recover_parts(run)
    assert streams.task_file(Episode.open(run.episodes_dir / "scan.mcap")).data == MINE.data


@pytest.mark.parametrize(
    ("value", "error"),
    [
        (7, ControlError),
        ("#" * (MAX_BYTES + 1), ControlError),
        ("name = 1", TaskFileError),
        (TEXT.replace("inside", "onside"), TaskFileError),
        ("\ud800", TaskFileError),
    ],
)
def test_what_is_no_task_file_is_refused_on_receipt(value: object, error: type[Exception]) -> None:
    with pytest.raises(error):
        parse_task_file(value)


@pytest.mark.parametrize(
    "info",
    [
        EpisodeInfo(id="t", kind="trial", task="another"),
        EpisodeInfo(id="t", kind="trial", task_sha256="0" * 64),
    ],
)
def test_a_description_that_contradicts_its_task_file_is_refused(
    recorder: Recorder, run: RunFolder, info: EpisodeInfo
) -> None:
    with pytest.raises(UsageError):
        recorder.start(info, MINE)
    assert recorder.status()["state"] == "idle"
    assert not list(run.episodes_dir.iterdir())


def test_a_run_whose_tasks_cannot_be_written_records_all_the_same(
    recorder: Recorder, run: RunFolder
) -> None:
    run.tasks_dir.write_text("in the way")
    answer = recorded(recorder, SCAN, MINE)
    assert "cannot be written" in str(answer["task_remark"])
    episode = Episode.open(Path(run.episodes_dir / "scan.mcap"))
    assert streams.task_file(episode).data == MINE.data
