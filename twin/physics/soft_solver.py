"""How soft bodies, and the convex pieces they touch, are handed to the native solver."""

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Float, Int32
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from bridge.geometry import se3
from bridge.geometry.mesh import box_corners
from twin.physics._soft import SoftSolver as SoftSolver
from twin.physics.arm import Hulls
from twin.physics.soft import SoftModel

_NORMAL_DIGITS = 2
"""Faces of a hull whose normals agree so far become one; the piece grows by a hundredth at most."""
_SIDES = 12


@dataclass(frozen=True, kw_only=True)
class ConvexPiece:
    """Everything behind all of some planes."""

    planes: Float[np.ndarray, "num_planes 4"]
    """Outward normal of length 1, and the plane's distance from the origin along it [m]."""
    corners_m: Float[np.ndarray, "num_corners 3"]
    """Of the piece, or of something around it."""


def hull_piece(points_m: Float[np.ndarray, "num_points 3"]) -> ConvexPiece:
    """Return a few planes around the convex hull of points; each touches the hull."""
    hull = ConvexHull(points_m)
    normals = np.unique(np.round(hull.equations[:, :3], _NORMAL_DIGITS), axis=0)
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    offsets = (normals @ points_m[hull.vertices].T).max(axis=1)
    low, high = points_m.min(axis=0), points_m.max(axis=0)
    corners = np.array(list(product(*zip(low, high, strict=True))))
    return ConvexPiece(planes=np.column_stack([normals, offsets]), corners_m=corners)


def box_piece(size_m: Float[np.ndarray, "3"], T_owner_box: Float[np.ndarray, "4 4"]) -> ConvexPiece:
    """Return a box of these extents, in its owner's frame."""
    normals = np.concatenate([np.eye(3), -np.eye(3)]) @ T_owner_box[:3, :3].T
    offsets = np.tile(np.asarray(size_m) / 2, 2) + normals @ T_owner_box[:3, 3]
    return ConvexPiece(
        planes=np.column_stack([normals, offsets]),
        corners_m=se3.apply(T_owner_box, box_corners(size_m)),
    )


def link_pieces(urdf: str, mesh_hulls_m: Hulls) -> dict[str, list[ConvexPiece]]:
    """Return the pieces of each link that has any, in the link's frame."""
    found = {}
    for link in ET.fromstring(urdf).findall("link"):
        name = link.get("name", "")
        pieces = [hull_piece(points) for points in mesh_hulls_m.get(name, ())]
        for collision in link.findall("collision"):
            piece = _primitive(collision)
            if piece is not None:
                pieces.append(piece)
        if pieces:
            found[name] = pieces
    return found


def _primitive(collision: ET.Element) -> ConvexPiece | None:
    T = _origin(collision.find("origin"))
    box, cylinder = collision.find("geometry/box"), collision.find("geometry/cylinder")
    if box is not None:
        return box_piece(_numbers(box.get("size", "0 0 0")), T)
    if cylinder is None:
        return None
    angle = np.arange(_SIDES) * 2 * np.pi / _SIDES
    radius = float(cylinder.get("radius", "0")) / np.cos(np.pi / _SIDES)
    half = float(cylinder.get("length", "0")) / 2
    ring = np.stack([np.cos(angle) * radius, np.sin(angle) * radius], axis=1)
    ends = [np.column_stack([ring, np.full(_SIDES, side * half)]) for side in (-1, 1)]
    return hull_piece(se3.apply(T, np.concatenate(ends)))


def _origin(element: ET.Element | None) -> Float[np.ndarray, "4 4"]:
    if element is None:
        return np.eye(4)
    turns = Rotation.from_euler("xyz", _numbers(element.get("rpy", "0 0 0")))
    return se3.from_rotation(turns.as_matrix(), _numbers(element.get("xyz", "0 0 0")))


def _numbers(text: str) -> Float[np.ndarray, "3"]:
    return np.array([float(word) for word in text.split()])


LEAST_MASS = 0.4
"""Nodes get at least this share of the mean node's mass: a light corner would be the stiffest."""

CRITICAL = 2.0
"""The slowest deformation is damped at most critically: at twice its frequency. The viscosity of
single tetrahedra reaches only short waves: one visit in each substep is too few for long ones."""


def add_body(
    solver: SoftSolver,
    model: SoftModel,
    T_base_object: Float[np.ndarray, "4 4"],
    *,
    friction: float,
) -> tuple[int, Float[np.ndarray, " num_nodes"]]:
    """Hand a body at rest to a solver; its number there, and the masses of its nodes [kg]."""
    rest, surface = model.nodes_m.astype(np.float64), model.surface()
    masses, omega = _node_masses(model), model.slowest_mode_rad_s()
    index = solver.add_body(
        se3.apply(T_base_object, rest),
        rest,
        np.ascontiguousarray(model.tets),
        masses,
        surface_samples(surface),
        np.ascontiguousarray(surface),
        model.young_pa,
        model.poisson,
        model.damping_s,
        min(model.damping_s * omega**2, CRITICAL * omega),
        friction,
        model.spacing_m,
    )
    return int(index), masses


def _node_masses(model: SoftModel) -> Float[np.ndarray, " num_nodes"]:
    share = model.mass_fraction.astype(np.float64)
    share = np.maximum(share / share.sum(), LEAST_MASS / len(share))
    return np.asarray(model.mass_kg * share / share.sum())


def surface_samples(
    triangles: Int32[np.ndarray, "num_triangles 3"],
) -> Int32[np.ndarray, "num_samples 2"]:
    """Where contact is looked for: surface nodes, and middles of surface edges."""
    nodes = np.unique(triangles)
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    edges = np.unique(np.sort(edges, axis=1), axis=0)
    return np.ascontiguousarray(
        np.concatenate([np.stack([nodes, nodes], axis=1), edges]), dtype=np.int32
    )
