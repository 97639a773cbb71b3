"""Messages as cells send them, for the publisher's process and the tests."""

import io

import numpy as np
from PIL import Image

from bridge.episode import schema
from bridge.episode.cdr import codec
from bridge.episode.cdr.messages import CompressedColor, DepthImage, JointSample

STAMP = slice(4, 12)
"""Where a stamped CDR message holds its stamp; another one makes another message."""
NUMBER = b"number: "
"""In the comment of a JPEG: eight digits behind it make another picture of it."""
JOINTS, GRIPPER = "/cell/joint_states", "/cell/gripper/state"
COLOR, DEPTH, RAW = (
    "/cell/cam/a/color/image",
    "/cell/cam/a/depth/image",
    "/cell/cam/raw/color/image",
)
MIX = ("joints", "gripper", "color", "depth")


def joints(number: int = 0, count: int = 6) -> bytes:
    return JointSample(
        stamp_ns=number,
        names=tuple(f"joint_{index}" for index in range(count)),
        position=np.linspace(0, number, count),
        velocity=np.zeros(count),
        effort=np.zeros(0),
    ).to_cdr()


def image(pixels: np.ndarray, encoding: str, **fields: object) -> bytes:
    """A sensor_msgs/Image; ``fields`` replace what would be true."""
    height, width = pixels.shape[:2]
    message = {
        "header": {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": "a"},
        "height": height,
        "width": width,
        "encoding": encoding,
        "is_bigendian": 0,
        "step": pixels[0].nbytes,
        "data": pixels.tobytes(),
        **fields,
    }
    return codec.encode(schema.IMAGE, message)


def jpeg(height: int = 480, width: int = 640) -> bytes:
    rng = np.random.default_rng(3)
    blocks = rng.integers(0, 255, (height // 8, width // 8, 3), np.uint8)
    stream = io.BytesIO()
    picture = Image.fromarray(blocks.repeat(8, axis=0).repeat(8, axis=1))
    picture.save(stream, "JPEG", comment=NUMBER + b"0" * 8)
    return stream.getvalue()


def color(data: bytes) -> bytes:
    return CompressedColor(stamp_ns=0, frame_id="a", format="jpeg", data=data).to_cdr()


def depth_mm(height: int = 240, width: int = 320) -> np.ndarray:
    noise = np.random.default_rng(7).normal(0, 3, (height, width))
    return (np.linspace(400, 4000, width)[None, :] + noise).astype(np.uint16)


def streams() -> dict[str, tuple[str, str, int, bytes]]:
    """Topic, type, ticks of 2 ms between two messages, and a message of each stream."""
    depth = DepthImage(stamp_ns=0, frame_id="a", depth_mm=depth_mm())
    pixels = np.random.default_rng(5).integers(0, 255, (480, 640, 3), np.uint8)
    return {
        "joints": (JOINTS, schema.JOINT_STATE, 1, joints()),
        "gripper": (GRIPPER, schema.JOINT_STATE, 5, joints(count=1)),
        "color": (COLOR, schema.COMPRESSED_IMAGE, 16, color(jpeg())),
        "depth": (DEPTH, schema.IMAGE, 16, depth.to_cdr()),
        "raw": (RAW, schema.IMAGE, 16, image(pixels, "rgb8")),
    }
