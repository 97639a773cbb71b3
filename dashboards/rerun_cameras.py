"""Camera images, depth and poses of an episode, as Rerun shows them."""

from collections.abc import Iterator
from itertools import islice
from typing import TypeVar

import numpy as np
import rerun as rr

from bridge.episode import streams
from bridge.episode.cdr.messages import CameraInfo, DepthImage, color_file_from_message
from bridge.episode.reader import Episode
from bridge.episode.transforms import TransformTree
from bridge.errors import GstError
from bridge.geometry import se3
from bridge.geometry.trajectory import PoseTrajectory
from dashboards.frames import media_type
from dashboards.rerun_file import RerunFile

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
                file.note(f"{entity} has no place in 3D: {error}")
    return ids


def _batches(items: Iterator[Item]) -> Iterator[list[Item]]:
    while batch := list(islice(items, BATCH)):
        yield batch


def _send_color(file: RerunFile, episode: Episode, topic: str, entity: str) -> list[int]:
    stamps = []
    images = (
        color_file_from_message(message.type_name, message.data)
        for message in episode.messages([topic])
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
    if np.array_equal(Ts, np.broadcast_to(Ts[0], Ts.shape)):  # a camera that stands still
        stamps, Ts = stamps[:1], Ts[:1]
    q, p = se3.split(Ts)
    file.poses(entity, PoseTrajectory(stamps, p, q))
