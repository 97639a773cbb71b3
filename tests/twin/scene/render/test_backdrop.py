"""The far shell: each direction in its place, what is drawn untouched, unseen corners not black."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from clouds import even_cloud

from bridge.episode.run_folder import RunFolder
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.media.color import decode_color
from twin.errors import UnreadableFileError
from twin.scene import backdrop
from twin.scene.frames.rgbd import Target, TrainingView
from twin.scene.raster.rasteriser import RasterConfig, Rasteriser, View
from twin.scene.render import render
from twin.scene.settings import RenderConfig
from twin.scene.store.folder import read_record, read_scene

CAMERA = Camera(width=64, height=48, fx=40.0, fy=40.0, cx=32.0, cy=24.0)


def looking(heading_rad: float, tilt_rad: float = 0.0) -> np.ndarray:
    """A level camera (z forwards, y down) turned about the vertical, then tilted down."""
    R = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    T = np.eye(4)
    T[:3, :3] = (
        se3.rotation_from_vector(np.array([0, 0, heading_rad]))
        @ se3.rotation_from_vector(np.array([0, tilt_rad, 0]))
        @ R
    )
    return T


def painted(directions: np.ndarray) -> np.ndarray:
    """A colour for each direction, another one for each."""
    return (directions + 1) / 2


def shell() -> backdrop.Backdrop:
    rows, columns = 90, 180
    down = (np.arange(rows)[:, None] + 0.5) / rows * np.pi
    heading = ((np.arange(columns) + 0.5) / columns - 0.5) * 2 * np.pi
    directions = np.stack(
        np.broadcast_arrays(
            np.sin(down) * np.cos(heading), np.sin(down) * np.sin(heading), np.cos(down)
        ),
        axis=-1,
    )
    colors = painted(directions).astype(np.float32)
    return backdrop.Backdrop(colors=colors)


def nothing(alpha: float = 0.0) -> View:
    shape = (CAMERA.height, CAMERA.width)
    return View(
        image=np.full((*shape, 3), 0.25, dtype=np.float32),
        depth_m=np.zeros(shape, dtype=np.float32),
        alpha=np.full(shape, alpha, dtype=np.float32),
    )


HEADINGS = (-3.1, -1.5, 0.0, 1.0, 3.1)


def test_what_is_drawn_keeps_its_bits_and_less_of_it_shows_more_of_the_shell() -> None:
    for alpha in (backdrop.OPAQUE, 0.99, 1.0):
        view = nothing(alpha)
        assert shell().behind(view, CAMERA, looking(0.0)).image is view.image
    added = [
        (shell().behind(nothing(alpha), CAMERA, looking(0.0)).image - 0.25).mean()
        for alpha in (0.0, 0.2, 0.4, 0.6)
    ]
    assert (np.diff(added) < 0).all()
    assert min(added) > 0
    before = nothing(0.2)
    after = shell().behind(before, CAMERA, looking(0.0))
    assert after.depth_m is before.depth_m
    assert after.alpha is before.alpha


def seen_views(headings: tuple[float, ...]) -> list[TrainingView]:
    views = []
    for heading in headings:
        T = looking(heading)
        rays = CAMERA.rays() @ T[:3, :3].T
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        planes = np.rint(255 * np.moveaxis(painted(rays), -1, 0)).astype(np.uint8)
        shape = planes.shape[1:]
        target = Target(
            camera=CAMERA,
            planes_u8=planes,
            depth_m=np.zeros(shape, dtype=np.float32),
            static_mask=np.ones(shape, dtype=bool),
        )
        views.append(
            TrainingView(camera_id="c", stamp_ns=0, T_base_color=T, half=target, full=target)
        )
    return views


def test_the_shell_shows_what_views_saw_and_goes_on_smoothly_where_none_looked() -> None:
    views = seen_views((-3.0, -2.2, -1.4))
    made = backdrop.backdrop_of(
        even_cloud(np.zeros((0, 3)), 0.0), views, Rasteriser(RasterConfig(threads=1))
    )
    black = replace(nothing(), image=np.zeros((48, 64, 3), np.float32))
    for view in views:
        drawn = made.behind(black, CAMERA, view.T_base_color).image
        np.testing.assert_allclose(
            drawn, np.moveaxis(view.half.image(), 0, -1), atol=0.12
        )  # a picture of 3.75 degrees a pixel
    behind = made.behind(black, CAMERA, looking(1.0)).image
    seen = np.concatenate([view.half.image().reshape(3, -1) for view in views], axis=1)
    assert (behind >= seen.min(axis=1) - 0.01).all()
    assert (behind <= seen.max(axis=1) + 0.01).all()
    edge_rad = -1.4 + np.arctan(32 / 40)  # of the last view
    beside = made.behind(black, CAMERA, looking(edge_rad + 0.1)).image[24, 32]
    edge = painted(np.array([np.cos(edge_rad), np.sin(edge_rad), 0.0]))
    np.testing.assert_allclose(beside, edge, atol=0.12)
    assert np.abs(np.diff(behind, axis=1)).max() < 0.05


def test_it_comes_back_as_it_was_written_and_is_missing_without_harm(tmp_path: Path) -> None:
    run = RunFolder.create(tmp_path / "run")
    run.scene_dir.mkdir(parents=True)
    about = shell().write(run.scene_dir)
    back = backdrop.read_backdrop(run, {"backdrop": about})
    assert back is not None
    np.testing.assert_allclose(back.colors, shell().colors, atol=0.5 / 255 + 1e-6)
    assert backdrop.read_backdrop(run, {}) is None
    path = run.scene_dir / backdrop.BACKDROP
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(UnreadableFileError, match=r"backdrop\.png: .*robot-gst rebuild"):
        backdrop.read_backdrop(run, {"backdrop": about})
    (run.scene_dir / backdrop.BACKDROP).unlink()
    assert backdrop.read_backdrop(run, {"backdrop": about}) is None


def test_a_corner_that_nobody_saw_is_drawn_and_counts_as_unseen(room: RunFolder) -> None:
    record = read_record(room)
    assert record is not None
    assert record["backdrop"] == {"file": backdrop.BACKDROP}
    away = read_scene(room).background.means_m.max(axis=0) + 0.05
    out = room.results_dir / "corner.png"
    config = RenderConfig(
        eye=tuple(float(v) for v in away),
        target=tuple(float(v) for v in 2 * away),
        out=out,
        depth=True,
    )
    render(room, config)
    assert decode_color(out.read_bytes()).min() > 5
    seen = decode_color(out.with_name("corner_seen.png").read_bytes())
    depth = decode_color(out.with_name("corner_depth.png").read_bytes())
    assert seen.max() == 0
    assert depth.max() == 0


@pytest.mark.parametrize("heading", HEADINGS)
@pytest.mark.parametrize("tilt", [-1.2, 0.0, 0.7])
def test_each_pixel_shows_the_shell_in_its_own_direction(heading: float, tilt: float) -> None:
    T = looking(heading, tilt)
    drawn = shell().behind(replace(nothing(), image=np.zeros((48, 64, 3), np.float32)), CAMERA, T)
    rays = CAMERA.rays() @ T[:3, :3].T
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    np.testing.assert_allclose(drawn.image, painted(rays), atol=0.02)


def test_pixels_that_moved_say_nothing() -> None:
    (view,) = seen_views((0.0,))
    masked = view.half.planes_u8.copy()
    masked[:, :, :32] = 255
    static = np.ones(masked.shape[1:], dtype=bool)
    static[:, :32] = False
    target = replace(view.half, planes_u8=masked, static_mask=static)
    made = backdrop.backdrop_of(
        even_cloud(np.zeros((0, 3)), 0.0),
        [replace(view, half=target, full=target)],
        Rasteriser(RasterConfig(threads=1)),
    )
    assert made.colors.max() <= view.half.image()[:, :, 32:].max() + 0.01
