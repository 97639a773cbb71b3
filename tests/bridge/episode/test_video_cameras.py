"""Cameras that send video: kept as they sent it, and decoded when images are read."""

from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bridge.clock import AnchoredClock
from bridge.episode import schema
from bridge.episode.cdr.messages import (
    CameraInfo,
    DepthImage,
    FrameTransform,
    RawColor,
    transforms_to_cdr,
)
from bridge.episode.check import check_episode
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.protobuf import bytes_field, number_field
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.streams import image_messages, rgbd_frames
from bridge.episode.topics import COLOR_IMAGE, DEPTH_IMAGE, camera_topic
from bridge.episode.writer import EpisodeWriter
from bridge.errors import EpisodeError
from bridge.exchange.rgbd import export_tum
from bridge.geometry.camera import Camera
from bridge.media.video import VideoDecoder, VideoDecodingError
from bridge.record.recorder import Recorder
from bridge.wire.session import WireSample

av = pytest.importorskip("av")
HEIGHT, WIDTH, COUNT = 64, 96, 24
START_NS, STEP_NS = 1_700_000_000_000_000_000, 33_000_000
TOPIC = camera_topic("lab", "eye", COLOR_IMAGE)
ENCODERS = {
    "h264": ("libx264", {"preset": "ultrafast", "tune": "zerolatency", "bf": "0", "crf": "10"}),
    "h265": ("libx265", {"preset": "ultrafast", "tune": "zerolatency", "crf": "10"}),
}


def picture(index: int) -> np.ndarray:
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    return np.stack([2 * x + 2 * index, 3 * y + index, x + y], axis=-1).astype(np.uint8)


def encoded(video_format: str, *, keyframe_every: int = 8) -> list[bytes]:
    """Annex B, a whole picture with its parameter sets now and then."""
    name, options = ENCODERS[video_format]
    context: Any = av.CodecContext.create(name, "w")
    context.width, context.height, context.pix_fmt = WIDTH, HEIGHT, "yuv420p"
    context.framerate, context.time_base, context.gop_size = 30, Fraction(1, 30), keyframe_every
    context.thread_count = 1
    quiet = {"x265-params": "log-level=none:repeat-headers=1:bframes=0:annexb=1"}
    extra = quiet if video_format == "h265" else {"x264-params": "repeat-headers=1:annexb=1:log=-1"}
    context.options = {**options, **extra}
    packets: list[bytes] = []
    for index in range(COUNT):
        frame = av.VideoFrame.from_ndarray(picture(index), format="rgb24")
        frame.pts = index
        packets += [bytes(packet) for packet in context.encode(frame)]
    packets += [bytes(packet) for packet in context.encode(None)]
    assert len(packets) == COUNT
    return packets


def message(index: int, data: bytes, video_format: str) -> bytes:
    seconds, nanos = divmod(START_NS + index * STEP_NS, 10**9)
    return b"".join(
        (
            bytes_field(1, number_field(1, seconds) + number_field(2, nanos)),
            bytes_field(2, b"eye"),
            bytes_field(3, data),
            bytes_field(4, video_format.encode()),
        )
    )


def write_video(path: Path, frames: list[bytes], *, first: int = 0) -> None:
    camera = Camera(fx=80.0, fy=80.0, cx=48.0, cy=32.0, width=WIDTH, height=HEIGHT)
    with EpisodeWriter(path) as writer:
        writer.describe(EpisodeInfo(id=path.stem, kind="scan", cell="lab"))
        still = FrameTransform(
            parent="base_link", child="eye", stamp_ns=0, T_parent_child=np.eye(4)
        )
        writer.write(
            "/tf_static",
            transforms_to_cdr([still]),
            type_name=schema.TF_MESSAGE,
            log_time_ns=START_NS,
        )
        for stream in ("color", "depth"):
            info = CameraInfo(stamp_ns=START_NS, frame_id="eye", camera=camera).to_cdr()
            topic = camera_topic("lab", "eye", f"/{stream}/info")
            writer.write(topic, info, type_name=schema.CAMERA_INFO, log_time_ns=START_NS)
        for index in range(first, len(frames)):
            at_ns = START_NS + index * STEP_NS
            pixels = np.full((HEIGHT, WIDTH), 500 + index, np.uint16)
            depth = DepthImage(stamp_ns=at_ns, frame_id="eye", depth_mm=pixels).to_cdr()
            for topic, kind, data in (
                (camera_topic("lab", "eye", DEPTH_IMAGE), schema.IMAGE, depth),
                (TOPIC, schema.COMPRESSED_VIDEO, frames[index]),
            ):
                writer.write(topic, data, type_name=kind, log_time_ns=at_ns)


def all_messages(video_format: str) -> list[bytes]:
    packets = encoded(video_format)
    return [message(index, data, video_format) for index, data in enumerate(packets)]


@pytest.mark.parametrize("video_format", ENCODERS)
def test_frames_of_a_video_are_images_with_depth_and_pose(
    tmp_path: Path, video_format: str
) -> None:
    write_video(tmp_path / "v.mcap", all_messages(video_format))
    episode = Episode.open(tmp_path / "v.mcap")
    frames = list(rgbd_frames(episode, "eye"))
    assert [frame.stamp_ns for frame in frames] == [START_NS + n * STEP_NS for n in range(COUNT)]
    for index, frame in enumerate(frames):
        assert np.abs(frame.image_u8.astype(int) - picture(index)).mean() < 4
        assert frame.depth_m[0, 0] == pytest.approx((500 + index) * 1e-3)
    assert check_episode(tmp_path / "v.mcap").exit_code == 0


def test_a_video_that_begins_in_its_middle_shows_from_the_next_whole_picture_on(
    tmp_path: Path,
) -> None:
    write_video(tmp_path / "v.mcap", all_messages("h264"), first=3)
    images = list(image_messages(Episode.open(tmp_path / "v.mcap"), [TOPIC]))
    assert len(images) == COUNT - 8
    image = RawColor.from_cdr(images[0].data)
    assert image.stamp_ns == START_NS + 8 * STEP_NS
    assert np.abs(image.image_u8().astype(int) - picture(8)).mean() < 4


def test_a_video_is_exported_as_pictures(tmp_path: Path) -> None:
    write_video(tmp_path / "v.mcap", all_messages("h264"))
    (report,) = export_tum(
        Episode.open(tmp_path / "v.mcap"),
        tmp_path / "tum",
        camera=None,
        color="recorded",
        force=False,
        advance=lambda done, note: None,
    )
    assert len(report.colors) == len(report.depths) == COUNT


def test_a_recorder_keeps_video_as_it_came(tmp_path: Path) -> None:
    run, clock = RunFolder.create(tmp_path / "run"), AnchoredClock()
    sent = all_messages("h265")
    recorder = Recorder(run, now_ns=clock.now_ns)
    recorder.start(EpisodeInfo(id="t1", kind="trial", cell="lab"))
    for number, data in enumerate(sent):
        recorder.receive(
            WireSample(
                topic=TOPIC,
                type_name=schema.COMPRESSED_VIDEO,
                message_encoding="protobuf",
                data=data,
                source_ns=None,
                sequence=number,
                source_gid=b"g" * 16,
                received_ns=clock.now_ns(),
            )
        )
    answer = recorder.stop()
    recorder.close()
    assert (answer["messages"], answer["lost"], answer["undecodable"]) == (COUNT, 0, 0)
    episode = Episode.open(run.episodes_dir / "t1.mcap")
    found = list(episode.messages([TOPIC]))
    assert [each.data for each in found] == sent
    assert [each.publish_time_ns for each in found] == [
        START_NS + n * STEP_NS for n in range(COUNT)
    ]
    assert len(list(image_messages(episode, [TOPIC]))) == COUNT


def test_an_unknown_format_and_a_damaged_frame_are_named(tmp_path: Path) -> None:
    with pytest.raises(VideoDecodingError, match="format 'mpeg7'; known are h264, h265"):
        VideoDecoder("mpeg7")
    frames = all_messages("h264")
    write_video(tmp_path / "v.mcap", [message(0, b"\0\0\0\1junk", "mpeg7"), *frames[1:]])
    with pytest.raises(EpisodeError, match=f"{TOPIC}: video cannot be decoded"):
        list(image_messages(Episode.open(tmp_path / "v.mcap"), [TOPIC]))
