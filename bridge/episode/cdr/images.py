"""Turn raw camera images into what an episode holds: JPEG colour, RVL depth.

Each function takes and returns whole CDR messages, may be called from many threads, and spends
its time outside Python's lock. Bytes that are no image raise ``MalformedMessageError`` and
nothing else; an encoding that is no business of the function gives None.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import UInt8

from bridge.clock import join_ns
from bridge.episode import schema
from bridge.episode.cdr.codec import Buffer, MalformedMessageError, decode, encode
from bridge.episode.topics import COLOR_TOPIC, DEPTH_IMAGE
from bridge.media.color import JPEG_QUALITY, MAX_PIXELS, encode_jpeg
from bridge.media.depth import RVL_FORMAT, pack_rvl
from bridge.media.pixels import COLORS, YUV420, YUV422, num_rows, pixel_bytes

COLOR_LAYOUTS = {"mono8": ("GRAY", 1)} | {
    f"{name}8": (name.upper(), len(name)) for name in ("rgb", "bgr", "rgba", "bgra")
}
"""Colour encodings that JPEG takes as they are: the order of their channels, and how many."""
SUBSAMPLING = "420"
"""Half the work and the size of full colour; cameras interpolate their colour anyway."""
DEPTH_ENCODINGS = ("16UC1", "mono16")
FLOAT_DEPTH = "32FC1"
"""Depth in metres; NaN, infinity and 0 are no measurement (REP 118)."""


@dataclass(frozen=True, kw_only=True)
class ImageHeader:
    """Everything a sensor_msgs/Image says of itself, and its pixels, which are not copied."""

    header: dict[str, Any]
    height: int
    width: int
    encoding: str
    is_bigendian: int
    step: int
    data: memoryview

    @property
    def stamp_ns(self) -> int:
        """Source time [ns]."""
        return join_ns(**self.header["stamp"])

    @property
    def frame_id(self) -> str:
        """Where it was taken."""
        return str(self.header["frame_id"])


def _malformed(found: str) -> MalformedMessageError:
    return MalformedMessageError(type_name=schema.IMAGE, found=found)


def image_header(data: Buffer) -> ImageHeader:
    """Read a sensor_msgs/Image without touching its pixels."""
    return ImageHeader(**decode(schema.IMAGE, data))


def pixel_rows(header: ImageHeader) -> UInt8[np.ndarray, "rows row"]:
    """View the pixels of a message, row padding cut off; nothing is copied."""
    height, width, step, encoding = header.height, header.width, header.step, header.encoding
    depth_bytes = 4 if encoding == FLOAT_DEPTH else 2
    row = width * (pixel_bytes(encoding) if encoding in COLORS else depth_bytes)
    rows = num_rows(encoding, height)
    if not 0 < height * width <= MAX_PIXELS:
        raise _malformed(f"an image of {width} x {height} pixels")
    if (encoding in YUV422 and width % 2) or (encoding in YUV420 and (width % 2 or height % 2)):
        raise _malformed(f"{width} x {height} pixels of {encoding}, which come in pairs")
    if step < row:
        raise _malformed(f"a step of {step} bytes for rows of {width} {encoding} pixels")
    if len(header.data) != step * rows:
        raise _malformed(f"{len(header.data)} bytes for {rows} rows of {step}")
    return np.frombuffer(header.data, np.uint8).reshape(rows, step)[:, :row]


def check_image(topic: str, header: ImageHeader) -> None:
    """Refuse an image that nobody could read: of a strange encoding, or of another size."""
    depths = (*DEPTH_ENCODINGS, FLOAT_DEPTH)
    known = depths if topic.endswith(DEPTH_IMAGE) else COLORS if COLOR_TOPIC.search(topic) else None
    if header.encoding not in (known or (*COLORS, *depths)):
        raise no_encoding(header.encoding, known or (*COLORS, *depths))
    pixel_rows(header)


def no_encoding(encoding: str, known: Iterable[str]) -> MalformedMessageError:
    """Say that an encoding cannot be read here, and which can."""
    hint = f"Have the camera send one of {', '.join(known)}."
    found = f"encoding {encoding!r} cannot be read"
    return MalformedMessageError(type_name=schema.IMAGE, found=found, hint=hint)


def image_to_jpeg(header: ImageHeader, quality: int = JPEG_QUALITY) -> bytes | None:
    """Make a raw image of ``COLOR_LAYOUTS`` a CompressedImage; None of another encoding."""
    if header.encoding not in COLOR_LAYOUTS:
        return None
    layout, channels = COLOR_LAYOUTS[header.encoding]
    image_u8 = pixel_rows(header).reshape(header.height, header.width, channels)
    try:
        jpeg = encode_jpeg(image_u8, quality, layout=layout, subsampling=SUBSAMPLING)
    except ValueError as error:
        raise _malformed(str(error)) from error
    return _compressed_image(header, "jpeg", [jpeg])


def depth_to_compact(header: ImageHeader) -> bytes | None:
    """Make a raw depth image of 16 bits a CompressedImage without loss; None of another one."""
    if header.encoding not in DEPTH_ENCODINGS:
        return None
    packed = pack_rvl(pixel_rows(header), swap_bytes=bool(header.is_bigendian))
    return _compressed_image(header, RVL_FORMAT, packed)


def _compressed_image(header: ImageHeader, image_format: str, data: list[bytes]) -> bytes:
    message = {"header": header.header, "format": image_format, "data": b"".join(data)}
    return encode(schema.COMPRESSED_IMAGE, message)
