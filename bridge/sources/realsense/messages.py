"""RealSense frames and calibration as messages of an episode."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from jaxtyping import Float, UInt8, UInt16

from bridge.episode import schema
from bridge.episode.cdr import codec
from bridge.episode.cdr.messages import (
    CameraInfo,
    CompressedColor,
    DepthImage,
    FrameTransform,
    header,
    transforms_to_cdr,
)
from bridge.episode.schema import StampedMessage
from bridge.episode.topics import TF_STATIC, camera_topic
from bridge.errors import PathNotFoundError
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.media.color import encode_jpeg
from bridge.sources.realsense.config import MountsError, RealSenseConfig

ROUNDED = 0.01
"""Quaternions written by hand have few digits; a length this far from one is still a rotation."""
Mount = tuple[str, Float[np.ndarray, "4 4"]]
"""Parent frame and ``T_parent_color``."""


class _Entry(msgspec.Struct):
    parent: Annotated[str, msgspec.Meta(min_length=1)]
    p_m: tuple[float, float, float]
    q_wxyz: tuple[float, float, float, float]


def read_mounts(path: Path, cameras: list[str]) -> dict[str, Mount]:
    """Read the pose of the colour cameras."""
    if not path.is_file():
        raise PathNotFoundError(path=path, what="mounts file", hint="Check --mounts.")
    try:
        entries = msgspec.json.decode(path.read_bytes(), type=dict[str, msgspec.Raw])
    except msgspec.DecodeError as error:
        raise MountsError(path=path, found=str(error)) from error
    mounts = {}
    for name, text in entries.items():
        if name not in cameras:
            listed = ", ".join(cameras)
            raise MountsError(path=path, found=f"camera {name!r} is not one of {listed}")
        try:
            entry = msgspec.json.decode(text, type=_Entry)
        except msgspec.DecodeError as error:
            raise MountsError(path=path, found=f"{name}: {error}") from error
        if not abs(np.linalg.norm(entry.q_wxyz) - 1.0) < ROUNDED:
            raise MountsError(path=path, found=f"{name}: q_wxyz is not a unit quaternion")
        mounts[name] = entry.parent, se3.transform_from(np.array(entry.q_wxyz), np.array(entry.p_m))
    return mounts


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """Intrinsics of both streams and how they are mounted to each other."""

    color_camera: Camera
    depth_camera: Camera
    T_color_depth: Float[np.ndarray, "4 4"]


@dataclass(frozen=True, kw_only=True)
class ColorFrame:
    """An undistorted colour image (sRGB)."""

    number: int
    """The device's frame counter of this stream."""
    stamp_ns: int
    image_u8: UInt8[np.ndarray, "height width 3"]


@dataclass(frozen=True, kw_only=True)
class DepthFrame:
    """Depth along the optical axis in whole millimetres; 0 is "no measurement"."""

    number: int
    stamp_ns: int
    depth_mm: UInt16[np.ndarray, "height width"]


Frame = ColorFrame | DepthFrame


class CameraMessages:
    """Makes the messages of one camera."""

    def __init__(self, config: RealSenseConfig, camera: str) -> None:
        """Name its topics and frames."""
        self._config = config
        self.root = camera_topic(config.cell, camera)
        self.color_frame = f"{camera}_color_optical"
        self.depth_frame = f"{camera}_depth_optical"

    def topic_and_type(self, stream: str) -> tuple[str, str]:
        """Topic and type of a stream's images."""
        raw = stream == "depth" or self._config.color == "raw"
        return f"{self.root}/{stream}/image", schema.IMAGE if raw else schema.COMPRESSED_IMAGE

    def facts(
        self, calibration: Calibration, mount: Mount | None, stamp_ns: int
    ) -> list[StampedMessage]:
        """Intrinsics of both streams, and where depth and colour are."""
        transforms = [
            FrameTransform(
                stamp_ns=stamp_ns,
                parent=self.color_frame,
                child=self.depth_frame,
                T_parent_child=calibration.T_color_depth,
            )
        ]
        if mount is not None:
            parent, T_parent_color = mount
            transforms.append(
                FrameTransform(
                    stamp_ns=stamp_ns,
                    parent=parent,
                    child=self.color_frame,
                    T_parent_child=T_parent_color,
                )
            )
        made = [(TF_STATIC, schema.TF_MESSAGE, transforms_to_cdr(transforms))]
        for stream, frame_id, camera in (
            ("color", self.color_frame, calibration.color_camera),
            ("depth", self.depth_frame, calibration.depth_camera),
        ):
            info = CameraInfo(stamp_ns=stamp_ns, frame_id=frame_id, camera=camera)
            made.append((f"{self.root}/{stream}/info", schema.CAMERA_INFO, info.to_cdr()))
        return [
            StampedMessage(topic=topic, type_name=type_name, data=data, stamp_ns=stamp_ns)
            for topic, type_name, data in made
        ]

    def color(self, frame: ColorFrame) -> bytes:
        """Serialise a colour image, compressed or as it is."""
        if self._config.color == "jpeg":
            return CompressedColor(
                stamp_ns=frame.stamp_ns,
                frame_id=self.color_frame,
                format="jpeg",
                data=encode_jpeg(frame.image_u8, self._config.quality, subsampling="420"),
            ).to_cdr()
        height, width, _ = frame.image_u8.shape
        message = {
            "header": header(frame.stamp_ns, self.color_frame),
            "height": height,
            "width": width,
            "encoding": "rgb8",
            "step": 3 * width,
            "data": frame.image_u8.tobytes(),
        }
        return codec.encode(schema.IMAGE, message)

    def depth(self, frame: DepthFrame) -> bytes:
        """Serialise a depth image."""
        return DepthImage(
            stamp_ns=frame.stamp_ns, frame_id=self.depth_frame, depth_mm=frame.depth_mm
        ).to_cdr()
