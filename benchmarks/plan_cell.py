"""The scene of the planner's benchmarks: a box that is partly taken, beside a wall."""

from dataclasses import replace

import numpy as np

from bridge.geometry import se3
from bridge.robots.default import ROBOT
from bridge.task.task_file import ObjectModel, load_task
from twin.plan.problem import Grasp, Problem, Shape
from twin.replay.scene import ReplayScene
from twin.robot.model import load_robot
from twin.scene.objects.decompose import shape_mesh


def box_shape(size_m: tuple[float, float, float]) -> Shape:
    """A box as a closed mesh."""
    model = ObjectModel(id="box", shape="box", size_m=size_m, color_srgb=(0, 0, 0))
    vertices, triangles = shape_mesh(model)
    return Shape(vertices_m=vertices, triangles=triangles, source="task file")


def upright(x: float, y: float, z: float, yaw_rad: float = 0.0) -> np.ndarray:
    q = np.array([np.cos(yaw_rad / 2), 0.0, 0.0, np.sin(yaw_rad / 2)])
    return se3.transform_from(q, np.array([x, y, z]))


def box_with_wall() -> tuple[Problem, Grasp]:
    """Problem and grasp of the cube that is put in."""
    task = load_task("cube_into_box")
    cube = task.objects["cube"]
    wall = ObjectModel(
        id="wall", shape="box", size_m=(0.2, 0.02, 0.3), color_srgb=(90, 90, 90), fixed=True
    )
    objects = {**task.objects, "other": replace(cube, id="other"), "wall": wall}
    task = replace(task, objects=objects)
    sure = np.diag([1e-6] * 3 + [1e-4] * 3)
    scene = ReplayScene(
        task=task,
        urdf=ROBOT.urdf_text(),
        Ts_base_object={
            "cube": upright(0.5, -0.15, 0.02, 0.4),
            "box": upright(0.5, 0.19, 0.0, 0.2),
            "other": upright(0.505, 0.18, 0.026, 0.5),
            "wall": upright(0.5, 0.29, 0.15, 0.2),
        },
        covariances=dict.fromkeys(("cube", "box"), sure),
    )
    shapes = {name: box_shape(model.size_m) for name, model in objects.items()}
    T_object_tcp = np.diag([1.0, -1.0, -1.0, 1.0])
    T_object_tcp[2, 3] = 0.004
    robot = load_robot(scene.urdf)
    grasp = Grasp(
        object_id="cube",
        T_object_tcp=T_object_tcp,
        width_m=cube.size_m[1],
        open_m=0.06,
        margin=1.0,
        joints_rad=robot.home_rad,
        pregrasp_m=0.1,
    )
    return Problem(scene=scene, robot=robot, shapes=shapes), grasp
