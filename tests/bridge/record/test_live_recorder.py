"""The recorder on the wire: status, liveliness, previews, departures, and clocks of sources."""

import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from joint_samples import at_positions
from live_recorder import LiveRecorder, open_recorder
from loopback import free_endpoint
from mcap.reader import make_reader
from patience import wait_until

from bridge.clock import NS_PER_S, AnchoredClock
from bridge.episode import schema
from bridge.episode.cdr.messages import CompressedColor
from bridge.episode.clocks import Reading, clocks_of, open_episode
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import UsageError
from bridge.media.color import decode_color, encode_jpeg
from bridge.record import clocks as record_clocks
from bridge.record.clocks import ClockBook
from bridge.record.config import RecorderConfig
from bridge.record.control import RecorderClient
from bridge.record.recorder import Recorder
from bridge.record.status import describe_status
from bridge.task.record import parse_record
from bridge.wire.clocks import ClockAnswer, announce
from bridge.wire.config import WireConfig
from bridge.wire.session import WireSample, WireSession, open_session

WAIT_S = 10.0


@pytest.fixture
def wire(endpoint: str) -> WireConfig:
    return WireConfig(mode="router", connect=(), listen=(endpoint,))


@pytest.fixture
def live(tmp_path: Path, wire: WireConfig) -> Iterator[LiveRecorder]:
    with open_recorder(tmp_path / "run", wire=wire) as made:
        yield made


@pytest.fixture
def client(live: LiveRecorder, endpoint: str) -> Iterator[WireSession]:
    with open_session(WireConfig(connect=(endpoint,))) as session:
        yield session


def test_the_status_is_published_and_fits_its_schema(
    live: LiveRecorder, client: WireSession
) -> None:
    got: list[WireSample] = []
    client.subscribe("rec/main/status", got.append)
    live.start("t1")
    publisher = client.publisher("/lab/event", schema.EVENT)
    publisher.put(b"{}", source_ns=time.time_ns())
    wait_until(lambda: any(b'"messages": 1' in sample.data for sample in got))
    status = parse_record(got[-1].data, name="status", package="bridge.episode")
    assert (status["state"], status["episode"]) == ("recording", "t1")
    assert status["topics"]["/lab/event"]["received"] == 1
    assert abs(status["topics"]["/lab/event"]["clock_offset_ns"]) < 10**9
    assert {"rates_hz", "disk_free_bytes", "recovered", "clocks"} <= set(status)
    assert not any(topic.startswith("/rec/") for topic in status["seen"])


def test_no_first_message_waits_for_the_definitions_of_types(
    tmp_path: Path, wire: WireConfig
) -> None:
    """Making them takes long on a busy machine, and a kill would cost what comes meanwhile."""
    schema.ros_types.cache_clear()
    with open_recorder(tmp_path / "run", wire=wire):
        assert schema.ros_types.cache_info().currsize == 1


def test_the_recorder_is_seen_while_it_lives(
    tmp_path: Path, wire: WireConfig, endpoint: str
) -> None:
    with open_session(wire) as router:
        config = WireConfig(connect=(endpoint,))
        with open_recorder(tmp_path / "run", wire=config):
            wait_until(lambda: router.query_alive("rec/*/alive") == ["rec/main/alive"])
        wait_until(lambda: router.query_alive("rec/*/alive") == [])


def test_every_command_is_answered_over_the_wire(live: LiveRecorder, client: WireSession) -> None:
    ask = RecorderClient(client, timeout_s=WAIT_S).ask
    ask("start", {"id": "s1"})
    client.publisher("/lab/x", "odd/Type").put(b"1", source_ns=1)
    wait_until(lambda: "/lab/x" in live.status()["seen"])
    assert ask("mark", {})["ok"]
    assert ask("stop", {})["messages"] == 1
    ask("start", {"id": "t1", "info": {"task": "cube"}})
    assert ask("status", {})["state"] == "recording"
    ask("stop", {"outcome": {"result": "failure"}})
    listed = ask("list", {})
    found = [(item["id"], item["task"], item["outcome"]) for item in listed["episodes"]]
    assert found == [("s1", "", "unknown"), ("t1", "cube", "failure")]


def test_a_preview_is_made_only_while_somebody_looks(
    live: LiveRecorder, client: WireSession
) -> None:
    got: list[WireSample] = []
    pixels = np.full((480, 640, 3), 90, np.uint8)
    message = CompressedColor(stamp_ns=5, frame_id="c", format="jpeg", data=encode_jpeg(pixels))
    publisher = client.publisher("/lab/cam/eye/color/image", schema.COMPRESSED_IMAGE)
    publisher.put(message.to_cdr(), source_ns=1)
    wait_until(lambda: "/lab/cam/eye/color/image" in live.status()["seen"])
    assert live.core.input_queue.watched == frozenset()
    looking = client.subscribe("rec/main/preview/eye", got.append)
    wait_until(lambda: live.core.input_queue.watched)
    publisher.put(message.to_cdr(), source_ns=1)
    wait_until(lambda: got)
    assert decode_color(CompressedColor.from_cdr(got[0].data).data).shape == (240, 320, 3)
    looking.close()
    wait_until(lambda: not live.core.input_queue.watched)


def test_what_a_departed_source_said_is_not_repeated(
    live: LiveRecorder, client: WireSession, endpoint: str
) -> None:
    client.publisher("/tf_static", schema.TF_MESSAGE).put(b"", source_ns=1)
    with open_session(WireConfig(connect=(endpoint,))) as source:
        source.declare_alive("lab/alive")
        source.publisher("/lab/cam/a/color/info", schema.CAMERA_INFO).put(b"x", source_ns=1)
        wait_until(lambda: len(live.status()["seen"]) == 2)
        live.start("t1")
        live.stop()
    wait_until(lambda: len(live.core._life.latched.all()) == 1)
    live.start("t2")
    live.stop()
    topics = [
        set(Episode.open(live.run.episodes_dir / f"{name}.mcap").topics()) for name in ("t1", "t2")
    ]
    assert "/lab/cam/a/color/info" in topics[0]
    assert "/lab/cam/a/color/info" not in topics[1]
    assert "/tf_static" in topics[1]  # of a source that declared nothing: still true


def test_messages_of_ones_own_type_carry_their_definition(
    run: RunFolder, make_sample: Callable[..., WireSample], tmp_path: Path
) -> None:
    folder = tmp_path / "src"
    (folder / "my_msgs" / "msg").mkdir(parents=True)
    definition = folder / "my_msgs" / "msg" / "Grip.msg"
    definition.write_text("float64 width\n")
    config = RecorderConfig(msg_folder=folder)
    recorder = Recorder(run, now_ns=AnchoredClock().now_ns, config=config)
    recorder.start(EpisodeInfo(id="t1", kind="trial"))
    recorder.receive(make_sample(topic="/grip", type_name="my_msgs/msg/Grip", data=bytes(12)))
    recorder.stop()
    recorder.close()
    path = run.episodes_dir / "t1.mcap"
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    (found,) = [each for each in summary.schemas.values() if each.name == "my_msgs/msg/Grip"]
    assert (found.encoding, b"float64 width" in found.data) == ("ros2msg", True)
    settings = Episode.open(path).metadata_records["recorder"]["settings"]
    assert settings["msg_folder"] == str(folder)


def test_a_folder_without_definitions_is_refused_at_the_start(tmp_path: Path) -> None:
    with (
        pytest.raises(UsageError, match="holds no message definitions"),
        open_recorder(
            tmp_path / "run",
            wire=WireConfig(mode="peer", connect=(), listen=()),
            config=RecorderConfig(msg_folder=tmp_path),
        ),
    ):
        pass


AHEAD_NS = 1800 * NS_PER_S


def _set_clock(session: WireSession, ahead_ns: int) -> None:
    """Let a session be on a host whose clock is wrong."""
    session._clock = AnchoredClock(wall_ns=lambda: time.time_ns() + ahead_ns)


@pytest.fixture
def asking(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[LiveRecorder, str]]:
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
    asking: tuple[LiveRecorder, str],
) -> None:
    recorder, endpoint = asking
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
    asking: tuple[LiveRecorder, str],
) -> None:
    recorder, endpoint = asking
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


def test_two_sources_of_one_cell_are_told_apart(asking: tuple[LiveRecorder, str]) -> None:
    recorder, endpoint = asking
    wire = WireConfig(connect=(endpoint,))
    with open_session(wire) as first, open_session(wire) as second:
        _set_clock(second, AHEAD_NS)
        announce(first, "lab")
        announce(second, "lab")
        wait_until(lambda: len(recorder.status()["clocks"]) == 2)
        offsets_s = sorted(each["offset_ms"] / 1e3 for each in recorder.status()["clocks"])
        assert offsets_s == pytest.approx([0.0, 1800.0], abs=0.5)


def test_the_cameras_of_an_arm_that_left_are_still_there(
    asking: tuple[LiveRecorder, str],
) -> None:
    recorder, endpoint = asking
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
