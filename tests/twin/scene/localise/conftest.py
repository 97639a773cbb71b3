"""Ray-cast frames of a cube, an open box and a table; nothing of the stand-in cell."""

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest

from bridge.episode.streams import RgbdFrame
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.task.meshes.catalogue import object_mesh
from bridge.task.task_file import Task, load_task

sys.path.insert(0, str(Path(__file__).parent))

WIDTH, HEIGHT = 320, 240
DEPTH_CAMERA = Camera(width=WIDTH, height=HEIGHT, fx=300.0, fy=300.0, cx=160.0, cy=120.0)
COLOR_CAMERA = Camera(width=WIDTH, height=HEIGHT, fx=310.0, fy=310.0, cx=158.0, cy=121.0)
T_COLOR_DEPTH = np.eye(4)
T_COLOR_DEPTH[0, 3] = 0.015
TABLE_COLOR = (150, 140, 128)
LIGHT = np.array([0.3, -0.4, 0.87])


def srgb_from_linear(linear: np.ndarray) -> np.ndarray:
    curve = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.clip(np.rint(curve * 255), 0, 255).astype(np.uint8)


def linear_from_srgb(color: tuple[int, ...]) -> np.ndarray:
    c = np.array(color) / 255
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


class Stage:
    """Meshes with colours, and a camera that looks at them."""

    def __init__(self, task: Task, poses: dict[str, np.ndarray]) -> None:
        """Put a table and the objects of a task in place."""
        self.scene = o3d.t.geometry.RaycastingScene()
        self.albedo: list[np.ndarray] = []
        self.add_box(np.array([0.45, 0, -0.02]), np.array([1.2, 1.4, 0.04]), TABLE_COLOR)
        for object_id, T in poses.items():
            model = task.objects[object_id]
            if model.mesh is not None:
                mesh = object_mesh(model)
                self.add_mesh(mesh.vertices_m, mesh.triangles, model.color_srgb, T)
                continue
            for centre, extents in model.panels():
                self.add_box(centre, extents, model.color_srgb, T)

    def add_box(
        self,
        centre: np.ndarray,
        extents: np.ndarray,
        color: tuple[int, int, int],
        T: np.ndarray | None = None,
    ) -> None:
        mesh = o3d.geometry.TriangleMesh.create_box(*map(float, extents))
        mesh.translate(-np.asarray(extents) / 2 + centre)
        mesh.transform(np.eye(4) if T is None else T)
        self.scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(mesh))
        self.albedo.append(linear_from_srgb(color))

    def add_mesh(
        self, vertices_m: np.ndarray, triangles: np.ndarray, color: tuple[int, ...], T: np.ndarray
    ) -> None:
        self.scene.add_triangles(
            o3d.core.Tensor(se3.apply(T, vertices_m).astype(np.float32)),
            o3d.core.Tensor(np.ascontiguousarray(triangles, dtype=np.uint32)),
        )
        self.albedo.append(linear_from_srgb(color))

    def _cast(self, camera: Camera, T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rays = camera.rays()
        direction = rays @ T[:3, :3].T
        origin = np.broadcast_to(T[:3, 3], direction.shape)
        hit = self.scene.cast_rays(
            o3d.core.Tensor(np.concatenate([origin, direction], axis=-1).astype(np.float32))
        )
        depth = hit["t_hit"].numpy()
        ids = hit["geometry_ids"].numpy()
        shade = 0.25 + 0.75 * np.clip(hit["primitive_normals"].numpy() @ LIGHT, 0, 1)
        albedo = np.array([*self.albedo, np.zeros(3)])
        index = np.where(np.isfinite(depth), ids, len(self.albedo)).astype(np.int64)
        return np.where(np.isfinite(depth), depth, 0.0), albedo[index] * shade[..., None]

    def frame(
        self,
        camera_id: str,
        eye: tuple[float, float, float],
        target: tuple[float, float, float],
        rng: np.random.Generator,
        *,
        stamp_ns: int = 0,
        noise: float = 1.0,
        depth_scale: float = 1.0,
        T_error: np.ndarray | None = None,
    ) -> RgbdFrame:
        """Colour is super-sampled 2 x 2; depth has 1 mm (z / 0.5 m)^2 noise and whole mm."""
        up = np.array([0.0, 0.0, 1.0]) if abs(eye[0] - target[0]) > 0.05 else np.array([1.0, 0, 0])
        T_base_depth = se3.look_at(np.array(eye), np.array(target), up)
        T_base_color = T_base_depth @ se3.invert(T_COLOR_DEPTH)
        depth, _ = self._cast(DEPTH_CAMERA, T_base_depth)
        fine = COLOR_CAMERA.scaled(2.0)
        _, color = self._cast(fine, T_base_color)
        color = color.reshape(HEIGHT, 2, WIDTH, 2, 3).mean(axis=(1, 3))
        color = np.clip(color * (1 + 0.03 * noise * rng.standard_normal(color.shape)), 0, 1)
        valid = depth > 0
        depth = depth * depth_scale
        depth += noise * 1e-3 * (depth / 0.5) ** 2 * rng.standard_normal(depth.shape)
        depth = np.where(valid & (rng.random(depth.shape) > 0.02), np.rint(depth * 1e3) * 1e-3, 0)
        T_error = np.eye(4) if T_error is None else T_error
        return RgbdFrame(
            camera_id=camera_id,
            stamp_ns=stamp_ns,
            image_u8=srgb_from_linear(color),
            depth_m=depth.astype(np.float32),
            color_camera=COLOR_CAMERA,
            depth_camera=DEPTH_CAMERA,
            T_base_color=T_error @ T_base_color,
            T_base_depth=T_error @ T_base_depth,
        )


@pytest.fixture
def task() -> Task:
    return load_task("cube_into_box")


@pytest.fixture
def stage(task: Task) -> Callable[..., Stage]:
    def make(poses: dict[str, np.ndarray]) -> Stage:
        return Stage(task, poses)

    return make
