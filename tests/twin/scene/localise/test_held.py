"""What lies in the hand, tilted as fingers left it, is found in the tool's frame."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from bridge.geometry import se3
from bridge.task.task_file import Task
from twin.scene.localise.held import UPWARDS, fitted_in_hand
from twin.scene.localise.mesh_fit import known_surface
from twin.scene.shape.known import turned_alike

EYES = [(0.3, 0.05, 0.4), (-0.2, 0.35, 0.25)]


def fitted(task: Task, stage: Callable[..., Any], T_tcp_cube: np.ndarray) -> np.ndarray | None:
    scene = stage({"cube": UPWARDS @ T_tcp_cube})
    rng = np.random.default_rng(1)
    frames = [scene.frame(f"cam{k}", eye, (0.0, 0.0, 0.0), rng) for k, eye in enumerate(EYES)]
    cube = task.objects["cube"]
    return fitted_in_hand(frames, task, cube, known_surface(cube))


@pytest.mark.parametrize("turn_deg", [(0.0, 0.0, 20.0), (35.0, 10.0, 0.0), (-20.0, 40.0, 60.0)])
def test_a_cube_is_found_however_it_is_tilted(
    task: Task, stage: Callable[..., Any], turn_deg: tuple[float, float, float]
) -> None:
    R = se3.rotation_from_vector(np.radians(turn_deg))
    true = se3.from_rotation(R, [-0.015, 0.002, -0.04])
    found = fitted(task, stage, true)
    assert found is not None
    alike = turned_alike(found, true, task.objects["cube"])
    assert np.linalg.norm(alike[:3, 3] - true[:3, 3]) < 0.002
    assert np.degrees(se3.rotation_angle_rad(alike[:3, :3].T @ R)) < 3.0


def test_an_empty_hand_holds_nothing(task: Task, stage: Callable[..., Any]) -> None:
    assert fitted(task, stage, se3.from_rotation(np.eye(3), [0.3, 0.2, -0.04])) is None
