"""A camera in the hand is where the joints were; without joints nobody knows."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import textured_room

from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.streams import JointTrack
from bridge.errors import GstError
from bridge.robots.default import ARM_JOINTS, ROBOT
from bridge.terminal import Output
from twin.robot.posture import PostureTrack
from twin.scene.frames.selection import choose_frames, find_sources
from twin.scene.localise.stationary_frames import calibrated_cameras, stationary_frames
from twin.scene.settings import FrameConfig
from twin.scene.store import calibration as calibration_module
from twin.scene.store.calibration import read_calibration, write_calibration

S = 1_000_000_000
PLACE = {
    "link": "tool0",
    "stream": "color",
    "T_link_camera": {"p_m": [0.0, 0.0, 0.1], "q_wxyz": [1.0, 0.0, 0.0, 0.0]},
}


@pytest.fixture
def run(tmp_path: Path) -> RunFolder:
    """Images from 1.0 to 3.9 s, and a camera that was calibrated in the hand."""
    run = RunFolder.create(tmp_path / "run")
    textured_room.write_episode(run.episodes_dir / "scan.mcap", num_frames=30)
    write_calibration(run, {"wrist": PLACE}, {})
    return run


def joints_at(monkeypatch: pytest.MonkeyPatch, stamps_ns: np.ndarray, position: np.ndarray) -> None:
    arm = JointTrack(names=tuple(ARM_JOINTS), stamps_ns=stamps_ns, position=position)
    track = PostureTrack(urdf=ROBOT.urdf_text(), arm=arm, widths=None)
    answer: Callable[[Episode], PostureTrack] = lambda _episode: track  # noqa: E731
    monkeypatch.setattr(calibration_module, "posture_track", answer)


def moving(count: int) -> np.ndarray:
    return np.linspace(0.0, 0.5, count)[:, None] * np.ones(6) + np.array([0, -1.5, 1, -1, -1, 0])


def test_images_without_joints_around_them_are_left_out_and_counted(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    joints_at(monkeypatch, np.arange(1 * S, 2 * S, S // 100), moving(100))
    (choice,) = choose_frames(
        find_sources(run), FrameConfig(), Output(), read_calibration(run)
    ).choices
    assert choice.poses.source == "hand-eye"
    assert max(choice.train_ns | choice.holdout_ns) < 2.5 * S
    assert "frames of camera wrist are left out: joints" in " ".join(
        capsys.readouterr().err.split()
    )


def test_joints_that_are_no_numbers_place_no_camera(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    stamps = np.arange(1 * S, 4 * S, S // 100)
    position = moving(300)
    position[100:] = np.nan
    joints_at(monkeypatch, stamps, position)
    (choice,) = choose_frames(
        find_sources(run), FrameConfig(), Output(quiet=True), read_calibration(run)
    ).choices
    assert max(choice.train_ns | choice.holdout_ns) < 2 * S


def test_without_any_joints_at_its_images_a_camera_is_refused(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    joints_at(monkeypatch, np.arange(100 * S, 101 * S, S // 100), moving(100))
    with pytest.raises(GstError, match="was taken while joints said where it is"):
        choose_frames(find_sources(run), FrameConfig(), Output(quiet=True), read_calibration(run))


def test_a_hand_that_stands_still_at_each_image_is_seen_to(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between far images it went elsewhere."""
    stamps = np.arange(9 * S // 10, 4 * S, S // 100)
    stops = np.clip((stamps - 95 * S // 100) // (S // 10), 0, 29)
    joints_at(monkeypatch, stamps, moving(30)[stops])
    episode = Episode.open(run.episodes_dir / "scan.mcap")
    poses = calibrated_cameras(episode, read_calibration(run))
    assert len(stationary_frames(episode, 30, evenly=True, poses=poses)) == 30
