"""The robot and the cameras of an episode in Rerun."""

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import rerun as rr
from jaxtyping import Float, Int
from rerun.urdf import UrdfTree

from bridge.episode import streams
from bridge.episode.cdr.messages import CameraInfo
from bridge.episode.reader import Episode
from bridge.errors import GstError
from bridge.geometry import se3
from bridge.geometry.trajectory import PoseTrajectory
from bridge.robots.robot import RECORD_TAG, mimics_of, resolve_mesh, robot_of
from dashboards.frames import media_type
from dashboards.recording import Recording
from dashboards.rerun_file import RerunFile

ROOT_FRAME = "tf#/"
"""Rerun's name for the frame of the entity ``/``, which is the robot's root frame here."""


def log_robot(file: RerunFile, urdf: str | None, prefix: str, recording: Recording) -> None:
    """Log the robot under ``<prefix>/robot``; when it cannot be drawn, note why.

    Finger joints are where their law puts them at the gripper's width [m].
    """
    if urdf is None:
        file.note("the robot is not drawn: the episode holds no robot description")
        return
    try:
        tree = _log_tree(file, drawable(urdf), prefix)
    except (GstError, ET.ParseError, RuntimeError, ValueError) as error:
        file.note(f"the robot is not drawn: {error}")
        return
    joints, widths = recording.joints, recording.widths
    if joints is None:
        file.note("the robot does not move: no joint states")
        return
    arm = dict(zip(joints.names, joints.position.T, strict=True))
    _move(file, tree, prefix, joints.stamps_ns, arm)
    if widths is not None:
        fingers = {}
        for finger in robot_of(urdf).gripper.fingers:
            fingers[finger.joint] = values = finger.value(widths.position[:, 0])
            for item in mimics_of(urdf):
                if item.leader == finger.joint:
                    fingers[item.joint] = item.multiplier * values + item.offset
        _move(file, tree, prefix, widths.stamps_ns, fingers)


def _log_tree(file: RerunFile, urdf: str, prefix: str) -> UrdfTree:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "robot.urdf"
        path.write_text(urdf, encoding="utf-8")
        tree = UrdfTree.from_file_path(
            path,
            entity_path_prefix=prefix,
            frame_prefix=f"{prefix}/",
            static_transform_entity_path=f"{prefix}/robot_links",
        )
        tree.log_urdf_to_recording(file.stream)
    root = f"{prefix}/{tree.root_link().name}"
    file.always(f"{prefix}/robot_root", rr.Transform3D(parent_frame=ROOT_FRAME, child_frame=root))
    return tree


def _move(
    file: RerunFile,
    tree: UrdfTree,
    prefix: str,
    stamps_ns: Int[np.ndarray, " num_samples"],
    positions: Mapping[str, Float[np.ndarray, " num_samples"]],
) -> None:
    for name, values in positions.items():
        joint = tree.get_joint_by_name(name)
        if joint is None:
            file.note(f"joint {name!r} is not in the robot description and is not shown")
            continue
        columns = joint.compute_transform_columns(values.tolist(), clamp=False)
        file.rows(f"{prefix}/robot_joints/{name}", stamps_ns, columns)


def drawable(urdf: str) -> str:
    """Return the URDF with only its visuals, absolute meshes, and the robot's base as its root.

    Raises:
        ParseError: When the text is not XML.
        GstError: When a mesh cannot be found.
    """
    robot = ET.fromstring(urdf)
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


def _drop_above(robot: ET.Element, base: str) -> None:
    """Remove the links that carry ``base``: an episode's poses are given in that frame."""
    links = {link.get("name", ""): link for link in robot.findall("link")}
    joints = [(each, _end(each, "parent"), _end(each, "child")) for each in robot.findall("joint")]
    kept: set[str] = set()
    reached = {base} if base in links else set(links)
    while reached != kept:
        kept = reached
        reached = kept | {child for _, parent, child in joints if parent in kept}
    for name in links.keys() - kept:
        robot.remove(links[name])
    for joint, parent, _ in joints:
        if parent not in kept:
            robot.remove(joint)


def _end(joint: ET.Element, which: str) -> str:
    return next((each.get("link", "") for each in joint.iter(which)), "")


FRUSTUM_M = 0.12
"""How far from the camera its image is drawn."""
MILLIMETRES_PER_METRE = 1000.0


def log_cameras(file: RerunFile, episode: Episode, prefix: str, start_ns: int) -> list[str]:
    """Log every camera as ``<prefix>/cameras/<id>/{color,depth}``; return these entities.

    A camera has the pose of its first frame from ``start_ns`` on. What is missing (intrinsics,
    transforms, images that are no JPEG or PNG) is noted and the rest is shown.
    """
    entities = []
    for camera_id in streams.camera_ids(episode):
        for kind, send in (("color", _send_color), ("depth", _send_depth)):
            topic = streams.find_camera_topic(episode, camera_id, f"{kind}/image")
            if topic is None:
                continue
            entity = f"{prefix}/cameras/{camera_id}/{kind}"
            entities.append(entity)
            try:
                stamps_ns = send(file, episode, camera_id, entity)
            except GstError as error:
                file.note(f"{entity} is not shown further: {error}")
                continue
            try:
                info = streams.camera_info(episode, camera_id, kind)
                _log_place(file, episode, info, entity, [start_ns, *stamps_ns])
            except GstError as error:
                file.note(f"{entity} is not shown in 3D: {error}")
    return entities


def _send_color(file: RerunFile, episode: Episode, camera_id: str, entity: str) -> list[int]:
    stamps = []
    for image in streams.color_images(episode, camera_id):
        data = image.as_file()
        try:
            kind = media_type(data, episode.path)
        except GstError as error:
            file.note(f"{entity}: {error}")
            continue
        picture = rr.EncodedImage(contents=data, media_type=kind)
        file.at(entity, image.stamp_ns, picture)
        stamps.append(image.stamp_ns)
    return stamps


def _send_depth(file: RerunFile, episode: Episode, camera_id: str, entity: str) -> list[int]:
    stamps = []
    for image in streams.depth_images(episode, camera_id):
        file.at(entity, image.stamp_ns, rr.DepthImage(image.depth_mm.astype("<u2")))
        stamps.append(image.stamp_ns)
    file.always(entity, rr.DepthImage.from_fields(meter=MILLIMETRES_PER_METRE))
    return stamps


def _log_place(
    file: RerunFile, episode: Episode, info: CameraInfo, entity: str, stamps_ns: list[int]
) -> None:
    camera = info.camera
    pinhole = rr.Pinhole(
        focal_length=(camera.fx, camera.fy),
        principal_point=(camera.cx, camera.cy),  # Rerun's pixels, too, have centres at +0.5
        width=camera.width,
        height=camera.height,
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=FRUSTUM_M,
    )
    file.always(entity, pinhole)
    stamps = np.unique(np.array(stamps_ns, dtype=np.int64))
    Ts = streams.transform_tree(episode).Ts_root_frame(info.frame_id, stamps)
    if np.array_equal(Ts, np.broadcast_to(Ts[0], Ts.shape)):  # a stationary camera
        stamps, Ts = stamps[:1], Ts[:1]
    q, p = se3.split(Ts)
    file.poses(entity, PoseTrajectory(stamps, p, q))
