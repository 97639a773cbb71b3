"""A trial shows the objects of its own task, and says which of them no scan saw."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from clouds import even_cloud

from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.geometry.camera import Camera
from bridge.task.task_file import Task, load_task
from twin.scene import trial
from twin.scene.gaussians import write_ply
from twin.scene.raster.rasteriser import Rasteriser
from twin.scene.render import part_masks
from twin.scene.shape.known import pose_of, shape_mesh
from twin.scene.store.folder import background_hash, read_scene, write_record
from twin.scene.trial import trial_parts

POSES = {
    "cube": pose_of(np.array([0.50, -0.12, 0.02, 0.4])),
    "block": pose_of(np.array([0.50, 0.10, 0.025, 0.2])),
}
CAMERA = Camera(width=64, height=48, fx=60.0, fy=60.0, cx=32.0, cy=24.0)
EYES = (("side", (1.1, -0.4, 0.6), (0.45, 0.0, 0.0)), ("wrist", (0.3, 0.0, 0.6), (0.5, 0.02, 0.0)))


@pytest.fixture
def on_block() -> Task:
    return load_task("cube_on_block")


@pytest.fixture
def run(tmp_path: Path) -> RunFolder:
    """A scene whose scan saw the cube and the box."""
    run = RunFolder.create(tmp_path / "run")
    run.scene_dir.mkdir()
    grid = np.stack(np.meshgrid(np.arange(0.2, 0.8, 0.006), np.arange(-0.3, 0.3, 0.006)), -1)
    table = np.column_stack([grid.reshape(-1, 2), np.zeros(grid[..., 0].size)])
    write_ply(run.scene_dir / "background.ply", even_cloud(table, (0.6, 0.55, 0.5), 0.004))
    for name in ("cube", "box"):
        place = run.scene_dir / "objects" / name
        place.mkdir(parents=True)
        corners = np.random.default_rng(0).uniform(-0.02, 0.02, (300, 3))
        write_ply(place / "gaussians.ply", even_cloud(corners, (0.8, 0.2, 0.2), 0.004))
        pose = {"p_m": [0.5, 0.2, 0.02], "q_wxyz": [1.0, 0.0, 0.0, 0.0]}
        (place / "object.json").write_text(json.dumps({"T_base_object": pose}))
    scanned: dict[str, Any] = {"cube": {}, "box": {}}
    record = {"schema_version": 1, "key": "k", "scene_hash": background_hash(run),
              "background": {}, "sources": [], "views": [], "objects": scanned}  # fmt: skip
    write_record(run, record)
    return run


@pytest.fixture
def episode(run: RunFolder) -> Episode:
    path = run.episodes_dir / "trial_0001.mcap"
    with EpisodeWriter(path) as writer:
        writer.describe(EpisodeInfo(id="trial_0001", kind="trial", task="cube_on_block"))
    return Episode.open(path)


@pytest.fixture
def first_frames(
    monkeypatch: pytest.MonkeyPatch, on_block: Task, stage: Callable[..., Any]
) -> list[Any]:
    """What both cameras saw before the first motion; nobody looks at anything else."""
    scene = stage({})
    for name, T in POSES.items():
        model = on_block.objects[name]
        scene.add_mesh(*shape_mesh(model), model.color_srgb, T)
    frames = [scene.frame(name, eye, at, np.random.default_rng(0)) for name, eye, at in EYES]
    asked: list[dict[str, Any]] = []

    def stationary(_episode: Episode, _count: int, **given: Any) -> list[Any]:
        asked.append(given)
        return frames

    monkeypatch.setattr(trial, "stationary_frames", stationary)
    monkeypatch.setattr(trial, "trial_cameras", lambda *_: {})
    monkeypatch.setattr(trial, "first_execution_ns", lambda _: 77)
    return frames


@pytest.mark.usefixtures("first_frames")
def test_what_no_scan_saw_is_drawn_from_the_task_and_marked(
    run: RunFolder, episode: Episode, on_block: Task, first_frames: list[Any]
) -> None:
    parts, notes = trial_parts(run, read_scene(run), episode, on_block, POSES)
    assert list(parts.objects) == ["cube", "block"]  # and not the box of another task
    assert parts.not_scanned == {"block"}
    assert notes == [
        "block was not scanned: drawn from the task's shape, with colours from before the first "
        "motion"
    ]
    seen = parts.objects["block"].cloud.take(
        np.flatnonzero(~parts.objects["block"].cloud.completed)
    )
    assert (seen.colors[:, 1] > seen.colors[:, 0]).mean() > 0.95  # green
    frame = first_frames[0]
    camera, T = frame.color_camera, frame.T_base_color
    drawn = parts.draw(Rasteriser(), parts.at(POSES), camera, T)
    meshes = {name: shape_mesh(on_block.objects[name]) for name in POSES}
    masks = part_masks(camera, T, None, meshes, POSES, parts.not_scanned)
    block = masks["not scanned"]
    assert block.sum() > 200
    assert masks["objects"][block].all()
    assert not masks["background"][block].any()
    both = (drawn.not_scanned["block"] & block).sum() / (drawn.not_scanned["block"] | block).sum()
    assert both > 0.85
    assert not drawn.seen_mask[drawn.not_scanned["block"]].any()
    marked = (drawn.marked_u8() != drawn.image_u8).any(axis=-1)
    assert marked.any()
    assert not marked[drawn.not_scanned["block"]].all()


def test_where_everything_was_scanned_nothing_is_marked(
    run: RunFolder, episode: Episode, task: Task
) -> None:
    parts, notes = trial_parts(run, read_scene(run), episode, task, {"cube": POSES["cube"]})
    assert (list(parts.objects), parts.not_scanned, notes) == (["cube"], frozenset(), [])
    drawn = parts.draw(Rasteriser(), parts.at(POSES), CAMERA, np.eye(4))
    np.testing.assert_array_equal(drawn.marked_u8(), drawn.image_u8)


def test_without_a_task_or_a_localisation_what_was_scanned_stands_where_it_was(
    run: RunFolder, episode: Episode, on_block: Task
) -> None:
    parts, notes = trial_parts(run, read_scene(run), episode, None, None)
    assert (sorted(parts.objects), notes) == (["box", "cube"], [])
    parts, notes = trial_parts(run, read_scene(run), episode, on_block, None)
    assert list(parts.objects) == ["cube"]
    assert "block was not scanned" in notes[0]


@pytest.mark.usefixtures("first_frames")
def test_an_object_that_nobody_saw_before_the_first_motion_is_named_and_left_out(
    run: RunFolder, episode: Episode, on_block: Task
) -> None:
    elsewhere = POSES | {"block": pose_of(np.array([3.0, 3.0, 0.025, 0.0]))}
    parts, notes = trial_parts(run, read_scene(run), episode, on_block, elsewhere)
    assert list(parts.objects) == ["cube"]
    assert notes == ["block was not scanned and is not drawn: nobody saw it"]
