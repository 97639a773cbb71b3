"""Convex hulls of the robot's links, the one shape that pinocchio, coal and PyBullet all share.

TRAP (measured, design page on physics): ``BVHModel.buildConvexRepresentation`` reuses the concave
triangles of the mesh; distances then come out up to 95 mm too large, which is the unsafe side.
``ConvexBase.convexHull`` computes a true hull; a test pins hull distance <= mesh distance.
"""

from dataclasses import dataclass
from itertools import product

import coal
import numpy as np
import pinocchio as pin
from jaxtyping import Float

from twin.robot.description import RobotDescriptionError
from twin.robot.model import RobotModel

_CYLINDER_SIDES = 24
_THINNEST_M = 1e-7


@dataclass(frozen=True, kw_only=True)
class LinkHull:
    """One convex piece of a link, its points in the link's frame."""

    link: str
    points_m: Float[np.ndarray, "num_points 3"]
    shape: coal.ConvexBase
    from_mesh: bool
    """False where the description has a box or a cylinder."""


def convex_hull(points_m: Float[np.ndarray, "num_points 3"]) -> coal.ConvexBase:
    """Return the true convex hull of points, as coal wants it."""
    stored = coal.StdVec_Vec3s()
    for point in points_m:
        stored.append(np.asarray(point, dtype=np.float64))
    return coal.ConvexBase.convexHull(stored, False, "Qt")


def collision_geometry(robot: RobotModel) -> pin.GeometryModel:
    """Read the collision shapes of a description.

    Raises:
        RobotDescriptionError: When a mesh cannot be read.
    """
    try:
        return pin.buildGeomFromUrdfString(robot.model, robot.urdf, pin.GeometryType.COLLISION)
    except (ValueError, RuntimeError) as error:
        raise RobotDescriptionError(
            found=f"has collision shapes that cannot be read ({str(error)[:200]})",
            hint="Check its mesh files.",
        ) from error


def link_hulls(robot: RobotModel) -> list[LinkHull]:
    """Return one hull for each collision element of the description.

    Raises:
        RobotDescriptionError: When a mesh cannot be read, or a shape is of an unknown kind or has
            no volume.
    """
    geometry = collision_geometry(robot)
    hulls = []
    for item in geometry.geometryObjects:
        frame = robot.model.frames[item.parentFrame]
        T_link_shape = frame.placement.inverse() * item.placement
        points = _points(item) @ T_link_shape.rotation.T + T_link_shape.translation
        if not _has_volume(points):
            raise RobotDescriptionError(
                found=f"has a collision shape without volume at {item.name}",
                hint="Give it three extents above zero, or leave it out.",
            )
        shape = convex_hull(points)
        corners = np.array(shape.points())
        from_mesh = isinstance(item.geometry, coal.BVHModelBase)
        hulls.append(LinkHull(link=frame.name, points_m=corners, shape=shape, from_mesh=from_mesh))
    return hulls


def _has_volume(points_m: Float[np.ndarray, "num_points 3"]) -> bool:
    """Whether points span a body; of others coal ends the process."""
    if len(points_m) < 4 or not np.isfinite(points_m).all():
        return False
    spread = np.linalg.svd(points_m - points_m.mean(axis=0), compute_uv=False)
    return bool(spread[2] > _THINNEST_M)


def _points(item: pin.GeometryObject) -> Float[np.ndarray, "num_points 3"]:
    shape = item.geometry
    if isinstance(shape, coal.BVHModelBase):
        return np.array(shape.vertices())
    if isinstance(shape, coal.ConvexBase):
        return np.array(shape.points())
    if isinstance(shape, coal.Box):
        corners: Float[np.ndarray, "8 3"] = np.array(list(product((-1.0, 1.0), repeat=3)))
        corners *= np.array(shape.halfSide)
        return corners
    if isinstance(shape, coal.Cylinder):
        angle = np.arange(_CYLINDER_SIDES) * 2 * np.pi / _CYLINDER_SIDES
        # Corners on the circumscribed circle: the prism contains the cylinder (safe side).
        radius = shape.radius / np.cos(np.pi / _CYLINDER_SIDES)
        ring = np.stack([np.cos(angle) * radius, np.sin(angle) * radius], axis=1)
        ends = [np.column_stack([ring, np.full(len(ring), s)]) for s in (-1, 1)]
        prism: Float[np.ndarray, "num_points 3"] = np.concatenate(ends)
        prism[:, 2] *= float(shape.halfLength)
        return prism
    raise RobotDescriptionError(
        found=f"has a collision shape {type(shape).__name__} at {item.name}",
        hint="Known: mesh, box, cylinder.",
    )
