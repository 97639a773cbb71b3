"""The recorder from command to file: what goes in comes out, its task too, or is refused."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.reader import make_reader

from bridge.clock import NS_PER_S, AnchoredClock
from bridge.data_files import datasets_folder
from bridge.episode import schema, streams
from bridge.episode.check import check_episode
from bridge.episode.metadata import EpisodeInfo, Outcome
from bridge.episode.reader import Episode
from bridge.episode.recover import recover_parts
from bridge.episode.run_folder import RunFolder
from bridge.episode.streams import events
from bridge.errors import UsageError
from bridge.record.config import QueueConfig, RecorderConfig
from bridge.record.control import parse_task_file
from bridge.record.errors import ControlError, LifecycleError
from bridge.record.recorder import Recorder
from bridge.task.check import TaskFileError
from bridge.task.find import ATTACHMENT, MissingTaskError
from bridge.task.task_file import MAX_BYTES, TaskFile
from bridge.wire.session import WireSample

MakeSample = Callable[..., WireSample]
INFO = EpisodeInfo(id="t1", kind="trial", cell="cell")


def path_of(run: RunFolder, name: str = "t1") -> Path:
    return run.episodes_dir / f"{name}.mcap"


def test_messages_come_out_as_they_went_in(
    recorder: Recorder, run: RunFolder, make_sample: MakeSample
) -> None:
    before = make_sample()
    recorder.receive(before)
    recorder.start(INFO)
    sent = [make_sample() for _ in range(50)]
    for sample in sent:
        recorder.receive(sample)
    answer = recorder.stop()
    recorder.receive(make_sample())
    assert answer["messages"] == 50
    assert answer["lost"] == 0
    with path_of(run).open("rb") as stream:
        found = [
            (m.data, m.publish_time, m.log_time, m.sequence)
            for _, channel, m in make_reader(stream, validate_crcs=True).iter_messages()
            if channel.topic == "/cell/joint_states"
        ]
    assert found == [(s.data, s.source_ns, s.received_ns, s.sequence) for s in sent]


@pytest.mark.parametrize(("stand_in", "early"), [(True, False), (True, True), (False, False)])
def test_only_of_a_stand_in_cell_the_clock_that_runs_ahead_is_that_of_the_log(
    recorder: Recorder, run: RunFolder, make_sample: MakeSample, stand_in: bool, early: bool
) -> None:
    """So its episode is as long as its motion; what was sent long before begins nothing early."""
    recorder.receive(make_sample(topic="/robot_description", type_name=schema.STRING))
    recorder.start(EpisodeInfo(id="t1", kind="trial", cell="cell", stand_in=stand_in))
    now_ns = make_sample().received_ns
    ahead_ns = now_ns + 60 * NS_PER_S
    if early:
        recorder.receive(make_sample(source_ns=1))
    for number in range(5):
        recorder.receive(make_sample(source_ns=ahead_ns + number * NS_PER_S))
    recorder.stop()
    with path_of(run).open("rb") as stream:
        found = [
            (channel.topic, m.log_time) for _, channel, m in make_reader(stream).iter_messages()
        ]
    times_ns = [log_ns for _, log_ns in found]
    if stand_in:
        assert max(times_ns) == ahead_ns + 4 * NS_PER_S
    else:
        assert max(times_ns) < ahead_ns - 30 * NS_PER_S
    if stand_in and not early:
        assert ("/robot_description", ahead_ns) in found
        assert min(times_ns) == ahead_ns
    else:
        assert now_ns - 20 * NS_PER_S < min(times_ns) < now_ns + 20 * NS_PER_S


def test_latched_messages_open_every_episode(
    recorder: Recorder, run: RunFolder, make_sample: MakeSample
) -> None:
    recorder.receive(make_sample(topic="/robot_description", type_name=schema.STRING, data=b"old"))
    recorder.receive(make_sample(topic="/robot_description", type_name=schema.STRING, data=b"urdf"))
    for name in ("a", "b"):
        recorder.start(EpisodeInfo(id=name, kind="trial"))
        recorder.receive(make_sample())
        assert recorder.stop()["messages"] == 1
        first = next(iter(Episode.open(path_of(run, name)).messages()))
        assert (first.topic, first.data) == ("/robot_description", b"urdf")


def test_marks_labels_and_outcome_are_in_the_episode(recorder: Recorder, run: RunFolder) -> None:
    recorder.start(INFO)
    recorder.mark("look here")
    recorder.label(outcome=Outcome(result="failure", detail="slipped"))
    recorder.stop()
    episode = Episode.open(path_of(run))
    assert [event["type"] for event in events(episode)] == ["mark", "label"]
    assert "/cell/event" in episode.topics()
    assert episode.outcome is not None
    assert (episode.outcome.result, episode.outcome.detail) == ("failure", "slipped")
    recorder.label(text="it held", outcome=Outcome(result="success"))
    note = json.loads((run.notes_dir / "t1.outcome.json").read_text())
    assert (note["result"], note["detail"]) == ("success", "it held")
    assert Episode.open(path_of(run)).outcome == episode.outcome  # the file is not rewritten


def test_a_discarded_take_leaves_nothing(recorder: Recorder, run: RunFolder) -> None:
    recorder.start(INFO)
    assert recorder.stop(discard=True)["discarded"]
    assert list(run.episodes_dir.iterdir()) == []
    recorder.start(INFO)  # the name is free again
    assert recorder.status()["state"] == "recording"


def test_commands_out_of_place_are_refused(recorder: Recorder, run: RunFolder) -> None:
    with pytest.raises(LifecycleError, match="nothing is being recorded"):
        recorder.stop()
    with pytest.raises(LifecycleError, match="no episode has been recorded"):
        recorder.label(text="x")
    recorder.start(INFO)
    with pytest.raises(LifecycleError, match="'t1' is being recorded"):
        recorder.start(EpisodeInfo(id="t2", kind="trial"))
    recorder.stop()
    with pytest.raises(UsageError, match="exists already"):
        recorder.start(INFO)
    with pytest.raises(UsageError, match=r"episode not found: .*Episodes here: t1"):
        recorder.label(episode="t9", outcome=Outcome(result="success"))


def test_a_take_that_was_cut_off_is_not_overwritten(recorder: Recorder, run: RunFolder) -> None:
    part = run.episodes_dir / "t1.mcap.part"
    part.write_bytes(b"precious")
    with pytest.raises(UsageError, match="cut off"):
        recorder.start(INFO)
    assert part.read_bytes() == b"precious"


def test_topics_without_end_are_dropped_and_counted(
    run: RunFolder, make_sample: MakeSample
) -> None:
    config = RecorderConfig(queues=QueueConfig(max_topics=5))
    recorder = Recorder(run, now_ns=AnchoredClock().now_ns, config=config)
    recorder.start(INFO)
    for number in range(9):
        recorder.receive(make_sample(topic=f"/t{number}", source_gid=bytes([number]) * 16))
    answer = recorder.stop()
    recorder.close()
    assert (answer["messages"], answer["lost"]) == (5, 4)


def test_a_message_nobody_thought_of_ends_nothing(
    recorder: Recorder,
    run: RunFolder,
    make_sample: Callable[..., WireSample],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def inspect_badly(*_: object) -> None:
        message = "a bug"
        raise ZeroDivisionError(message)

    recorder.start(EpisodeInfo(id="t1", kind="trial"))
    with monkeypatch.context() as patch:
        patch.setattr("bridge.episode.cdr.codec.decode", inspect_badly)
        recorder.receive(make_sample())
        recorder.receive(make_sample())
        recorder.mark("behind both")
    recorder.receive(make_sample())
    answer = recorder.stop()
    assert (answer["messages"], answer["lost"]) == (1, 2)
    assert capsys.readouterr().err.count("ZeroDivisionError: a bug") == 1


def test_an_ending_recorder_starts_nothing_and_forgives_a_stop_at_the_same_moment(
    recorder: Recorder, run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder.start(EpisodeInfo(id="t1", kind="trial"))
    stop = recorder.stop
    monkeypatch.setattr(recorder, "stop", lambda **options: (stop(), stop(**options))[1])
    assert recorder.close() is None
    assert [path.name for path in run.episodes_dir.iterdir()] == ["t1.mcap"]


def test_an_episode_without_an_id_gets_the_next_number_of_its_kind(run: RunFolder) -> None:
    for name in ("trial_0001.mcap", "trial_0002.mcap.part", "scan_0003.mcap"):
        (run.episodes_dir / name).touch()
    assert [run.free_id(kind) for kind in ("trial", "scan")] == ["trial_0003", "scan_0001"]
    (run.episodes_dir / "trial_0002.mcap.part").unlink()  # deleted, and its label forgotten
    run.notes_dir.mkdir()
    (run.notes_dir / "trial_0002.outcome.json").touch()
    assert run.free_id("trial") == "trial_0003"


def test_an_episode_takes_no_name_whose_label_is_left(recorder: Recorder, run: RunFolder) -> None:
    run.notes_dir.mkdir()
    (run.notes_dir / "t1.outcome.json").touch()
    with pytest.raises(UsageError, match=r"t1\.outcome\.json is the label of an earlier t1\."):
        recorder.start(INFO)
    assert not path_of(run).exists()


def test_an_episode_without_a_message_is_not_clean(recorder: Recorder, run: RunFolder) -> None:
    recorder.start(INFO)
    assert "nothing_recorded" in str(recorder.stop())
    report = check_episode(path_of(run))
    assert (report.summary, report.exit_code) == ("nothing recorded", 3)


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
