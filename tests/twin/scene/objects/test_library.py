"""Objects are made once, from the scan that shows them, and the background from what shows none."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cast_views
import numpy as np
import open3d as o3d
import pytest
from clouds import even_cloud

from bridge.episode.metadata import EpisodeInfo
from bridge.episode.provenance import hash_file
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.task.task_file import Task, load_task
from bridge.terminal import Output
from twin.scene.frames.rgbd import PointSet, Target, TrainingView
from twin.scene.gaussians import as_float32, read_ply
from twin.scene.localise.result import LocalisedObject
from twin.scene.objects.decompose import Decomposition, decompose, fill_footprint
from twin.scene.objects.placement import Placement, Placements
from twin.scene.shape.known import pose_of, shape_mesh

QUIET = Output(quiet=True)
INTO_BOX, ON_BLOCK = load_task("cube_into_box"), load_task("cube_on_block")
FULL = Camera(width=320, height=240, fx=300.0, fy=300.0, cx=160.0, cy=120.0)
GREY = np.array((150, 140, 128)) / 255
HALF = Camera(width=160, height=120, fx=150.0, fy=150.0, cx=80.0, cy=60.0)
SCANS = {
    "scan_1": (
        INTO_BOX,
        {
            "cube": pose_of(np.array([0.50, -0.10, 0.02, 0.4])),
            "box": pose_of(np.array([0.49, 0.12, 0.0, -0.12])),
        },
    ),
    "scan_2": (
        ON_BLOCK,
        {
            "cube": pose_of(np.array([0.45, -0.15, 0.02, 0.1])),
            "block": pose_of(np.array([0.50, 0.10, 0.025, 0.2])),
        },
    ),
}
"""Two scans of one table: the cube elsewhere, and the block where the box stood."""


def episode_named(folder: Path, name: str) -> Episode:
    path = folder / f"{name}.mcap"
    with EpisodeWriter(path) as writer:
        writer.describe(EpisodeInfo(id=name, kind="scan"))
    return Episode.open(path)


@pytest.fixture(scope="module")
def episodes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Episode]:
    folder = tmp_path_factory.mktemp("episodes")
    return {name: episode_named(folder, name) for name in (*SCANS, "scan_9")}


def target_of(meshes: dict[str, Any], colors: np.ndarray, T: np.ndarray, camera: Camera) -> Target:
    """Each object in one colour, the table grey: cast with Open3D."""
    scene = cast_views.ray_scene([*meshes.values(), cast_views.table()])
    directions = camera.rays() @ T[:3, :3].T
    rays = np.concatenate([np.broadcast_to(T[:3, 3], directions.shape), directions], axis=-1)
    hit = scene.cast_rays(o3d.core.Tensor(rays.astype(np.float32)))
    which = np.minimum(hit["geometry_ids"].numpy(), len(colors) - 1)
    depth = hit["t_hit"].numpy()
    return Target(
        camera=camera,
        planes_u8=np.ascontiguousarray(np.moveaxis(colors[which], -1, 0)),
        depth_m=np.where(np.isfinite(depth), depth, 0.0).astype(np.float32),
        static_mask=np.ones(depth.shape, dtype=bool),
    )


def views_of(task: Task, poses: dict[str, np.ndarray], count: int = 14) -> list[TrainingView]:
    meshes = {}
    for key, T in poses.items():
        vertices, faces = shape_mesh(task.objects[key])
        meshes[key] = (se3.apply(T, vertices), faces)
    colors = np.array([*(task.objects[key].color_srgb for key in poses), (150, 140, 128)], "u1")
    return [
        TrainingView(
            camera_id="wrist",
            stamp_ns=index,
            T_base_color=T,
            half=target_of(meshes, colors, T, HALF),
            full=target_of(meshes, colors, T, FULL),
        )
        for index, T in enumerate(cast_views.around([0.5, 0.0, 0.02], count, 0.6))
    ]


@pytest.fixture(scope="module")
def views() -> dict[str, list[TrainingView]]:
    return {name: views_of(*scan) for name, scan in SCANS.items()}


def localised(key: str, T: np.ndarray) -> LocalisedObject:
    return LocalisedObject(
        object_id=key, T_base_object=T, covariance=None, confidence=1.0,
        method="given", reason=None, stamp_ns=1,
    )  # fmt: skip


@pytest.fixture(scope="module")
def placements(episodes: dict[str, Episode]) -> Placements:
    placed = {
        episodes[name].path: Placement(
            episode=episodes[name],
            task=task,
            localised={key: localised(key, T) for key, T in poses.items()},
        )
        for name, (task, poses) in SCANS.items()
    }
    task = replace(INTO_BOX, objects=INTO_BOX.objects | ON_BLOCK.objects)
    return Placements(task=task, by_episode=placed, remark="")


@pytest.fixture(scope="module")
def parts(placements: Placements, views: dict[str, list[TrainingView]]) -> Decomposition:
    grid = np.stack(np.meshgrid(np.arange(0.3, 0.7, 0.003), np.arange(-0.3, 0.3, 0.003)), -1)
    table = np.column_stack([grid.reshape(-1, 2), np.zeros(grid[..., 0].size)])
    table[0] = SCANS["scan_1"][1]["cube"][:3, 3] + [0.0, 0.0, 0.025]  # left over above the cube
    return decompose(
        placements,
        even_cloud(table, GREY, logit=2.0),
        lambda episode: views[episode.path.stem],
        QUIET,
    )


@pytest.mark.parametrize("name", SCANS)
def test_the_pixels_of_objects_and_hardly_any_others_are_masked(
    name: str,
    placements: Placements,
    views: dict[str, list[TrainingView]],
    episodes: dict[str, Episode],
) -> None:
    grey = np.array((150, 140, 128))
    nothing = PointSet(
        p_m=np.zeros((0, 3), "f4"), normals=np.zeros((0, 3), "f4"),
        colors=np.zeros((0, 3), "f4"), footprint_m=np.zeros(0, "f4"),
    )  # fmt: skip
    for view in views[name]:
        _, bare = placements.take_out(episodes[name], nothing, view)
        shows = (view.half.planes_u8 != grey[:, None, None]).any(axis=0)
        assert not (shows & bare.half.static_mask).any()
        assert (~bare.half.static_mask & ~shows).sum() < 0.5 * shows.sum() + 60
        assert view.half.static_mask.all()


def test_points_of_an_object_are_told_from_the_table_beside_it(
    placements: Placements, episodes: dict[str, Episode]
) -> None:
    placement = placements.by_episode[episodes["scan_1"].path]
    T = SCANS["scan_1"][1]["cube"]
    own = se3.apply(T, np.array([[0.0, 0.0, 0.02], [0.02, 0.01, 0.0], [0.0, -0.02, -0.015]]))
    others = se3.apply(T, np.array([[0.024, 0.0, -0.0195], [0.05, 0.0, 0.0], [0.0, 0.0, 0.05]]))
    np.testing.assert_array_equal(placement.owns(as_float32(own)), True)
    np.testing.assert_array_equal(placement.owns(as_float32(others)), False)
    under = se3.apply(T, np.array([[0.0, 0.0, -0.021], [0.022, 0.0, -0.02], [0.03, 0.0, -0.02]]))
    np.testing.assert_array_equal(placement.covers(as_float32(under)), [True, True, False])
    np.testing.assert_array_equal(placement.covers(as_float32(own)), False)


@pytest.mark.slow
def test_each_object_comes_from_the_first_scan_that_shows_it(parts: Decomposition) -> None:
    assert parts.background.means_m[:, 2].max() < 0.01
    filled = parts.background.completed.sum()
    assert 0 < filled < 650  # of 4 mm: what the block covers, and not all the box did
    sources = {key: item.episode_id for key, item in parts.library.items()}
    assert sources == {"cube": "scan_1", "box": "scan_1", "block": "scan_2"}
    for key, item in parts.library.items():
        color = np.array((INTO_BOX.objects | ON_BLOCK.objects)[key].color_srgb) / 255
        seen = ~item.splats.cloud.completed
        np.testing.assert_allclose(item.splats.cloud.colors[seen].mean(axis=0), color, atol=0.02)


@pytest.mark.slow
def test_an_episode_shows_its_own_objects_where_it_has_them(
    parts: Decomposition, episodes: dict[str, Episode]
) -> None:
    for name, (_, poses) in SCANS.items():
        cloud = parts.as_seen_in(episodes[name])
        own = cloud.means_m[len(parts.background) :]
        count = sum(len(parts.library[key].splats.cloud) for key in poses)
        assert len(own) == count
        first = len(parts.library[next(iter(poses))].splats.cloud)
        T = poses[next(iter(poses))]
        np.testing.assert_allclose(own[:first].mean(axis=0), T[:3, 3], atol=0.004)
    assert len(parts.as_seen_in(episodes["scan_9"])) == len(parts.background)


@pytest.mark.slow
def test_the_object_folders_are_vouched_for_by_hashes_and_old_ones_go(
    parts: Decomposition, views: dict[str, list[TrainingView]], tmp_path: Path
) -> None:
    run = RunFolder.create(tmp_path / "run")
    old = run.scene_dir / "objects" / "duck"
    old.mkdir(parents=True)
    (old / "mesh.ply").write_bytes(b"of an earlier scene")
    every = [view for each in views.values() for view in each]
    record = parts.write(run, every, lambda episode: views[episode.path.stem])
    assert sorted(record["objects"]) == ["block", "box", "cube"]
    assert not old.exists()
    for about in record["objects"].values():
        folder = run.scene_dir / about["folder"]
        assert {path.name for path in folder.iterdir()} == set(about["files"])
        for name, sha256 in about["files"].items():
            assert hash_file(folder / name) == sha256
        assert len(read_ply(folder / "gaussians.ply")) == about["num_splats"]
        saved = json.loads((folder / "object.json").read_text())
        assert saved["scanned_in"] == about["scanned_in"]


def test_the_hole_under_an_object_is_filled_with_the_table_around_and_only_there() -> None:
    T, model = SCANS["scan_1"][1]["cube"], INTO_BOX.objects["cube"]
    grid = np.stack(np.meshgrid(np.arange(0.4, 0.6, 0.003), np.arange(-0.2, 0.0, 0.003)), -1)
    xy = grid.reshape(-1, 2)
    half = np.array(model.size_m[:2]) / 2
    under = se3.apply(se3.invert(T), np.column_stack([xy, np.zeros(len(xy))]))[:, :2]
    seen = np.any(np.abs(under) > half, axis=1)
    table = even_cloud(np.column_stack([xy[seen], np.full(seen.sum(), 0.001)]), GREY, logit=2.0)
    filling = fill_footprint(table, model, T)
    assert len(filling) == pytest.approx(0.04**2 / 0.004**2, rel=0.3)
    local = se3.apply(se3.invert(T), filling.means_m.astype(np.float64))
    assert np.all(np.abs(local[:, :2]) < half + 0.001)
    np.testing.assert_allclose(filling.means_m[:, 2], 0.001, atol=1e-6)
    np.testing.assert_allclose(filling.colors - table.colors[0], 0.0, atol=1e-6)
    whole = even_cloud(np.column_stack([xy, np.zeros(len(xy))]), GREY, logit=2.0)
    assert len(fill_footprint(whole, model, T)) == 0
