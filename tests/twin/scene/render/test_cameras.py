"""Which camera a scene is drawn from: where the scene has it, or one sentence about why not."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import textured_room

from bridge.episode.run_folder import RunFolder
from bridge.errors import UsageError
from bridge.geometry import se3
from bridge.media.color import decode_color
from twin.scene import trial
from twin.scene.render import render
from twin.scene.settings import RenderConfig
from twin.scene.store.calibration import write_calibration
from twin.scene.store.folder import read_record, write_record

pytestmark = pytest.mark.usefixtures("few_voxels")


def change(run: RunFolder, edit: Callable[[dict[str, Any]], object]) -> None:
    record = read_record(run)
    assert record is not None
    edit(record)
    write_record(run, record)


def picture(run: RunFolder, out: Path, at_s: float) -> np.ndarray:
    render(run, RenderConfig(at_s=at_s, out=out))
    return decode_color(out.read_bytes())


def test_a_camera_that_the_scene_has_from_calibrate_is_drawn_from_there(
    room: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """/tf says something else; that it is wrong may be why the camera was calibrated."""
    monkeypatch.setattr(trial, "moved_cameras", lambda *_: {})  # its images do say otherwise
    from_tf = picture(room, tmp_path / "tf.png", 0.6)
    q, p = se3.split(textured_room.camera_pose(6, 9))
    pose = {"p_m": p.tolist(), "q_wxyz": q.tolist()}
    place = {"link": "base_link", "stream": "color", "T_link_camera": pose}
    write_calibration(room, {"wrist": place}, {})
    change(room, lambda record: record["cameras"][0].update(poses_from="hand-eye"))
    np.testing.assert_array_equal(picture(room, tmp_path / "first.png", 0.0), from_tf)
    np.testing.assert_array_equal(picture(room, tmp_path / "late.png", 0.8), from_tf)


def test_a_scene_in_a_frame_that_the_episode_does_not_know_is_drawn_from_a_chosen_place(
    room: RunFolder, tmp_path: Path
) -> None:
    """As when the images themselves were followed: /tf places the camera elsewhere, or nowhere."""
    change(room, lambda record: record.update(frame="odometry_scan_wrist"))
    with pytest.raises(UsageError, match=r"'odometry_scan_wrist': .* --eye and --target"):
        render(room, RenderConfig(out=tmp_path / "a.png"))
    chosen = RenderConfig(eye=(0.0, -0.8, 0.6), target=(0.0, 0.1, 0.0), out=tmp_path / "a.png")
    assert render(room, chosen)["coverage_fraction"] > 0.3


def test_a_time_at_which_nobody_knows_the_camera_is_refused(
    room: RunFolder, tmp_path: Path
) -> None:
    with pytest.raises(UsageError, match=r"nobody recorded where camera wrist .* at --at-s 30"):
        render(room, RenderConfig(at_s=30.0, out=tmp_path / "a.png"))


def test_an_episode_that_cannot_be_read_does_not_stop_the_others(
    room: RunFolder, tmp_path: Path
) -> None:
    (room.episodes_dir / "trial_1.mcap").write_bytes(b"cut short")
    render(room, RenderConfig(out=tmp_path / "a.png"))
