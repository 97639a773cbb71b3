"""A folder of posed colour images as the messages of cameras that see no depth."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

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
from bridge.media.color import encode_jpeg
from bridge.sources.folder.config import PosedConfig
from bridge.sources.folder.frames import check_size, read_color
from bridge.sources.folder.messages import WORLD
from bridge.sources.folder.posed_index import Lens, PosedImage, PosedIndex

TYPICAL_DISTANCE_M = 1.0
"""Poses without a scale are scaled so that what the cameras look at is this far away."""
CALIBRATION_EVERY = 30
"""Images between two repetitions of a camera's intrinsics."""
ZOOM_STEPS, MOST_ZOOM = 40, 4.0
UNDISTORTED_QUALITY = 95


def metres_per_unit(index: PosedIndex, config: PosedConfig) -> float:
    """What lengths of the folder are multiplied with, given or chosen.

    Raises:
        FolderError: When it was not given and the images do not tell how far they look.
    """
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
        "undistorted": sorted(k for k, lens in index.lenses.items() if not lens.is_straight),
        "times": f"nominal, {config.rate_hz:g} Hz from 0; the folder has none",
        "assumed": index.assumed,
    }


def posed_messages(index: PosedIndex, config: PosedConfig) -> Iterator[list[StampedMessage]]:
    """Yield the messages of one image after another.

    Raises:
        FolderError: When an image cannot be read or has another size than its camera.
    """
    scale = metres_per_unit(index, config)
    views = {name: Undistortion(lens) for name, lens in index.lenses.items()}
    sent = dict.fromkeys(index.lenses, 0)
    for number, image in enumerate(index.images):
        stamp_ns = number * ns_from_s(1.0 / config.rate_hz)
        name = camera_name(index, config, image.camera)
        view = views[image.camera]
        messages = []
        if sent[image.camera] % CALIBRATION_EVERY == 0:
            messages.append(_info(config, name, view.camera, stamp_ns))
        sent[image.camera] += 1
        T = image.T_world_camera.copy()
        T[:3, 3] *= scale
        messages.append(_pose(name, T, stamp_ns))
        color = CompressedColor(
            stamp_ns=stamp_ns, frame_id=frame_of(name), format="jpeg", data=_jpeg(image, view)
        )
        topic = camera_topic(config.cell, name, COLOR_IMAGE)
        messages.append(_message(topic, schema.COMPRESSED_IMAGE, color.to_cdr(), stamp_ns))
        yield messages


def camera_name(index: PosedIndex, config: PosedConfig, camera: str) -> str:
    """Name of a folder's camera in topics."""
    return config.camera if len(index.lenses) == 1 else f"{config.camera}{camera}"


def frame_of(camera: str) -> str:
    """Frame of a camera's images."""
    return f"{camera}_color_optical"


class Undistortion:
    """What an undistorted camera sees of the images of a lens."""

    def __init__(self, lens: Lens) -> None:
        """Zoom in until no pixel looks beyond the edge of the distorted image."""
        self.lens, self.camera = lens, lens.camera
        self._uv: Float[np.ndarray, "height width 2"] | None = None
        if lens.is_straight:
            return
        for zoom in np.geomspace(1.0, MOST_ZOOM, ZOOM_STEPS).tolist():
            focal = {"fx": lens.camera.fx * zoom, "fy": lens.camera.fy * zoom}
            self.camera = replace(lens.camera, **focal)
            self._uv = _distorted(lens, self.camera.rays())
            if _inside(lens.camera, self._uv):
                break

    def of(
        self, image_u8: UInt8[np.ndarray, "height width 3"]
    ) -> UInt8[np.ndarray, "height width 3"]:
        """The undistorted image, sampled bilinearly."""
        if self._uv is None:
            return image_u8
        height, width = image_u8.shape[:2]
        x = np.clip(self._uv[..., 0] - 0.5, 0.0, width - 1.0)
        y = np.clip(self._uv[..., 1] - 0.5, 0.0, height - 1.0)
        x0 = np.minimum(x.astype(np.int64), width - 2)
        y0 = np.minimum(y.astype(np.int64), height - 2)
        fx, fy = (x - x0)[..., None], (y - y0)[..., None]
        top = image_u8[y0, x0] * (1 - fx) + image_u8[y0, x0 + 1] * fx
        bottom = image_u8[y0 + 1, x0] * (1 - fx) + image_u8[y0 + 1, x0 + 1] * fx
        return np.asarray(np.rint(top * (1 - fy) + bottom * fy).astype(np.uint8))


def _inside(camera: Camera, uv: Float[np.ndarray, "height width 2"]) -> bool:
    """Whether the edge of the undistorted image, and so all of it, shows what the lens saw."""
    u, v = np.concatenate([uv[0], uv[-1], uv[:, 0], uv[:, -1]]).T
    return bool(((u >= 0) & (v >= 0) & (u <= camera.width) & (v <= camera.height)).all())


def _distorted(
    lens: Lens, rays: Float[np.ndarray, "height width 3"]
) -> Float[np.ndarray, "height width 2"]:
    """Pixel of the lens that looks along a ray (OpenCV's model, its documentation of calib3d)."""
    x, y = rays[..., 0], rays[..., 1]
    r2 = x * x + y * y
    radial = 1 + lens.k1 * r2 + lens.k2 * r2 * r2
    bent_x = x * radial + 2 * lens.p1 * x * y + lens.p2 * (r2 + 2 * x * x)
    bent_y = y * radial + lens.p1 * (r2 + 2 * y * y) + 2 * lens.p2 * x * y
    camera = lens.camera
    return np.stack([camera.fx * bent_x + camera.cx, camera.fy * bent_y + camera.cy], axis=-1)


def _jpeg(image: PosedImage, view: Undistortion) -> bytes:
    """The stored bytes where they can stay as they are."""
    color = read_color(image.path)
    check_size(image.path, color.image_u8.shape[:2], view.lens.camera)
    if view.lens.is_straight:
        return color.as_jpeg()
    return encode_jpeg(view.of(color.image_u8), quality=UNDISTORTED_QUALITY)


def _pose(camera: str, T_world_camera: Float[np.ndarray, "4 4"], stamp_ns: int) -> StampedMessage:
    pose = FrameTransform(
        stamp_ns=stamp_ns, parent=WORLD, child=frame_of(camera), T_parent_child=T_world_camera
    )
    return _message(TF, schema.TF_MESSAGE, transforms_to_cdr([pose]), stamp_ns)


def _info(config: PosedConfig, name: str, camera: Camera, stamp_ns: int) -> StampedMessage:
    info = CameraInfo(stamp_ns=stamp_ns, frame_id=frame_of(name), camera=camera)
    topic = camera_topic(config.cell, name, COLOR_INFO)
    return _message(topic, schema.CAMERA_INFO, info.to_cdr(), stamp_ns)


def _message(topic: str, type_name: str, data: bytes, stamp_ns: int) -> StampedMessage:
    return StampedMessage(topic=topic, type_name=type_name, data=data, stamp_ns=stamp_ns)
