"""Let physics answer: drive the robot along a path and watch the objects."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from bridge.geometry import se3
from bridge.task.task_file import ObjectModel
from twin.physics.world import World
from twin.replay.config import ReplayConfig
from twin.replay.path import JointPath
from twin.replay.scene import ReplayScene
from twin.robot.collision import RobotHulls

_LIFT_M = 0.0002
"""Objects localised into their support start this far above it instead."""


@dataclass(frozen=True, kw_only=True)
class States:
    """What a replay saw, settling at the end included."""

    stamps_ns: Int[np.ndarray, " num_steps"]
    joints_rad: Float[np.ndarray, "num_steps num_joints"]
    width_m: Float[np.ndarray, " num_steps"]
    Ts_base_object: dict[str, Float[np.ndarray, "num_steps 4 4"]]
    finger_contact: dict[str, Bool[np.ndarray, " num_steps"]]


def simulate(
    path: JointPath, scene: ReplayScene, hulls: RobotHulls, config: ReplayConfig
) -> States:
    """Follow a path with position-controlled motors and free objects.

    Every run of the same inputs gives the same bits: one fresh client, fixed steps.
    """
    rate = config.physics.rate_hz
    stride = rate // config.sample_rate_hz
    moving_steps = int(np.ceil(path.end_ns() * 1e-9 * rate))
    # Whole samples, so that the last one lies at the end of settling.
    total = -(-(moving_steps + round(config.settle_after_s * rate)) // stride) * stride
    times_ns = (np.arange(total + 1) * (1e9 / rate)).round().astype(np.int64)
    targets = path.joints_at(times_ns)
    velocities = np.diff(targets, axis=0) * rate
    widths = path.width_at(times_ns)
    mesh_hulls: dict[str, list[Float[np.ndarray, "num_points 3"]]] = {}
    for hull in hulls.hulls:
        if hull.from_mesh:
            mesh_hulls.setdefault(hull.link, []).append(hull.points_m)
    samples = _Samples(scene)
    with World(hulls.robot.urdf, mesh_hulls, config.physics) as world:
        _furnish(world, scene)
        world.reset_robot(targets[0], float(widths[0]))
        world.command(targets[0], np.zeros(targets.shape[1]), float(widths[0]))
        for _ in range(round(config.settle_before_s * rate)):
            world.step()
        samples.take(world, 0)
        for step in range(total):
            world.command(targets[step + 1], velocities[step], float(widths[step]))
            world.step()
            if (step + 1) % stride == 0:
                samples.take(world, int(times_ns[step + 1]))
    return samples.states()


class _Samples:
    """Collects states while a world runs."""

    def __init__(self, scene: ReplayScene) -> None:
        self._objects = list(scene.movable())
        self._still = scene.containers()
        self._stamps: list[int] = []
        self._joints: list[Float[np.ndarray, " num_joints"]] = []
        self._widths: list[float] = []
        self._poses: dict[str, list[tuple[float, ...]]] = {name: [] for name in self._objects}
        self._touch: dict[str, list[bool]] = {name: [] for name in self._objects}

    def take(self, world: World, t_ns: int) -> None:
        self._stamps.append(t_ns)
        self._joints.append(world.joints_rad())
        self._widths.append(world.width_m())
        for name in self._objects:
            self._poses[name].append(world.object_pose(name))
            self._touch[name].append(world.finger_touches(name))

    def states(self) -> States:
        poses = {}
        for name, items in self._poses.items():
            table = np.array(items)
            poses[name] = se3.transform_from(table[:, 3:], table[:, :3])
        poses |= {
            name: np.repeat(T[None], len(self._stamps), axis=0) for name, T in self._still.items()
        }
        return States(
            stamps_ns=np.array(self._stamps, dtype=np.int64),
            joints_rad=np.stack(self._joints),
            width_m=np.array(self._widths),
            Ts_base_object=poses,
            finger_contact={name: np.array(items) for name, items in self._touch.items()},
        )


def _furnish(world: World, scene: ReplayScene) -> None:
    world.add_table(scene.table_height_m)
    for name, T in scene.containers().items():
        world.add_static(scene.task.objects[name].panels(), T)
    for name, T in scene.movable().items():
        model = scene.task.objects[name]
        world.add_free(
            name, np.array(model.size_m), model.mass_kg, lifted(T, model, scene.table_height_m)
        )


def lifted(
    T_base_object: Float[np.ndarray, "4 4"], model: ObjectModel, table_height_m: float
) -> Float[np.ndarray, "4 4"]:
    """Raise an object whose localised pose reaches into the table until it stands just above."""
    corners = np.stack(np.meshgrid(*([(-0.5, 0.5)] * 3)), axis=-1).reshape(-1, 3) * model.size_m
    lowest = float(se3.apply(T_base_object, corners)[:, 2].min())
    T = T_base_object.copy()
    T[2, 3] += max(0.0, table_height_m + _LIFT_M - lowest)
    return T
