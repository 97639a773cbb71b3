"""Toys on a table, and two cameras that look at them."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from bridge.episode.streams import RgbdFrame
from bridge.geometry import se3
from bridge.task.meshes.catalogue import object_mesh
from bridge.task.task_file import Task, load_task
from twin.scene.shape.known import pose_of

SLOTH, DUCKS = load_task("sloth_into_basket"), load_task("five_ducks_into_basket")
DUCK = DUCKS.objects["duck_1"]
SIDE = ("side", (1.15, -0.15, 0.65), (0.45, 0.0, 0.0))
WRIST = ("wrist", (0.48, -0.1, 0.55), (0.49, -0.12, 0.0))
AT = pose_of(np.array([0.50, -0.15, 0.03, 0.4]))


def only(task: Task, *names: str) -> Task:
    objects = {key: task.objects[key] for key in names}
    return replace(task, objects=objects, start={key: task.start[key] for key in names})


def shoot(scene: Any, seed: int = 0) -> list[RgbdFrame]:
    rng = np.random.default_rng(seed)
    return [scene.frame(name, eye, target, rng) for name, eye, target in (SIDE, WRIST)]


def table_with(stage: Callable[..., Any], *things: tuple[Any, np.ndarray]) -> Any:
    """A table, and models put down on it."""
    scene = stage({})
    for model, T in things:
        mesh = object_mesh(model)
        scene.add_mesh(mesh.vertices_m, mesh.triangles, model.color_srgb, T)
    return scene


def off(T: np.ndarray, T_true: np.ndarray) -> tuple[float, float]:
    angle = np.degrees(se3.rotation_angle_rad(T[:3, :3].T @ T_true[:3, :3]))
    return float(np.linalg.norm((T - T_true)[:3, 3])) * 1e3, float(angle)


def ducks_at(*places: tuple[float, float, float]) -> list[np.ndarray]:
    return [pose_of(np.array([x, y, 0.03, yaw])) for x, y, yaw in places]
