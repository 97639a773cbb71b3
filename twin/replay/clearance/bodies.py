"""Convex pieces with what holds them, and the names bodies have in contacts and failures."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import coal
import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull

from bridge.geometry import se3
from bridge.geometry.mesh import box_corners
from bridge.robots.robot import Gripper
from bridge.task.meshes.toys import basket_parts, basket_rim_parts
from bridge.task.task_file import BASKET, ObjectModel
from twin.replay._clearance import Bounds, surface_to_boxes
from twin.robot.collision import RobotHulls, convex_hull

TABLE = "table"
PanelBox = tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "3"]]
"""Pose ``T_base_box`` of the middle, and extents of a box [m]."""
GRIPPER = "gripper"
"""What task files call the links of any robot's gripper."""
SCENE = "scene"
"""What stands still and has no name of its own."""

_FAR_M = 1e3
_SKIN_M = 0.001
"""A basket's surface is rounded where its boxes meet, and stands out of them by so much."""


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
    corners_m: Float[np.ndarray, "num_points 3"]
    """Points whose hull holds the shape; none where it has no end."""


def solid_of(
    body: str, shape: coal.CollisionGeometry, points_m: Float[np.ndarray, "num_points 3"]
) -> Solid:
    """Put box and sphere around a shape in its body's frame, which the points' hull holds there."""
    low, high = points_m.min(axis=0), points_m.max(axis=0)
    centre = (low + high) / 2
    radius = float(np.linalg.norm(points_m - centre, axis=1).max())
    return Solid(body, shape, centre, radius, (high - low) / 2, points_m)


def box_solid(body: str, size_m: Float[np.ndarray, "3"]) -> Solid:
    """A box around the origin."""
    corners = box_corners(size_m)
    return solid_of(body, convex_hull(corners), corners)


def half_space_solid(body: str) -> Solid:
    """Everything below its frame; the box is as large as any cell and far beyond."""
    half = np.full(3, _FAR_M)
    shape = coal.Halfspace(np.array([0.0, 0.0, 1.0]), 0.0)
    return Solid(body, shape, np.array([0.0, 0.0, -_FAR_M]), float("inf"), half, np.empty((0, 3)))


def names_of(body: str, gripper: Gripper) -> tuple[str, ...]:
    """The names stages allow contacts by: a body's own, and its group's."""
    return (GRIPPER, gripper.name, body) if body in gripper.links else (body,)


def placement_of(T: Float[np.ndarray, "4 4"]) -> coal.Transform3s:
    """The same pose, as coal wants it."""
    return coal.Transform3s(T[:3, :3], T[:3, 3])


def placed_panels(model: ObjectModel, T_base_object: Float[np.ndarray, "4 4"]) -> list[PanelBox]:
    """An object's boxes (walls, a basket's corners, rim, handles): pose of centre, extents [m]."""
    if model.mesh == BASKET:
        shape = model.inner_m, model.wall_m
        return [
            (
                T_base_object @ se3.transform_from(part.q_wxyz, part.centre_m),
                part.size_m + 2 * _SKIN_M,
            )
            for part in basket_parts(*shape) + basket_rim_parts(*shape)
        ]
    placed = []
    for centre, extents in model.panels():
        T_object_panel = np.eye(4)
        T_object_panel[:3, 3] = centre
        placed.append((T_base_object @ T_object_panel, extents))
    return placed


# Pairs of convex bodies with a lower bound of their distance, nearest first.
# A body is at least as far away as the box and the sphere that hold it. Where boxes are turned
# against each other this is nearly exact, so most pairs need no distance (tests/parity compares).
# Where only near pairs are asked for, a plane between the hulls leaves out most of the others.

_SLACK_M = 1e-6
"""Measured distances are exact to this much: bounds stay below them."""


class NearPairs:
    """Some pairs of bodies; where each body is, is written into ``R`` and ``t``."""

    def __init__(self, solids: Sequence[Solid], pairs: Sequence[tuple[int, int]]) -> None:
        """Lay boxes and spheres out."""
        self.R: Float[np.ndarray, "num_bodies 3 3"] = np.tile(np.eye(3), (len(solids), 1, 1))
        """Rotations ``R_base_body``."""
        self.t: Float[np.ndarray, "num_bodies 3"] = np.zeros((len(solids), 3))
        """Positions of the bodies' frames [m]."""
        self._bounds = np.empty(len(pairs))
        self._order = np.empty(len(pairs), dtype=np.int32)
        corners = [np.asarray(solid.corners_m, dtype=np.float64) for solid in solids]
        ends = np.cumsum([0, *map(len, corners)])
        self._native = Bounds(
            np.array([solid.centre for solid in solids], dtype=np.float64).reshape(-1, 3),
            np.array([solid.half_m for solid in solids], dtype=np.float64).reshape(-1, 3),
            np.array([solid.radius_m for solid in solids], dtype=np.float64),
            np.concatenate([np.empty((0, 3)), *corners]),
            np.column_stack([ends[:-1], ends[1:]]).astype(np.int32),
            np.array(pairs, dtype=np.int32).reshape(-1, 2),
        )

    def nearest_first(self, up_to_m: float = np.inf) -> Iterator[tuple[float, int]]:
        """Yield a lower bound of the distance [m], and the pair; none that is surely farther."""
        count = self._native.nearest_first(
            self.R, self.t, self._bounds, self._order, up_to_m + _SLACK_M
        )
        if not count:  # most often, where only what touches is asked for
            return iter(())
        bounds = self._bounds[:count] - _SLACK_M
        return zip(bounds.tolist(), self._order[:count].tolist(), strict=True)


@lru_cache(maxsize=4)
def own_links_touch(hulls: RobotHulls) -> Callable[[], bool]:
    """Say whether links of the robot touch where its hulls have been placed; made once."""
    solids = [solid_of(hull.link, hull.shape, hull.points_m) for hull in hulls.hulls]
    near = NearPairs(solids, hulls.pairs)
    # The same memory: the pairs are where the hulls have been placed last.
    near.R, near.t = hulls.rotations, hulls.translations
    return lambda: any(
        hulls.distance_m(*hulls.pairs[index]) <= 0 for _, index in near.nearest_first(0.0)
    )


# Distances of soft bodies, which are given by their nodes.
# A node inside a convex piece lies behind all of its planes; outside, the largest height over a
# plane is a lower bound of the distance, exact over the faces. Between nodes nothing is known: a
# body is as large as its nodes say.


Planes = Float[np.ndarray, "num_planes 4"]
"""The faces of a convex piece in the frame of its link: outward normals of unit length, offsets."""


def distance_to_planes_m(
    planes: Planes,
    points_m: Float[np.ndarray, "num_points 3"],  # base frame
    R: Float[np.ndarray, "3 3"],  # of the piece's link in the base frame
    t: Float[np.ndarray, "3"],  # that link's origin, base frame [m]
) -> float:
    """Smallest signed distance of points to the placed piece [m], never too large outside."""
    local = (points_m - t) @ R
    return float((local @ planes[:, :3].T + planes[:, 3]).max(axis=1).min())


@lru_cache(maxsize=4)
def planes_of(hulls: RobotHulls) -> tuple[Planes, ...]:
    """Return the planes of each of a robot's hulls."""
    faces = (ConvexHull(hull.points_m).equations.round(9) for hull in hulls.hulls)
    return tuple(np.unique(each, axis=0) for each in faces)


def distances_to_boxes_m(
    points_m: Float[np.ndarray, "num_points 3"],  # base frame
    boxes: Sequence[PanelBox],
) -> Float[np.ndarray, " num_boxes"]:
    """Smallest signed distance of points to each box [m]."""
    Ts = np.array([T for T, _ in boxes]).reshape(-1, 4, 4)
    halves_m = np.array([extents / 2 for _, extents in boxes]).reshape(-1, 3)
    where = np.ascontiguousarray(Ts[:, :3, :3]), np.ascontiguousarray(Ts[:, :3, 3]), halves_m
    here = np.eye(3)[None], np.zeros((1, 3)), np.ascontiguousarray(points_m)
    answers = np.empty((1, len(boxes)))
    surface_to_boxes(*where, *here, answers)
    return np.asarray(answers[0])
