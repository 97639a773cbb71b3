"""Raw images become what an episode holds; broken ones are kept as they came."""

import threading
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from patience import wait_until
from written_messages import STAMP_NS, raw_image

from bridge.clock import AnchoredClock
from bridge.episode import schema
from bridge.episode.cdr.messages import CompressedColor, DepthImage
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.media.color import decode_color, encode_jpeg
from bridge.record.config import QueueConfig
from bridge.record.live import WIDTH, small_picture
from bridge.record.recorder import Recorder
from bridge.wire.session import WireSample

MakeRecorder = Callable[..., Recorder]
COLOR, DEPTH = "/cell/cam/a/color/image", "/cell/cam/a/depth/image"
CLOCK = AnchoredClock()


def smooth(height: int = 24, width: int = 32) -> np.ndarray:
    rows, columns = np.mgrid[0:height, 0:width]
    return np.stack([rows * 8 % 256, columns * 6 % 256, rows + columns], -1).astype(np.uint8)


def depth_image(height: int = 24, width: int = 32) -> bytes:
    values = np.arange(height * width, dtype=np.uint16).reshape(height, width)
    return DepthImage(stamp_ns=0, frame_id="eye", depth_mm=values).to_cdr()


def sample_of(
    topic: str, data: bytes, number: int = 0, type_name: str = schema.IMAGE
) -> WireSample:
    return WireSample(
        topic=topic,
        type_name=type_name,
        message_encoding="cdr",
        data=data,
        source_ns=number,
        sequence=number,
        source_gid=topic.encode()[:16].ljust(16),
        received_ns=CLOCK.now_ns(),
    )


@pytest.fixture
def started(make_recorder: MakeRecorder) -> MakeRecorder:
    def start(**settings: object) -> Recorder:
        recorder = make_recorder(**settings)
        recorder.start(EpisodeInfo(id="t1", kind="trial", cell="cell"))
        return recorder

    return start


def messages_of(run: RunFolder, topic: str) -> list[tuple[str, bytes]]:
    episode = Episode.open(run.episodes_dir / "t1.mcap")
    return [(message.type_name, message.data) for message in episode.messages([topic])]


@pytest.mark.parametrize(
    ("encoding", "order"), [("rgb8", [0, 1, 2]), ("bgr8", [2, 1, 0]), ("bgra8", [2, 1, 0, 0])]
)
def test_raw_colour_is_recorded_as_jpeg(
    started: MakeRecorder, run: RunFolder, encoding: str, order: list[int]
) -> None:
    recorder = started()
    recorder.receive(sample_of(COLOR, raw_image(smooth()[..., order], encoding)))
    answer = recorder.stop()
    assert (answer["messages"], answer["undecodable"]) == (1, 0)
    [(type_name, data)] = messages_of(run, COLOR)
    assert type_name == schema.COMPRESSED_IMAGE
    image = CompressedColor.from_cdr(data)
    assert (image.format, image.frame_id, image.stamp_ns) == ("jpeg", "camera", STAMP_NS)
    difference = decode_color(image.data).astype(int) - smooth()
    assert np.abs(difference).mean() < 6


def test_colour_as_is_and_depth_raw_keep_every_byte(started: MakeRecorder, run: RunFolder) -> None:
    recorder = started(color="as_is")
    color, depth = raw_image(smooth(), "rgb8"), depth_image()
    recorder.receive(sample_of(COLOR, color))
    recorder.receive(sample_of(DEPTH, depth))
    recorder.stop()
    assert messages_of(run, COLOR) == [(schema.IMAGE, color)]
    assert messages_of(run, DEPTH) == [(schema.IMAGE, depth)]


@pytest.mark.parametrize(
    ("data", "undecodable"),
    [
        (raw_image(smooth(), "rgb8", step=95), 1),
        (raw_image(smooth(), "rgb8")[:-1], 1),
        (raw_image(smooth()[:0], "rgb8", step=96), 1),
        (raw_image(smooth(), "yuv422"), 0),
        (b"", 1),
        (b"\x00\x01\x00\x00", 1),
    ],
)
def test_what_cannot_be_encoded_is_recorded_as_it_came(
    started: MakeRecorder, run: RunFolder, data: bytes, undecodable: int
) -> None:
    recorder = started(depth="compact")
    recorder.receive(sample_of(COLOR, data))
    answer = recorder.stop()
    assert (answer["messages"], answer["lost"], answer["undecodable"]) == (1, 0, undecodable)
    assert messages_of(run, COLOR) == [(schema.IMAGE, data)]


def test_each_stream_keeps_its_order_and_a_stop_waits_for_all_encoders(
    started: MakeRecorder, run: RunFolder
) -> None:
    recorder = started()
    topics = [f"/cell/cam/{name}/color/image" for name in "abcd"]
    data = raw_image(smooth(120, 160), "rgb8")
    for number in range(20):
        for topic in topics:
            recorder.receive(sample_of(topic, data, number))
    answer = recorder.stop()
    assert (answer["messages"], answer["lost"]) == (80, 0)
    episode = Episode.open(run.episodes_dir / "t1.mcap")
    for topic in topics:
        assert [m.sequence for m in episode.messages([topic])] == list(range(20))


def test_small_messages_do_not_wait_for_an_encoder(
    started: MakeRecorder,
    monkeypatch: pytest.MonkeyPatch,
    make_sample: Callable[..., WireSample],
) -> None:
    gate = threading.Event()
    monkeypatch.setattr(
        "bridge.record.encoders.image_to_jpeg", lambda data, quality: gate.wait(10.0) and None
    )
    recorder = started()
    recorder.receive(sample_of(COLOR, raw_image(smooth(), "rgb8")))
    for _ in range(10):
        recorder.receive(make_sample())
    wait_until(lambda: recorder.status()["messages"] == 10)
    assert recorder.mark("while it hangs")["ok"]
    gate.set()
    assert recorder.stop()["messages"] == 11


def test_under_overload_every_image_is_accounted_for(
    started: MakeRecorder,
    monkeypatch: pytest.MonkeyPatch,
    make_sample: Callable[..., WireSample],
) -> None:
    """Law: sent = written + dropped, of each stream; joints lose nothing."""

    def slow(data: bytes, quality: int) -> None:
        time.sleep(0.004)

    monkeypatch.setattr("bridge.record.encoders.image_to_jpeg", slow)
    monkeypatch.setattr("bridge.record.encoders.depth_to_compact", lambda data: slow(data, 0))
    recorder = started(depth="compact", queues=QueueConfig(camera_queue_mb=4))
    color, depth = raw_image(smooth(120, 160), "rgb8"), depth_image(120, 240)
    for number in range(300):
        recorder.receive(sample_of(COLOR, color, number))
        recorder.receive(sample_of(DEPTH, depth, number))
        recorder.receive(make_sample())
        time.sleep(0.001)
    end = [sample_of(COLOR, color, 300), sample_of(DEPTH, depth, 300)]
    while recorder.status()["queue_bytes"] > 100_000:
        time.sleep(0.01)
    for sample in end:
        recorder.receive(sample)
    topics = None
    while recorder.status()["queue_bytes"]:
        time.sleep(0.01)
    topics = recorder.status()["topics"]
    answer = recorder.stop()
    for topic in (COLOR, DEPTH):
        tally = topics[topic]
        assert tally["gaps"] == 0
        assert tally["received"] + tally["queue_drops"] == 301
    assert topics[COLOR]["queue_drops"] > 0
    assert topics["/cell/joint_states"]["received"] == 300
    assert answer["messages"] + answer["lost"] == 2 * 301 + 300


def test_a_small_picture_is_a_jpeg_of_whatever_is_colour() -> None:
    wide = np.repeat(smooth(240, 320), 3, axis=1)
    raw = small_picture(sample_of(COLOR, raw_image(wide, "rgb8")))
    message = CompressedColor(stamp_ns=7, frame_id="f", format="jpeg", data=encode_jpeg(wide))
    packed = small_picture(
        replace(sample_of(COLOR, message.to_cdr()), type_name=schema.COMPRESSED_IMAGE)
    )
    assert raw is not None
    assert packed is not None
    assert (packed.stamp_ns, packed.frame_id) == (7, "f")
    for picture in (raw, packed):
        assert decode_color(picture.data).shape == (80, WIDTH, 3)
    assert small_picture(sample_of(DEPTH, depth_image())) is None
