"""Convex pieces with what holds them, and the names bodies have in contacts and failures."""

from dataclasses import dataclass

import coal
import numpy as np
from jaxtyping import Float

from bridge.geometry.box import box_corners
from bridge.task.robot import GRIPPER_LINKS
from bridge.task.task_file import ObjectModel
from twin.robot.hulls import convex_hull

TABLE = "table"
GRIPPER = "gripper"
SCENE = "scene"
"""What stands still and has no name of its own."""

_FAR_M = 1e3


@dataclass(frozen=True)
class Solid:
    """One convex piece with a box and a sphere that hold it, to skip pairs that are far apart."""

    body: str
    shape: coal.CollisionGeometry
    centre: Float[np.ndarray, "3"]
    """Of both, in the piece's frame."""
    radius_m: float
    half_m: Float[np.ndarray, "3"]
    """Half the extents of the box, along the axes of the piece's frame."""


def solid_of(
    body: str, shape: coal.CollisionGeometry, points_m: Float[np.ndarray, "num_points 3"]
) -> Solid:
    """Put a box and a sphere around a piece."""
    low, high = points_m.min(axis=0), points_m.max(axis=0)
    centre = (low + high) / 2
    radius = float(np.linalg.norm(points_m - centre, axis=1).max())
    return Solid(body, shape, centre, radius, (high - low) / 2)


def box_solid(body: str, size_m: Float[np.ndarray, "3"]) -> Solid:
    """A box around the origin."""
    corners = box_corners(size_m)
    return solid_of(body, convex_hull(corners), corners)


def half_space_solid(body: str) -> Solid:
    """Everything below its frame; the box is as large as any cell and far beyond."""
    half = np.full(3, _FAR_M)
    shape = coal.Halfspace(np.array([0.0, 0.0, 1.0]), 0.0)
    return Solid(body, shape, np.array([0.0, 0.0, -_FAR_M]), float("inf"), half)


def group_of(body: str) -> str:
    """The name stages allow contacts by."""
    return GRIPPER if body in GRIPPER_LINKS else body


def placement_of(T: Float[np.ndarray, "4 4"]) -> coal.Transform3s:
    """The same pose, as coal wants it."""
    return coal.Transform3s(T[:3, :3], T[:3, 3])


def placed_panels(
    model: ObjectModel, T_base_object: Float[np.ndarray, "4 4"]
) -> list[tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "3"]]]:
    """The boxes an object is made of: pose of each box's centre, and its extents [m]."""
    placed = []
    for centre, extents in model.panels():
        T_object_panel = np.eye(4)
        T_object_panel[:3, 3] = centre
        placed.append((T_base_object @ T_object_panel, extents))
    return placed
