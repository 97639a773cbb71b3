from pathlib import Path

import numpy as np
import pytest

from bridge.episode import schema, streams
from bridge.episode.cdr import codec
from bridge.episode.cdr.images import depth_to_compact, image_header, image_to_jpeg
from bridge.episode.cdr.messages import CameraInfo, DepthImage, FrameTransform, transforms_to_cdr
from bridge.episode.reader import Episode
from bridge.episode.writer import EpisodeWriter
from bridge.geometry.camera import Camera

STEP_NS = 100_000_000
COUNT = 3
CAMERA = Camera(width=32, height=24, fx=30.0, fy=30.0, cx=16.0, cy=12.0)


def depth(index: int) -> np.ndarray:
    return np.random.default_rng(index).integers(0, 3000, (24, 32), dtype=np.uint16)


def color(index: int) -> bytes:
    stamp = {"sec": 0, "nanosec": (index + 1) * STEP_NS}
    pixels = np.full((24, 32, 3), [10 * index, 100, 200], dtype=np.uint8)
    fields = {"height": 24, "width": 32, "encoding": "bgr8", "step": 96, "data": pixels.tobytes()}
    return codec.encode(schema.IMAGE, {"header": {"stamp": stamp, "frame_id": "eye"}, **fields})


def record(path: Path, *, is_color_raw: bool, is_depth_raw: bool) -> Episode:
    with EpisodeWriter(path) as writer:
        here = FrameTransform(stamp_ns=0, parent="base", child="eye", T_parent_child=np.eye(4))
        writer.write(
            "/tf_static", transforms_to_cdr([here]), type_name=schema.TF_MESSAGE, log_time_ns=1
        )
        info = CameraInfo(stamp_ns=0, frame_id="eye", camera=CAMERA).to_cdr()
        for stream in ("color", "depth"):
            topic = f"/cell/cam/eye/{stream}/info"
            writer.write(topic, info, type_name=schema.CAMERA_INFO, log_time_ns=1)
        for index in range(COUNT):
            stamp_ns = (index + 1) * STEP_NS
            raw = DepthImage(stamp_ns=stamp_ns, frame_id="eye", depth_mm=depth(index)).to_cdr()
            for stream, message, coded, is_raw in (
                ("color", color(index), image_to_jpeg(image_header(color(index))), is_color_raw),
                ("depth", raw, depth_to_compact(image_header(raw)), is_depth_raw),
            ):
                data = message if is_raw else coded
                name = schema.IMAGE if is_raw else schema.COMPRESSED_IMAGE
                assert data is not None
                topic = f"/cell/cam/eye/{stream}/image"
                writer.write(topic, data, type_name=name, log_time_ns=stamp_ns)
    return Episode.open(path)


@pytest.mark.parametrize("is_color_raw", [True, False])
@pytest.mark.parametrize("is_depth_raw", [True, False])
def test_frames_are_the_same_however_images_were_recorded(
    tmp_path: Path, is_color_raw: bool, is_depth_raw: bool
) -> None:
    episode = record(tmp_path / "a.mcap", is_color_raw=is_color_raw, is_depth_raw=is_depth_raw)
    assert streams.camera_ids(episode) == ["eye"]
    frames = list(streams.rgbd_frames(episode, "eye"))
    assert [frame.stamp_ns for frame in frames] == [(i + 1) * STEP_NS for i in range(COUNT)]
    for index, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.depth_m, depth(index) * np.float32(1e-3))
        # One colour all over: only the rounding of JPEG remains.
        assert np.abs(frame.image_u8.astype(int) - [200, 100, 10 * index]).max() <= 3
