"""The recorder without the wire: what goes in comes out, and every wrong command is refused."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.reader import make_reader

from bridge.clock import AnchoredClock
from bridge.episode import schema
from bridge.episode.metadata import EpisodeInfo, Outcome
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.streams import events
from bridge.errors import UsageError
from bridge.record.config import EpisodeAbout, QueueConfig, RecorderConfig
from bridge.record.errors import LifecycleError
from bridge.record.process import Keys
from bridge.record.recorder import Recorder
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


def test_keys_start_stop_mark_and_label(recorder: Recorder, run: RunFolder) -> None:
    keys = Keys(recorder, run, EpisodeAbout(kind="probe", task="x"))
    said = [keys.act(key) for key in "xsmyxsxn?"]
    assert said == [
        "nothing is being recorded. Start an episode first.",
        "started probe_0001",
        "marked probe_0001",
        "probe_0001: success",
        "probe_0001: 0 messages, 0 lost",
        "started probe_0002",
        "probe_0002: 0 messages, 0 lost",
        "probe_0002: failure",
        "",
    ]
    first = Episode.open(path_of(run, "probe_0001"))
    assert (first.info.kind, first.info.task) == ("probe", "x")
    assert first.outcome is not None
    assert first.outcome.result == "success"
    assert first.metadata_records["recorder"]["stopped_by"] == "keyboard"
