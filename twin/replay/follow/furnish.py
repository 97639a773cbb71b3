"""Put a replay's objects into a physics world: boxes, containers of panels, soft bodies."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from bridge.geometry.box import box_corners
from bridge.task.task_file import ObjectModel
from twin.physics.soft import SoftModel
from twin.physics.world import World
from twin.replay.place.scene import ReplayScene

LIFT_M = 0.0002
"""Objects localised into their support start this far above it instead."""


def soft_models(scene: ReplayScene) -> dict[str, SoftModel]:
    """The soft objects that were localised: the scene's lattice where it has one, else the task's.

    Their extents at rest are those of the task file either way, so that the same shape predicate
    judges both.
    """
    models = {}
    for name in scene.movable():
        model = scene.task.objects[name]
        if model.soft is not None:
            arrays = scene.lattices.get(name)
            models[name] = (
                SoftModel.from_task(model)
                if arrays is None
                else SoftModel.from_lattice(arrays, model)
            )
    return models


def furnish(world: World, scene: ReplayScene, soft: Mapping[str, SoftModel]) -> None:
    """Put table, containers and objects where the scene says.

    Args:
        world: An empty one.
        scene: Where they are.
        soft: The bodies of ``soft_models``.
    """
    world.add_table(scene.table_height_m)
    for name, T in scene.containers().items():
        world.add_static(scene.task.objects[name].panels(), T)
    for name, T in scene.movable().items():
        model = scene.task.objects[name]
        T_free = lifted(T, outline_m(model, soft.get(name)), scene.table_height_m)
        if name in soft:
            world.add_soft(name, soft[name], T_free)
        else:
            world.add_free(name, np.array(model.size_m), model.mass_kg, T_free)


def outline_m(model: ObjectModel, soft: SoftModel | None) -> Float[np.ndarray, "num_points 3"]:
    """Points whose convex hull holds the object, in its own frame [m]."""
    if soft is not None:
        return np.asarray(soft.nodes_m, dtype=np.float64)
    return box_corners(np.array(model.size_m))


def lifted(
    T_base_object: Float[np.ndarray, "4 4"],
    points_m: Float[np.ndarray, "num_points 3"],
    table_height_m: float,
) -> Float[np.ndarray, "4 4"]:
    """Raise an object whose localised pose reaches into the table until it stands just above."""
    lowest = float(se3.apply(T_base_object, points_m)[:, 2].min())
    T = T_base_object.copy()
    T[2, 3] += max(0.0, table_height_m + LIFT_M - lowest)
    return T
