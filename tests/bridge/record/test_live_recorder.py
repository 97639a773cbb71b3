"""The recorder on the wire: from Python, with status, liveliness, previews and departures."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from live_recorder import LiveRecorder, open_recorder
from mcap.reader import make_reader
from patience import wait_until

from bridge.clock import AnchoredClock
from bridge.episode import schema
from bridge.episode.cdr.messages import CompressedColor
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import UsageError
from bridge.media.color import decode_color, encode_jpeg
from bridge.record.config import RecorderConfig
from bridge.record.control import RecorderClient
from bridge.record.recorder import Recorder
from bridge.task.record import parse_record
from bridge.wire.config import WireConfig
from bridge.wire.session import WireSample, WireSession, open_session

WAIT_S = 10.0


@pytest.fixture
def wire(endpoint: str) -> WireConfig:
    return WireConfig(mode="router", connect=(), listen=(endpoint,))


@pytest.fixture
def live(tmp_path: Path, wire: WireConfig) -> Iterator[LiveRecorder]:
    with open_recorder(tmp_path / "run", wire=wire, config=RecorderConfig(preroll_s=9.0)) as made:
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
    client.publisher("/lab/x", "odd/Type").put(b"1", source_ns=1)
    wait_until(lambda: "/lab/x" in live.status()["seen"])
    ask("start", {"id": "s1"})
    assert ask("mark", {})["ok"]
    assert ask("stop", {})["messages"] == 1
    ask("start", {"id": "t1", "info": {"task": "cube"}})
    assert ask("status", {})["state"] == "recording"
    ask("stop", {"outcome": {"result": "failure"}})
    listed = ask("list", {})
    found = [(item["id"], item["task"], item["outcome"]) for item in listed["episodes"]]
    assert found == [("s1", "", "unknown"), ("t1", "cube", "failure")]
    assert [item["id"] for item in ask("list", {"last": 1})["episodes"]] == ["t1"]
    with pytest.raises(Exception, match="last must be a whole number"):
        ask("list", {"last": 0})


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
