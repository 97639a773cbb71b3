"""The robot's links and joints, read once from the URDF for physics and for the cameras."""

import xml.etree.ElementTree as ET
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from bridge.task.robot import BASE_FRAME, resolve_mesh, ur5_with_gripper_urdf


@dataclass(frozen=True, kw_only=True)
class LinkShape:
    """One solid of a link: a mesh file or a box."""

    T_link_shape: Float[np.ndarray, "4 4"]
    mesh: str | None
    box_m: tuple[float, float, float] | None


@dataclass(frozen=True, kw_only=True)
class LinkModel:
    """One link with the joint that carries it."""

    name: str
    parent: str | None
    joint: str | None
    joint_type: str
    axis: tuple[float, float, float]
    limits: tuple[float, float]
    T_parent_link: Float[np.ndarray, "4 4"]
    mass_kg: float
    T_link_inertial: Float[np.ndarray, "4 4"]
    inertia: tuple[float, float, float, float, float, float]
    """xx, yy, zz, xy, xz, yz [kg m^2]."""
    shapes: tuple[LinkShape, ...]


def robot_links() -> list[LinkModel]:
    """Return every link, parents before children, starting at ``base_link``."""
    root = ET.fromstring(ur5_with_gripper_urdf())
    elements = {item.attrib["name"]: item for item in root.findall("link")}
    joints = root.findall("joint")
    links = []
    waiting: list[tuple[str, ET.Element | None]] = [(BASE_FRAME, None)]
    while waiting:
        name, joint = waiting.pop(0)
        links.append(_link(elements[name], joint))
        for item in joints:
            if _child_of(item, "parent") == name:
                waiting.append((_child_of(item, "child"), item))
    return links


def _child_of(joint: ET.Element, tag: str) -> str:
    found = joint.find(tag)
    return "" if found is None else found.attrib["link"]


def _link(element: ET.Element, joint: ET.Element | None) -> LinkModel:
    inertial = element.find("inertial")
    mass = None if inertial is None else inertial.find("mass")
    tensor = None if inertial is None else inertial.find("inertia")
    names = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    values = [0.0] * 6 if tensor is None else [float(tensor.attrib[name]) for name in names]
    axis = None if joint is None else joint.find("axis")
    limit = None if joint is None else joint.find("limit")
    return LinkModel(
        name=element.attrib["name"],
        parent=None if joint is None else _child_of(joint, "parent"),
        joint=None if joint is None else joint.attrib["name"],
        joint_type="fixed" if joint is None else joint.attrib["type"],
        axis=_vector(None if axis is None else axis.attrib["xyz"], (1.0, 0.0, 0.0)),
        limits=(0.0, 0.0)
        if limit is None
        else (float(limit.attrib["lower"]), float(limit.attrib["upper"])),
        T_parent_link=_origin(joint),
        mass_kg=0.0 if mass is None else float(mass.attrib["value"]),
        T_link_inertial=_origin(inertial),
        inertia=(values[0], values[1], values[2], values[3], values[4], values[5]),
        shapes=tuple(_shapes(element)),
    )


def _shapes(element: ET.Element) -> list[LinkShape]:
    shapes = []
    for collision in element.findall("collision"):
        mesh, box = collision.find("geometry/mesh"), collision.find("geometry/box")
        if mesh is not None:
            path = str(resolve_mesh(mesh.attrib["filename"]))
            shapes.append(LinkShape(T_link_shape=_origin(collision), mesh=path, box_m=None))
        elif box is not None and element.attrib["name"] != "ee_link":
            # ee_link holds a 1 cm marker box inside the flange, not a part of the robot.
            size = _vector(box.attrib["size"], (0.0, 0.0, 0.0))
            shapes.append(LinkShape(T_link_shape=_origin(collision), mesh=None, box_m=size))
    return shapes


def _vector(text: str | None, default: tuple[float, float, float]) -> tuple[float, float, float]:
    if text is None:
        return default
    x, y, z = (float(value) for value in text.split())
    return x, y, z


def _origin(element: ET.Element | None) -> Float[np.ndarray, "4 4"]:
    """Read ``<origin xyz rpy>``: fixed-axis roll, pitch, yaw as URDF defines it."""
    origin = None if element is None else element.find("origin")
    if origin is None:
        return np.eye(4)
    roll, pitch, yaw = _vector(origin.attrib.get("rpy"), (0.0, 0.0, 0.0))
    q = _multiply(_about(2, yaw), _multiply(_about(1, pitch), _about(0, roll)))
    return se3.transform_from(q, np.array(_vector(origin.attrib.get("xyz"), (0.0, 0.0, 0.0))))


def _about(axis: int, angle_rad: float) -> Float[np.ndarray, "4"]:
    q = np.zeros(4)
    q[0], q[1 + axis] = np.cos(angle_rad / 2), np.sin(angle_rad / 2)
    return q


def _multiply(a: Float[np.ndarray, "4"], b: Float[np.ndarray, "4"]) -> Float[np.ndarray, "4"]:
    """Hamilton product of two wxyz quaternions."""
    w = a[0] * b[0] - a[1:] @ b[1:]
    return np.concatenate([[w], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])])
