"""Ideal or noisy depth views of known shapes on a table, by ray casting (Open3D)."""

from collections.abc import Sequence

import numpy as np
import open3d as o3d

from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.task.task_file import load_task
from twin.scene.frames.rgbd import Target, TrainingView
from twin.scene.shape.carve import MaskedView
from twin.scene.shape.known import pose_of, shape_mesh

CAMERA = Camera(width=320, height=240, fx=300.0, fy=300.0, cx=160.0, cy=120.0)
Mesh = tuple[np.ndarray, np.ndarray]
TASK = load_task("cube_into_box")


def table(z_m: float = 0.0, half_m: float = 1.0) -> Mesh:
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * half_m
    return corners + np.array([0, 0, z_m]), np.array([[0, 1, 2], [0, 2, 3]])


def cube_mesh() -> Mesh:
    """4 cm cube standing on z = 0."""
    vertices, faces = shape_mesh(TASK.objects["cube"])
    return vertices + np.array([0, 0, TASK.objects["cube"].size_m[2] / 2]), faces


def open_box_mesh() -> Mesh:
    return shape_mesh(TASK.objects["box"])


def look_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    T[:3, 3] = eye
    return T


def around(centre: Sequence[float], num: int, distance_m: float = 0.5) -> list[np.ndarray]:
    """Camera poses on a spiral over the upper half sphere, from 25 to 80 degrees up."""
    poses = []
    for index in range(num):
        up = np.radians(25 + 55 * (index + 0.5) / num)
        turn = index * np.pi * (3 - np.sqrt(5))
        way = [np.cos(up) * np.cos(turn), np.cos(up) * np.sin(turn), np.sin(up)]
        poses.append(look_at(np.array(centre) + distance_m * np.array(way), np.array(centre)))
    return poses


def ray_scene(meshes: Sequence[Mesh]) -> o3d.t.geometry.RaycastingScene:
    scene = o3d.t.geometry.RaycastingScene()
    for vertices, faces in meshes:
        scene.add_triangles(
            o3d.core.Tensor(np.ascontiguousarray(vertices, dtype=np.float32)),
            o3d.core.Tensor(np.ascontiguousarray(faces, dtype=np.uint32)),
        )
    return scene


def cast(
    meshes: Sequence[Mesh],
    poses: Sequence[np.ndarray],
    *,
    noise: float = 0.0,
    camera: Camera = CAMERA,
    seed: int = 0,
) -> list[MaskedView]:
    """Views of meshes; the mask shows the first of them. Noise is sigma = noise * z^2 [1/m]."""
    rng = np.random.default_rng(seed)
    scene = ray_scene(meshes)
    rays = camera.rays().reshape(-1, 3)
    views = []
    for T in poses:
        directions = rays @ T[:3, :3].T
        origins = np.broadcast_to(T[:3, 3], directions.shape)
        hit = scene.cast_rays(
            o3d.core.Tensor(np.concatenate([origins, directions], 1).astype(np.float32))
        )
        depth = hit["t_hit"].numpy().astype(np.float64)
        depth[~np.isfinite(depth)] = 0.0
        depth += (depth > 0) * noise * depth**2 * rng.standard_normal(len(depth))
        shape = (camera.height, camera.width)
        views.append(
            MaskedView(
                camera=camera,
                T_base_camera=T,
                depth_m=depth.reshape(shape),
                mask=(hit["geometry_ids"].numpy() == 0).reshape(shape),
            )
        )
    return views


def mean_error_m(mesh: Mesh, reference: Mesh, *, num: int = 4000) -> tuple[float, float]:
    """Mean and 95th percentile of the distances of the reference's surface to a mesh [m]."""
    surface = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(reference[0]),
        o3d.utility.Vector3iVector(np.asarray(reference[1], dtype=np.int32)),
    )
    o3d.utility.random.seed(0)
    points = np.asarray(surface.sample_points_uniformly(num).points)
    away = ray_scene([mesh]).compute_distance(o3d.core.Tensor(points.astype(np.float32))).numpy()
    return float(away.mean()), float(np.percentile(away, 95))


POSES = {
    "cube": pose_of(np.array([0.50, -0.10, 0.02, 0.4])),
    "box": pose_of(np.array([0.49, 0.12, 0.0, -0.12])),
}
"""Where they stand in ``training_views``."""


def placed(key: str) -> Mesh:
    vertices, faces = shape_mesh(TASK.objects[key])
    return se3.apply(POSES[key], vertices), faces


def training_views() -> list[TrainingView]:
    """Cube and box on a table, seen from 24 places."""
    poses = around([0.5, 0.0, 0.02], 24, 0.6)
    meshes = [placed("cube"), placed("box"), table()]
    training = []
    for seen in cast(meshes, poses, noise=0.003):
        target = Target(
            camera=seen.camera,
            planes_u8=np.zeros((3, *seen.depth_m.shape), dtype=np.uint8),
            depth_m=seen.depth_m.astype(np.float32),
            static_mask=np.ones(seen.depth_m.shape, dtype=bool),
        )
        training.append(
            TrainingView(
                camera_id="wrist",
                stamp_ns=len(training),
                T_base_color=seen.T_base_camera,
                half=target,
                full=target,
            )
        )
    return training
