"""Cameras that send video: their frames on the review pages and in Rerun."""

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from video_messages import video_message

from bridge.episode import schema
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.writer import EpisodeWriter
from bridge.media.color import decode_color
from dashboards.frames import camera_tracks, read_frame

av = pytest.importorskip("av")
HEIGHT, WIDTH, COUNT, KEYFRAME_EVERY = 48, 64, 100, 50
START_NS, STEP_NS = 1_700_000_000_000_000_000, 33_000_000


def shade(index: int) -> int:
    return 30 + 2 * index


def encoded() -> list[bytes]:
    context: Any = av.CodecContext.create("libx264", "w")
    context.width, context.height, context.pix_fmt = WIDTH, HEIGHT, "yuv420p"
    context.framerate, context.time_base = 30, Fraction(1, 30)
    context.gop_size, context.thread_count = KEYFRAME_EVERY, 1
    parameters = "repeat-headers=1:annexb=1:scenecut=0:log=-1"
    context.options = {
        "preset": "ultrafast",
        "tune": "zerolatency",
        "bf": "0",
        "crf": "5",
        "x264-params": parameters,
    }
    packets: list[bytes] = []
    for index in range(COUNT):
        grey = np.full((HEIGHT, WIDTH, 3), shade(index), dtype=np.uint8)
        frame = av.VideoFrame.from_ndarray(grey, format="rgb24")
        frame.pts = index
        packets += [bytes(packet) for packet in context.encode(frame)]
    return packets + [bytes(packet) for packet in context.encode(None)]


@pytest.fixture(scope="module")
def episode(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A camera that sends nothing but video, joined ten frames before a whole picture."""
    path = tmp_path_factory.mktemp("video") / "trial.mcap"
    with EpisodeWriter(path) as writer:
        writer.describe(EpisodeInfo(id="trial", kind="trial", cell="lab"))
        for index, data in enumerate(encoded()):
            if index < KEYFRAME_EVERY - 10:
                continue
            stamp_ns = START_NS + index * STEP_NS
            writer.write(
                "/lab/cam/eye/color/image",
                video_message(stamp_ns, "eye", data),
                type_name=schema.COMPRESSED_VIDEO,
                log_time_ns=stamp_ns,
            )
    return path


@pytest.mark.parametrize("index", [KEYFRAME_EVERY, KEYFRAME_EVERY + 1, 77, COUNT - 1])
def test_a_frame_of_a_video_is_the_image_of_its_instant(episode: Path, index: int) -> None:
    assert list(camera_tracks(episode)) == ["eye"]
    data, kind = read_frame(episode, "eye", START_NS + index * STEP_NS + 1000)
    assert kind == "image/jpeg"
    assert np.abs(decode_color(data).astype(int) - shade(index)).max() <= 4


def test_before_the_first_whole_picture_that_picture_is_shown(episode: Path) -> None:
    data, _ = read_frame(episode, "eye", START_NS)
    assert np.abs(decode_color(data).astype(int) - shade(KEYFRAME_EVERY)).max() <= 4


def test_rerun_lists_a_camera_that_sends_video(
    episode: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("rerun")
    from dashboards import rerun_entities
    from dashboards.rerun_view import export_rrd

    sent: list[int] = []
    real: Callable[..., list[int]] = rerun_entities._send_color

    def counted(*arguments: Any) -> list[int]:
        sent.extend(stamps := real(*arguments))
        return stamps

    monkeypatch.setattr(rerun_entities, "_send_color", counted)
    made = export_rrd(episode, tmp_path / "trial.rrd", run=None)
    assert made.cameras == ("eye",)
    assert len(sent) == COUNT - KEYFRAME_EVERY
    assert not [note for note in made.notes if "color is not shown further" in note]
