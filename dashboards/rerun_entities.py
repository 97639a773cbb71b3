"""The robot and the cameras of an episode in Rerun."""

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeVar

import numpy as np
import rerun as rr
from jaxtyping import Float
from rerun.urdf import UrdfTree

from bridge.episode import streams
from bridge.episode.cdr.messages import CameraInfo, DepthImage, color_file_from_message
from bridge.episode.reader import Episode
from bridge.episode.streams import JointTrack
from bridge.episode.transforms import TransformTree
from bridge.errors import GstError
from bridge.geometry import se3
from bridge.geometry.trajectory import PoseTrajectory
from bridge.robots.robot import RECORD_TAG, mimics_of, resolve_mesh, robot_of
from dashboards.errors import DashboardError
from dashboards.frames import media_type
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

    Finger joints are where their law puts them at the gripper's width.

    Args:
        file: The Rerun file being written.
        urdf: Robot description as text; None where the episode holds none.
        prefix: Entities start with this.
        joints: Joint positions [rad] over the cell's source time; None leaves the robot still.
        widths: Gripper widths [m] over time, in the first column; None leaves the fingers still.
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
        file.note("the robot does not move: no joint states")
        return True
    for index, name in enumerate(joints.names):
        _move(file, tree, prefix, name, joints, joints.position[:, index])
    if widths is not None:
        for finger in robot_of(urdf).gripper.fingers:
            values = finger.value(widths.position[:, 0])
            _move(file, tree, prefix, finger.joint, widths, values)
            for item in mimics_of(urdf):
                if item.leader == finger.joint:
                    follows = item.multiplier * values + item.offset
                    _move(file, tree, prefix, item.joint, widths, follows)
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
        file.note(f"joint {name!r} is not in the robot description and is not shown")
        return
    columns = joint.compute_transform_columns(values.tolist(), clamp=False)
    file.rows(f"{prefix}/robot_joints/{name}", track.stamps_ns, columns)


def drawable(urdf: str) -> str:
    """Return the URDF with only its visuals, absolute meshes, and the robot's base as its root.

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
    for record in robot.findall(RECORD_TAG):
        robot.remove(record)
    for link in robot.findall("link"):
        for collision in link.findall("collision"):
            link.remove(collision)
        for mesh in link.iter("mesh"):
            mesh.set("filename", str(resolve_mesh(mesh.get("filename", ""))))
    _drop_above(robot, robot_of(urdf).base_frame)
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


BATCH = 32
"""Images held in memory at once."""
FRUSTUM_M = 0.12
"""How far from the camera its image is drawn."""
MILLIMETRES_PER_METRE = 1000.0

Item = TypeVar("Item")


def log_cameras(file: RerunFile, episode: Episode, prefix: str, start_ns: int) -> list[str]:
    """Log every camera under ``<prefix>/cameras/<id>/{color,depth}``; return the ids.

    A camera has the pose of its first frame from ``start_ns`` on. What is missing (intrinsics,
    transforms, images that are no JPEG or PNG) is noted and the rest is shown.

    Args:
        file: The Rerun file being written; it notes what is missing.
        episode: The recorded episode.
        prefix: Entities start with this.
        start_ns: Source time from which a camera has a pose [ns].
    """
    try:
        tree = streams.transform_tree(episode)
    except GstError as error:
        file.note(f"transforms are not shown: {error}")
        tree = TransformTree([])
    ids = streams.camera_ids(episode)
    for camera_id in ids:
        for kind in ("color", "depth"):
            topic = streams.find_camera_topic(episode, camera_id, f"{kind}/image")
            if topic is None:
                continue
            entity = f"{prefix}/cameras/{camera_id}/{kind}"
            send = _send_color if kind == "color" else _send_depth
            try:
                stamps = send(file, episode, topic, entity)
            except GstError as error:
                file.note(f"{entity} is not shown further: {error}")
                continue
            try:
                info = streams.camera_info(episode, camera_id, kind)
                _log_pinhole(file, info, entity)
                _log_pose(file, tree, info.frame_id, entity, [start_ns, *stamps])
            except GstError as error:
                file.note(f"{entity} is not shown in 3D: {error}")
    return ids


def _batches(items: Iterator[Item]) -> Iterator[list[Item]]:
    while batch := list(islice(items, BATCH)):
        yield batch


def _send_color(file: RerunFile, episode: Episode, topic: str, entity: str) -> list[int]:
    stamps = []
    images = (
        color_file_from_message(message.type_name, message.data)
        for message in streams.image_messages(episode, [topic])
    )
    for batch in _batches(images):
        kept = []
        for image in batch:
            try:
                kept.append((image, media_type(image.data, episode.path)))
            except GstError as error:
                file.note(f"{entity}: {error}")
        if not kept:
            continue
        times = [image.stamp_ns for image, _ in kept]
        columns = rr.EncodedImage.columns(
            blob=[image.data for image, _ in kept], media_type=[kind for _, kind in kept]
        )
        file.rows(entity, np.array(times), columns)
        stamps += times
    return stamps


def _send_depth(file: RerunFile, episode: Episode, topic: str, entity: str) -> list[int]:
    stamps: list[int] = []
    images = (
        DepthImage.from_message(message.type_name, message.data)
        for message in episode.messages([topic])
    )
    for batch in _batches(images):
        times = [image.stamp_ns for image in batch]
        formats = []
        for image in batch:
            height, width = image.depth_mm.shape
            formats.append(
                rr.components.ImageFormat(
                    width=width,
                    height=height,
                    color_model=rr.ColorModel.L,
                    channel_datatype=rr.ChannelDatatype.U16,
                )
            )
        columns = rr.DepthImage.columns(
            buffer=[image.depth_mm.astype("<u2").tobytes() for image in batch], format=formats
        )
        file.rows(entity, np.array(times), columns)
        stamps += times
    file.always(entity, rr.DepthImage.from_fields(meter=MILLIMETRES_PER_METRE))
    return stamps


def _log_pinhole(file: RerunFile, info: CameraInfo, entity: str) -> None:
    camera = info.camera
    file.always(
        entity,
        rr.Pinhole(
            focal_length=(camera.fx, camera.fy),
            principal_point=(camera.cx, camera.cy),  # Rerun's pixels, too, have centres at +0.5
            width=camera.width,
            height=camera.height,
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=FRUSTUM_M,
        ),
    )


def _log_pose(
    file: RerunFile, tree: TransformTree, frame: str, entity: str, stamps_ns: list[int]
) -> None:
    stamps = np.unique(np.array(stamps_ns, dtype=np.int64))
    Ts = np.stack([tree.T_root_frame(frame, int(stamp)) for stamp in stamps])
    if np.array_equal(Ts, np.broadcast_to(Ts[0], Ts.shape)):  # a stationary camera
        stamps, Ts = stamps[:1], Ts[:1]
    q, p = se3.split(Ts)
    file.poses(entity, PoseTrajectory(stamps, p, q))
