"""Typed records over the ROS 2 messages an episode holds, with their CDR form.

``stamp_ns`` is the source time (``header.stamp``). Camera intrinsics follow ``Camera`` (pixel
centres at +0.5) in memory and ROS (centres at whole numbers) on disk.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, UInt8, UInt16

from bridge.clock import join_ns, split_ns
from bridge.episode import schema
from bridge.episode.cdr import codec
from bridge.episode.cdr.codec import Message
from bridge.episode.cdr.images import (
    DEPTH_ENCODINGS,
    FLOAT_DEPTH,
    image_header,
    no_encoding,
    pixel_rows,
)
from bridge.episode.cdr.straighten import Straightening, straightening
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.geometry.lens import LensError
from bridge.media import depth
from bridge.media.color import decode_color, encode_jpeg
from bridge.media.pixels import COLORS, rgb_from


def header(stamp_ns: int, frame_id: str) -> dict[str, object]:
    """Make a std_msgs/Header."""
    sec, nanosec = split_ns(stamp_ns)
    return {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame_id}


def stamp_of(message: Message) -> int:
    """Return ``header.stamp`` of a decoded message [ns]."""
    return join_ns(**message["header"]["stamp"])


@dataclass(frozen=True, kw_only=True)
class JointSample:
    """Joint positions, and velocities and efforts where known [rad, m; per second; Nm, N]."""

    stamp_ns: int
    names: tuple[str, ...]
    position: Float[np.ndarray, " num_joints"]
    velocity: Float[np.ndarray, " num_velocities"]
    effort: Float[np.ndarray, " num_efforts"]

    def to_cdr(self) -> bytes:
        """Serialise as sensor_msgs/JointState."""
        message = {
            "header": header(self.stamp_ns, ""),
            "name": list(self.names),
            "position": self.position,
            "velocity": self.velocity,
            "effort": self.effort,
        }
        return codec.encode(schema.JOINT_STATE, message)

    @staticmethod
    def from_cdr(data: bytes) -> "JointSample":
        """Read a sensor_msgs/JointState."""
        message = codec.decode(schema.JOINT_STATE, data)
        if len(message["position"]) not in (0, len(message["name"])):
            found = f"{len(message['position'])} positions of {len(message['name'])} joints"
            raise codec.MalformedMessageError(type_name=schema.JOINT_STATE, found=found)
        return JointSample(
            stamp_ns=stamp_of(message),
            names=tuple(message["name"]),
            position=np.asarray(message["position"]),
            velocity=np.asarray(message["velocity"]),
            effort=np.asarray(message["effort"]),
        )


@dataclass(frozen=True, kw_only=True)
class CompressedColor:
    """A JPEG or PNG colour image as it travels; ``format`` also tells compressed depth."""

    stamp_ns: int
    frame_id: str
    format: str
    data: bytes
    lens: Straightening | None = None

    def to_cdr(self) -> bytes:
        """Serialise as sensor_msgs/CompressedImage."""
        message = {
            "header": header(self.stamp_ns, self.frame_id),
            "format": self.format,
            "data": self.data,
        }
        return codec.encode(schema.COMPRESSED_IMAGE, message)

    @staticmethod
    def from_cdr(data: bytes) -> "CompressedColor":
        """Read a sensor_msgs/CompressedImage."""
        message = codec.decode(schema.COMPRESSED_IMAGE, data)
        return CompressedColor(
            stamp_ns=stamp_of(message),
            frame_id=message["header"]["frame_id"],
            format=message["format"],
            data=bytes(message["data"]),
        )

    def decoded(self) -> np.ndarray:
        """Decode whatever it holds, colour or depth; raises ``UnreadableImageError``."""
        if "compressedDepth" in self.format:
            return depth.unpack(self.format, self.data)
        return self.image_u8()

    def image_u8(self) -> UInt8[np.ndarray, "height width 3"]:
        """Decode to sRGB, as a pinhole camera sees it; raises ``UnreadableImageError``."""
        image_u8 = decode_color(self.data)
        return image_u8 if self.lens is None else self.lens.color(image_u8)

    def as_file(self, encode: Callable[[np.ndarray], bytes] = encode_jpeg) -> bytes:
        """JPEG or PNG to be shown: as it was recorded, or encoded anew without its lens."""
        return self.data if self.lens is None else encode(self.image_u8())


@dataclass(frozen=True, kw_only=True)
class RawColor:
    """An uncompressed colour image, in bytes as ``encoding`` states."""

    stamp_ns: int
    frame_id: str
    encoding: str
    rows: UInt8[np.ndarray, "rows row"]
    swap_bytes: bool = False
    lens: Straightening | None = None

    @staticmethod
    def from_cdr(data: bytes) -> "RawColor":
        """Read a sensor_msgs/Image of colour or grey; refuses other encodings."""
        header = image_header(data)
        if header.encoding not in COLORS:
            raise no_encoding(header.encoding, COLORS)
        return RawColor(
            stamp_ns=header.stamp_ns,
            frame_id=header.frame_id,
            encoding=header.encoding,
            rows=pixel_rows(header),
            swap_bytes=bool(header.is_bigendian),
        )

    def image_u8(self) -> UInt8[np.ndarray, "height width 3"]:
        """Convert to sRGB of 8 bits, as a pinhole camera sees it; alpha is dropped."""
        try:
            image_u8 = rgb_from(self.rows, self.encoding, swap_bytes=self.swap_bytes)
        except ValueError as error:
            found = str(error)
            raise codec.MalformedMessageError(type_name=schema.IMAGE, found=found) from error
        return image_u8 if self.lens is None else self.lens.color(image_u8)

    def as_file(self, encode: Callable[[np.ndarray], bytes] = encode_jpeg) -> bytes:
        """A file to be shown."""
        return encode(self.image_u8())


def color_from_message(
    type_name: str, data: bytes, lens: Straightening | None = None
) -> CompressedColor | RawColor:
    """Read a colour image; both kinds have ``stamp_ns``, ``image_u8()`` and ``as_file()``."""
    kind = RawColor if type_name == schema.IMAGE else CompressedColor
    return replace(kind.from_cdr(data), lens=lens)


@dataclass(frozen=True, kw_only=True)
class DepthImage:
    """Depth along the optical axis in whole millimetres; 0 is "no measurement"."""

    stamp_ns: int
    frame_id: str
    depth_mm: UInt16[np.ndarray, "height width"]

    def to_cdr(self) -> bytes:
        """Serialise as sensor_msgs/Image with encoding 16UC1."""
        height, width = self.depth_mm.shape
        message = {
            "header": header(self.stamp_ns, self.frame_id),
            "height": height,
            "width": width,
            "encoding": "16UC1",
            "is_bigendian": 0,
            "step": 2 * width,
            "data": self.depth_mm.astype("<u2").tobytes(),
        }
        return codec.encode(schema.IMAGE, message)

    @staticmethod
    def from_cdr(data: bytes) -> "DepthImage":
        """Read a sensor_msgs/Image; refuses other encodings and sizes that do not match.

        Metres of encoding 32FC1 are rounded to whole millimetres.
        """
        header = image_header(data)
        if header.encoding not in (*DEPTH_ENCODINGS, FLOAT_DEPTH):
            raise no_encoding(header.encoding, (*DEPTH_ENCODINGS, FLOAT_DEPTH))
        rows, order = np.ascontiguousarray(pixel_rows(header)), "<>"[bool(header.is_bigendian)]
        if header.encoding == FLOAT_DEPTH:
            depth_mm = depth.from_metres(rows.view(f"{order}f4").astype(np.float32))
        else:
            depth_mm = rows.view(f"{order}u2").astype(np.uint16)
        return DepthImage(stamp_ns=header.stamp_ns, frame_id=header.frame_id, depth_mm=depth_mm)

    @staticmethod
    def from_message(
        type_name: str, data: bytes, lens: Straightening | None = None
    ) -> "DepthImage":
        """Read depth in any form an episode may hold: raw, or compressed as RVL or PNG."""
        if type_name == schema.IMAGE:
            return DepthImage.from_cdr(data).through(lens)
        image = CompressedColor.from_cdr(data)
        return DepthImage(
            stamp_ns=image.stamp_ns,
            frame_id=image.frame_id,
            depth_mm=depth.unpack(image.format, image.data),
        ).through(lens)

    def through(self, lens: Straightening | None) -> "DepthImage":
        """As a pinhole camera sees it."""
        return self if lens is None else replace(self, depth_mm=lens.depth(self.depth_mm))

    def depth_m(self) -> Float[np.ndarray, "height width"]:
        """Depth in metres, 0 where there is no measurement."""
        return self.depth_mm.astype(np.float32) * np.float32(1e-3)


@dataclass(frozen=True, kw_only=True)
class CameraInfo:
    """Intrinsics of one image stream and the frame its images are taken in."""

    stamp_ns: int
    frame_id: str
    camera: Camera
    """The pinhole camera of the images as they are read: those of a lens are straightened."""
    lens: Straightening | None = None

    def to_cdr(self) -> bytes:
        """Serialise as sensor_msgs/CameraInfo, of images without distortion."""
        fx, fy, cx, cy = self.camera.to_ros()
        message = {
            "header": header(self.stamp_ns, self.frame_id),
            "height": self.camera.height,
            "width": self.camera.width,
            "distortion_model": "plumb_bob",
            "d": [0.0] * 5,
            "k": [fx, 0, cx, 0, fy, cy, 0, 0, 1],
            "r": [1, 0, 0, 0, 1, 0, 0, 0, 1],
            "p": [fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0],
        }
        return codec.encode(schema.CAMERA_INFO, message)

    @staticmethod
    def from_cdr(data: bytes) -> "CameraInfo":
        """Read a sensor_msgs/CameraInfo; refuses what it cannot use instead of ignoring it."""
        message, found = codec.decode(schema.CAMERA_INFO, data), ""
        k = message["k"]
        camera = Camera.from_ros(
            width=message["width"],
            height=message["height"],
            fx=float(k[0]),
            fy=float(k[4]),
            cx=float(k[2]),
            cy=float(k[5]),
        )
        if not (np.isfinite(k).all() and min(k[0], k[4], camera.width, camera.height) > 0):
            size = f"images of {message['width']} x {message['height']}"
            found = f"focal lengths of {k[0]:g} and {k[4]:g} pixels, {size}; calibrate the camera"
        elif k[1] or max(message["binning_x"], message["binning_y"]) > 1:
            found = f"skew of {k[1]:g}, or binned images; publish what K says of the images as sent"
        numbers = tuple(map(float, message["d"]))
        lens = None if found else straightening(message["distortion_model"], numbers, camera)
        if isinstance(lens, LensError):
            found = f"{lens}; calibrate the camera, or publish rectified images with zeros in D"
        if found or isinstance(lens, LensError):
            hint = "Mend what publishes it."
            raise codec.MalformedMessageError(type_name=schema.CAMERA_INFO, found=found, hint=hint)
        return CameraInfo(
            stamp_ns=stamp_of(message),
            frame_id=message["header"]["frame_id"],
            camera=camera if lens is None else lens.camera,
            lens=lens,
        )


@dataclass(frozen=True, kw_only=True)
class FrameTransform:
    """``T_parent_child`` at one instant."""

    stamp_ns: int
    parent: str
    child: str
    T_parent_child: Float[np.ndarray, "4 4"]


def _pose_fields(
    T: Float[np.ndarray, "4 4"], position: str, rotation: str
) -> dict[str, dict[str, float]]:
    q, p = se3.split(T)
    return {
        position: dict(zip("xyz", map(float, p), strict=True)),
        rotation: dict(zip("wxyz", map(float, q), strict=True)),
    }


def _transform_of(
    position: dict[str, float], rotation: dict[str, float], *, type_name: str
) -> Float[np.ndarray, "4 4"]:
    q = np.array([rotation[axis] for axis in "wxyz"])
    if not 1e-6 < np.linalg.norm(q) < 1e6:
        raise codec.MalformedMessageError(type_name=type_name, found=f"{q} (wxyz) is no rotation")
    return se3.transform_from(q, np.array([position[axis] for axis in "xyz"]))


def transforms_to_cdr(transforms: list[FrameTransform]) -> bytes:
    """Serialise as tf2_msgs/TFMessage."""
    items = [
        {
            "header": header(item.stamp_ns, item.parent),
            "child_frame_id": item.child,
            "transform": _pose_fields(item.T_parent_child, "translation", "rotation"),
        }
        for item in transforms
    ]
    return codec.encode(schema.TF_MESSAGE, {"transforms": items})


def transforms_from_cdr(data: bytes) -> list[FrameTransform]:
    """Read a tf2_msgs/TFMessage."""
    return [
        FrameTransform(
            stamp_ns=stamp_of(item),
            parent=item["header"]["frame_id"],
            child=item["child_frame_id"],
            T_parent_child=_transform_of(
                item["transform"]["translation"],
                item["transform"]["rotation"],
                type_name=schema.TF_MESSAGE,
            ),
        )
        for item in codec.decode(schema.TF_MESSAGE, data)["transforms"]
    ]


@dataclass(frozen=True, kw_only=True)
class PoseSample:
    """Pose ``T_frame_body`` of one body at one instant (geometry_msgs/PoseStamped)."""

    stamp_ns: int
    frame_id: str
    T_frame_body: Float[np.ndarray, "4 4"]

    def to_cdr(self) -> bytes:
        """Serialise as geometry_msgs/PoseStamped."""
        message = {
            "header": header(self.stamp_ns, self.frame_id),
            "pose": _pose_fields(self.T_frame_body, "position", "orientation"),
        }
        return codec.encode(schema.POSE_STAMPED, message)

    @staticmethod
    def from_cdr(data: bytes) -> "PoseSample":
        """Read a geometry_msgs/PoseStamped."""
        message = codec.decode(schema.POSE_STAMPED, data)
        pose = message["pose"]
        return PoseSample(
            stamp_ns=stamp_of(message),
            frame_id=message["header"]["frame_id"],
            T_frame_body=_transform_of(
                pose["position"], pose["orientation"], type_name=schema.POSE_STAMPED
            ),
        )


def string_to_cdr(text: str) -> bytes:
    """Serialise as std_msgs/String."""
    return codec.encode(schema.STRING, {"data": text})


def string_from_cdr(data: bytes) -> str:
    """Read a std_msgs/String."""
    return str(codec.decode(schema.STRING, data)["data"])


FLOAT32 = 7
"""PointField's number for this type."""
POINT_STEP = 12


@dataclass(frozen=True, kw_only=True)
class PointCloudSample:
    """Points of one body at one instant."""

    stamp_ns: int
    frame_id: str
    points_m: Float[np.ndarray, "num_points 3"]

    def to_cdr(self) -> bytes:
        """Serialise as sensor_msgs/PointCloud2."""
        count = len(self.points_m)
        message = {
            "header": header(self.stamp_ns, self.frame_id),
            "height": 1,
            "width": count,
            "fields": [
                {"name": name, "offset": 4 * index, "datatype": FLOAT32, "count": 1}
                for index, name in enumerate("xyz")
            ],
            "point_step": POINT_STEP,
            "row_step": POINT_STEP * count,
            "data": self.points_m.astype("<f4").tobytes(),
            "is_dense": True,
        }
        return codec.encode(schema.POINT_CLOUD, message)

    @staticmethod
    def from_cdr(data: bytes) -> "PointCloudSample":
        """Read a cloud as ``to_cdr`` writes it."""
        message = codec.decode(schema.POINT_CLOUD, data)
        layout = [(item["name"], item["offset"], item["datatype"]) for item in message["fields"]]
        raw, count = bytes(message["data"]), int(message["width"]) * int(message["height"])
        if (
            layout != [(name, 4 * index, FLOAT32) for index, name in enumerate("xyz")]
            or message["is_bigendian"]
            or int(message["point_step"]) != POINT_STEP
            or len(raw) != POINT_STEP * count
        ):
            raise codec.MalformedMessageError(
                type_name=schema.POINT_CLOUD, found=f"fields {layout} over {len(raw)} bytes"
            )
        return PointCloudSample(
            stamp_ns=stamp_of(message),
            frame_id=message["header"]["frame_id"],
            points_m=np.frombuffer(raw, dtype="<f4").reshape(-1, 3).astype(np.float64),
        )
