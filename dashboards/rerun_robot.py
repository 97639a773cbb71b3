"""The recorded robot, moved by its recorded joints: a URDF as Rerun loads it."""

import xml.etree.ElementTree as ET
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import rerun as rr
from jaxtyping import Float
from rerun.urdf import UrdfTree

from bridge.episode.streams import JointTrack
from bridge.errors import GstError
from bridge.task.robot import BASE_FRAME, FINGER_JOINTS, resolve_mesh
from dashboards.errors import DashboardError
from dashboards.rerun_file import RerunFile

ROOT_FRAME = "tf#/"
"""Rerun's name for the frame of the entity ``/``, which is the robot's root frame here."""


def log_robot(
    file: RerunFile,
    urdf: str | None,
    prefix: str,
    *,
    joints: JointTrack | None,
    widths: JointTrack | None,
) -> bool:
    """Log the robot under ``<prefix>/robot``; when it cannot be drawn, note why and return False.

    Each finger joint is at half the gripper width.
    """
    if urdf is None:
        file.note("the robot is not drawn: the episode holds no robot description")
        return False
    try:
        text = drawable(urdf)
    except GstError as error:
        file.note(f"the robot is not drawn: {error}")
        return False
    with TemporaryDirectory() as folder:
        path = Path(folder) / "robot.urdf"
        path.write_text(text, encoding="utf-8")
        try:
            tree = UrdfTree.from_file_path(
                path,
                entity_path_prefix=prefix,
                frame_prefix=f"{prefix}/",
                static_transform_entity_path=f"{prefix}/robot_links",
            )
            tree.log_urdf_to_recording(file.stream)
        except (RuntimeError, ValueError) as error:
            file.note(f"the robot is not drawn: Rerun refuses its description ({error})")
            return False
    root = f"{prefix}/{tree.root_link().name}"
    file.always(f"{prefix}/robot_root", rr.Transform3D(parent_frame=ROOT_FRAME, child_frame=root))
    if joints is None:
        file.note("the robot stands still: no joint states")
        return True
    for index, name in enumerate(joints.names):
        _move(file, tree, prefix, name, joints, joints.position[:, index])
    if widths is not None:
        for name in FINGER_JOINTS:
            _move(file, tree, prefix, name, widths, widths.position[:, 0] / 2)
    return True


def _move(
    file: RerunFile,
    tree: UrdfTree,
    prefix: str,
    name: str,
    track: JointTrack,
    values: Float[np.ndarray, " num_samples"],
) -> None:
    joint = tree.get_joint_by_name(name)
    if joint is None:
        file.note(f"joint {name!r} is not in the robot description; it does not move the drawing")
        return
    columns = joint.compute_transform_columns(values.tolist(), clamp=False)
    file.rows(f"{prefix}/robot_joints/{name}", track.stamps_ns, columns)


def drawable(urdf: str) -> str:
    """Return the URDF with only its visuals, absolute meshes, and ``base_link`` as its root.

    Raises:
        DashboardError: When the text is not a URDF.
        GstError: When a mesh cannot be found.
    """
    try:
        robot = ET.fromstring(urdf)
    except ET.ParseError as error:
        message = f"the robot description is not XML ({error})."
        raise DashboardError(message) from error
    if robot.tag != "robot":
        message = f"the robot description has the root element <{robot.tag}>, not <robot>."
        raise DashboardError(message)
    robot.set("name", "robot")
    for link in robot.findall("link"):
        for collision in link.findall("collision"):
            link.remove(collision)
        for mesh in link.iter("mesh"):
            mesh.set("filename", str(resolve_mesh(mesh.get("filename", ""))))
    _drop_above(robot, BASE_FRAME)
    return ET.tostring(robot, encoding="unicode")


def _drop_above(robot: ET.Element, link_name: str) -> None:
    """Remove the links that carry ``link_name``: an episode's poses are given in that frame."""
    links = {link.get("name"): link for link in robot.findall("link")}
    if link_name not in links:
        return
    kept = {link_name}
    joints = list(robot.findall("joint"))
    ends = [(_end(joint, "parent"), _end(joint, "child")) for joint in joints]
    growing = True
    while growing:
        reached = {child for parent, child in ends if parent in kept} | kept
        growing, kept = reached != kept, reached
    for name, link in links.items():
        if name not in kept:
            robot.remove(link)
    for joint, (parent, _) in zip(joints, ends, strict=True):
        if parent not in kept:
            robot.remove(joint)


def _end(joint: ET.Element, which: str) -> str:
    element = joint.find(which)
    return "" if element is None else element.get("link", "")
