"""The surface of a known shape, and how it may be turned."""

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from bridge.geometry import se3
from bridge.geometry.mesh import box_corners
from bridge.task.meshes.catalogue import object_mesh
from bridge.task.task_file import SCANNED, ObjectModel


def pose_of(state: Float[np.ndarray, "4"]) -> Float[np.ndarray, "4 4"]:
    """Turn (x, y, z, yaw) into ``T_base_object``."""
    T = np.eye(4)
    c, s = np.cos(state[3]), np.sin(state[3])
    T[:2, :2] = [[c, -s], [s, c]]
    T[:3, 3] = state[:3]
    return T


def yaw_period_rad(model: ObjectModel) -> float:
    """Turn after which the footprint looks the same: a quarter with equal sides, else a half.

    A scanned object may have any shape, so only a whole turn.
    """
    if model.shape == SCANNED:
        return 2 * np.pi
    return np.pi / 2 if np.isclose(model.size_m[0], model.size_m[1]) else np.pi


def turned_alike(
    T_base_object: Float[np.ndarray, "4 4"],
    T_base_expected: Float[np.ndarray, "4 4"],
    model: ObjectModel,
) -> Float[np.ndarray, "4 4"]:
    """Of the poses in which an object looks the same, the one turned nearest to another.

    A solid box may also stand on any of its other sides.
    """
    count = round(2 * np.pi / yaw_period_rad(model))
    turns = Rotation.create_group(f"C{count}").as_matrix()
    if model.shape == "box":
        cube = Rotation.create_group("O").as_matrix()
        turns = cube[np.isclose(np.abs(cube) @ model.size_m, model.size_m).all(axis=1)]
    best = min(
        (T_base_object[:3, :3] @ turn for turn in turns),
        key=lambda R: float(se3.rotation_angle_rad(R.T @ T_base_expected[:3, :3])),
    )
    return se3.from_rotation(best, T_base_object[:3, 3])


def rectangle_yaw_rad(xy: Float[np.ndarray, "num_points 2"], kept_percent: float = 98.0) -> float:
    """Direction of a side of the smallest enclosing rectangle, in [-45, 45) degrees.

    The smallest rectangle has a side along an edge of the hull (Freeman and Shapira 1975). Where
    the outermost points are noisy, the few per cent farthest out are left out first. Points on
    one line have the direction 0.
    """
    distance = np.linalg.norm(xy - np.median(xy, axis=0), axis=1)
    core = xy[distance <= np.percentile(distance, kept_percent)]
    try:
        hull = core[ConvexHull(core).vertices]
    except QhullError:
        return 0.0
    step = np.roll(hull, -1, axis=0) - hull
    angles = np.unique(np.round(np.mod(np.arctan2(step[:, 1], step[:, 0]), np.pi / 2), 4))
    c, s = np.cos(angles)[:, None], np.sin(angles)[:, None]
    u = c * hull[:, 0] + s * hull[:, 1]
    v = -s * hull[:, 0] + c * hull[:, 1]
    best = float(angles[int(np.argmin(np.ptp(u, axis=1) * np.ptp(v, axis=1)))])
    return float(np.mod(best + np.pi / 4, np.pi / 2) - np.pi / 4)


def surface_distances(
    points: Float[np.ndarray, "num_points 3"],
    model: ObjectModel,
    T_base_object: Float[np.ndarray, "4 4"],
) -> tuple[Float[np.ndarray, " num_points"], Float[np.ndarray, "num_points 3"]]:
    """Distance to the object's panels, negative inside one, and its gradient in the base frame.

    Outside, the distance to a union is the smallest of the parts'; inside a panel the walls it
    shares with a neighbour count too, which matters only for points deep in the material.
    """
    p = se3.apply(se3.invert(T_base_object), points)
    rows = np.arange(len(p))
    distances, gradients = [], []
    for centre, extents in model.panels():
        q = p - centre
        excess = np.abs(q) - extents / 2
        outside = np.maximum(excess, 0.0)
        length = np.linalg.norm(outside, axis=1)
        is_out = length > 1e-9
        deepest = excess.argmax(axis=1)
        inward = np.zeros_like(q)
        inward[rows, deepest] = 1.0
        away = np.where(is_out[:, None], outside / np.maximum(length, 1e-9)[:, None], inward)
        distances.append(np.where(is_out, length, excess[rows, deepest]))
        gradients.append(away * np.where(q < 0, -1.0, 1.0))
    nearest = np.argmin(distances, axis=0)
    gradient = np.stack(gradients)[nearest, rows] @ T_base_object[:3, :3].T
    return np.stack(distances)[nearest, rows], gradient


def outside_m(
    points: Float[np.ndarray, "num_points 3"],
    model: ObjectModel,
    T_base_object: Float[np.ndarray, "4 4"],
) -> Float[np.ndarray, " num_points"]:
    """Signed distance to a rigid object's known shape, mesh or panels; of a soft one to its box."""
    if model.mesh is None or model.soft is not None:
        return surface_distances(points, model, T_base_object)[0]
    return object_mesh(model).solid(se3.apply(se3.invert(T_base_object), points))


def shape_mesh(
    model: ObjectModel,
) -> tuple[Float[np.ndarray, "num_vertices 3"], Int[np.ndarray, "num_faces 3"]]:
    """Triangles of the known shape in the object frame [m]: its mesh, or a box per panel."""
    if model.mesh is not None:
        known = object_mesh(model)
        return known.vertices_m, known.triangles
    vertices, faces = [], []
    # Counter-clockwise seen from outside.
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    triangles = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    for index, (centre, extents) in enumerate(model.panels()):
        vertices.append(centre + box_corners(extents))
        faces.append(triangles + 8 * index)
    return np.concatenate(vertices), np.concatenate(faces)
