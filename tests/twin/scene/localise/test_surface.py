"""Points spread over a mesh, and what cameras see of it."""

from collections.abc import Callable
from typing import Any

import numpy as np
import open3d as o3d
from toy_frames import AT, DUCK, DUCKS, only, shoot, table_with

from bridge.task.meshes.catalogue import object_mesh
from twin.scene.localise import mesh_fit
from twin.scene.localise.points import fuse_stationary


def test_samples_lie_on_the_mesh_evenly_and_face_outwards() -> None:
    mesh = object_mesh(DUCK)
    surface = mesh_fit.mesh_surface(mesh.vertices_m, mesh.triangles, 2000)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(mesh.vertices_m.astype(np.float32)),
        o3d.core.Tensor(mesh.triangles.astype(np.uint32)),
    )

    def distance(p: np.ndarray) -> np.ndarray:
        return scene.compute_signed_distance(o3d.core.Tensor(p.astype(np.float32))).numpy()

    assert np.abs(distance(surface.p_m)).max() < 1e-5
    assert (distance(surface.p_m + 5e-4 * surface.normals) > 0).mean() > 0.98
    corners = mesh.vertices_m[mesh.triangles]
    areas = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    middle = (corners.mean(axis=1) * areas[:, None]).sum(axis=0) / areas.sum()
    np.testing.assert_allclose(surface.p_m.mean(axis=0), middle, atol=1e-3)


def test_a_mesh_of_which_no_camera_measures_anything_is_not_believed(
    stage: Callable[..., Any],
) -> None:
    task = only(DUCKS, "duck_1")
    frames = shoot(table_with(stage, (DUCK, AT)))
    views = fuse_stationary(frames, 3, 8, task)
    surface, below = mesh_fit.known_surface(DUCK, 1000), AT.copy()
    below[2, 3] -= 0.2  # hidden by the table, so nothing sees through it either
    assert mesh_fit.agreeing(AT, surface, views, 0.012) > 0.8
    assert mesh_fit.seen_through(below, surface, views, 0.012) < 0.05
    assert mesh_fit.agreeing(below, surface, views, 0.012) < 0.05
