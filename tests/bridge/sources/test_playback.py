"""An episode played back: recorded again it is the same; what cannot be played is refused."""

import json
import signal
import subprocess
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from joint_samples import at_positions
from loopback import free_endpoint
from mcap.reader import make_reader

from bridge.episode import schema
from bridge.episode.cdr.messages import DepthImage, string_to_cdr
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.schema import Schema
from bridge.episode.writer import EpisodeWriter
from bridge.errors import EpisodeError, UsageError
from bridge.sources.playback.config import PlaybackConfig, choose_topics
from bridge.sources.playback.publish import EpisodeSource, Pace
from bridge.sources.source import Source, run_source
from bridge.terminal import Output
from bridge.wire.config import WireConfig
from bridge.wire.session import WireSample, WireSession, open_session

START_NS = 1_700_000_000_000_000_000
STEP_NS = 2_000_000
WAIT_S = 30.0
QUIET = Output(quiet=True)


def joints(number: int) -> bytes:
    position = np.array([number, -number], dtype=float)
    return at_positions(START_NS + number, ("a", "b"), position).to_cdr()


def depth(number: int) -> bytes:
    pixels = np.full((48, 64), number % 5000, dtype=np.uint16)
    return DepthImage(stamp_ns=START_NS + number, frame_id="eye", depth_mm=pixels).to_cdr()


GRIP = Schema(
    name="my_msgs/msg/Grip",
    schema_encoding="ros2msg",
    message_encoding="cdr",
    data=b"float64 force\n",
)
BLOB = Schema(
    name="lab.Blob", schema_encoding="protobuf", message_encoding="protobuf", data=b"\n\x00"
)


def write_episode(path: Path, *, steps: int) -> None:
    """Every kind of message there is, some at the same instant, published out of order."""
    with EpisodeWriter(path) as writer:
        writer.describe(EpisodeInfo(id=path.stem, kind="trial", cell="lab", task="stack"))
        description = string_to_cdr("<robot/>")
        writer.write(
            "/robot_description", description, type_name=schema.STRING, log_time_ns=START_NS
        )
        for step in range(steps):
            at_ns = START_NS + step * STEP_NS
            times = {"log_time_ns": at_ns, "publish_time_ns": at_ns - 5_000_000 + step % 3}
            kind = schema.JOINT_STATE
            writer.write("/lab/joint_states", joints(step), type_name=kind, **times)
            if step % 5 == 0:
                writer.write(
                    "/lab/cam/eye/depth/image", depth(step), type_name=schema.IMAGE, **times
                )
            if step % 7 == 0:
                event = {"schema_version": 1, "stamp_ns": at_ns, "type": "mark", "text": f"{step}"}
                writer.write_json("/lab/event", event, type_name=schema.EVENT, **times)
            for topic, record in (("/lab/grip", GRIP), ("/lab/blob", BLOB)):
                data = bytes([step % 256]) * (8 + step)
                writer.write_foreign(topic, data, schema_record=record, **times)
            writer.write_foreign("/lab/raw", b"raw%d" % step, schema_record=None, **times)
            drops = {"schema_version": 1, "stamp_ns": at_ns}
            writer.write_json("/recorder/drops", drops, type_name=schema.DROPS, log_time_ns=at_ns)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    write_episode(tmp_path / "first.mcap", steps=60)
    return tmp_path / "first.mcap"


def stored(path: Path) -> list[tuple[str, tuple[str, str, bytes] | None, str, int, bytes]]:
    """What a file holds, in order, but what its recorder itself wrote."""
    with path.open("rb") as stream:
        return [
            (
                channel.topic,
                (each.name, each.encoding, each.data) if each else None,
                channel.message_encoding,
                message.publish_time,
                message.data,
            )
            for each, channel, message in make_reader(stream).iter_messages()
            if channel.topic != "/recorder/drops"
        ]


@pytest.mark.slow
def test_an_episode_played_and_recorded_again_is_the_same(
    path: Path, tmp_path: Path, spawn: Callable[..., "subprocess.Popen[str]"]
) -> None:
    endpoint = free_endpoint()
    recorder = spawn(
        "robot_gst.py", "record", str(tmp_path / "run"), "--listen", endpoint, "--min-free-mb", "1"
    )
    assert recorder.stderr is not None
    assert "listens on" in recorder.stderr.readline()
    player = spawn(
        "robot_gst.py",
        "publish",
        "episode",
        str(path),
        "--episode",
        "again",
        "--connect",
        endpoint,
        "--json",
        "--shared-memory-mb",
        "2",
    )
    out, said = player.communicate(timeout=WAIT_S)
    assert player.returncode == 0, said
    again = tmp_path / "run" / "episodes" / "again.mcap"
    assert stored(again) == stored(path)
    answer = json.loads(out)
    assert answer["sent"]["messages"] == answer["recorded"]["messages"] == len(stored(path))
    assert answer["recorded"]["lost"] == 0
    recorder.send_signal(signal.SIGTERM)
    assert recorder.wait(timeout=WAIT_S) == 0
    with again.open("rb") as stream:
        (info,) = [r for r in make_reader(stream).iter_metadata() if r.name == "episode"]
    assert json.loads(info.metadata["task"]) == "stack"
    assert "playback:first" in json.loads(info.metadata["tags"])


class Heard:
    """What one subscriber of a router got."""

    def __init__(self, session: WireSession, endpoint: str) -> None:
        """Listen to everything."""
        self.endpoint = endpoint
        self.session = session
        self.samples: list[WireSample] = []
        self.changed = threading.Condition()
        session.subscribe("**", self.take)

    def take(self, sample: WireSample) -> None:
        with self.changed:
            self.samples.append(sample)
            self.changed.notify_all()

    def wait_for(self, number: int) -> list[WireSample]:
        with self.changed:
            assert self.changed.wait_for(lambda: len(self.samples) >= number, WAIT_S)
            return list(self.samples)


@pytest.fixture
def heard() -> Iterator[Heard]:
    endpoint = free_endpoint()
    with open_session(WireConfig(mode="router", connect=(), listen=(endpoint,))) as session:
        yield Heard(session, endpoint)


def play(
    source: EpisodeSource, heard: Heard, stop: threading.Event | None = None
) -> dict[str, Any]:
    with open_session(WireConfig(connect=(heard.endpoint,))) as session:
        return source.run(session, stop or threading.Event(), QUIET)


def test_chosen_topics_go_out(path: Path, heard: Heard) -> None:
    config = PlaybackConfig(rate=100.0, topics=("lab/*", "/robot_description"))
    source = EpisodeSource(path, config)
    assert isinstance(source, Source)
    names = {"/lab/joint_states", "/lab/event", "/lab/grip", "/lab/blob", "/lab/raw"}
    assert set(source.topics) == names | {"/robot_description"}
    counts = play(source, heard)
    samples = heard.wait_for(source.num_messages)
    assert counts["messages"] == len(samples) == source.num_messages
    assert {sample.topic for sample in samples} == set(source.topics)
    for topic in source.topics:
        assert [s.sequence for s in samples if s.topic == topic] == list(
            range(counts["topics"][topic])
        )


def test_a_late_start_sends_first_what_is_latched(path: Path, heard: Heard) -> None:
    source = EpisodeSource(path, PlaybackConfig(rate=100.0, start_s=0.1))
    play(source, heard)
    expected = [item for item in stored(path) if item[0] == "/lab/joint_states"][50:]
    samples = heard.wait_for(len(expected) + 1)
    assert (samples[0].topic, samples[0].source_ns) == ("/robot_description", START_NS)
    played = [s.data for s in samples if s.topic == "/lab/joint_states"]
    assert played == [item[-1] for item in expected]


class Clock(threading.Event):
    """Time that only waiting takes."""

    def __init__(self) -> None:
        """Begin anywhere."""
        super().__init__()
        self.now_s = 12.5

    def wait(self, timeout: float | None = None) -> bool:
        self.now_s += max(timeout or 0.0, 1e-9)  # less would not move it
        return False


@given(st.floats(0.1, 100), st.lists(st.integers(0, 10**8), min_size=1, max_size=10))
@settings(max_examples=25)
def test_messages_are_as_far_apart_as_they_came_by_the_rate(
    rate: float, gaps_ns: list[int]
) -> None:
    clock = Clock()
    pace = Pace(rate, monotonic=lambda: clock.now_s)
    times_ns = START_NS + np.cumsum(gaps_ns)
    sent_s = []
    for at_ns in times_ns.tolist():
        assert pace.wait(at_ns, clock) is not None
        sent_s.append(clock.now_s)
    expected_s = (times_ns - times_ns[0]) * 1e-9 / rate
    np.testing.assert_allclose(np.array(sent_s) - sent_s[0], expected_s, atol=1e-6)


def test_what_cannot_be_played_is_refused(path: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"--rate 0 makes no sense; it must be at least 0.001"):
        PlaybackConfig(rate=0.0)
    for config, message in (
        (PlaybackConfig(topics=("/lab/nothing",)), "no topic of the episode. There are: /lab/blob"),
        (PlaybackConfig(start_s=1.0), "behind the end"),
    ):
        with pytest.raises(UsageError, match=message):
            EpisodeSource(path, config)
    (tmp_path / "text.mcap").write_text("this is a text\n" * 100)
    with pytest.raises(EpisodeError, match="not a finished MCAP file"):
        EpisodeSource(tmp_path / "text.mcap", PlaybackConfig())
    with EpisodeWriter(tmp_path / "empty.mcap") as writer:
        writer.describe(EpisodeInfo(id="empty", kind="trial"))
    with pytest.raises(UsageError, match="holds no messages to play"):
        EpisodeSource(tmp_path / "empty.mcap", PlaybackConfig())


def test_damage_in_the_middle_is_named_and_ends_the_playback(tmp_path: Path, heard: Heard) -> None:
    path = tmp_path / "first.mcap"
    write_episode(path, steps=60)
    with path.open("rb") as stream:
        chunk = make_reader(stream).get_summary().chunk_indexes[0]  # type: ignore[union-attr]
    data = bytearray(path.read_bytes())
    data[chunk.chunk_start_offset + chunk.chunk_length // 2] ^= 0xFF
    path.write_bytes(data)
    with pytest.raises(EpisodeError, match="damaged"):
        run_source(
            EpisodeSource(path, PlaybackConfig(rate=1000.0)),
            WireConfig(connect=(heard.endpoint,)),
            QUIET,
        )


TOPICS = ["/lab/a", "/lab/b/c", "/other", "/lab2/a"]


@pytest.mark.parametrize(
    ("pattern", "expected"),
    [
        ("**", TOPICS),
        ("/**", TOPICS),
        ("lab/**", ["/lab/a", "/lab/b/c"]),
        ("/lab/*", ["/lab/a"]),
        ("*/a", ["/lab/a", "/lab2/a"]),
        ("/other", ["/other"]),
        ("**/a", ["/lab/a", "/lab2/a"]),
    ],
)
def test_a_pattern_is_a_key_expression(pattern: str, expected: list[str]) -> None:
    assert choose_topics([pattern], TOPICS) == expected
