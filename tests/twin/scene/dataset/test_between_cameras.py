"""A camera that stands still is judged by what moving cameras measured."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import textured_room

from bridge.episode.run_folder import RunFolder
from twin.scene.dataset import scan_check
from twin.scene.frames.downscaled import DownscaledDepth, downscaled_depth
from twin.scene.frames.selection import choose_frames, find_sources
from twin.scene.settings import FrameConfig

NUM = 10
CONFIG = FrameConfig()


def thumbs() -> list[DownscaledDepth]:
    return [downscaled_depth(textured_room.frame(k, NUM), 72) for k in range(NUM)]


def side(change: Callable[[np.ndarray], np.ndarray] = lambda T: T) -> list[DownscaledDepth]:
    thumb = thumbs()[4]
    return [replace(thumb, T_base_depth=change(thumb.T_base_depth))] * 3


def shifted(T: np.ndarray) -> np.ndarray:
    T = T.copy()
    T[2, 3] += 0.15
    return T


def test_a_camera_where_it_is_said_to_be_agrees() -> None:
    report = scan_check.check_between(side(), thumbs())
    assert report.agreement is not None
    assert report.agreement > 0.9
    assert report.better is None


def test_a_fixed_camera_elsewhere_is_said_and_one_read_wrongly_is_refused(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    run = RunFolder.create(tmp_path_factory.mktemp("run"))
    textured_room.write_episode(run.episodes_dir / "scan.mcap", num_frames=8)
    choice = choose_frames(find_sources(run), CONFIG).choices[0]
    wrist = scan_check.CameraCheck(choice=choice, images=thumbs(), trusted=[1.0] * NUM)
    still = replace(choice, camera_id="side", stationary=True)

    def judged(change: Callable[[np.ndarray], np.ndarray]) -> list[str]:
        fixed = scan_check.CameraCheck(choice=still, images=side(change), trusted=[1.0] * 3)
        return scan_check.check_scan([wrist, fixed], CONFIG).remarks()

    assert judged(lambda T: T) == []
    about, advice = judged(shifted)
    assert about.startswith("camera side of episode scan: only")
    assert "robot-gst calibrate RUN --cameras" in advice
    with pytest.raises(scan_check.PoseConventionError, match=r"camera side .*OpenGL axes"):
        judged(lambda T: T @ scan_check.FLIP_YZ)
