"""The robot description as PyBullet should load it.

PyBullet gives links without ``<inertial>`` a mass of 1 kg, massless frames included, and makes its
own hulls of meshes; both are settled here so that it simulates the robot that was described.
"""

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull

_TINY_MASS_KG = 1e-3
_TINY_INERTIA_KG_M2 = 1e-6

Hulls = Mapping[str, Sequence[Float[np.ndarray, "num_points 3"]]]


def write_description(urdf: str, mesh_hulls_m: Hulls, folder: Path) -> Path:
    """Write ``robot.urdf`` and its hull meshes into a folder.

    Args:
        urdf: Description without package URIs.
        mesh_hulls_m: Per link, the hulls that stand for its mesh collision elements, in the
            link's frame [m].
        folder: Where the files go.

    Returns:
        The path of the URDF file.
    """
    root = ET.fromstring(urdf)
    for number, link in enumerate(root.findall("link")):
        for visual in link.findall("visual"):
            link.remove(visual)
        if link.find("inertial") is None:
            link.append(_tiny_inertial())
        hulls = mesh_hulls_m.get(link.get("name", ""), ())
        if hulls:  # by number: a name may hold a slash
            _replace_meshes(link, hulls, folder, f"link_{number}")
    path = folder / "robot.urdf"
    path.write_text(ET.tostring(root, encoding="unicode"))
    return path


def _tiny_inertial() -> ET.Element:
    inertial = ET.Element("inertial")
    ET.SubElement(inertial, "mass", value=str(_TINY_MASS_KG))
    inertia = ET.SubElement(inertial, "inertia", ixy="0", ixz="0", iyz="0")
    for axis in ("ixx", "iyy", "izz"):
        inertia.set(axis, str(_TINY_INERTIA_KG_M2))
    return inertial


def _replace_meshes(
    link: ET.Element,
    hulls: Sequence[Float[np.ndarray, "num_points 3"]],
    folder: Path,
    stem: str,
) -> None:
    for collision in link.findall("collision"):
        if collision.find("geometry/mesh") is not None:
            link.remove(collision)
    for index, points in enumerate(hulls):
        path = folder / f"{stem}_{index}.obj"
        path.write_text(_obj(points))
        collision = ET.SubElement(link, "collision")
        geometry = ET.SubElement(collision, "geometry")
        ET.SubElement(geometry, "mesh", filename=str(path))


def _obj(points_m: Float[np.ndarray, "num_points 3"]) -> str:
    return _obj_of(np.asarray(points_m, dtype=np.float64).tobytes())


@lru_cache(maxsize=64)
def _obj_of(points: bytes) -> str:
    """Every world of a process loads the same robot: its hulls are written out once."""
    points_m = np.frombuffer(points).reshape(-1, 3)
    triangles = ConvexHull(points_m).simplices + 1
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in points_m]
    lines += [f"f {a} {b} {c}" for a, b, c in triangles]
    return "\n".join(lines) + "\n"
