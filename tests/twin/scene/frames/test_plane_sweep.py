"""Depth of posed images from each other: against exact depth, and what it may not depend on."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from bridge.episode import schema
from bridge.episode.cdr.messages import (
    CameraInfo,
    CompressedColor,
    FrameTransform,
    transforms_to_cdr,
)
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.media.color import encode_png
from bridge.terminal import Output
from twin.scene.frames.camera_poses import base_tree
from twin.scene.frames.pairing import frames_at, paired_stamps_ns
from twin.scene.frames.plane_sweep import choose_references, posed_view, sweep
from twin.scene.frames.selection import NoFramesError
from twin.scene.frames.swept_episode import find_or_sweep_sources
from twin.scene.settings import FrameConfig

CAMERA = Camera(width=80, height=60, fx=75.0, fy=75.0, cx=40.0, cy=30.0)
NEAR, FAR = 0.5, 2.0
QUIET = Output(quiet=True)
SIDE = 400
SHADES = ndimage.gaussian_filter(
    np.random.default_rng(5).uniform(-1, 1, (SIDE, SIDE, 3)), (3, 3, 0)
)
SHADES = np.clip(0.5 + 0.5 * SHADES / np.abs(SHADES).max() * 1.5, 0, 1)
METRES = 4.0


def seen(T_world_camera: np.ndarray, *, step_m: float = 0.25) -> tuple[np.ndarray, np.ndarray]:
    """Colour image and exact depth: a wall at z = 1, nearer by a step where x is above zero."""
    rays = CAMERA.rays() @ T_world_camera[:3, :3].T
    origin = T_world_camera[:3, 3]
    depth = (1.0 - origin[2]) / rays[..., 2]
    nearer = (1.0 - step_m - origin[2]) / rays[..., 2]
    is_near = (origin + rays * nearer[..., None])[..., 0] > 0
    depth = np.where(is_near, nearer, depth)
    p = origin + rays * depth[..., None]
    at = (p[..., :2] / METRES + 0.5) * SIDE
    coordinates = [np.clip(at[..., k], 0, SIDE - 1) for k in (1, 0)]
    image = np.stack(
        [ndimage.map_coordinates(SHADES[..., c], coordinates, order=1) for c in range(3)], axis=-1
    )
    return np.rint(image * 255).astype(np.uint8), depth


def arc(count: int) -> list[np.ndarray]:
    down = np.array([0.0, -1.0, 0.0])
    target = np.array([0.0, 0.0, 1.0])
    return [
        se3.look_at(np.array([x, 0.06 * (-1) ** k, 0.0]), target, down)
        for k, x in enumerate(np.linspace(-0.25, 0.25, count))
    ]


def test_depth_is_within_a_hundredth_of_the_exact_one() -> None:
    poses = arc(6)
    exact = [seen(T)[1] for T in poses]
    found = sweep([posed_view(seen(T)[0], CAMERA, T) for T in poses], NEAR, FAR)
    known = [depth > 0 for depth in found]
    shares = [mask.mean() for mask in known]
    assert min(shares) > 0.5, shares
    errors = np.concatenate(
        [np.abs(f - e)[k] / e[k] for f, e, k in zip(found, exact, known, strict=True)]
    )
    assert np.median(errors) < 0.01
    assert (errors < 0.05).mean() > 0.95


def test_depth_has_the_scale_of_the_poses() -> None:
    poses = arc(5)
    views = [posed_view(seen(T)[0], CAMERA, T) for T in poses]
    larger = []
    for view in views:
        scaled = view.T_world_camera.copy()
        scaled[:3, 3] *= 3.0
        larger.append(replace(view, T_world_camera=scaled))
    for one, three in zip(sweep(views, NEAR, FAR), sweep(larger, 3 * NEAR, 3 * FAR), strict=True):
        np.testing.assert_allclose(three, 3 * one, rtol=1e-3, atol=1e-6)


def test_the_order_of_the_images_does_not_matter() -> None:
    views = [posed_view(seen(T)[0], CAMERA, T) for T in arc(5)]
    forwards, backwards = sweep(views, NEAR, FAR), sweep(views[::-1], NEAR, FAR)
    for one, other in zip(forwards, backwards[::-1], strict=True):
        np.testing.assert_array_equal(one, other)


def test_images_from_one_place_measure_nothing() -> None:
    T = arc(3)[1]
    views = [posed_view(seen(T)[0], CAMERA, T) for _ in range(3)]
    assert choose_references(0, views, NEAR, FAR) == []
    assert all((depth == 0).all() for depth in sweep(views, NEAR, FAR))


def record(run: RunFolder, name: str, images: list[np.ndarray], poses: list[np.ndarray]) -> None:
    topic = "/lab/cam/eye/color"
    with EpisodeWriter(run.episodes_dir / f"{name}.mcap") as writer:
        writer.describe(EpisodeInfo(id=name, kind="scan", cell="lab"))
        for number, (image, T) in enumerate(zip(images, poses, strict=True)):
            stamp = number * 100_000_000
            info = CameraInfo(stamp_ns=stamp, frame_id="eye", camera=CAMERA)
            pose = FrameTransform(stamp_ns=stamp, parent="world", child="eye", T_parent_child=T)
            color = CompressedColor(
                stamp_ns=stamp, frame_id="eye", format="png", data=encode_png(image)
            )
            for where, data, kind in (
                (f"{topic}/info", info.to_cdr(), schema.CAMERA_INFO),
                ("/tf", transforms_to_cdr([pose]), schema.TF_MESSAGE),
                (f"{topic}/image", color.to_cdr(), schema.COMPRESSED_IMAGE),
            ):
                writer.write(where, data, type_name=kind, log_time_ns=stamp)


def depths_of(run: RunFolder, config: FrameConfig) -> dict[int, np.ndarray]:
    sources = find_or_sweep_sources(run, config, QUIET)
    (episode,) = sources.episodes
    assert "estimated by plane sweep" in sources.remark
    assert episode.derived is not None
    assert episode.derived.kind == "depth"
    stamps = paired_stamps_ns(episode, "eye").tolist()
    frames = frames_at(episode, "eye", base_tree(episode), stamps)
    return {frame.stamp_ns: frame.depth_m for frame in frames}


def test_what_is_held_out_has_no_depth_and_changes_none(tmp_path: Path) -> None:
    poses = arc(9)
    images = [seen(T)[0] for T in poses]
    config = FrameConfig(holdout_every=4, holdout_offset=1)
    held = [1, 5]
    noise = np.random.default_rng(0)
    broken = [
        noise.integers(0, 255, image.shape).astype(np.uint8) if k in held else image
        for k, image in enumerate(images)
    ]
    found = []
    for name, shown in (("a", images), ("b", broken)):
        run = RunFolder.create(tmp_path / name)
        record(run, "scan", shown, poses)
        found.append(depths_of(run, config))
    assert len(found[0]) == len(poses)
    for k in range(len(poses)):
        stamp = k * 100_000_000
        one, other = (np.nan_to_num(depths[stamp], posinf=0.0) for depths in found)
        np.testing.assert_array_equal(one, other)
        assert (one > 0).any() == (k not in held)


def test_a_run_with_neither_depth_nor_poses_is_refused(tmp_path: Path) -> None:
    run = RunFolder.create(tmp_path / "run")
    with pytest.raises(NoFramesError, match="import images"):
        find_or_sweep_sources(run, FrameConfig(), QUIET)
    record(run, "scan", [seen(T)[0] for T in arc(2)], arc(2))
    with pytest.raises(NoFramesError, match="needs 3"):
        find_or_sweep_sources(run, FrameConfig(), QUIET)
