"""The robot's visible surface, link by link, posed by forward kinematics.

Made of the description's collision shapes: every URDF has them, they are light, and unlike most
visual meshes they load without a reader of COLLADA files. Normals are those of the triangles.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import coal
import numpy as np
import pinocchio as pin
from jaxtyping import Float, Float32, Int, Int64

from bridge.geometry import se3
from bridge.geometry.mesh import sample_triangles
from twin.robot.collision import collision_geometry, convex_hull, corners_of
from twin.robot.model import RobotDescriptionError, RobotModel
from twin.robot.posture import Posture

NOT_SEEN = ("ee_link",)
"""Markers inside other links, not parts of the robot."""


@dataclass(frozen=True, kw_only=True)
class LinkSurface:
    """Triangles of one shape of a link, in the link's frame."""

    link: str
    vertices_m: Float[np.ndarray, "num_vertices 3"]
    triangles: Int[np.ndarray, "num_triangles 3"]


@dataclass(frozen=True, kw_only=True)
class Nearest:
    """For each asked point the nearest one of the surface."""

    p_m: Float[np.ndarray, "num_points 3"]
    normals: Float[np.ndarray, "num_points 3"]
    """Unit length; outward where the description's triangles are."""
    distance_m: Float[np.ndarray, " num_points"]
    link_ids: Int64[np.ndarray, " num_points"]


def link_poses(robot: RobotModel, posture: Posture) -> dict[str, Float[np.ndarray, "4 4"]]:
    """Pose ``T_base_link`` of every frame of the description."""
    q = robot.configuration(posture.joints_rad, posture.width_m)
    pin.framesForwardKinematics(robot.model, robot.data, q)
    return {
        frame.name: np.array(robot.data.oMf[index].homogeneous)
        for index, frame in enumerate(robot.model.frames)
    }


@lru_cache(maxsize=4)
def link_surfaces(robot: RobotModel) -> tuple[LinkSurface, ...]:
    """Read the surface of every link once."""
    geometry = collision_geometry(robot.model, robot.urdf)
    surfaces = []
    for item in geometry.geometryObjects:
        frame = robot.model.frames[item.parentFrame]
        if frame.name in NOT_SEEN:
            continue
        T = frame.placement.inverse() * item.placement
        vertices, triangles = _mesh(item)
        surfaces.append(
            LinkSurface(
                link=frame.name,
                vertices_m=vertices @ T.rotation.T + T.translation,
                triangles=triangles,
            )
        )
    if not surfaces:
        raise RobotDescriptionError(
            "has no collision shapes", "Without them nobody can say how it looks."
        )
    return tuple(surfaces)


class PosedSurface:
    """The surface of the whole robot in one posture, in the base frame; answers by ray casting."""

    def __init__(self, robot: RobotModel, posture: Posture) -> None:
        """Pose all links."""
        poses = link_poses(robot, posture)
        surfaces = link_surfaces(robot)
        self.links: tuple[str, ...] = tuple(item.link for item in surfaces)
        meshes = [(se3.apply(poses[s.link], s.vertices_m), s.triangles) for s in surfaces]
        self._scene = ray_scene(meshes)
        self._boxes = [(vertices.min(axis=0), vertices.max(axis=0)) for vertices, _ in meshes]

    def near_box(
        self, p_base: Float[np.ndarray, "num_points 3"], margin_m: float
    ) -> Int64[np.ndarray, " num_near"]:
        """Which points lie in the bounding box of a shape grown by a margin; others are far."""
        lows, highs = (np.array(ends) for ends in zip(*self._boxes, strict=True))
        around = (p_base > lows.min(axis=0) - margin_m) & (p_base < highs.max(axis=0) + margin_m)
        candidates = np.flatnonzero(around.all(axis=1))
        p, near = p_base[candidates], np.zeros(len(candidates), dtype=bool)
        for low, high in zip(lows, highs, strict=True):
            near |= ((p > low - margin_m) & (p < high + margin_m)).all(axis=1)
        return candidates[near]

    def nearest(self, p_base: Float[np.ndarray, "num_points 3"]) -> Nearest:
        """Find the nearest surface points."""
        if not len(p_base):
            none = np.zeros((0, 3))
            ids = np.zeros(0, dtype=np.int64)
            return Nearest(p_m=none, normals=none, distance_m=np.zeros(0), link_ids=ids)
        found = self._scene.compute_closest_points(tensor(p_base.astype(np.float32)))
        p = found["points"].numpy().astype(np.float64)
        normals = found["primitive_normals"].numpy().astype(np.float64)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        return Nearest(
            p_m=p,
            normals=normals,
            distance_m=np.linalg.norm(p_base - p, axis=1),
            link_ids=found["geometry_ids"].numpy().astype(np.int64),
        )

    def depth_along(
        self, rays_camera: Float[np.ndarray, "*shape 3"], T_base_camera: Float[np.ndarray, "4 4"]
    ) -> Float32[np.ndarray, "*shape"]:
        """Depth at which rays with z = 1 in the camera meet the robot; infinite where they miss."""
        turned = rays_camera @ T_base_camera[:3, :3].T
        origin = np.broadcast_to(T_base_camera[:3, 3], turned.shape)
        rays = np.concatenate([origin, turned], axis=-1).astype(np.float32)
        return np.asarray(self._scene.cast_rays(tensor(rays))["t_hit"].numpy())


def sample_surface(
    robot: RobotModel, posture: Posture, count: int, seed: int
) -> Float[np.ndarray, "num_points 3"]:
    """Points of the posed robot, evenly over its area, in the base frame [m]."""
    poses = link_poses(robot, posture)
    corners = np.concatenate(
        [
            (item.vertices_m @ poses[item.link][:3, :3].T + poses[item.link][:3, 3])[item.triangles]
            for item in link_surfaces(robot)
        ]
    )
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    chosen, u, v = sample_triangles(area, count, np.random.default_rng(seed))
    return np.asarray(a[chosen] + u * (b - a)[chosen] + v * (c - a)[chosen])


def _mesh(item: pin.GeometryObject) -> tuple[np.ndarray, np.ndarray]:
    """Corners and triangles of a shape as pinocchio read it; of what is round, those around it."""
    shape = item.geometry
    if isinstance(shape, coal.BVHModelBase):
        corners, three = shape.vertices(), map(shape.tri_indices, range(shape.num_tris))
    else:
        shape = convex_hull(corners_of(item))
        corners, three = shape.points(), map(shape.polygons, range(shape.num_polygons))
    return np.array(corners), np.array([[face[0], face[1], face[2]] for face in three])


def ray_scene(meshes: Iterable[tuple[np.ndarray, np.ndarray]]) -> Any:
    """Open3D's scene of triangles, each mesh a geometry of its own: for rays and distances."""
    import open3d  # noqa: PLC0415  # loads 300 modules; pages that only read need none

    make: Any = open3d.t.geometry.RaycastingScene  # its stubs leave out the defaults
    scene = make()
    for vertices_m, triangles in meshes:
        scene.add_triangles(
            tensor(vertices_m.astype(np.float32)), tensor(triangles.astype(np.uint32))
        )
    return scene


def tensor(array: np.ndarray) -> Any:
    """An array as Open3D takes it."""
    import open3d  # noqa: PLC0415  # loads 300 modules; pages that only read need none

    make: Any = open3d.core.Tensor  # its stubs leave out that an array alone is enough
    return make(np.ascontiguousarray(array))
