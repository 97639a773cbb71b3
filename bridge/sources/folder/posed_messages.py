"""A folder of posed colour images as the messages of cameras that see no depth."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.clock import ns_from_s
from bridge.episode import schema
from bridge.episode.cdr.messages import (
    CameraInfo,
    CompressedColor,
    FrameTransform,
    transforms_to_cdr,
)
from bridge.episode.provenance import hash_file
from bridge.episode.schema import StampedMessage
from bridge.episode.topics import COLOR_IMAGE, COLOR_INFO, TF, camera_topic
from bridge.geometry.camera import Camera
from bridge.sources.folder.config import PosedConfig
from bridge.sources.folder.frames import check_size, read_color
from bridge.sources.folder.messages import WORLD, stamped
from bridge.sources.folder.posed_index import PosedIndex

TYPICAL_DISTANCE_M = 1.0
"""Poses without a scale are scaled so that what the cameras look at is this far away."""
CALIBRATION_EVERY = 30
"""Images between two repetitions of a camera's intrinsics."""


def metres_per_unit(index: PosedIndex, config: PosedConfig) -> float:
    """What lengths of the folder are multiplied with, given or chosen."""
    if config.metres_per_unit is not None:
        return config.metres_per_unit
    return TYPICAL_DISTANCE_M / index.typical_distance()


def describe_posed(index: PosedIndex, config: PosedConfig) -> dict[str, Any]:
    """What an episode's metadata says about the folder it came from."""
    scale = metres_per_unit(index, config)
    return {
        "folder": index.name,
        "layout": index.layout,
        "index_sha256": hash_file(index.path),
        "is_metric": config.metres_per_unit is not None,
        "metres_per_unit": scale,
        "times": f"nominal, {config.rate_hz:g} Hz from 0; the folder has none",
        "assumed": index.assumed,
    }


def posed_messages(index: PosedIndex, config: PosedConfig) -> Iterator[list[StampedMessage]]:
    """Yield the messages of one image after another."""
    scale = metres_per_unit(index, config)
    sent = dict.fromkeys(index.cameras, 0)
    for number, image in enumerate(index.images):
        stamp_ns = number * ns_from_s(1.0 / config.rate_hz)
        name = camera_name(index, config, image.camera)
        camera = index.cameras[image.camera]
        messages = []
        if sent[image.camera] % CALIBRATION_EVERY == 0:
            messages.append(_info(config, name, camera, stamp_ns))
        sent[image.camera] += 1
        T = image.T_world_camera.copy()
        T[:3, 3] *= scale
        messages.append(_pose(name, T, stamp_ns))
        read = read_color(image.path)
        check_size(image.path, read.image_u8.shape[:2], camera)
        color = CompressedColor(
            stamp_ns=stamp_ns, frame_id=frame_of(name), format="jpeg", data=read.as_jpeg()
        )
        topic = camera_topic(config.cell, name, COLOR_IMAGE)
        messages.append(stamped(topic, schema.COMPRESSED_IMAGE, color.to_cdr(), stamp_ns))
        yield messages


def camera_name(index: PosedIndex, config: PosedConfig, camera: str) -> str:
    """Name of a folder's camera in topics."""
    return config.camera if len(index.cameras) == 1 else f"{config.camera}{camera}"


def frame_of(camera: str) -> str:
    """Frame of a camera's images."""
    return f"{camera}_color_optical"


def _pose(camera: str, T_world_camera: Float[np.ndarray, "4 4"], stamp_ns: int) -> StampedMessage:
    pose = FrameTransform(
        stamp_ns=stamp_ns, parent=WORLD, child=frame_of(camera), T_parent_child=T_world_camera
    )
    return stamped(TF, schema.TF_MESSAGE, transforms_to_cdr([pose]), stamp_ns)


def _info(config: PosedConfig, name: str, camera: Camera, stamp_ns: int) -> StampedMessage:
    info = CameraInfo(stamp_ns=stamp_ns, frame_id=frame_of(name), camera=camera)
    topic = camera_topic(config.cell, name, COLOR_INFO)
    return stamped(topic, schema.CAMERA_INFO, info.to_cdr(), stamp_ns)
