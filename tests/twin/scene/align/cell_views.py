"""Depth images of the stand-in cell's own geometry from its side camera, with everything known."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from standin_hidden import nominal_hidden

from bridge.geometry import se3
from bridge.robots.default import ROBOT
from bridge.sources.standin.cell_file import load_cell
from bridge.sources.standin.render import Renderer, measure_depth
from bridge.sources.standin.surfaces import lab_surfaces, object_surfaces, robot_surfaces
from bridge.task.task_file import load_task
from twin.robot.model import RobotModel, load_robot
from twin.robot.posture import Posture
from twin.robot.surface import link_poses
from twin.scene.align.view import RobotView

POSTURES = (
    (-0.26, -1.71, 1.37, -1.23, -1.57, 1.31),
    (0.75, -1.25, 1.20, -1.60, -1.20, 0.40),
    (-1.00, -1.50, 1.75, -1.90, -1.90, 0.90),
    (0.20, -2.00, 1.90, -0.90, -0.80, -0.60),
)
"""Arm joints [rad]: home of the cell, and three others over the table."""


@dataclass(frozen=True, kw_only=True)
class CellErrors:
    """What is wrong with the cell that is looked at."""

    depth_scale: float = 1.0
    """Measured over true depth."""
    joint_offset_rad: tuple[float, ...] = (0.0,) * 6
    """Encoder reading minus true angle."""
    noise: bool = True


def robot() -> RobotModel:
    return load_robot(ROBOT.urdf_text())


@cache
def renderer() -> Renderer:
    task = load_task("cube_into_box")
    return Renderer([*robot_surfaces(), *object_surfaces(task), *lab_surfaces(0)])


def side_camera_pose() -> np.ndarray:
    return load_cell("standin").cameras["side"].T_parent_camera


def object_places() -> dict[str, np.ndarray]:
    """The task's objects side by side on the table."""
    places = {}
    for index, (object_id, model) in enumerate(load_task("cube_into_box").objects.items()):
        T = np.eye(4)
        height = model.size_m[2] / 2 if model.shape == "box" else 0.0
        T[:3, 3] = (0.42 + 0.05 * index, 0.18 * (-1) ** index, height)
        places[object_id] = T
    return places


def take(
    joints_rad: Sequence[float], errors: CellErrors, seed: int, width_m: float = 0.06
) -> np.ndarray:
    """Depth [m] as the side camera measures it, with the encoders at these joints."""
    cell = load_cell("standin")
    true = np.array(joints_rad) - np.array(errors.joint_offset_rad)
    poses = link_poses(robot(), Posture(joints_rad=true, width_m=width_m))
    picture = renderer().render(
        cell.cameras["side"].camera, side_camera_pose(), {**poses, **object_places()}
    )
    hidden = replace(nominal_hidden(cell), depth_scale=errors.depth_scale, depth_offset_m=0.0)
    sensors = cell.sensors if errors.noise else replace(cell.sensors, depth_noise_per_m=0.0)
    depth_mm = measure_depth(picture, sensors, hidden, np.random.default_rng(seed))
    return depth_mm.astype(np.float64) * 1e-3


def views(
    postures: Sequence[Sequence[float]],
    T_source_base: np.ndarray,
    errors: CellErrors = CellErrors(),
    width_m: float = 0.06,
) -> list[RobotView]:
    """Views in a source frame that lies anywhere; the truth is the inverse of the pose given."""
    camera = load_cell("standin").cameras["side"].camera
    return [
        RobotView(
            camera=camera,
            depth_m=take(joints, errors, seed=index, width_m=width_m),
            T_source_camera=T_source_base @ side_camera_pose(),
            posture=Posture(joints_rad=np.array(joints), width_m=width_m),
        )
        for index, joints in enumerate(postures)
    ]


def anywhere(seed: int) -> np.ndarray:
    """A random rigid transform, metres away and turned about every axis."""
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3] = se3.rotation_from_vector(rng.normal(size=3))
    T[:3, 3] = rng.uniform(-2, 2, 3)
    return T


def surface_error_m(
    T_base_source: np.ndarray, T_source_base: np.ndarray, p_base: np.ndarray
) -> float:
    """Mean distance by which points of the robot are put wrong."""
    return float(
        np.linalg.norm(se3.apply(T_base_source @ T_source_base, p_base) - p_base, axis=1).mean()
    )
