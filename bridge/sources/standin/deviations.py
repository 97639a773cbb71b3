"""How a laboratory differs from what is published of it, beyond friction, weight and offsets.

A cell file whose table ``hidden.deviations`` gives ranges has these; the frozen cells have none.
Everything published (URDF, camera info, the task's sizes) stays nominal, and so is wrong. What was
drawn goes to the topics below ``/standin/truth`` only.
"""

import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.robots.default import ARM_JOINTS
from bridge.task.meshes.toys import BoxPart, basket_parts
from bridge.task.task_file import BASKET, ObjectModel, Task

DEVIATION_STREAM = 404
"""Keeps these draws apart from every other draw of the same seed."""
LONGER_LINKS = ("forearm_link", "wrist_1_link", "wrist_3_link", "tool0")
"""Links whose distance from their parent is not what the URDF says."""
TILTED_ABOUT_M = (0.48, 0.0, 0.0)
"""The middle of where things are done: a tilt lifts one end of it and lowers the other."""
LIP_HEIGHT_M = 0.005
RANGES = (
    "object_size_scale",
    "object_rebate_m",
    "object_centre_of_mass",
    "container_size_scale",
    "container_height_scale",
    "container_lip_m",
    "container_shift_m",
    "container_yaw_rad",
    "container_tilt_rad",
    "table_height_m",
    "table_tilt_rad",
    "link_length_m",
    "joint_zero_rad",
    "joint_drag_Nm",
    "joint_backlash_rad",
    "finger_shift_m",
    "finger_thickness_m",
    "finger_length_m",
    "pad_time_s",
    "focal_scale",
    "principal_point_fraction",
    "distortion_k1",
    "distortion_k2",
)
"""Every key that ``hidden.deviations`` must have; the cell file says unit and reason of each."""


@dataclass(frozen=True, kw_only=True)
class Lens(Camera):
    """A camera with radial distortion, as a real one has and its published calibration has not."""

    k1: float
    k2: float

    def rays(self) -> Float[np.ndarray, "height width 3"]:
        """Directions through all pixel centres with z = 1, after the distortion is undone.

        Brown's model, x_distorted = x (1 + k1 r^2 + k2 r^4), solved by fixed-point iteration.
        """
        distorted = super().rays()
        x = distorted.copy()
        for _ in range(20):
            r2 = np.sum(np.square(x[..., :2]), axis=-1, keepdims=True)
            x[..., :2] = distorted[..., :2] / (1 + self.k1 * r2 + self.k2 * r2**2)
        return x


@dataclass(frozen=True, kw_only=True)
class ObjectDeviation:
    """How one object differs from its description in the task file."""

    size_scale: tuple[float, float, float]
    """True extents over published ones, along its axes; of a container, of its cavity."""
    rebate_m: float = 0.0
    """Depth and width of a step along every edge of a box: its faces are smaller than it is."""
    centre_of_mass: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """From the middle, in half extents."""
    lip_m: float = 0.0
    """How far an open box's rim reaches inwards."""
    shift_m: tuple[float, float] = (0.0, 0.0)
    """Of a fixed container from where it is declared, in its own frame."""
    turn_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Of a fixed container: a rotation vector in its own frame."""


@dataclass(frozen=True, kw_only=True)
class Deviations:
    """One draw."""

    objects: dict[str, ObjectDeviation]
    table_height_m: float
    table_tilt_rad: tuple[float, float]
    """About the x and y axes of the base, through ``TILTED_ABOUT_M``."""
    link_length_m: dict[str, float]
    """By how much a link is farther from its parent than published."""
    joint_zero_rad: tuple[float, ...]
    """Encoder reading minus true angle, on top of the zero-mean offset every cell has."""
    joint_drag_Nm: tuple[float, ...]
    """Dry friction of each joint."""
    joint_backlash_rad: tuple[float, ...]
    """Play between a joint's encoder and its link, from one end to the other."""
    finger_shift_m: float
    """Both pads, along the direction in which they close: they do not meet in the middle."""
    finger_thickness_m: float
    finger_length_m: float
    """Beyond the published ones."""
    pad_time_s: float
    """Time constant of the pads' contact: larger is softer."""
    lenses: dict[str, tuple[float, float, float, float, float]]
    """Per camera: focal scale, principal point shift in widths (x, y), k1, k2."""

    @property
    def T_base_table(self) -> Float[np.ndarray, "4 4"]:
        """Moves what is declared on the published table, the plane z = 0, onto the true one."""
        R = se3.rotation_from_vector(np.array([*self.table_tilt_rad, 0.0]))
        pivot = np.array(TILTED_ABOUT_M)
        return se3.from_rotation(R, pivot - R @ pivot + [0.0, 0.0, self.table_height_m])

    def lens(self, camera_id: str, camera: Camera) -> Lens:
        """The true camera behind a published one."""
        focal, cx, cy, k1, k2 = self.lenses[camera_id]
        true = replace(
            camera,
            fx=camera.fx * focal,
            fy=camera.fy * focal,
            cx=camera.cx + cx * camera.width,
            cy=camera.cy + cy * camera.width,
        )
        return Lens(**vars(true), k1=k1, k2=k2)

    def put_down(
        self, task: Task, declared: Mapping[str, Float[np.ndarray, "4 4"]]
    ) -> dict[str, Float[np.ndarray, "4 4"]]:
        """Where things come to lie that were declared on the published table, the plane z = 0."""
        poses = {}
        for object_id, T in declared.items():
            model, known = task.objects[object_id], self.objects.get(object_id)
            T_table_object = T.copy()
            T_table_object[2, 3] = model.rest_height_m
            poses[object_id] = self.T_base_table @ T_table_object
            if known is not None and model.fixed:
                turned = se3.small_motion(np.array([*known.turn_rad, *known.shift_m, 0.0]))
                poses[object_id] = poses[object_id] @ turned
        return poses

    def true_task(self, task: Task) -> Task:
        """The task with the objects' true sizes."""
        objects = {
            key: _scaled(model, self.objects[key].size_scale) if key in self.objects else model
            for key, model in task.objects.items()
        }
        return replace(task, objects=objects)


def _scaled(model: ObjectModel, scale: tuple[float, float, float]) -> ObjectModel:
    if model.wall_m > 0:  # the cavity is scaled, the walls are as thick as published
        x, y, z = np.array(model.inner_m) * scale
        size = (x + 2 * model.wall_m, y + 2 * model.wall_m, z + model.wall_m)
    else:
        x, y, z = np.array(model.size_m) * scale
        size = (x, y, z)
    return replace(model, size_m=(float(size[0]), float(size[1]), float(size[2])))


def parts_of(model: ObjectModel, deviation: ObjectDeviation | None = None) -> list[BoxPart]:
    """The boxes a rigid object collides with, and is seen as."""
    if model.mesh == BASKET:
        return basket_parts(model.inner_m, model.wall_m)
    panels = model.panels()
    if deviation is not None and deviation.rebate_m > 0 and model.shape == "box":
        size, step = np.array(model.size_m), 2 * deviation.rebate_m
        panels = [(np.zeros(3), size - step * (np.arange(3) != axis)) for axis in range(3)]
    if deviation is not None and deviation.lip_m > 0 and model.shape == "open_box":
        panels = [*panels, *_lip(model, deviation.lip_m)]
    straight = np.array([1.0, 0.0, 0.0, 0.0])
    return [BoxPart(centre_m=centre, size_m=size, q_wxyz=straight) for centre, size in panels]


def _lip(
    model: ObjectModel, lip_m: float
) -> list[tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]]:
    x, y, _ = model.inner_m
    z = model.size_m[2] - LIP_HEIGHT_M / 2
    long, wide = np.array([x, lip_m, LIP_HEIGHT_M]), np.array([lip_m, y, LIP_HEIGHT_M])
    return [
        (np.array([0.0, (y - lip_m) / 2, z]), long),
        (np.array([0.0, -(y - lip_m) / 2, z]), long),
        (np.array([(x - lip_m) / 2, 0.0, z]), wide),
        (np.array([-(x - lip_m) / 2, 0.0, z]), wide),
    ]


def draw_deviations(
    ranges: Mapping[str, tuple[float, float]],
    seed: int,
    *,
    cameras: Iterable[str],
    objects: Mapping[str, ObjectModel],
    start_seed: int | None = None,
) -> Deviations:
    """Draw one laboratory; each quantity has a stream of its own, so that none shifts another.

    With a start's seed the objects that are not fixed are others, drawn for that start.
    """

    def draw(key: str, whose: str = "", count: int = 1) -> Any:
        stream = [DEVIATION_STREAM, seed, zlib.crc32(f"{key} {whose}".encode())]
        if start_seed is not None and whose in objects and not objects[whose].fixed:
            stream.append(start_seed)
        low, high = ranges[key]
        return tuple(float(v) for v in np.random.default_rng(stream).uniform(low, high, count))

    def one(key: str, whose: str = "") -> float:
        return float(draw(key, whose)[0])

    num_joints = len(ARM_JOINTS)
    lenses = {}
    for camera_id in cameras:
        cx, cy = draw("principal_point_fraction", camera_id, 2)
        k1, k2 = one("distortion_k1", camera_id), one("distortion_k2", camera_id)
        lenses[camera_id] = (one("focal_scale", camera_id), cx, cy, k1, k2)
    return Deviations(
        objects={key: _draw_object(model, draw) for key, model in objects.items()},
        table_height_m=one("table_height_m"),
        table_tilt_rad=draw("table_tilt_rad", count=2),
        link_length_m={link: one("link_length_m", link) for link in LONGER_LINKS},
        joint_zero_rad=draw("joint_zero_rad", "", num_joints),
        joint_drag_Nm=draw("joint_drag_Nm", "", num_joints),
        joint_backlash_rad=draw("joint_backlash_rad", "", num_joints),
        finger_shift_m=one("finger_shift_m"),
        finger_thickness_m=one("finger_thickness_m"),
        finger_length_m=one("finger_length_m"),
        pad_time_s=one("pad_time_s"),
        lenses=lenses,
    )


def _draw_object(model: ObjectModel, draw: Any) -> ObjectDeviation:
    own = partial(draw, whose=model.id)
    if model.wall_m > 0:
        return ObjectDeviation(
            size_scale=(*own("container_size_scale", count=2), *own("container_height_scale")),
            lip_m=own("container_lip_m")[0],
            shift_m=own("container_shift_m", count=2),
            turn_rad=(*own("container_tilt_rad", count=2), *own("container_yaw_rad")),
        )
    return ObjectDeviation(
        size_scale=own("object_size_scale", count=3),
        rebate_m=own("object_rebate_m")[0],
        centre_of_mass=own("object_centre_of_mass", count=3),
    )
