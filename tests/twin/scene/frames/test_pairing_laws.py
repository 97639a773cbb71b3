"""Colour and depth of a moving camera: each is posed at its own instant."""

from pathlib import Path

import numpy as np
import pytest

from bridge.episode import streams
from bridge.episode.cdr.messages import (
    CameraInfo,
    CompressedColor,
    DepthImage,
    FrameTransform,
    transforms_to_cdr,
)
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.topics import type_of_topic
from bridge.episode.writer import EpisodeWriter
from bridge.geometry.camera import Camera
from bridge.media.color import encode_jpeg
from twin.scene.frames.pairing import paired_stamps_ns

CAMERA = Camera(width=8, height=6, fx=8.0, fy=8.0, cx=4.0, cy=3.0)
S = 1_000_000_000
LATE_NS = 8_000_000
SPEED_M_S = 0.5


def moving(stamp_ns: int) -> bytes:
    """Both cameras go along x; depth sits 2 cm beside colour."""
    poses = []
    for name, beside_m in (("color", 0.0), ("depth", 0.02)):
        T = np.eye(4)
        T[0, 3] = SPEED_M_S * stamp_ns / S
        T[1, 3] = beside_m
        poses.append(FrameTransform(stamp_ns=stamp_ns, parent="base", child=name, T_parent_child=T))
    return transforms_to_cdr(poses)


@pytest.fixture
def episode(tmp_path: Path) -> Episode:
    path = tmp_path / "e.mcap"
    image = encode_jpeg(np.zeros((6, 8, 3), dtype=np.uint8))
    far = np.full((6, 8), 700, dtype=np.uint16)
    with EpisodeWriter(path) as writer:

        def write(topic: str, data: bytes, stamp_ns: int) -> None:
            kind = type_of_topic(topic) or ""
            writer.write(topic, data, type_name=kind, log_time_ns=stamp_ns)

        for name in ("color", "depth"):
            info = CameraInfo(stamp_ns=S, frame_id=name, camera=CAMERA)
            write(f"/lab/cam/eye/{name}/info", info.to_cdr(), S)
        for stamp in range(S, 2 * S + 1, S // 10):
            write("/tf", moving(stamp), stamp)
        for stamp in range(S, 2 * S, S // 5):
            color = CompressedColor(stamp_ns=stamp, frame_id="color", format="jpeg", data=image)
            depth = DepthImage(stamp_ns=stamp + LATE_NS, frame_id="depth", depth_mm=far)
            write("/lab/cam/eye/color/image", color.to_cdr(), stamp)
            write("/lab/cam/eye/depth/image", depth.to_cdr(), stamp + LATE_NS)
        writer.describe(EpisodeInfo(id="e", kind="trial"))
    return Episode.open(path)


def test_each_image_of_a_pair_is_posed_at_its_own_instant(episode: Episode) -> None:
    tree = streams.transform_tree(episode)
    stamps = paired_stamps_ns(episode, "eye")
    assert stamps.tolist() == list(range(S, 2 * S, S // 5))
    chosen = list(streams.rgbd_frames(episode, "eye", tree, stamps.tolist()[1:4]))
    assert [frame.stamp_ns for frame in chosen] == stamps.tolist()[1:4]
    for frame in [*chosen, *streams.rgbd_frames(episode, "eye", tree)]:
        x = SPEED_M_S * frame.stamp_ns / S
        np.testing.assert_allclose(frame.T_base_color[:3, 3], [x, 0.0, 0.0], atol=1e-9)
        later = x + SPEED_M_S * LATE_NS / S
        np.testing.assert_allclose(frame.T_base_depth[:3, 3], [later, 0.02, 0.0], atol=1e-9)
