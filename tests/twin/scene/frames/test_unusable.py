"""Cameras and poses that cannot be used: one sentence each, and what can be kept is kept."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import textured_room

from bridge.episode import streams
from bridge.episode.cdr.messages import CameraInfo, FrameTransform
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.terminal import Output
from twin.scene.frames.selection import choose_frames, find_sources, load, root_frame
from twin.scene.settings import FrameConfig

SECOND = 1_000_000_000
QUIET = Output(quiet=True)
Change = Callable[[list[FrameTransform]], list[FrameTransform]]


def write(
    run: RunFolder,
    monkeypatch: pytest.MonkeyPatch,
    change: Change,
    *,
    num_frames: int = 12,
    name: str = "scan",
) -> None:
    """An episode whose /tf was changed by somebody."""
    encode = textured_room.transforms_to_cdr
    with monkeypatch.context() as spoilt:
        spoilt.setattr(textured_room, "transforms_to_cdr", lambda items: encode(change(items)))
        textured_room.write_episode(run.episodes_dir / f"{name}.mcap", num_frames=num_frames)


@pytest.mark.parametrize(
    ("kinds", "taken"),
    [("scan imported trial", "scan"), ("imported trial retry", "imported"), ("trial", "trial")],
)
def test_scans_are_taken_else_what_is_no_trial(tmp_path: Path, kinds: str, taken: str) -> None:
    """A bag that was imported without a task is the scan of those that are trials."""
    folder = RunFolder.create(tmp_path / "run")
    for kind in kinds.split():
        textured_room.write_episode(folder.episodes_dir / f"{kind}.mcap", num_frames=2, kind=kind)
    assert [episode.info.kind for episode in find_sources(folder).episodes] == [taken]


def later(seconds: float) -> Change:
    return lambda items: [
        replace(item, stamp_ns=item.stamp_ns + round(seconds * SECOND)) for item in items
    ]


def test_images_and_poses_of_two_clocks_are_refused_and_not_taken_for_a_still_camera(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(run, monkeypatch, later(3600.0))
    with pytest.raises(GstError, match=r"/tf said where it is, 359\d\.\d s away.*--poses odometry"):
        choose_frames(find_sources(run), FrameConfig(), QUIET)


def test_a_camera_that_stands_still_may_say_so_once(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    def first_pose(items: list[FrameTransform]) -> list[FrameTransform]:
        poses = (textured_room.camera_pose(0, 12), textured_room.camera_pose(0, 12))
        return [
            replace(item, stamp_ns=item.stamp_ns % 3, T_parent_child=T)
            for item, T in zip(items, poses, strict=True)
        ]

    write(run, monkeypatch, first_pose)
    (choice,) = choose_frames(find_sources(run), FrameConfig(), QUIET).choices
    assert choice.stationary
    assert not choice.poses.unposed_ns


@pytest.mark.parametrize("parent", [None, "elsewhere"])
def test_depth_that_hangs_on_nothing_or_elsewhere_is_refused(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch, parent: str | None
) -> None:
    """Its pose in another tree is no pose in this one, however good it looks."""

    def cut(items: list[FrameTransform]) -> list[FrameTransform]:
        color, depth = items
        return [color] if parent is None else [color, replace(depth, parent=parent)]

    write(run, monkeypatch, cut)
    with pytest.raises(GstError, match="how its depth frame 'wrist_depth_optical' lies"):
        choose_frames(find_sources(run), FrameConfig(), QUIET)


def other_info(
    monkeypatch: pytest.MonkeyPatch, run: RunFolder, change: Callable[[Camera], Camera]
) -> None:
    """An episode whose camera states other intrinsics on color/info than its images have."""
    encode = CameraInfo.to_cdr

    def spoil(self: CameraInfo) -> bytes:
        is_color = self.frame_id == "wrist_color_optical"
        return encode(replace(self, camera=change(self.camera)) if is_color else self)

    with monkeypatch.context() as spoilt:
        spoilt.setattr(CameraInfo, "to_cdr", spoil)
        textured_room.write_episode(run.episodes_dir / "scan.mcap", num_frames=6)


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (lambda c: replace(c, width=128, height=96), "images of 64 x 48 pixels.*for 128 x 96"),
        (lambda c: replace(c, width=32, height=24), "images of 64 x 48 pixels.*for 32 x 24"),
        (lambda c: replace(c, fx=0.0, fy=0.0), "camera wrist.*focal lengths of 0 and 0 pixels"),
        (lambda c: replace(c, fx=float("nan")), "focal lengths of nan"),
    ],
)
def test_intrinsics_that_are_not_the_images_are_refused(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch, change: Callable[[Camera], Camera], found: str
) -> None:
    other_info(monkeypatch, run, change)
    with pytest.raises(GstError, match=found):
        choose_frames(find_sources(run), FrameConfig(), QUIET)


def test_a_camera_whose_images_never_come_in_pairs_is_named(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    make = textured_room.depth_image

    def late(stamp_ns: int, *more: Any) -> object:
        return make(stamp_ns + 50_000_000, *more)

    with monkeypatch.context() as spoilt:
        spoilt.setattr(textured_room, "depth_image", late)
        textured_room.write_episode(run.episodes_dir / "scan.mcap", num_frames=6)
    with pytest.raises(GstError, match="camera wrist of episode scan has a depth image within 20"):
        choose_frames(find_sources(run), FrameConfig(), QUIET)


def test_an_episode_that_cannot_be_read_is_passed_over_and_named(run: RunFolder) -> None:
    textured_room.write_episode(run.episodes_dir / "scan.mcap", num_frames=6)
    whole = (run.episodes_dir / "scan.mcap").read_bytes()
    (run.episodes_dir / "trial_1.mcap").write_bytes(whole[: len(whole) // 2])
    sources = find_sources(run)
    assert [episode.info.id for episode in sources.episodes] == ["scan"]
    assert "trial_1.mcap" in sources.remark
    (run.episodes_dir / "scan.mcap").unlink()
    with pytest.raises(GstError, match=r"trial_1\.mcap"):
        find_sources(run)


T_WORLD_BASE = se3.transform_from(np.array([0.9, 0.0, 0.0, 0.4]), np.array([1.0, -2.0, 0.8]))


def test_what_hangs_on_a_world_frame_is_given_in_the_robots_base(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the driver of a UR publishes it: world above base_link above everything else."""

    def hang(items: list[FrameTransform]) -> list[FrameTransform]:
        world = FrameTransform(
            stamp_ns=1, parent="world", child="base_link", T_parent_child=T_WORLD_BASE
        )
        room = FrameTransform(stamp_ns=1, parent="map", child="world", T_parent_child=np.eye(4))
        return [*items, world, room]

    write(run, monkeypatch, hang)
    (choice,) = choose_frames(find_sources(run), FrameConfig(), QUIET).choices
    assert root_frame(choice) == "base_link"
    for frame in load(choice, choice.train_ns):
        index = round((frame.stamp_ns - SECOND) / 100_000_000)
        np.testing.assert_allclose(
            frame.T_base_color, textured_room.camera_pose(index, 12), atol=1e-9
        )


def test_a_base_that_drives_about_is_not_the_root(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    def drive(items: list[FrameTransform]) -> list[FrameTransform]:
        T = T_WORLD_BASE.copy()
        T[0, 3] += items[0].stamp_ns * 1e-9
        stamp = items[0].stamp_ns
        return [
            *items,
            FrameTransform(stamp_ns=stamp, parent="odom", child="base_link", T_parent_child=T),
        ]

    write(run, monkeypatch, drive)
    (choice,) = choose_frames(find_sources(run), FrameConfig(), QUIET).choices
    assert root_frame(choice) == "odom"


def test_the_wanted_frames_are_those_that_reading_all_of_them_gives(run: RunFolder) -> None:
    textured_room.write_episode(run.episodes_dir / "scan.mcap", num_frames=9)
    (choice,) = choose_frames(find_sources(run), FrameConfig(), QUIET).choices
    wanted = choice.train_ns
    episode = Episode.open(run.episodes_dir / "scan.mcap")
    expected = [f for f in streams.rgbd_frames(episode, "wrist") if f.stamp_ns in wanted]
    found = list(load(choice, wanted))
    assert len(found) == len(expected) == 8
    for one, other in zip(found, expected, strict=True):
        assert one.stamp_ns == other.stamp_ns
        np.testing.assert_array_equal(one.image_u8, other.image_u8)
        np.testing.assert_array_equal(one.depth_m, other.depth_m)
        np.testing.assert_array_equal(one.T_base_depth, other.T_base_depth)
