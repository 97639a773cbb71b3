"""The parts under localisation against independent references."""

import numpy as np
import open3d as o3d
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bridge.media.color import linear_from_srgb
from bridge.task.task_file import load_task
from twin.scene.localise.objects import fit_table
from twin.scene.localise.points import clusters, likeness, voxel_mean
from twin.scene.shape.known import pose_of, rectangle_yaw_rad, surface_distances

TASK = load_task("cube_into_box")


@pytest.mark.parametrize("object_id", ["cube", "box"])
def test_surface_distances_agree_with_open3d_outside_the_material(object_id: str) -> None:
    model = TASK.objects[object_id]
    T = pose_of(np.array([0.4, -0.1, 0.03, 0.7]))
    scene = o3d.t.geometry.RaycastingScene()
    for centre, extents in model.panels():
        mesh = o3d.geometry.TriangleMesh.create_box(*map(float, extents))
        mesh.translate(centre - extents / 2)
        mesh.transform(T)
        scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(mesh))
    points = T[:3, 3] + np.random.default_rng(0).uniform(-0.15, 0.15, (400, 3))
    ours, gradient = surface_distances(points, model, T)
    reference = scene.compute_distance(o3d.core.Tensor(points.astype(np.float32))).numpy()
    outside = ours > 0
    assert outside.sum() > 200
    np.testing.assert_allclose(ours[outside], reference[outside], atol=1e-6)
    step = 1e-6
    for axis in range(3):
        ahead, _ = surface_distances(points + step * np.eye(3)[axis], model, T)
        slope = (ahead - ours) / step
        smooth = np.abs(slope - gradient[:, axis]) < 1e-3
        assert smooth.mean() > 0.98  # the rest sits on a crease between two panels


@settings(max_examples=25, deadline=None)
@given(yaw=st.floats(-0.78, 0.78), seed=st.integers(0, 1000))
def test_the_smallest_rectangle_gives_the_yaw_of_a_filled_rectangle(yaw: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    local = rng.uniform(-0.5, 0.5, (2000, 2)) * (0.06, 0.04)
    c, s = np.cos(yaw), np.sin(yaw)
    found = rectangle_yaw_rad(local @ np.array([[c, s], [-s, c]]))
    difference = np.mod(found - yaw + np.pi / 4, np.pi / 2) - np.pi / 4
    assert abs(difference) < 0.12  # 98 % of the points cut the corners a little


def test_clusters_are_separated_by_a_gap_and_ordered_by_size() -> None:
    rng = np.random.default_rng(0)
    a = rng.uniform(0, 0.04, (300, 3))
    b = rng.uniform(0, 0.04, (200, 3)) + np.array([0.07, 0, 0])
    groups = clusters(np.concatenate([b, a]), np.repeat([0, 1], [200, 300]), 0.008)
    assert [len(group) for group in groups[:2]] == [300, 200]
    assert set(groups[0].view_ids) == {1}


def test_the_table_fit_finds_a_tilted_and_lifted_plane() -> None:
    rng = np.random.default_rng(0)
    xy = rng.uniform([0.2, -0.3], [0.8, 0.3], (2000, 2))
    z = 0.004 + 0.01 * (xy[:, 0] - 0.5) + rng.normal(0, 0.001, 2000)
    points = np.column_stack([xy, z])
    points[:200, 2] += rng.uniform(0.01, 0.02, 200)  # clutter
    T_new_old, depth_factor = fit_table(points, np.array([1.2, 0.0, 0.7]))
    after = points[200:] @ T_new_old[:3, :3].T + T_new_old[:3, 3]
    camera = T_new_old[:3, :3] @ np.array([1.2, 0.0, 0.7]) + T_new_old[:3, 3]
    after = camera + depth_factor * (after - camera)
    plane = np.linalg.lstsq(
        np.column_stack([after[:, :2] - [0.5, 0], np.ones(len(after))]), after[:, 2], rcond=None
    )[0]
    np.testing.assert_allclose(plane, 0.0, atol=5e-4)


@settings(max_examples=50, deadline=None)
@given(shade=st.floats(0.15, 1.0))
def test_likeness_does_not_depend_on_shading(shade: float) -> None:
    albedo = linear_from_srgb(np.array([[[200, 45, 40]]]) / 255.0)
    like = likeness(albedo * shade, (200, 45, 40))
    np.testing.assert_allclose(like, 1.0, atol=1e-5)


def test_voxel_mean_keeps_the_mean_of_each_voxel() -> None:
    points = np.array([[0.0001, 0, 0], [0.0009, 0, 0], [-0.0005, 0, 0], [0.5, 0.5, 0.5]])
    means = voxel_mean(points, 0.001)
    assert sorted(means[:, 0].round(6)) == [-0.0005, 0.0005, 0.5]
