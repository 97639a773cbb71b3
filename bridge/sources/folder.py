"""An RGB-D folder as the messages of a live camera."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import UInt8, UInt16

from bridge.clock import ns_from_s
from bridge.episode import schema
from bridge.episode.message import StampedMessage
from bridge.episode.records import (
    CameraInfo,
    CompressedColor,
    DepthImage,
    FrameTransform,
    transforms_to_cdr,
)
from bridge.geometry.camera import Camera
from bridge.media.color import JPEG_MAGIC, UnreadableImageError, decode_color, encode_jpeg
from bridge.media.depth import decode_depth_png, to_millimetres
from bridge.sources.errors import FolderError
from bridge.sources.folder_config import FolderConfig
from bridge.sources.folder_index import FolderFrame, FolderIndex

WORLD = "world"
INFO_PERIOD_S = 1.0
"""Calibration and static transforms are repeated this often [s]."""


def num_frames(index: FolderIndex, config: FolderConfig) -> int:
    """How many frames will be sent."""
    return min(len(index.frames), config.max_frames or len(index.frames))


def folder_messages(
    index: FolderIndex, config: FolderConfig, start_ns: int
) -> Iterator[list[StampedMessage]]:
    """Yield the messages of one frame after another.

    Args:
        index: The checked index.
        config: Names and rate.
        start_ns: Stamp of the first frame.

    Raises:
        FolderError: When an image cannot be read or has another size than its camera.
    """
    period_ns = ns_from_s(1.0 / config.rate_hz)
    info_every = max(1, round(INFO_PERIOD_S * config.rate_hz))
    color_camera: Camera | None = None
    for number, frame in enumerate(index.frames[: num_frames(index, config)]):
        stamp_ns = start_ns + number * period_ns
        color = _read_color(frame)
        if color_camera is None:
            color_camera = _color_camera(index, color.shape)
        _check_size(frame.color_path, color.shape[:2], color_camera)
        messages = []
        if number % info_every == 0:
            messages += _calibration(index, config, color_camera, stamp_ns)
        yield messages + _frame_messages(index, config, frame, color, stamp_ns)


def _frame_messages(
    index: FolderIndex,
    config: FolderConfig,
    frame: FolderFrame,
    color: UInt8[np.ndarray, "height width 3"],
    stamp_ns: int,
) -> list[StampedMessage]:
    depth_frame = f"{config.camera}_depth_optical"
    pose = FrameTransform(
        stamp_ns=stamp_ns, parent=WORLD, child=depth_frame, T_parent_child=frame.T_world_depth
    )
    depth = DepthImage(stamp_ns=stamp_ns, frame_id=depth_frame, depth_mm=_read_depth(index, frame))
    stored = frame.color_path.read_bytes()
    image = CompressedColor(
        stamp_ns=stamp_ns,
        frame_id=f"{config.camera}_color_optical",
        format="jpeg",
        data=stored if stored[:2] == JPEG_MAGIC else encode_jpeg(color),
    )
    prefix = f"/{config.cell}/cam/{config.camera}"
    return [
        _message("/tf", schema.TF_MESSAGE, transforms_to_cdr([pose]), stamp_ns),
        _message(f"{prefix}/depth/image", schema.IMAGE, depth.to_cdr(), stamp_ns),
        _message(f"{prefix}/color/image", schema.COMPRESSED_IMAGE, image.to_cdr(), stamp_ns),
    ]


def _calibration(
    index: FolderIndex, config: FolderConfig, color_camera: Camera, stamp_ns: int
) -> list[StampedMessage]:
    messages = []
    for stream, camera in (("depth", index.depth_camera), ("color", color_camera)):
        frame_id = f"{config.camera}_{stream}_optical"
        info = CameraInfo(stamp_ns=stamp_ns, frame_id=frame_id, camera=camera)
        topic = f"/{config.cell}/cam/{config.camera}/{stream}/info"
        messages.append(_message(topic, schema.CAMERA_INFO, info.to_cdr(), stamp_ns))
    between = FrameTransform(
        stamp_ns=stamp_ns,
        parent=f"{config.camera}_depth_optical",
        child=f"{config.camera}_color_optical",
        T_parent_child=index.T_depth_color,
    )
    messages.append(
        _message("/tf_static", schema.TF_MESSAGE, transforms_to_cdr([between]), stamp_ns)
    )
    return messages


def _message(topic: str, type_name: str, data: bytes, stamp_ns: int) -> StampedMessage:
    return StampedMessage(topic=topic, type_name=type_name, data=data, stamp_ns=stamp_ns)


def _color_camera(index: FolderIndex, shape: tuple[int, ...]) -> Camera:
    """The camera of the colour images; registered ones may be a resized depth camera's."""
    if index.color_camera is not None:
        return index.color_camera
    return index.depth_camera.scaled(shape[1] / index.depth_camera.width)


def _read_color(frame: FolderFrame) -> UInt8[np.ndarray, "height width 3"]:
    try:
        return decode_color(frame.color_path.read_bytes())
    except (UnreadableImageError, OSError) as error:
        raise FolderError(
            path=frame.color_path, found=str(error), hint="Restore the file or remove the frame."
        ) from error


def _read_depth(index: FolderIndex, frame: FolderFrame) -> UInt16[np.ndarray, "height width"]:
    try:
        stored = decode_depth_png(frame.depth_path.read_bytes())
    except (UnreadableImageError, OSError) as error:
        raise FolderError(
            path=frame.depth_path, found=str(error), hint="Restore the file or remove the frame."
        ) from error
    _check_size(frame.depth_path, stored.shape, index.depth_camera)
    return to_millimetres(
        stored,
        unit_m=index.depth_unit_m,
        invalid_values=index.depth_invalid_values,
        encoding=index.depth_encoding,
    )


def _check_size(path: Path, shape: tuple[int, ...], camera: Camera) -> None:
    if shape != (camera.height, camera.width):
        raise FolderError(
            path=path,
            found=f"{shape[1]} x {shape[0]} pixels, camera {camera.width} x {camera.height}",
            hint="Correct the intrinsics in scene.json or the image.",
        )
