"""Sources with clocks of their own, asked over a real network and recorded."""

import json
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from joint_samples import at_positions
from live_recorder import LiveRecorder, open_recorder
from loopback import free_endpoint
from patience import wait_until

from bridge.clock import NS_PER_S, AnchoredClock
from bridge.episode import schema
from bridge.episode.clocks import Reading, clocks_of, open_episode
from bridge.episode.reader import Episode
from bridge.record import clocks as record_clocks
from bridge.record.clocks import ClockBook
from bridge.record.status import describe_status
from bridge.wire.clocks import ClockAnswer, announce
from bridge.wire.config import WireConfig
from bridge.wire.session import WireSession, open_session

AHEAD_NS = 1800 * NS_PER_S


def _set_clock(session: WireSession, ahead_ns: int) -> None:
    """Let a session be on a host whose clock is wrong."""
    session._clock = AnchoredClock(wall_ns=lambda: time.time_ns() + ahead_ns)


@pytest.fixture
def live(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[LiveRecorder, str]]:
    monkeypatch.setattr(record_clocks, "PERIOD_S", 0.02)
    endpoint = free_endpoint()
    wire = WireConfig(mode="router", connect=(), listen=(endpoint,))
    with open_recorder(tmp_path / "run", wire=wire) as recorder:
        yield recorder, endpoint


def _publish(session: WireSession, count: int) -> None:
    publisher = session.publisher("/lab/joint_states", schema.JOINT_STATE)
    for _ in range(count):
        now_ns = session.now_ns()
        sample = at_positions(now_ns, ("a",), np.ones(1))
        publisher.put(sample.to_cdr(), source_ns=now_ns)


def test_the_clock_of_another_host_is_measured_recorded_and_taken_out(
    live: tuple[LiveRecorder, str],
) -> None:
    recorder, endpoint = live
    with open_session(WireConfig(connect=(endpoint,))) as source:
        _set_clock(source, AHEAD_NS)
        announce(source, "lab")
        _publish(source, 1)
        wait_until(lambda: any(each["source"] == "lab" for each in recorder.status()["clocks"]))
        told = recorder.status()["clocks"][0]
        assert told["offset_ms"] == pytest.approx(1800e3, abs=500)
        assert "1.8e+03 s ahead" in describe_status(recorder.status())
        recorder.start("t1", cell="lab")
        _publish(source, 200)
        readings = len(recorder.core.clocks.earlier()[0]["readings"])
        wait_until(lambda: len(recorder.core.clocks.earlier()[0]["readings"]) > readings)
        answer = recorder.stop()
        assert answer["messages"] == 200
    path = recorder.run.episodes_dir / "t1.mcap"
    (clock,) = clocks_of(Episode.open(path))
    assert clock.topics == {"/lab/joint_states"}
    (line,) = clock.lines()
    assert line.offset_ns == pytest.approx(AHEAD_NS, abs=line.uncertainty_ns + 1e6)
    messages = list(open_episode(path, clock="corrected").messages(["/lab/joint_states"]))
    assert len(messages) == 200
    bound_ns = line.uncertainty_ns + 1e6
    for message in messages:  # sent before it arrived, and not half an hour ago
        late_ns = message.log_time_ns - message.publish_time_ns
        assert -bound_ns <= late_ns < 20e9


def test_a_publisher_whose_clock_is_set_is_named_live_and_in_the_file(
    live: tuple[LiveRecorder, str],
) -> None:
    recorder, endpoint = live
    with open_session(WireConfig(connect=(endpoint,))) as source:
        announce(source, "lab/cam/side")
        recorder.start("t1", cell="lab")
        wait_until(recorder.core.clocks.status)
        _set_clock(source, -AHEAD_NS)
        wait_until(lambda: any("was set back" in text for text in recorder.core.news))
        recorder.stop()
    episode = Episode.open(recorder.run.episodes_dir / "t1.mcap")
    notes = [json.loads(message.data) for message in episode.messages(["/lab/event"])]
    (jump,) = [note["data"] for note in notes if note["data"].get("kind") == "clock_jump"]
    assert jump["source"] == "lab/cam/side"
    assert jump["by_ns"] == pytest.approx(-AHEAD_NS, rel=1e-3)
    assert any("lab/cam/side" in text for text in episode.metadata_records["drops"]["warnings"])


def test_two_sources_of_one_cell_are_told_apart(live: tuple[LiveRecorder, str]) -> None:
    recorder, endpoint = live
    wire = WireConfig(connect=(endpoint,))
    with open_session(wire) as first, open_session(wire) as second:
        _set_clock(second, AHEAD_NS)
        announce(first, "lab")
        announce(second, "lab")
        wait_until(lambda: len(recorder.status()["clocks"]) == 2)
        offsets_s = sorted(each["offset_ms"] / 1e3 for each in recorder.status()["clocks"])
        assert offsets_s == pytest.approx([0.0, 1800.0], abs=0.5)


def test_the_cameras_of_an_arm_that_left_are_still_there(
    live: tuple[LiveRecorder, str],
) -> None:
    recorder, endpoint = live
    wire = WireConfig(connect=(endpoint,))
    with open_session(wire) as cameras:
        announce(cameras, "lab/cam/side")
        with open_session(wire) as arm:
            announce(arm, "lab")
            for session, topic in ((cameras, "/lab/cam/side/color/info"), (arm, "/lab/arm/info")):
                session.publisher(topic, schema.CAMERA_INFO).put(b"x", source_ns=1)
            wait_until(lambda: "/lab/arm/info" in recorder.core.presence._topics)
            recorder.start("t1", cell="lab")
        wait_until(lambda: any("/lab/ left" in text for text in recorder.core.news))
        recorder.stop()
        recorder.start("t2", cell="lab")
        recorder.stop()
    episode = Episode.open(recorder.run.episodes_dir / "t2.mcap")
    counts = {topic: each.count for topic, each in episode.topics().items()}
    assert counts.get("/lab/cam/side/color/info") == 1
    assert "/lab/arm/info" not in counts


def test_what_was_measured_before_begins_an_episode_in_few_records() -> None:
    book = ClockBook()
    for k in range(1000):
        reading = Reading(k * NS_PER_S, 5, 100 + k % 7)
        book.take(ClockAnswer("lab", "1", "pc", frozenset(("/lab/a",)), reading, {}))
    (record,) = book.earlier()
    assert len(record["readings"]) <= record_clocks.EARLIER
    assert {reading[2] for reading in record["readings"]} == {100}


def test_a_jump_that_answers_have_shown_is_not_told_again_for_its_stamps() -> None:
    book = ClockBook()
    for at_s, offset_ns in ((0, 0), (1, 60 * NS_PER_S)):
        reading = Reading(at_s * NS_PER_S, offset_ns, 100)
        book.take(ClockAnswer("lab", "1", "pc", frozenset(("/lab/a", "/tf")), reading, {}))
    assert book.has_named(["/lab/a"], 60 * NS_PER_S + 1000)
    assert not book.has_named(["/lab/a"], -60 * NS_PER_S)
    assert not book.has_named(["/lab/a", "/lab/b"], 60 * NS_PER_S)
