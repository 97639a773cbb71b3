"""RealSense settings, mounts and lens distortion, each for itself."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

rs = pytest.importorskip("pyrealsense2", reason="the extra [realsense] is not installed")

from software_camera import intrinsics  # noqa: E402

from bridge.errors import UsageError  # noqa: E402
from bridge.sources.realsense.config import (  # noqa: E402
    MountsError,
    RealSenseConfig,
)
from bridge.sources.realsense.device import (  # noqa: E402
    FrameStamps,
    is_distorted,
    rectifier,
)
from bridge.sources.realsense.messages import read_mounts  # noqa: E402

D405 = (-0.0547, 0.0575, 0.0004, 0.0006, -0.0186)


def smooth_image(width: int, height: int) -> np.ndarray:
    v, u = np.mgrid[0:height, 0:width].astype(np.float64)
    channels = [np.sin(u / 17 + k) * np.cos(v / 13 - k) for k in range(3)]
    return np.rint(127.5 + 120 * np.stack(channels, -1)).astype(np.uint8)


def test_rectified_images_are_those_of_opencv() -> None:
    cv2 = pytest.importorskip("cv2")
    found = intrinsics(320, 240, fx=305.0, coeffs=D405)
    image = smooth_image(320, 240)
    ours = rectifier(found).apply(image)
    x = (np.arange(320) - found.ppx) / found.fx
    y = (np.arange(240) - found.ppy) / found.fy
    pixels = np.array(
        [[rs.rs2_project_point_to_pixel(found, [float(a), float(b), 1.0]) for a in x] for b in y],
        dtype=np.float32,
    )
    theirs = cv2.remap(image, pixels, None, cv2.INTER_LINEAR)
    inside = (ours > 0).any(-1)
    assert inside.mean() > 0.9
    difference = np.abs(ours.astype(int) - theirs.astype(int))[inside]
    assert difference.max() <= 3
    assert difference.mean() < 0.5


def test_a_lens_without_distortion_is_left_alone() -> None:
    assert not is_distorted(intrinsics(64, 48, fx=60.0))
    assert is_distorted(intrinsics(64, 48, fx=60.0, coeffs=D405))


@pytest.mark.parametrize(
    ("camera", "words"),
    [
        (("side",), "has no serial number"),
        (("si-de=1",), "cannot be part of a topic"),
        (("a=1", "a=2"), "names a camera twice"),
        (("a=1", "b=1"), "names a camera twice"),
    ],
)
def test_cameras_that_cannot_be_told_apart_are_refused(camera: tuple[str, ...], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        RealSenseConfig(camera=camera)


def test_mounts_are_poses(tmp_path: Path) -> None:
    path = tmp_path / "mounts.json"
    entry = {"parent": "base_link", "p_m": [1, 2, 3], "q_wxyz": [0, 0, 0, 1]}
    path.write_text(json.dumps({"side": entry}))
    parent, T = read_mounts(path, ["side", "wrist"])["side"]
    assert parent == "base_link"
    np.testing.assert_allclose(T @ [1, 0, 0, 1], [0, 2, 3, 1], atol=1e-12)


@pytest.mark.parametrize(
    "content",
    [
        "no json",
        "[]",
        '{"other": {}}',
        '{"side": {"parent": "base_link", "p_m": [1, 2], "q_wxyz": [1, 0, 0, 0]}}',
        '{"side": {"parent": "base_link", "p_m": [1, 2, 3], "q_wxyz": [2, 0, 0, 0]}}',
        '{"side": {"parent": "", "p_m": [1, 2, 3], "q_wxyz": [1, 0, 0, 0]}}',
        '{"side": {"parent": "base_link", "p_m": [NaN, 2, 3], "q_wxyz": [1, 0, 0, 0]}}',
        '{"side": {"parent": "base_link", "p_m": "abc", "q_wxyz": [1, 0, 0, 0]}}',
        '{"side": 5}',
    ],
)
def test_mounts_that_are_none_are_refused(tmp_path: Path, content: str) -> None:
    path = tmp_path / "mounts.json"
    path.write_text(content)
    with pytest.raises(MountsError, match=r"mounts\.json"):
        read_mounts(path, ["side"])


class StampedFrame:
    """As much of a frame as its stamp needs."""

    def __init__(self, stamp_ms: float, domain: Any) -> None:
        """Remember."""
        self._stamp_ms, self._domain = stamp_ms, domain

    def get_timestamp(self) -> float:
        return self._stamp_ms

    def get_frame_timestamp_domain(self) -> Any:
        return self._domain


@pytest.mark.parametrize("name", ["global_time", "system_time"])
def test_host_time_is_taken_as_it_is(name: str) -> None:
    frame = StampedFrame(1.7e12 + 0.5, getattr(rs.timestamp_domain, name))
    assert FrameStamps().stamp_ns(frame, 5) == 1_700_000_000_000_500_000


def test_the_cameras_own_counter_is_mapped_through_its_wrap() -> None:
    stamps = FrameStamps()
    start_us = 2**32 - 2_000_000
    found = []
    for number in range(120):
        elapsed_us = number * 33_333
        stamp_ms = (start_us + elapsed_us) % 2**32 / 1e3
        frame = StampedFrame(stamp_ms, rs.timestamp_domain.hardware_clock)
        found.append(stamps.stamp_ns(frame, 10**18 + elapsed_us * 1000 + 5_000_000))
    known = [stamp for stamp in found if stamp is not None]
    assert 100 < len(known) < 106
    assert np.abs(np.diff(known) - 33_333_000).max() < 1000
    assert known[-1] == pytest.approx(10**18 + 119 * 33_333_000 + 5_000_000, abs=1000)


def test_a_camera_that_was_reset_is_mapped_anew() -> None:
    stamps = FrameStamps()
    hardware = rs.timestamp_domain.hardware_clock
    for number in range(60):
        stamps.stamp_ns(StampedFrame(1e6 + number * 33.0, hardware), number * 33_000_000)
    assert stamps.stamp_ns(StampedFrame(10.0, hardware), 60 * 33_000_000) is None
