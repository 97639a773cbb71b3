"""Bad scans: one clear sentence each, and what can be kept is kept."""

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import textured_room

from bridge.episode.cdr.messages import FrameTransform
from bridge.episode.run_folder import RunFolder
from bridge.geometry import se3
from bridge.terminal import Output
from twin.scene.align.moved_camera import MovedCameraError
from twin.scene.dataset.scan_check import (
    CameraCheck,
    NoDepthError,
    PoseConventionError,
    ScanReport,
    check_scan,
)
from twin.scene.frames.downscaled import DownscaledDepth, downscaled_depth
from twin.scene.frames.rgbd import without_seams
from twin.scene.frames.selection import FrameChoice, choose_frames, find_sources, root_frame
from twin.scene.settings import FrameConfig

CONFIG = FrameConfig()


@pytest.fixture(scope="module")
def choice(tmp_path_factory: pytest.TempPathFactory) -> FrameChoice:
    run = RunFolder.create(tmp_path_factory.mktemp("run"))
    textured_room.write_episode(run.episodes_dir / "scan.mcap", num_frames=8)
    return choose_frames(find_sources(run), CONFIG).choices[0]


def camera(choice: FrameChoice, *, count: int = 8, depth_times: float = 1.0) -> CameraCheck:
    thumbs = [downscaled_depth(textured_room.frame(k, 8), 72) for k in range(count)]
    scaled = [replace(t, depth_m=np.float32(depth_times) * t.depth_m) for t in thumbs]
    return CameraCheck(choice=choice, images=scaled, trusted=[float(depth_times == 1.0)] * count)


def test_a_good_scan_gives_no_remark(choice: FrameChoice) -> None:
    report = check_scan([camera(choice)], CONFIG)
    assert report.remarks() == []
    (poses,) = report.poses.values()
    assert poses.agreement is not None
    assert poses.agreement > 0.9


@pytest.mark.parametrize(
    ("times", "found"),
    [
        (0.0, "no depth at all"),
        (1000.0, "beyond --max-depth-m 5: check the unit"),
        (0.001, "nearer than any surface can be"),
    ],
)
def test_depth_that_cannot_be_used_says_why(choice: FrameChoice, times: float, found: str) -> None:
    with pytest.raises(NoDepthError, match=found):
        check_scan([camera(choice, depth_times=times)], CONFIG)


def test_one_blind_camera_of_two_is_a_remark(choice: FrameChoice) -> None:
    blind = camera(choice, depth_times=0.0)
    (remark,) = check_scan([camera(choice), blind], CONFIG).remarks()
    assert "camera wrist of episode scan measured no depth" in remark
    assert "check the unit of depth" in remark


def test_what_helps_noisy_poses_is_said(choice: FrameChoice) -> None:
    noisy, rng = camera(choice), np.random.default_rng(1)
    for thumb in noisy.images:
        thumb.T_base_depth[:3, 3] += rng.uniform(-0.2, 0.2, 3)
    unexplained, advice = check_scan([noisy], CONFIG).remarks()
    assert "no known convention" in unexplained
    assert "--poses odometry" in advice


def test_poses_in_a_wrong_convention_are_refused_unless_told_not_to(choice: FrameChoice) -> None:
    right = camera(choice)
    thumbs: list[DownscaledDepth] = [
        replace(t, T_base_depth=se3.invert(t.T_base_depth)) for t in right.images
    ]
    wrong = replace(right, images=thumbs)
    with pytest.raises(PoseConventionError, match=r"world-to-camera.*--no-check-poses") as caught:
        check_scan([wrong], CONFIG)
    assert caught.value.exit_code == 1
    (remark,) = check_scan([wrong], FrameConfig(check_poses=False)).remarks()
    assert "world-to-camera" in remark


def test_a_camera_in_motion_that_is_said_to_stand_still_is_refused(choice: FrameChoice) -> None:
    """As when /tf ends at the camera's own link: all images get one pose, no pose moves."""
    right = camera(choice)
    first = right.images[0]
    thumbs = [replace(first, depth_m=first.depth_m * np.float32(1 - 0.08 * k)) for k in range(8)]
    wrong = replace(right, choice=replace(choice, stationary=True), images=thumbs)
    with pytest.raises(MovedCameraError, match=r"stands still by its poses.*--poses odometry"):
        check_scan([wrong], CONFIG)
    (remark,) = check_scan([wrong], FrameConfig(check_poses=False)).remarks()
    assert "it was moved" in remark
    orbit = [replace(t, T_base_depth=first.T_base_depth) for t in right.images]
    (doubt,) = check_scan([replace(wrong, images=orbit)], CONFIG).remarks()
    assert "much moved before it, or it moved itself" in doubt
    truly = replace(wrong, images=[thumbs[0]] * 4)
    assert "moved" not in " ".join(check_scan([truly], CONFIG).remarks())


def test_a_thing_that_moved_is_said_with_its_place() -> None:
    report = ScanReport(poses={}, found=(), moving_fraction=0.012, moving_place="12 cm around (0)")
    (remark,) = report.remarks()
    assert "1.2 % of the measured surface moved during the scan" in remark
    assert remark.endswith("left out: most of it 12 cm around (0)")


def spoilt_transforms(
    monkeypatch: pytest.MonkeyPatch, change: dict[int, float] | None
) -> Iterator[None]:
    """Write /tf with other positions at some stamps, or empty."""
    write = textured_room.transforms_to_cdr

    def spoil(items: list[FrameTransform]) -> bytes:
        if change is None:
            return write([])
        for item in items:
            if item.stamp_ns in change:
                item.T_parent_child[:3, 3] = change[item.stamp_ns]
        return write(items)

    monkeypatch.setattr(textured_room, "transforms_to_cdr", spoil)
    yield


@pytest.mark.slow
def test_a_camera_that_tf_knows_nothing_of_is_followed_by_its_images(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = RunFolder.create(tmp_path)
    for _ in spoilt_transforms(monkeypatch, None):
        textured_room.write_episode(run.episodes_dir / "scan.mcap", num_frames=24)
    (choice,) = choose_frames(find_sources(run), CONFIG, Output()).choices
    assert choice.poses.source == "odometry"
    assert root_frame(choice) == "odometry_scan_wrist"
    agreed = re.search(r"(\d+) % of the depth agrees between them", capsys.readouterr().err)
    assert agreed is not None
    assert int(agreed[1]) > 80
    stamps = np.array([1_000_000_000 + 100_000_000 * k for k in range(24)])
    found = choice.poses.tree.Ts_root_frame("wrist_depth_optical", stamps)
    np.testing.assert_allclose(found[0], np.eye(4), atol=1e-6)
    path = np.linalg.norm(np.diff(found[:, :3, 3], axis=0), axis=1).sum()
    truth = np.stack([textured_room.camera_pose(k, 24) for k in range(24)])
    length = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum()
    assert path == pytest.approx(length, rel=0.35)


def test_empty_rows_and_columns_of_warped_depth_are_closed_and_edges_are_not() -> None:
    depth = np.tile(np.linspace(1.0, 1.1, 40, dtype=np.float32), (30, 1))
    depth[:, 20:] += 1.0
    warped = depth.copy()
    warped[::4] = 0.0
    warped[:, 1::3] = 0.0
    closed = without_seams(warped, 0.03)
    inner = np.s_[2:27, 3:17]
    np.testing.assert_allclose(closed[inner], depth[inner], atol=2e-3)
    assert not ((closed > 1.2) & (closed < 1.9)).any()  # nothing between the two surfaces
    holes = depth.copy()
    holes[10:14, 5:9] = 0.0
    assert without_seams(holes, 0.03) is holes
