"""RealSense frames and calibration as messages of an episode."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8, UInt16

from bridge.clock import split_ns
from bridge.episode import schema
from bridge.episode.cdr import codec
from bridge.episode.cdr.messages import (
    CameraInfo,
    CompressedColor,
    DepthImage,
    FrameTransform,
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


def read_mounts(path: Path, cameras: list[str]) -> dict[str, Mount]:
    """Read the pose of the colour cameras."""
    if not path.is_file():
        raise PathNotFoundError(path=path, what="mounts file", hint="Check --mounts.")
    try:
        entries = json.loads(path.read_bytes())
    except ValueError as error:
        raise MountsError(path=path, found=f"not JSON ({error})") from error
    if not isinstance(entries, dict):
        raise MountsError(path=path, found="not a table of cameras")
    mounts = {}
    for name, entry in entries.items():
        if name not in cameras:
            listed = ", ".join(cameras)
            raise MountsError(path=path, found=f"camera {name!r} is not one of {listed}")
        mounts[name] = _mount(path, name, entry)
    return mounts


def _mount(path: Path, name: str, entry: object) -> Mount:
    try:
        parent = str(entry["parent"])  # type: ignore[index]
        p_m = np.array(entry["p_m"], dtype=np.float64)  # type: ignore[index]
        q_wxyz = np.array(entry["q_wxyz"], dtype=np.float64)  # type: ignore[index]
    except (KeyError, TypeError, ValueError) as error:
        raise MountsError(path=path, found=f"{name}: {error!r}") from error
    if p_m.shape != (3,) or q_wxyz.shape != (4,) or not parent:
        raise MountsError(path=path, found=f"{name}: wrong number of values")
    if not (np.isfinite(p_m).all() and abs(np.linalg.norm(q_wxyz) - 1.0) < ROUNDED):
        raise MountsError(path=path, found=f"{name}: q_wxyz is not a unit quaternion")
    return parent, se3.transform_from(q_wxyz, p_m)


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
        """Intrinsics of both streams, and where depth and colour are.

        Args:
            calibration: Intrinsics of both streams, and ``T_color_depth``.
        """
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
        sec, nanosec = split_ns(frame.stamp_ns)
        message = {
            "header": {
                "stamp": {"sec": sec, "nanosec": nanosec},
                "frame_id": self.color_frame,
            },
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
