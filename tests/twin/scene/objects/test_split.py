"""Objects taken out of a scene: every Gaussian in one part, each part where it belongs."""

import json
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest

from bridge.episode.provenance import hash_file
from bridge.geometry import se3
from bridge.task.task_file import load_task
from twin.scene.gaussians import (
    GaussianCloud,
    arrays,
    as_float32,
    concatenate,
    moved_cloud,
    read_ply,
)
from twin.scene.localise.result import LocalisedObject
from twin.scene.movable_scene import MovableScene
from twin.scene.objects.decompose import (
    SplitConfig,
    fill_footprint,
    shape_mesh,
    split_objects,
    write_objects,
)
from twin.scene.shape.known import pose_of

TASK = load_task("cube_into_box")
POSES = {
    "cube": pose_of(np.array([0.50, -0.15, 0.02, 0.4])),
    "box": pose_of(np.array([0.49, 0.19, 0.0, -0.12])),
}


def cloud_of(points: np.ndarray, color: tuple[int, int, int], seed: int = 0) -> GaussianCloud:
    rng = np.random.default_rng(seed)
    count = len(points)
    return GaussianCloud(
        means_m=as_float32(points),
        quats_wxyz=as_float32(rng.normal(size=(count, 4))),
        scales_log=as_float32(np.full((count, 3), np.log(0.002))),
        opacities_logit=as_float32(np.full(count, 2.0)),
        colors=as_float32(np.tile(np.array(color) / 255, (count, 1))),
    )


def surface_points(object_id: str, count: int) -> np.ndarray:
    vertices, faces = shape_mesh(TASK.objects[object_id])
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(vertices), o3d.utility.Vector3iVector(faces)
    )
    o3d.utility.random.seed(1)
    points = np.asarray(mesh.sample_points_uniformly(count).points)
    points = se3.apply(POSES[object_id], points)
    return points[points[:, 2] > 0.003]


def localised(**poses: np.ndarray) -> dict[str, LocalisedObject]:
    return {
        key: LocalisedObject(
            object_id=key,
            found=key in poses,
            T_base_object=poses.get(key),
            covariance=None,
            confidence=1.0,
            method="test",
            reason=None if key in poses else "not there",
            stamp_ns=1,
        )
        for key in TASK.objects
    }


@pytest.fixture(scope="module")
def scene() -> tuple[GaussianCloud, np.ndarray]:
    """Table, cube and box as Gaussians, and the part each belongs to: -1, 0 cube, 1 box."""
    rng = np.random.default_rng(0)
    table = np.column_stack([rng.uniform([0.2, -0.5], [0.8, 0.5], (4000, 2)), np.zeros(4000)])
    table[:, 2] = rng.normal(0, 0.001, 4000)
    parts = [
        cloud_of(table, (150, 140, 128)),
        cloud_of(surface_points("cube", 800), TASK.objects["cube"].color_srgb),
        cloud_of(surface_points("box", 3000), TASK.objects["box"].color_srgb),
    ]
    owner = np.repeat([-1, 0, 1], [len(part) for part in parts])
    return concatenate(parts), owner


def test_every_gaussian_lands_in_exactly_one_part_and_in_the_right_one(
    scene: tuple[GaussianCloud, np.ndarray],
) -> None:
    cloud, owner = scene
    parts = split_objects(cloud, localised(**POSES), TASK)
    counts = [len(parts.background), *(len(item.cloud) for item in parts.objects.values())]
    assert sum(counts) == len(cloud)
    assert list(parts.objects) == ["cube", "box"]
    for count, index in zip(counts, (-1, 0, 1), strict=True):
        assert count == pytest.approx((owner == index).sum(), rel=0.01)


def test_objects_come_in_their_own_frame_and_compose_back(
    scene: tuple[GaussianCloud, np.ndarray],
) -> None:
    cloud, _ = scene
    parts = split_objects(cloud, localised(**POSES), TASK)
    half = np.array(TASK.objects["cube"].size_m) / 2
    assert np.all(np.abs(parts.objects["cube"].cloud.means_m) < half + 0.002)
    whole = MovableScene(
        background=parts.background, objects=parts.objects, links={}, T_root_base=np.eye(4)
    )
    again = whole.at({})
    for rows in (cloud.means_m, again.means_m):
        assert rows.shape == (len(cloud), 3)
    ours = again.means_m[np.lexsort(again.means_m.round(4).T)]
    theirs = cloud.means_m[np.lexsort(cloud.means_m.round(4).T)]
    np.testing.assert_allclose(ours.mean(axis=0), theirs.mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(ours.std(axis=0), theirs.std(axis=0), atol=1e-6)


def test_a_localisation_that_is_4_mm_off_follows_the_gaussians(
    scene: tuple[GaussianCloud, np.ndarray],
) -> None:
    cloud, owner = scene
    off = {key: T.copy() for key, T in POSES.items()}
    off["cube"][:2, 3] += (0.003, -0.003)
    parts = split_objects(cloud, localised(**off), TASK)
    np.testing.assert_allclose(
        parts.objects["cube"].T_base_object[:2, 3], POSES["cube"][:2, 3], atol=5e-4
    )
    assert len(parts.objects["cube"].cloud) == pytest.approx((owner == 0).sum(), rel=0.02)


def test_a_cube_in_the_box_is_not_taken_for_the_box() -> None:
    inside = POSES["box"] @ pose_of(np.array([0.0, 0.0, 0.026, 0.3]))
    cube_points = se3.apply(inside @ se3.invert(POSES["cube"]), surface_points("cube", 800))
    cloud = concatenate(
        [
            cloud_of(cube_points, TASK.objects["cube"].color_srgb),
            cloud_of(surface_points("box", 3000), TASK.objects["box"].color_srgb),
        ]
    )
    parts = split_objects(cloud, localised(cube=inside, box=POSES["box"]), TASK)
    red = parts.objects["box"].cloud.colors[:, 0] > 0.5
    assert red.mean() < 0.01
    assert len(parts.objects["cube"].cloud) > 0.98 * len(cube_points)


def test_the_hole_under_an_object_is_filled_with_the_table_around_and_only_there() -> None:
    grid = np.stack(np.meshgrid(np.arange(0.4, 0.6, 0.003), np.arange(-0.25, -0.05, 0.003)), -1)
    xy = grid.reshape(-1, 2)
    half = np.array(TASK.objects["cube"].size_m[:2]) / 2
    under = se3.apply(se3.invert(POSES["cube"]), np.column_stack([xy, np.zeros(len(xy))]))[:, :2]
    seen = np.any(np.abs(under) > half, axis=1)
    table = cloud_of(np.column_stack([xy[seen], np.full(seen.sum(), 0.001)]), (150, 140, 128))
    filling = fill_footprint(table, TASK.objects["cube"], POSES["cube"])
    local = se3.apply(se3.invert(POSES["cube"]), filling.means_m.astype(np.float64))
    assert np.all(np.abs(local[:, :2]) < half + 0.001)
    assert len(filling) == pytest.approx(0.04**2 / 0.004**2, rel=0.3)
    np.testing.assert_allclose(filling.means_m[:, 2], 0.001, atol=1e-6)
    np.testing.assert_allclose(
        filling.colors, np.tile(table.colors[0], (len(filling), 1)), atol=1e-6
    )
    whole = cloud_of(np.column_stack([xy, np.zeros(len(xy))]), (150, 140, 128))
    assert len(fill_footprint(whole, TASK.objects["cube"], POSES["cube"])) == 0


def test_moving_a_cloud_moves_covariances_like_points() -> None:
    cloud = cloud_of(np.random.default_rng(1).normal(size=(5, 3)), (10, 20, 30))
    cloud = GaussianCloud(
        **{**dict(arrays(cloud)), "scales_log": as_float32(np.log([[0.1, 0.2, 0.3]] * 5))}
    )
    T = se3.transform_from(np.array([0.5, 0.5, -0.1, 0.7]), np.array([1.0, 2.0, 3.0]))

    def covariances(item: GaussianCloud) -> np.ndarray:
        R = se3.rotation_from_quaternion(item.quats_wxyz.astype(np.float64))
        S = np.exp(2 * item.scales_log.astype(np.float64))
        return np.einsum("nij,nj,nkj->nik", R, S, R)

    moved = moved_cloud(cloud, T)
    expected = T[:3, :3] @ covariances(cloud) @ T[:3, :3].T
    np.testing.assert_allclose(covariances(moved), expected, atol=1e-6)
    np.testing.assert_allclose(
        moved.means_m, se3.apply(T, cloud.means_m.astype(np.float64)), atol=1e-6
    )


def test_the_object_folder_can_be_read_by_others_and_is_vouched_for_by_hashes(
    scene: tuple[GaussianCloud, np.ndarray], tmp_path: Path
) -> None:
    where = localised(**POSES)
    parts = split_objects(scene[0], where, TASK)
    record = write_objects(tmp_path, parts, where, TASK)
    assert sorted(record) == ["box", "cube"]
    for key, about in record.items():
        folder = tmp_path / about["folder"]
        assert {path.name for path in folder.iterdir()} == set(about["files"])
        for name, sha256 in about["files"].items():
            assert hash_file(folder / name) == sha256
        assert len(read_ply(folder / "gaussians.ply")) == about["num_splats"]
        mesh = o3d.io.read_triangle_mesh(str(folder / "mesh.ply"))
        assert np.ptp(np.asarray(mesh.vertices), axis=0) == pytest.approx(
            np.array(TASK.objects[key].size_m), rel=1e-5
        )
    saved = json.loads((tmp_path / "objects" / "cube" / "object.json").read_text())
    assert saved["size_m"] == list(TASK.objects["cube"].size_m)
    assert saved["localisation"]["found"] is True


def test_a_toy_that_lies_on_its_side_is_left_as_it_was_found() -> None:
    task = load_task("sloth_into_basket")
    T = pose_of(np.array([0.48, -0.17, 0.05, 0.3]))
    T[:3, :3] = T[:3, :3] @ np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    rng = np.random.default_rng(0)
    points = se3.apply(T, rng.uniform(-1, 1, (500, 3)) * [0.08, 0.05, 0.03])
    cloud = cloud_of(points, task.objects["sloth"].color_srgb)
    found = LocalisedObject(
        object_id="sloth",
        found=True,
        T_base_object=T,
        covariance=None,
        confidence=1.0,
        method="test",
        reason=None,
        stamp_ns=1,
    )
    parts = split_objects(cloud, {"sloth": found}, task)
    np.testing.assert_array_equal(parts.objects["sloth"].T_base_object, T)
    assert len(parts.objects["sloth"].cloud) == 500


def test_an_object_that_was_not_found_stays_in_the_background(
    scene: tuple[GaussianCloud, np.ndarray],
) -> None:
    cloud, owner = scene
    parts = split_objects(cloud, localised(box=POSES["box"]), TASK)
    assert list(parts.objects) == ["box"]
    assert len(parts.background) >= (owner == 0).sum() + 0.99 * (owner == -1).sum()


def test_a_big_background_gaussian_is_left_where_it_is() -> None:
    cloud = cloud_of(surface_points("cube", 300), TASK.objects["cube"].color_srgb)
    scales = cloud.scales_log.copy()
    scales[0] = np.log(0.2)
    cloud = GaussianCloud(**{**dict(arrays(cloud)), "scales_log": scales})
    parts = split_objects(cloud, localised(cube=POSES["cube"]), TASK, SplitConfig())
    assert len(parts.background) == 1
