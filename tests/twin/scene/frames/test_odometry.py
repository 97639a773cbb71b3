"""Real hand-held frames with their poses taken away, against the poses they came with."""

import os
from pathlib import Path

import numpy as np
import pytest

from bridge.episode.metadata import EpisodeInfo
from bridge.episode.run_folder import RunFolder
from bridge.exchange.rgbd import write_scan
from bridge.geometry import se3
from bridge.sources.folder.config import FolderConfig
from bridge.sources.folder.messages import folder_messages, read_index
from twin.scene.frames.selection import choose_frames, find_sources
from twin.scene.settings import FrameConfig

SHARED = Path(os.environ.get("GST_SHARED_DATA", Path(__file__).parents[5] / "shared" / "data"))
KITCHEN = SHARED / "rgbd_7scenes_redkitchen_a"
NUM_FRAMES = 18


@pytest.mark.slow
def test_a_real_camera_is_followed_to_a_few_centimetres(tmp_path: Path) -> None:
    if not KITCHEN.is_dir():
        pytest.skip(f"no shared data at {KITCHEN}")
    config = FolderConfig(max_frames=NUM_FRAMES)
    run = RunFolder.create(tmp_path)
    messages = (m for frame in folder_messages(read_index(KITCHEN), config, None) for m in frame)
    write_scan(run, EpisodeInfo(id="scan", kind="scan", cell=config.cell), messages, source={})
    (given,) = choose_frames(find_sources(run), FrameConfig(poses="tf")).choices
    (followed,) = choose_frames(find_sources(run), FrameConfig(poses="odometry")).choices
    assert followed.poses.source == "odometry"
    assert not followed.poses.unposed_ns
    stamps = np.array(sorted(followed.train_ns | followed.holdout_ns))
    Ts_given = given.poses.tree.Ts_root_frame("kinect_depth_optical", stamps)
    Ts_found = followed.poses.tree.Ts_root_frame("kinect_depth_optical", stamps)
    first = se3.invert(Ts_found[0]) @ Ts_found, se3.invert(Ts_given[0]) @ Ts_given
    errors = np.linalg.norm(first[0][:, :3, 3] - first[1][:, :3, 3], axis=1)
    moved = np.linalg.norm(first[1][:, :3, 3], axis=1).max()
    assert moved > 0.12  # metres: standing still would not pass
    assert np.median(errors) < 0.03
    assert errors.max() < 0.06
